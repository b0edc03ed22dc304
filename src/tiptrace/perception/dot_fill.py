"""Slopes under round dots, continued along the structure that crosses them.

At the edge of a tool the slope changes fast across the edge and hardly along it. Around each dot the direction of
least change is found from the slopes on a ring; each pixel under the dot takes the values where the line through
it in that direction leaves the dot, weighted by nearness.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.types import FloatArray

Float32Map = NDArray[np.float32]

_RING_POINTS = 48
_VARIED = 0.04  # standard deviation of the slope around a dot below which the smooth fill is left as it is
_OUTSIDE_PX = 1.0  # map pixels beyond the dot where values are taken


class DotFill:
    """Fills discs of one radius in maps of one size."""

    def __init__(self, shape: tuple[int, int], radius_px: float) -> None:
        """For maps of shape (H, W) and discs of a radius in map pixels."""
        self._shape, self._radius = shape, radius_px
        half = int(np.ceil(radius_px)) + 1
        dv, du = np.mgrid[-half : half + 1, -half : half + 1]
        disc = np.hypot(du, dv) <= radius_px + np.sqrt(0.5)
        self._offsets = np.stack([du[disc], dv[disc]], axis=1)  # (k, 2)
        angle = 2.0 * np.pi * np.arange(_RING_POINTS) / _RING_POINTS
        self._ring = (radius_px + _OUTSIDE_PX) * np.stack([np.cos(angle), np.sin(angle)], axis=1)  # (m, 2)

    def apply(self, maps: Float32Map, uv: FloatArray) -> None:
        """Overwrite discs at places (n, 2), map px, in smoothly filled maps (H, W, c)."""
        if not len(uv):
            return
        few, _ = self._around(maps, uv, self._ring[::6])
        uv = uv[few.std(axis=1).max(axis=1) > _VARIED]
        if not len(uv):
            return
        ring, seen = self._around(maps, uv, self._ring)
        direction = _from_nearest(self._directions(ring, seen), uv, np.asarray(seen.all(axis=1)))  # (n, 2)
        at = np.round(uv).astype(np.intp)
        pixels = at[:, None] + self._offsets[None]  # (n, k, 2)
        d = pixels - uv[:, None]
        along = np.einsum("nkc,nc->nk", d, direction)
        inside2 = self._radius**2 - np.sum(d * d, axis=2)
        H, W = self._shape
        keep = (inside2 > 0) & (pixels >= 0).all(axis=2) & (pixels[..., 0] < W) & (pixels[..., 1] < H)
        dot, k = np.nonzero(keep)
        reach = np.sqrt(inside2[dot, k] + along[dot, k] ** 2)
        ahead, behind = reach - along[dot, k] + _OUTSIDE_PX, reach + along[dot, k] + _OUTSIDE_PX
        place, c = pixels[dot, k].astype(np.float64), direction[dot]
        front, front_in = self._sample(maps, place + ahead[:, None] * c)
        back, back_in = self._sample(maps, place - behind[:, None] * c)
        w = np.where(front_in & back_in, behind / (ahead + behind), np.where(front_in, 1.0, 0.0))
        w = np.where(front_in | back_in, w, 0.5).astype(np.float32)[:, None]
        maps[pixels[dot, k, 1], pixels[dot, k, 0]] = w * front + (1.0 - w) * back

    def _directions(self, ring: Float32Map, seen: NDArray[np.bool_]) -> FloatArray:
        """Unit direction (n, 2) along which mirrored points of the ring agree best.

        Args:
            ring: (n, m, c) values on the ring.
            seen: (n, m) which of them lie in the map.
        """
        w = seen.astype(np.float32)[..., None]  # (n, m, 1)
        W, WV = np.fft.rfft(w, axis=1), np.fft.rfft(w * ring, axis=1)
        WVV = np.fft.rfft(w * np.sum(ring * ring, axis=2, keepdims=True), axis=1)
        # Σ_k w_k w_k' |v_k − v_k'|² over mirrored points k' = d + m/2 − k: circular convolutions, all d at once
        squares = np.fft.irfft(
            2.0 * (W * WVV)[..., 0] - 2.0 * np.sum(WV * WV, axis=2), n=_RING_POINTS, axis=1
        )
        count = np.fft.irfft((W * W)[..., 0], n=_RING_POINTS, axis=1)
        cost = np.where(count > 11.5, squares / np.maximum(count, 1.0), np.inf)
        cost = np.roll(cost, -_RING_POINTS // 2, axis=1)  # (n, d)
        best = np.argmin(cost, axis=1)
        rows = np.arange(len(ring))
        low, mid, high = (cost[rows, (best + k) % _RING_POINTS] for k in (-1, 0, 1))
        with np.errstate(invalid="ignore"):
            curvature = low - 2.0 * mid + high
            shift = np.where(curvature > 0, 0.5 * (low - high) / np.where(curvature > 0, curvature, 1.0), 0.0)
        theta = np.pi * (best + np.clip(np.nan_to_num(shift), -0.5, 0.5)) / _RING_POINTS
        return np.stack([np.cos(theta), np.sin(theta)], axis=1)

    def _around(
        self, maps: Float32Map, uv: FloatArray, ring: FloatArray
    ) -> tuple[Float32Map, NDArray[np.bool_]]:
        """Values (n, m, c) and whether they lie in the map (n, m), on rings (m, 2) around places (n, 2)."""
        values, seen = self._sample(maps, (uv[:, None] + ring[None]).reshape(-1, 2))
        return values.reshape(len(uv), len(ring), -1), seen.reshape(len(uv), len(ring))

    def _sample(self, maps: Float32Map, uv: FloatArray) -> tuple[Float32Map, NDArray[np.bool_]]:
        """Bilinear samples (k, c) at places (k, 2), and whether each lies in the map."""
        H, W = self._shape
        at = uv.astype(np.float32)
        samples = cv2.remap(maps, at[None], np.zeros(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = (at >= 0).all(axis=1) & (at[:, 0] <= W - 1) & (at[:, 1] <= H - 1)
        return np.asarray(samples, dtype=np.float32).reshape(len(uv), -1), np.asarray(inside)


def _from_nearest(direction: FloatArray, uv: FloatArray, sure: NDArray[np.bool_]) -> FloatArray:
    """Directions (n, 2), those of dots near the border replaced by that of the nearest dot that is seen all round."""
    if sure.all() or not sure.any():
        return direction
    good = np.flatnonzero(sure)
    nearest = good[np.linalg.norm(uv[:, None] - uv[good][None], axis=2).argmin(axis=1)]
    return np.where(sure[:, None], direction, direction[nearest])
