"""Health of a gel from a few images: wear is told before it costs a trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.calibration.gel_evaluation import measured_slopes
from tiptrace.errors import CalibrationError, PerceptionError
from tiptrace.perception.background import untouched_background
from tiptrace.perception.gel_model import GelModel
from tiptrace.perception.lifting import sample_map
from tiptrace.perception.markers import check_image, detect_markers, dot_contrast, dot_mask
from tiptrace.perception.poisson import PoissonSolver
from tiptrace.perception.seeding import seed
from tiptrace.types import BoolArray, FloatArray, Image

Float32Map = NDArray[np.float32]

# limits of the traffic light: (good up to, worn from)
LIMITS: dict[str, tuple[float, float]] = {
    "flatness_um": (25.0, 80.0),
    "curl_per_mm": (0.10, 0.40),
    "curl_in_contact": (0.15, 0.30),
    "illumination_change": (0.05, 0.15),
    "dots_lost": (0.0, 3.0),
    "dots_merged": (0.0, 3.0),
    "dots_moved_px": (0.5, 2.0),
}
_STEEP = 0.08  # slope change above which an image may show a contact …
_DEEP_M = 50e-6  # … if the gel is pressed in by so much
_SMOOTH_PX = 2.0  # of 320: noise of single pixels is no wear
_SCRATCH = 99.8  # percentile of the curl: a scratch is a small part of the image
_BLOCKS = (4, 3)  # of the image, whose brightness is compared
_LEAST_GREY = 30.0  # a channel darker than this cannot change by much of itself
_INK = 0.5  # of the dots' contrast, above which the gel between two dots, or anything else, is ink


@dataclass(frozen=True, slots=True)
class GelHealth:
    """Scores of one image against the untouched gel as it was at calibration.

    Attributes:
        touched: Whether the image shows a contact; flatness and curl are then of the rest of the gel.
        flatness_um: Rms height of untouched gel against the reference, tilt removed.
        curl_per_mm: Curl of the slope field on untouched gel, 99.8th percentile. Whatever changes colour without
            being a surface (a scratch, a worn coating, dirt) has some.
        curl_in_contact: Rms curl over the rms of all slope derivatives in a contact; a surface has none, a network
            that no longer fits the gel makes some. NaN on untouched gel.
        illumination_change: Largest change of a channel's brightness in any part of the image, as a share.
        dots: Dots found.
        dots_lost: Dots of the reference that are gone.
        dots_merged: Pairs of neighbouring dots that have run into each other.
        dots_moved_px: Median displacement of the dots; NaN where the gel is touched.
    """

    touched: bool
    flatness_um: float
    curl_per_mm: float
    curl_in_contact: float
    illumination_change: float
    dots: int
    dots_lost: int
    dots_merged: int
    dots_moved_px: float

    def verdicts(self) -> dict[str, str]:
        """``good``, ``watch`` or ``worn`` for each score."""
        result = {}
        for name, (good, worn) in LIMITS.items():
            value = float(getattr(self, name))
            if np.isnan(value):
                continue
            result[name] = "good" if value <= good else "watch" if value < worn else "worn"
        return result


def check_gel(
    images: Sequence[Image], reference: Image, gel: GelModel, metres_per_px: tuple[float, float]
) -> list[GelHealth]:
    """Score images of a gel, (H, W, 3) uint8 BGR each, against its reference.

    Raises:
        CalibrationError: no images, or one of another size than the reference.
        PerceptionError: an image that is black or overexposed.
    """
    if not images:
        raise CalibrationError("no image to check: take at least one of the untouched gel")
    check_image(reference)
    background = untouched_background(reference)
    flat = measured_slopes(gel, reference, background, dot_mask(reference))
    return [_score(image, reference, background, flat, gel, metres_per_px) for image in images]


def _score(
    image: Image,
    reference: Image,
    background: Float32Map,
    flat: Float32Map,
    gel: GelModel,
    metres_per_px: tuple[float, float],
) -> GelHealth:
    check_image(image)
    if image.shape != reference.shape:
        raise CalibrationError(
            f"image is {image.shape[1]}×{image.shape[0]} px, the reference {reference.shape[1]}×{reference.shape[0]}: "
            "take both with the same crop"
        )
    mask = dot_mask(image) | dot_mask(reference) | _other_ink(image)
    ratio = image / np.maximum(background, _LEAST_GREY)  # (H, W, 3)
    expected = background / np.maximum(background, _LEAST_GREY)
    gain = np.array([np.median(image[~mask, c] / np.maximum(background[~mask, c], 1.0)) for c in range(3)])
    change = measured_slopes(gel, image, background * gain.astype(np.float32), mask) - flat
    sigma = _SMOOTH_PX * image.shape[1] / 320.0
    change = np.asarray(cv2.GaussianBlur(change, (0, 0), sigma), dtype=np.float32)
    z = PoissonSolver(mask.shape, metres_per_px).integrate(change[..., 0], change[..., 1])
    steep = np.hypot(change[..., 0], change[..., 1])
    pressed = float(np.median(z) - np.percentile(z, 1))
    touched = bool(np.mean(steep > _STEEP) > 0.01) and pressed > _DEEP_M
    calm = np.ones(mask.shape, dtype=np.bool_)
    if touched:
        calm = np.asarray(cv2.blur((steep > _STEEP / 2).astype(np.float32), (31, 31)) == 0)
    dots, lost, merged, moved = _dots(image, reference)
    nan = float("nan")
    return GelHealth(
        touched=touched,
        flatness_um=_flatness_um(z, calm),
        curl_per_mm=_curl_per_mm(change, calm & ~mask, metres_per_px),
        curl_in_contact=_curl_in_contact(change, ~mask) if touched else nan,
        illumination_change=float(np.abs(gain - 1.0).max())
        if touched
        else _brightness(ratio - expected, mask),
        dots=dots,
        dots_lost=lost,
        dots_merged=merged,
        dots_moved_px=nan if touched else moved,
    )


def _other_ink(image: Image) -> BoolArray:
    """Dark spots that are no dots (merged dots, dirt), grown by two pixels; (H, W)."""
    contrast = dot_contrast(image)
    dots = contrast[dot_mask(image, 0)]
    if dots.size < 100:
        return np.zeros(contrast.shape, dtype=np.bool_)
    ink = (contrast > _INK * float(np.percentile(dots, 80))).astype(np.uint8)
    return np.asarray(cv2.dilate(ink, np.ones((5, 5), np.uint8)), dtype=np.bool_)


def _brightness(change: NDArray[np.floating], mask: BoolArray) -> float:
    """Largest median change of a channel over the image's blocks, from changes (H, W, 3)."""
    H, W = mask.shape
    largest = 0.0
    for rows in np.array_split(np.arange(H), _BLOCKS[1]):
        for columns in np.array_split(np.arange(W), _BLOCKS[0]):
            part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            seen = change[part][~mask[part]]
            if len(seen):
                largest = max(largest, float(np.abs(np.median(seen, axis=0)).max()))
    return largest


def _flatness_um(z: Float32Map, calm: BoolArray) -> float:
    """Rms height of calm gel after its plane is taken away, µm; NaN where there is none."""
    if int(calm.sum()) < 100:
        return float("nan")
    v, u = np.nonzero(calm)
    A = np.stack([np.ones(len(u)), u, v], axis=1).astype(np.float64)
    y = z[calm].astype(np.float64)
    residual = y - A @ np.linalg.lstsq(A, y, rcond=None)[0]
    return float(np.sqrt(np.mean(residual**2))) * 1e6


def _derivatives(change: Float32Map, seen: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Curl (n,) and sum of squares of all four derivatives (n,), per pixel, where all around is seen."""
    p_y, p_x = (np.gradient(change[..., 0], axis=axis) for axis in (0, 1))
    q_y, q_x = (np.gradient(change[..., 1], axis=axis) for axis in (0, 1))
    inner = np.asarray(cv2.erode(seen.astype(np.uint8), np.ones((5, 5), np.uint8)), dtype=np.bool_)
    return (q_x - p_y)[inner], (p_x**2 + p_y**2 + q_x**2 + q_y**2)[inner]


def _curl_per_mm(change: Float32Map, seen: BoolArray, s: tuple[float, float]) -> float:
    """Nearly the largest curl on gel that is seen; NaN where there is none."""
    curl, _ = _derivatives(change, seen)
    if len(curl) < 100:
        return float("nan")
    return float(np.percentile(np.abs(curl), _SCRATCH)) / (float(np.mean(s)) * 1e3)


def _curl_in_contact(change: Float32Map, seen: BoolArray) -> float:
    """Rms of ∂q/∂x − ∂p/∂y over the rms of all first derivatives."""
    curl, squares = _derivatives(change, seen)
    if not len(curl):
        return float("nan")
    return float(np.sqrt(np.mean(curl**2) / max(float(np.mean(squares)), 1e-18) / 2.0))


def _dots(image: Image, reference: Image) -> tuple[int, int, int, float]:
    """Dots found, dots of the reference that are missing, pairs that have merged, median displacement (px)."""
    nan = float("nan")
    try:
        known = detect_markers(reference).uv_px
    except PerceptionError:
        return 0, 0, 0, nan
    try:
        seeds = seed(image, reference)
    except PerceptionError:
        return 0, len(known), 0, nan
    uv, rest = seeds.markers.uv_px, seeds.rest_px
    distance = np.linalg.norm(known[:, None] - rest[None], axis=2)
    lost = int((distance.min(axis=1) > 1.0).sum())
    same = distance.min(axis=0) < 1.0
    moved: FloatArray = np.linalg.norm(uv - rest, axis=1)[same]
    return len(uv), lost, _merged(dot_contrast(image), uv), float(np.median(moved)) if len(moved) else nan


def _merged(contrast: Float32Map, uv: FloatArray) -> int:
    """Pairs of neighbours at places (n, 2) with ink half way between them."""
    distance = np.linalg.norm(uv[:, None] - uv[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    first, second = np.nonzero(np.triu(distance < 1.3 * np.median(distance.min(axis=1))))
    between = sample_map(contrast, 0.5 * (uv[first] + uv[second]))
    return int((between > _INK * np.median(sample_map(contrast, uv))).sum())
