"""Where a dot is to a few hundredths of a pixel: contrast-weighted centroid against the gel around it.

Shading slopes across a dot, more so at the edge of a contact. The gel's own brightness is continued smoothly
under each dot from the ring around it; what is darker than that is ink.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.perception.fill import pull_push
from tiptrace.types import BoolArray, FloatArray

_FLOOR = 0.15  # of the ink's contrast, below which a pixel counts as gel
_ROUNDS = 2  # of recentring within a window
_OFF_CENTRE_PX = 1.5  # a dot this far off the middle of its window gets another one

Grey = NDArray[np.uint8]
Float32Map = NDArray[np.float32]


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

    def measure(self, grey: Grey, uv_px: FloatArray) -> DotMeasurement:
        """Centroids of the dots nearest to places (n, 2) px, which must be right to about half a dot."""
        uv = np.array(uv_px, dtype=np.float64)  # (n, 2)
        ink, area = np.zeros(len(uv)), np.zeros(len(uv))
        mask = self.mask(uv, (grey.shape[0], grey.shape[1]))
        gel, weight = _halved_gel(grey, mask)
        pull_push(gel, weight)
        _measure_dots(grey, mask, gel[0], uv, ink, area, self._radius, self._core)
        return DotMeasurement(uv_px=uv, ink=ink, area_px=area)

    def mask(
        self, uv_px: FloatArray, shape: tuple[int, int], step: int = 1, margin_px: float = 0.5
    ) -> BoolArray:
        """Pixels of the dots at places (n, 2), with a margin, in a map (H, W) that has every ``step``-th pixel."""
        mask = np.zeros(shape, dtype=np.bool_)
        _stamp_discs(mask, np.ascontiguousarray(uv_px), (self.mask_radius_px + margin_px) / step, step)
        return mask


@compiled
def _stamp_discs(mask: BoolArray, uv_px: FloatArray, radius: float, step: int) -> None:
    """Mark discs of a radius in map pixels, centred on the map pixel nearest to each place (n, 2)."""
    H, W = mask.shape
    for i in range(len(uv_px)):
        u, v = (uv_px[i, 0] - (step - 1) / 2) / step, (uv_px[i, 1] - (step - 1) / 2) / step
        if not (abs(u) < 1e6 and abs(v) < 1e6):
            continue
        u0, v0 = round(u), round(v)
        for y in range(max(v0 - int(radius), 0), min(v0 + int(radius) + 1, H)):
            half = int(np.sqrt(radius * radius - (y - v0) ** 2))
            for x in range(max(u0 - half, 0), min(u0 + half + 1, W)):
                mask[y, x] = True


@compiled
def _halved_gel(grey: Grey, mask: BoolArray) -> tuple[Float32Map, Float32Map]:
    """Sums (1, h, w) and weights (h, w) of the pixels that are not masked, over 2 × 2: the gel is smooth."""
    H, W = grey.shape
    h, w = (H + 1) // 2, (W + 1) // 2
    sums, weight = np.zeros((1, h, w), dtype=np.float32), np.zeros((h, w), dtype=np.float32)
    total, count = np.zeros(2 * w, dtype=np.float32), np.zeros(2 * w, dtype=np.float32)
    quarter = np.float32(0.25)
    for v in range(h):
        for k in range(2):
            row, covered = grey[min(2 * v + k, H - 1)], mask[min(2 * v + k, H - 1)]
            for u in range(W):
                seen = np.float32(0.0) if covered[u] else quarter
                total[u] = seen * np.float32(row[u]) + (total[u] if k else np.float32(0.0))
                count[u] = seen + (count[u] if k else np.float32(0.0))
        total[2 * w - 1], count[2 * w - 1] = total[W - 1], count[W - 1]
        for u in range(w):
            sums[0, v, u] = total[2 * u] + total[2 * u + 1]
            weight[v, u] = count[2 * u] + count[2 * u + 1]
    return sums, weight


@compiled
def _measure_dots(
    grey: Grey,
    mask: BoolArray,
    gel: Float32Map,
    uv: FloatArray,
    ink: FloatArray,
    area: FloatArray,
    radius: float,
    core: float,
) -> None:
    """Centroid (in place), ink and area of each dot; once more in a fresh window where it lies off the middle."""
    H, W = grey.shape
    reach = int(np.ceil(radius + 1.0))
    window = np.empty((2 * reach + 1, 2 * reach + 1), dtype=np.float32)
    for i in range(len(uv)):
        for _ in range(2):
            if not (abs(uv[i, 0]) < 1e6 and abs(uv[i, 1]) < 1e6):
                break
            u0, v0 = min(max(round(uv[i, 0]), 0), W - 1), min(max(round(uv[i, 1]), 0), H - 1)
            _contrast_window(grey, mask, gel, u0, v0, window)
            du, dv = uv[i, 0] - u0, uv[i, 1] - v0
            for _ in range(_ROUNDS):
                du, dv, ink[i], area[i] = _centroid(window, du, dv, radius, core)
            uv[i, 0], uv[i, 1] = u0 + du, v0 + dv
            if max(abs(du), abs(dv)) <= _OFF_CENTRE_PX:
                break


@compiled
def _contrast_window(
    grey: Grey, mask: BoolArray, gel: Float32Map, u0: int, v0: int, window: Float32Map
) -> None:
    """1 − I/I_gel around a pixel, with the gel's brightness from its map (h, w) of half the size; 0 off the dots."""
    H, W = grey.shape
    h, w = gel.shape
    reach = window.shape[0] // 2
    for j in range(window.shape[0]):
        v = v0 - reach + j
        y = min(max((v - 0.5) / 2.0, 0.0), h - 1.0)
        y0 = min(int(y), max(h - 2, 0))
        b = np.float32(y - y0)
        for i in range(window.shape[1]):
            u = u0 - reach + i
            window[j, i] = 0.0
            if v < 0 or v >= H or u < 0 or u >= W or not mask[v, u]:
                continue
            x = min(max((u - 0.5) / 2.0, 0.0), w - 1.0)
            x0 = min(int(x), max(w - 2, 0))
            a = np.float32(x - x0)
            top = gel[y0, x0] + a * (gel[y0, x0 + 1] - gel[y0, x0])
            bottom = gel[y0 + 1, x0] + a * (gel[y0 + 1, x0 + 1] - gel[y0 + 1, x0])
            window[j, i] = np.float32(1.0) - np.float32(grey[v, u]) / max(
                top + b * (bottom - top), np.float32(1.0)
            )


@compiled
def _centroid(
    window: Float32Map, du: float, dv: float, radius: float, core: float
) -> tuple[float, float, float, float]:
    """Centroid (du, dv), ink and area in a window of contrasts, starting from (du, dv) off its middle."""
    size = window.shape[0]
    x, y = np.float32(du + size // 2), np.float32(dv + size // 2)
    zero, one, core2 = np.float32(0.0), np.float32(1.0), np.float32(core * core)
    dark, count = zero, zero
    for j in range(size):
        dy2 = (np.float32(j) - y) ** 2
        for i in range(size):
            inside = one if (np.float32(i) - x) ** 2 + dy2 <= core2 else zero
            dark += inside * window[j, i]
            count += inside
    ink = dark / max(count, one)
    gain = np.float32(1.0 / (1.0 - _FLOOR)) / max(ink, np.float32(0.05))
    floor, rim = np.float32(_FLOOR / (1.0 - _FLOOR)), np.float32(radius + 0.5)
    total, total_x, total_y = 0.0, 0.0, 0.0
    for j in range(size):
        dy = np.float32(j) - y
        row, row_x = zero, zero
        for i in range(size):
            dx = np.float32(i) - x
            rho2 = dx * dx + dy * dy
            share = min(max(gain * window[j, i] - floor, zero), one)
            share = one if rho2 <= core2 else share  # glints
            weight = share * min(max(rim - np.sqrt(rho2), zero), one)
            row += weight
            row_x += weight * dx
        total += float(row)
        total_x += float(row_x)
        total_y += float(row * dy)
    area = max(total, 1e-3)
    return du + total_x / area, dv + total_y / area, float(ink), area
