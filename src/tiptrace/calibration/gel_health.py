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
from tiptrace.perception.markers import check_image, detect_markers, dot_mask
from tiptrace.perception.poisson import PoissonSolver
from tiptrace.perception.seeding import seed
from tiptrace.types import FloatArray, Image

# limits of the traffic light: (good up to, worn from)
LIMITS: dict[str, tuple[float, float]] = {
    "flatness_um": (25.0, 80.0),
    "curl": (0.15, 0.30),
    "illumination_change": (0.05, 0.15),
    "dots_lost": (0.0, 3.0),
    "dots_moved_px": (0.5, 2.0),
}
_STEEP = 0.08  # slope change above which an image shows a contact
_SMOOTH_PX = 2.0  # of 320: noise of single pixels is no wear


@dataclass(frozen=True, slots=True)
class GelHealth:
    """Scores of one image against the untouched gel as it was at calibration.

    Attributes:
        touched: Whether the image shows a contact; flatness is then of the rest of the gel.
        flatness_um: Rms height of untouched gel against the reference, tilt removed.
        curl: Rms curl of the slope field over its rms variation in a contact; a surface has none, a network that no
            longer fits the gel makes some. NaN on untouched gel, where there is nothing but noise.
        illumination_change: Largest change of a channel's brightness against the reference, as a share.
        dots: Dots found.
        dots_lost: Dots of the reference that are gone or have merged.
        dots_moved_px: Median displacement of the others; NaN where the gel is touched.
    """

    touched: bool
    flatness_um: float
    curl: float
    illumination_change: float
    dots: int
    dots_lost: int
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
    background: NDArray[np.float32],
    flat: NDArray[np.float32],
    gel: GelModel,
    metres_per_px: tuple[float, float],
) -> GelHealth:
    check_image(image)
    if image.shape != reference.shape:
        raise CalibrationError(
            f"image is {image.shape[1]}×{image.shape[0]} px, the reference {reference.shape[1]}×{reference.shape[0]}: "
            "take both with the same crop"
        )
    mask = dot_mask(image)
    open_gel = ~mask & ~dot_mask(reference)
    gain = np.array(
        [np.median(image[open_gel][:, c] / np.maximum(background[open_gel][:, c], 1.0)) for c in range(3)]
    )
    change = measured_slopes(gel, image, background * gain.astype(np.float32), mask) - flat
    sigma = _SMOOTH_PX * image.shape[1] / 320.0
    change = np.asarray(cv2.GaussianBlur(change, (0, 0), sigma), dtype=np.float32)
    steep = np.hypot(change[..., 0], change[..., 1])
    touched = bool(np.mean(steep > _STEEP) > 0.01)
    calm = (
        np.asarray(cv2.blur((steep > _STEEP / 2).astype(np.float32), (31, 31)) == 0) if touched else steep < 1
    )
    dots, lost, moved = _dots(image, reference)
    return GelHealth(
        touched=touched,
        flatness_um=_flatness_um(change, calm, metres_per_px),
        curl=_curl(change, ~mask) if touched else float("nan"),
        illumination_change=float(np.abs(gain - 1.0).max()),
        dots=dots,
        dots_lost=lost,
        dots_moved_px=float("nan") if touched else moved,
    )


def _flatness_um(change: NDArray[np.float32], calm: NDArray[np.bool_], s: tuple[float, float]) -> float:
    """Rms height of calm gel after its plane is taken away, µm; NaN where there is none."""
    if int(calm.sum()) < 100:
        return float("nan")
    H, W = calm.shape
    z = PoissonSolver((H, W), s).integrate(change[..., 0], change[..., 1])
    v, u = np.nonzero(calm)
    A = np.stack([np.ones(len(u)), u, v], axis=1).astype(np.float64)
    y = z[calm].astype(np.float64)
    residual = y - A @ np.linalg.lstsq(A, y, rcond=None)[0]
    return float(np.sqrt(np.mean(residual**2))) * 1e6


def _curl(change: NDArray[np.float32], seen: NDArray[np.bool_]) -> float:
    """Rms of ∂q/∂x − ∂p/∂y over the rms of all first derivatives."""
    p_y, p_x = (np.gradient(change[..., 0], axis=axis) for axis in (0, 1))
    q_y, q_x = (np.gradient(change[..., 1], axis=axis) for axis in (0, 1))
    inner = np.asarray(cv2.erode(seen.astype(np.uint8), np.ones((5, 5), np.uint8)), dtype=np.bool_)
    total = float(np.sqrt(np.mean((p_x**2 + p_y**2 + q_x**2 + q_y**2)[inner])))
    curl = float(np.sqrt(np.mean(((q_x - p_y) ** 2)[inner])))
    return curl / max(total, 1e-9) / float(np.sqrt(2.0))


def _dots(image: Image, reference: Image) -> tuple[int, int, float]:
    """Dots found, dots of the reference that are missing, median displacement (px)."""
    try:
        known = len(detect_markers(reference))
    except PerceptionError:
        return 0, 0, float("nan")
    try:
        seeds = seed(image, reference)
    except PerceptionError:
        return 0, known, float("nan")
    moved: FloatArray = np.linalg.norm(seeds.markers.uv_px - seeds.rest_px, axis=1)
    return len(seeds.markers), max(known - len(seeds.markers), 0), float(np.median(moved))
