"""Lamps drift and flicker; gel beside the contact tells by how much.

Against the reference only a gain common to the three channels is believed: a gain per channel could not be told
from the slopes of the gel beside a contact. Of a colour change, slopes explain two dimensions (the network says
which); the third is the lamps'. From the first frame on each channel has a gain of its own, from gel that was
calm then and is calm now, whose slopes cancel. What is left tilts the depth map as a whole; :class:`Level` takes
that away where untouched gel is seen on more than one side.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.types import BoolArray, FloatArray

Float32Map = NDArray[np.float32]

_BLOCK = 8  # map pixels
_LEAST_BLOCKS = 10
_LEAST_SHARE = 0.4  # of a block's pixels
_PROBE = 0.03  # change of a channel's ratio by which the network's sensitivity is measured
_TILT_SIGMA = 10e-3  # what lamps and network may tilt a depth map by, m/m
_LEVEL_SIGMA_M = 10e-6  # how far untouched gel may lie from 0 beside a contact
_INDEPENDENT = 4.0  # untouched gel counts as so many independent measurements
_THIN = 4  # every so many pixels take part in the plane
_TILT_RATE = 0.1  # of a new frame's tilt in the mean


class LampGain:
    """Gain of each channel against the reference, frame by frame."""

    def __init__(self, shape: tuple[int, int], slopes_of: Callable[[Float32Map], Float32Map]) -> None:
        """Prepare.

        Args:
            shape: (H, W) of the maps.
            slopes_of: The network: ratio image (H, W, 3) to slopes (H, W, 2).
        """
        self._size = (max(shape[1] // _BLOCK, 1), max(shape[0] // _BLOCK, 1))
        self._not_slope = self._directions(shape, slopes_of)
        self._first: tuple[FloatArray, BoolArray] | None = None
        self._gain_0 = np.ones(3)
        self.gain: FloatArray = np.ones(3)

    def update(self, ratio: Float32Map, calm: BoolArray, flat: BoolArray) -> FloatArray:
        """Gain (3,) of the channels in the next image.

        Args:
            ratio: (H, W, 3) image over the untouched background.
            calm: (H, W) untouched gel; empty where none is visible.
            flat: (H, W) gel that leans little, pressed in or not; it tells a common gain where there is no calm gel.
        """
        means, good = _block_means(ratio, calm, *self._size)
        if int(good.sum()) < _LEAST_BLOCKS:
            self._from_flat(ratio, flat)
        elif self._first is None:
            self._first = (means, good)
            self._gain_0 = np.full(3, 1.0 + self._common_change(means[good] - 1.0, self._not_slope[good]))
            self.gain = self._gain_0
        else:
            means_0, good_0 = self._first
            both = good & good_0
            if int(both.sum()) >= _LEAST_BLOCKS:
                self.gain = self._gain_0 * _median_ratio(means, means_0, both)
            else:
                self._from_flat(ratio, flat)
        return self.gain

    def forget(self) -> None:
        """Start anew with the next image."""
        self._first = None

    def _from_flat(self, ratio: Float32Map, flat: BoolArray) -> None:
        means, good = _block_means(ratio, flat, *self._size)
        if int(good.sum()) >= _LEAST_BLOCKS:
            self.gain = np.full(3, 1.0 + self._common_change(means[good] - 1.0, self._not_slope[good]))

    @staticmethod
    def _common_change(change: FloatArray, not_slope: FloatArray) -> float:
        """Robust c with n · (δ − c 1) = 0 over blocks: change δ (b, 3), directions n (b, 3)."""
        seen, expected = np.sum(not_slope * change, axis=1), np.sum(not_slope, axis=1)
        weight = np.abs(expected)
        each = seen / np.where(weight > 0.05, expected, np.inf)
        order = np.argsort(each)
        half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
        return float(each[order[min(int(half), len(each) - 1)]])  # weighted median

    def _directions(
        self, shape: tuple[int, int], slopes_of: Callable[[Float32Map], Float32Map]
    ) -> FloatArray:
        """(b, 3) unit colour changes that move no slope, per block, for flat gel."""
        columns = []
        for c in range(3):
            up, down = (np.ones((*shape, 3), dtype=np.float32) for _ in range(2))
            up[..., c] += _PROBE
            down[..., c] -= _PROBE
            J = (slopes_of(up) - slopes_of(down)) / (2.0 * _PROBE)  # (H, W, 2)
            columns.append(cv2.resize(J, self._size, interpolation=cv2.INTER_AREA).reshape(-1, 2))
        J_p, J_q = (np.stack([column[:, k] for column in columns], axis=1) for k in (0, 1))  # (b, 3)
        n = np.cross(J_p, J_q)
        return np.asarray(n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9), dtype=np.float64)


@compiled
def _block_means(ratio: Float32Map, use: BoolArray, columns: int, rows: int) -> tuple[FloatArray, BoolArray]:
    """Mean ratio over the used pixels of each block, (b, 3), and which blocks have enough of them."""
    H, W = use.shape
    total = np.zeros((rows * columns, 3), dtype=np.float32)
    used, all_of = np.zeros(rows * columns), np.zeros(rows * columns)
    for v in range(H):
        for u in range(W):
            b = (v * rows // H) * columns + u * columns // W
            all_of[b] += 1.0
            if use[v, u]:
                used[b] += 1.0
                for c in range(3):
                    total[b, c] += ratio[v, u, c]
    means = np.empty((rows * columns, 3))
    for b in range(rows * columns):
        for c in range(3):
            means[b, c] = total[b, c] / max(used[b], 1.0)
    return means, used > _LEAST_SHARE * all_of


@compiled
def _median_ratio(means: FloatArray, means_0: FloatArray, use: BoolArray) -> FloatArray:
    """Median (3,) over the used blocks of the means (b, 3) against others."""
    values, median = np.empty(len(use)), np.empty(3)
    for c in range(3):
        n = 0
        for b in range(len(use)):
            if use[b]:
                values[n] = means[b, c] / means_0[b, c]
                n += 1
        median[c] = np.median(values[:n])
    return median


class Level:
    """Plane through untouched gel, taken away from depth maps; its tilt is averaged over frames."""

    def __init__(self, shape: tuple[int, int], metres_per_px: tuple[float, float]) -> None:
        """For maps of shape (H, W)."""
        H, W = shape
        self._x: FloatArray = (np.arange(W) - (W - 1) / 2) * np.float64(metres_per_px[0])
        self._y: FloatArray = (np.arange(H) - (H - 1) / 2) * np.float64(metres_per_px[1])
        self._tilt: FloatArray | None = None

    def apply(self, h: Float32Map, untouched: BoolArray | None) -> Float32Map:
        """Depth map (H, W) with untouched gel (H, W) at 0.

        Where none is visible (None), the last tilt is taken away and the border's lowest decile is 0.
        """
        if untouched is not None:
            tilt = _plane_tilt(h, untouched, self._x, self._y)
            self._tilt = tilt if self._tilt is None else self._tilt + _TILT_RATE * (tilt - self._tilt)
        tilt = np.zeros(2) if self._tilt is None else self._tilt
        z = _without_tilt(h, self._x, self._y, tilt)
        zero = _border_decile(z) if untouched is None else _median_of(z, untouched)
        z -= np.float32(zero)
        return z

    def forget(self) -> None:
        """Start anew with the next map."""
        self._tilt = None


@compiled
def _plane_tilt(h: Float32Map, untouched: BoolArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Tilt (2,) of the robust plane, with a prior of zero: gel seen on one side only hardly tilts the rest."""
    H, W = h.shape
    n = 0
    for v in range(0, H, _THIN):
        for u in range(0, W, _THIN):
            n += untouched[v, u]
    A, z, w = np.empty((n, 2)), np.empty(n), np.ones(n)
    n = 0
    for v in range(0, H, _THIN):
        for u in range(0, W, _THIN):
            if untouched[v, u]:
                A[n, 0], A[n, 1], z[n] = x[u], y[v], h[v, u]
                n += 1
    tilt = np.zeros(2)
    if n == 0:
        return tilt
    prior = (_LEVEL_SIGMA_M / _TILT_SIGMA) ** 2 / _INDEPENDENT
    for _ in range(3):
        tilt, zero = _weighted_plane(A, z, w, prior)
        r = np.abs(z - zero - A[:, 0] * tilt[0] - A[:, 1] * tilt[1])
        scale = 2.0 * np.median(r) + 1e-7
        for i in range(n):
            w[i] = 1.0 / max(1.0, r[i] / scale)
    return tilt


@compiled
def _weighted_plane(A: FloatArray, z: FloatArray, w: FloatArray, prior: float) -> tuple[FloatArray, float]:
    """Tilt (2,) and offset of z ≈ offset + A · tilt with weights (n,) and a prior weight for no tilt."""
    total, a, b, c = 0.0, 0.0, 0.0, 0.0
    for i in range(len(w)):
        total += w[i]
        a += w[i] * A[i, 0]
        b += w[i] * A[i, 1]
        c += w[i] * z[i]
    a, b, c = a / total, b / total, c / total
    aa, ab, bb, az, bz = prior, 0.0, prior, 0.0, 0.0
    for i in range(len(w)):
        da, db, dz = A[i, 0] - a, A[i, 1] - b, z[i] - c
        aa += w[i] * da * da / total
        ab += w[i] * da * db / total
        bb += w[i] * db * db / total
        az += w[i] * da * dz / total
        bz += w[i] * db * dz / total
    determinant = aa * bb - ab * ab
    tilt = np.array([(bb * az - ab * bz) / determinant, (aa * bz - ab * az) / determinant])
    return tilt, c - a * tilt[0] - b * tilt[1]


@compiled
def _without_tilt(h: Float32Map, x: FloatArray, y: FloatArray, tilt: FloatArray) -> Float32Map:
    H, W = h.shape
    z = np.empty((H, W), dtype=np.float32)
    slope, row = np.float32(tilt[0]), np.empty(W, dtype=np.float32)
    for u in range(W):
        row[u] = slope * np.float32(x[u])
    for v in range(H):
        rise = np.float32(tilt[1] * y[v])
        for u in range(W):
            z[v, u] = h[v, u] - row[u] - rise
    return z


@compiled
def _border_decile(z: Float32Map) -> float:
    """What a tenth of the border's pixels lie below."""
    H, W = z.shape
    border = np.empty(2 * (H + W), dtype=np.float32)
    border[:W], border[W : 2 * W] = z[0], z[H - 1]
    border[2 * W : 2 * W + H], border[2 * W + H :] = z[:, 0], z[:, W - 1]
    return float(np.sort(border)[round(0.1 * (len(border) - 1))])


@compiled
def _median_of(z: Float32Map, untouched: BoolArray) -> float:
    """Median over untouched gel, at every second pixel both ways."""
    H, W = z.shape
    values = np.empty(((H + 1) // 2) * ((W + 1) // 2), dtype=np.float32)
    n = 0
    for v in range(0, H, 2):
        for u in range(0, W, 2):
            if untouched[v, u]:
                values[n] = z[v, u]
                n += 1
    return np.median(values[: max(n, 1)]) if n else 0.0
