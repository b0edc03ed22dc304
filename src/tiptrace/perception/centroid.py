"""Where a dot is to a few hundredths of a pixel: contrast-weighted centroid against the gel around it.

Shading slopes across a dot, more so at the edge of a contact. The gel's own brightness is continued smoothly
under each dot from the ring around it; what is darker than that is ink.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.perception.fill import smooth_fill
from tiptrace.types import BoolArray, FloatArray

_FLOOR = 0.15  # of the ink's contrast, below which a pixel counts as gel
_ROUNDS = 3  # of recentring within a window
_WINDOWS = 2  # a second one where the dot lies off the middle of the first

Windows = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class DotMeasurement:
    """Dots found near given places.

    Attributes:
        uv_px: (n, 2) centroids.
        ink: (n,) contrast of the ink, 0 gel … 1 black.
        area_px: (n,) ink area.
    """

    uv_px: FloatArray
    ink: FloatArray
    area_px: FloatArray


class DotMeter:
    """Measures dots of one size."""

    def __init__(self, diameter_px: float, pitch_px: float) -> None:
        """Prepare for dots of a diameter, a pitch apart."""
        self.mask_radius_px = min(0.5 * diameter_px + 2.0, 0.42 * pitch_px)
        self._radius = max(min(0.72 * diameter_px + 1.0, 0.5 * pitch_px), 2.5)  # where ink is looked for
        self._core = max(0.28 * diameter_px, 1.0)
        self._reach = int(np.ceil(self._radius + 1.0))
        dv, du = np.mgrid[-self._reach : self._reach + 1, -self._reach : self._reach + 1]
        self._dv, self._du = dv.astype(np.float32), du.astype(np.float32)

    def measure(self, grey: NDArray[np.uint8], uv_px: FloatArray) -> DotMeasurement:
        """Centroids of the dots nearest to places (n, 2) px, which must be right to about half a dot."""
        uv = np.array(uv_px, dtype=np.float64)
        H, W = grey.shape
        image = grey.astype(np.float32)
        for _ in range(_WINDOWS):
            at = np.clip(np.round(uv), 0, (W - 1, H - 1)).astype(np.intp)  # (n, 2)
            contrast = self._contrast(image, uv)
            windows = self._windows(contrast, at)  # (n, k, k)
            for _ in range(_ROUNDS):
                uv, ink, area = self._centroid(windows, at, uv)
            if not len(uv) or np.abs(uv - at).max() < 1.5:
                break
        return DotMeasurement(uv_px=uv, ink=ink, area_px=area)

    def mask(self, uv_px: FloatArray, shape: tuple[int, int]) -> BoolArray:
        """Pixels (H, W) of the dots at places (n, 2), with a margin."""
        mask = np.zeros(shape, dtype=np.uint8)
        for u, v in uv_px[np.isfinite(uv_px).all(axis=1)]:
            cv2.circle(
                mask, (round(u * 8), round(v * 8)), round(self.mask_radius_px * 8), 1, cv2.FILLED, shift=3
            )
        return np.asarray(mask, dtype=np.bool_)

    def _contrast(self, image: Windows, uv: FloatArray) -> Windows:
        """1 − I/I_gel, (H, W), with I_gel continued under the dots."""
        gel = smooth_fill(image[..., None], self.mask(uv, image.shape[:2]))[..., 0]
        return np.asarray(1.0 - image / np.maximum(gel, 1.0), dtype=np.float32)

    def _windows(self, contrast: Windows, at: NDArray[np.intp]) -> Windows:
        r = self._reach
        padded = cv2.copyMakeBorder(contrast, r, r, r, r, cv2.BORDER_CONSTANT, value=0.0)
        k = np.arange(2 * self._reach + 1)
        windows: Windows = padded[
            at[:, 1, None, None] + k[None, :, None], at[:, 0, None, None] + k[None, None, :]
        ]
        return windows

    def _centroid(
        self, contrast: Windows, at: NDArray[np.intp], uv: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        offset = (uv - at).astype(np.float32)  # (n, 2)
        du = self._du[None] - offset[:, 0, None, None]
        dv = self._dv[None] - offset[:, 1, None, None]
        rho = np.sqrt(du * du + dv * dv)
        core = rho <= self._core
        ink = np.sum(contrast * core, axis=(1, 2)) / np.maximum(core.sum(axis=(1, 2)), 1)
        share = contrast / np.maximum(ink, 0.05)[:, None, None]
        weight = np.clip((share - _FLOOR) / (1.0 - _FLOOR), 0.0, 1.0)
        weight[core] = 1.0  # glints
        weight *= np.clip(self._radius + 0.5 - rho, 0.0, 1.0)
        area = np.maximum(weight.sum(axis=(1, 2)), 1e-3)
        shift = np.stack([np.sum(weight * du, axis=(1, 2)), np.sum(weight * dv, axis=(1, 2))], axis=1)
        moved = uv + (shift / area[:, None]).astype(np.float64)
        return moved, ink.astype(np.float64), area.astype(np.float64)
