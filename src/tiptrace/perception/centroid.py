"""Where a dot is to a few hundredths of a pixel: contrast-weighted centroid against the gel around it.

Shading slopes across a dot, more so at the edge of a contact. The gel's own brightness is continued smoothly
under each dot from the ring around it; what is darker than that is ink.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.perception.fill import pull_push
from tiptrace.types import BoolArray, FloatArray

_FLOOR = 0.15  # of the ink's contrast, below which a pixel counts as gel
_ROUNDS = 2  # of recentring within a window
_OFF_CENTRE_PX = 1.5  # a dot this far off the middle of its window gets another one

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
        self._offsets = np.stack([np.ones(du.size), du.ravel(), dv.ravel()], axis=1).astype(
            np.float32
        )  # (k², 3)

    def measure(self, grey: NDArray[np.uint8], uv_px: FloatArray) -> DotMeasurement:
        """Centroids of the dots nearest to places (n, 2) px, which must be right to about half a dot."""
        contrast = self._contrast(grey, uv_px)
        uv, ink, area, at = self._centroids(contrast, uv_px)
        off = np.flatnonzero(np.abs(uv - at).max(axis=1) > _OFF_CENTRE_PX)
        if off.size:
            uv[off], ink[off], area[off], _ = self._centroids(contrast, uv[off])
        return DotMeasurement(uv_px=uv, ink=ink, area_px=area)

    def mask(self, uv_px: FloatArray, shape: tuple[int, int], step: int = 1) -> BoolArray:
        """Pixels of the dots at places (n, 2), with a margin, in a map (H, W) that has every ``step``-th pixel."""
        radius = self.mask_radius_px / step + 0.5
        k = int(np.ceil(radius))
        dv, du = np.mgrid[-k : k + 1, -k : k + 1]
        disc = du**2 + dv**2 <= radius**2
        H, W = shape
        places = (uv_px[np.isfinite(uv_px).all(axis=1)] - (step - 1) / 2) / step
        at = np.clip(np.round(places), (-k, -k), (W - 1 + k, H - 1 + k)).astype(np.intp) + k
        padded = np.zeros((H + 2 * k, W + 2 * k), dtype=np.bool_)
        stamp = (dv[disc] * (W + 2 * k) + du[disc])[None]
        inside = (at >= k).all(axis=1) & (at[:, 0] < W + k) & (at[:, 1] < H + k)
        at = np.where(inside[:, None], at, np.clip(at, (k, k), (W - 1 + k, H - 1 + k)))
        padded.ravel()[(at[:, 1] * (W + 2 * k) + at[:, 0])[:, None] + stamp] = True
        return padded[k : k + H, k : k + W]

    def _contrast(self, grey: NDArray[np.uint8], uv: FloatArray) -> Windows:
        """1 − I/I_gel, (H, W), with I_gel continued under the dots."""
        H, W = grey.shape
        mask = self.mask(uv, (H, W))
        half = ((W + 1) // 2, (H + 1) // 2)  # the gel is smooth: half resolution is enough
        seen = (~mask).astype(np.float32)
        image = grey.astype(np.float32)
        known = np.asarray(cv2.resize(image * seen, half, interpolation=cv2.INTER_AREA), dtype=np.float32)
        weight = np.asarray(cv2.resize(seen, half, interpolation=cv2.INTER_AREA), dtype=np.float32)
        gel = cv2.resize(pull_push(known[..., None], weight), (W, H), interpolation=cv2.INTER_LINEAR)
        contrast = 1.0 - image / np.maximum(gel, 1.0)
        contrast[~mask] = 0.0
        return np.asarray(contrast, dtype=np.float32)

    def _centroids(
        self, contrast: Windows, uv_px: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.intp]]:
        """Centroids (n, 2), ink (n,), area (n,), and the middles of the windows used (n, 2)."""
        H, W = contrast.shape
        at = np.clip(np.round(uv_px), 0, (W - 1, H - 1)).astype(np.intp)  # (n, 2)
        windows = self._windows(contrast, at)  # (n, k²)
        uv = np.array(uv_px, dtype=np.float64)
        du, dv = self._offsets[:, 1], self._offsets[:, 2]
        for _ in range(_ROUNDS):
            c = (uv - at).astype(np.float32)
            rho = np.sqrt((du[None] - c[:, :1]) ** 2 + (dv[None] - c[:, 1:]) ** 2)
            core = rho <= self._core
            ink = np.einsum("nk,nk->n", windows, core.astype(np.float32)) / np.maximum(core.sum(axis=1), 1)
            share = windows * (1.0 / np.maximum(ink, 0.05) / (1.0 - _FLOOR))[:, None].astype(np.float32)
            weight = np.clip(share - np.float32(_FLOOR / (1.0 - _FLOOR)), 0.0, 1.0)
            weight[core] = 1.0  # glints
            weight *= np.clip(np.float32(self._radius + 0.5) - rho, 0.0, 1.0)
            moments = (weight @ self._offsets).astype(np.float64)  # (n, 3): area, Σ w du, Σ w dv
            area = np.maximum(moments[:, 0], 1e-3)
            uv = at + moments[:, 1:] / area[:, None]
        return uv, ink.astype(np.float64), area, at

    def _windows(self, contrast: Windows, at: NDArray[np.intp]) -> Windows:
        """Contrast around integer places (n, 2), (n, k²); 0 outside the image."""
        r = self._reach
        padded = cv2.copyMakeBorder(contrast, r, r, r, r, cv2.BORDER_CONSTANT, value=0.0)
        width = padded.shape[1]
        stamp = (self._offsets[:, 2] + r) * width + self._offsets[:, 1] + r
        index = (at[:, 1] * width + at[:, 0])[:, None] + stamp.astype(np.intp)[None]
        return np.asarray(padded.ravel()[index], dtype=np.float32)
