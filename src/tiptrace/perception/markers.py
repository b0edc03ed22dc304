"""Marker dots in a single image, without knowing their grid (paper, Sec. II-B, marker tracking).

A dot is a compact dark spot on a brighter gel. The gel's own brightness varies a lot (its corners are darker
than the dots in the middle), so darkness is measured against a local background: the morphological closing,
which removes everything dark that is narrower than its kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.errors import PerceptionError
from tiptrace.types import BoolArray, FloatArray, Image

MIN_MARKERS = 11  # drop 3, keep 8 (paper, marker selection)
_MAX_DIAMETER = 24.0 / 320.0  # of the image's width
_MIN_DIAMETER_PX = 3.0
_MIN_CONTRAST = 0.12  # of the local background
_PITCH_TOLERANCE = 0.25
_DARK, _BRIGHT = 12.0, 250.0  # mean grey level of a frame beyond which nothing can be seen

Contrast = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Markers:
    """Dots of one image.

    Attributes:
        uv_px: (n, 2) centres, sub-pixel, row by row of the image from the top.
        diameter_px: (n,) diameter of a disc with the dot's area.
    """

    uv_px: FloatArray
    diameter_px: FloatArray

    def __len__(self) -> int:
        return len(self.uv_px)


def check_image(image: Image, size_px: tuple[int, int] | None = None) -> None:
    """Refuse an image on which nothing can be measured.

    Args:
        image: (H, W, 3) uint8.
        size_px: (W, H) that the rig says, if it is known.

    Raises:
        PerceptionError: not (H, W, 3) uint8, of another size, black, or overexposed.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise PerceptionError(
            f"tactile image must be (height, width, 3) uint8 in BGR order, got {image.shape} {image.dtype}"
        )
    H, W = image.shape[:2]
    if size_px is not None and tuple(size_px) != (W, H):
        raise PerceptionError(
            f"tactile image is {W}×{H} px, the rig says {size_px[0]}×{size_px[1]}: set image_size_px to "
            "the size of the recorded images (mm_per_px belongs to that size)"
        )
    mean = float(np.mean(cv2.mean(image)[:3]))
    if mean < _DARK:
        raise PerceptionError(
            f"tactile image is black (mean grey level {mean:.0f} of 255): check lamps and cable"
        )
    if mean > _BRIGHT:
        raise PerceptionError(
            f"tactile image is overexposed (mean grey level {mean:.0f} of 255): lower the exposure"
        )


def dot_contrast(image: Image) -> Contrast:
    """How dark each pixel is against its surroundings: 0 gel, towards 1 ink; (H, W) float32.

    The closing is blurred so that its own steps do not shift the dots' weighted centroids.
    """
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (0, 0), 0.7).astype(np.float32)
    k = 2 * round(_MAX_DIAMETER * image.shape[1] * 0.65) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (k, k))
    background = cv2.morphologyEx(grey, cv2.MORPH_CLOSE, kernel)
    background = cv2.GaussianBlur(background, (0, 0), k / 6.0)
    return np.asarray(np.maximum(1.0 - grey / np.maximum(background, 1.0), 0.0), dtype=np.float32)


def detect_markers(image: Image) -> Markers:
    """Find the dots. Grid, pitch and size need not be known; dots cut by the image's border are left out.

    Args:
        image: (H, W, 3) uint8 BGR.

    Raises:
        PerceptionError: an unusable image, or fewer than 11 markers.
    """
    check_image(image)
    contrast = dot_contrast(image)
    markers = _measure(contrast, _dot_regions(contrast))
    if len(markers) < MIN_MARKERS:
        raise PerceptionError(
            f"found {len(markers)} markers, need at least {MIN_MARKERS}: "
            "is this a marker gel, in focus and evenly lit?"
        )
    return markers


def detect_cut_dots(image: Image) -> FloatArray:
    """Centres (c, 2) px of the visible parts of dots that the image's border cuts."""
    H, W = image.shape[:2]
    centres = []
    for outline in _dot_regions(dot_contrast(image), on_border=True):
        u, v, w, h = cv2.boundingRect(outline)
        if u <= 0 or v <= 0 or u + w >= W or v + h >= H:
            centres.append((u + (w - 1) / 2, v + (h - 1) / 2))
    return np.asarray(centres, dtype=np.float64).reshape(-1, 2)


def check_pitch(markers: Markers, pitch_mm: float | None, mm_per_px: tuple[float, float]) -> None:
    """Refuse a gel whose dots are not as far apart as the rig says.

    Raises:
        PerceptionError: the median distance to the nearest marker is off by more than a quarter.
    """
    if pitch_mm is None:
        return
    xy = markers.uv_px * np.asarray(mm_per_px)
    distance = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    seen = float(np.median(distance.min(axis=1)))
    if abs(seen / pitch_mm - 1.0) > _PITCH_TOLERANCE:
        raise PerceptionError(
            f"markers are {seen:.2f} mm apart at mm_per_px = {mm_per_px[0]:g}, the rig says {pitch_mm:g} mm: "
            "another gel is mounted, or mm_per_px belongs to another crop"
        )


def dot_mask(image: Image, margin_px: int = 2) -> BoolArray:
    """Pixels of dots, those cut by the border included, grown by a margin; (H, W). No minimum number."""
    mask = np.zeros(image.shape[:2], dtype=np.uint8)
    cv2.drawContours(mask, _dot_regions(dot_contrast(image), on_border=True), -1, 1, thickness=cv2.FILLED)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin_px + 1, 2 * margin_px + 1))
    return np.asarray(cv2.dilate(mask, kernel), dtype=np.bool_)


def _dot_regions(contrast: Contrast, on_border: bool = False) -> list[NDArray[np.int32]]:
    """Outlines of what looks like dots, (k, 1, 2) px each: compact and of similar size."""
    H, W = contrast.shape
    dark = (contrast > _threshold(contrast)).astype(np.uint8)
    whole = cv2.morphologyEx(dark, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    outlines, _ = cv2.findContours(whole, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)  # fills glints
    kept: list[NDArray[np.int32]] = []
    areas: list[float] = []
    for outline in outlines:
        u, v, w, h = cv2.boundingRect(outline)
        area = _outline_area(outline)
        diameter = 2.0 * np.sqrt(area / np.pi)
        cut = u <= 0 or v <= 0 or u + w >= W or v + h >= H
        if (cut and not on_border) or not _MIN_DIAMETER_PX <= diameter <= _MAX_DIAMETER * W:
            continue
        if (not cut and max(w, h) > 2.2 * min(w, h)) or area < 0.4 * w * h:
            continue  # a scratch, an edge of the contact
        kept.append(np.asarray(outline, dtype=np.int32))
        areas.append(area)
    if not kept:
        return []
    typical = _typical(np.asarray(areas))
    least = 0.1 if on_border else 0.3
    return [o for o, area in zip(kept, areas, strict=True) if least * typical <= area <= 3.0 * typical]


def _threshold(contrast: Contrast) -> float:
    """Half way between the gel and the ink, by Otsu's rule on what is not plainly gel."""
    levels = np.asarray(np.minimum(contrast * 255.0, 255.0), dtype=np.uint8)
    otsu = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0]
    return max(float(otsu) / 255.0, _MIN_CONTRAST)


def _outline_area(outline: cv2.typing.MatLike) -> float:
    """Pixels inside an outline and on it (Pick's theorem)."""
    return float(cv2.contourArea(outline)) + 0.5 * len(outline) + 1.0


def _typical(areas: FloatArray) -> float:
    """Area of the typical dot: the median by covered area, so that specks of dirt do not count."""
    areas = np.sort(areas)
    cumulative = np.cumsum(areas)
    return float(areas[int(np.searchsorted(cumulative, 0.5 * cumulative[-1]))])


def _measure(contrast: Contrast, outlines: list[NDArray[np.int32]]) -> Markers:
    """Centres as contrast-weighted centroids over the filled outline and a margin of two pixels."""
    rows = []
    for outline in outlines:
        u, v, w, h = cv2.boundingRect(outline)
        u0, v0 = max(u - 3, 0), max(v - 3, 0)
        window = contrast[v0 : v + h + 3, u0 : u + w + 3]
        inside = np.zeros(window.shape, dtype=np.uint8)
        cv2.drawContours(inside, [outline - np.array([u0, v0], dtype=np.int32)], -1, 1, thickness=cv2.FILLED)
        weight = _dot_weight(window, inside.astype(bool))
        vs, us = np.indices(window.shape)
        total = float(weight.sum())
        centre = (u0 + float((us * weight).sum()) / total, v0 + float((vs * weight).sum()) / total)
        rows.append((*centre, 2.0 * np.sqrt(float(inside.sum()) / np.pi)))
    table = np.asarray(rows, dtype=np.float64).reshape(-1, 3)
    if rows:
        table = table[np.argsort(table[:, 1])]
        row = np.cumsum(np.diff(table[:, 1], prepend=table[0, 1]) > 0.5 * np.median(table[:, 2]))
        table = table[np.lexsort((table[:, 0], row))]
    return Markers(uv_px=table[:, :2].copy(), diameter_px=table[:, 2].copy())


def _dot_weight(window: Contrast, inside: BoolArray) -> Contrast:
    """Weights of a dot's pixels: 1 in the ink (glints included), falling with the contrast at its rim."""
    ink = float(np.percentile(window[inside], 60))
    margin = cv2.dilate(inside.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    core = cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    floor = float(np.median(window[~margin])) if (~margin).any() else 0.0
    weight = np.clip((window - floor) / max(ink - floor, 1e-3), 0.0, 1.0) * margin
    weight[core] = 1.0
    return np.asarray(weight, dtype=np.float32)
