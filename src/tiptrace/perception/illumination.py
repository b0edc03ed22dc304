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

from tiptrace.types import BoolArray, FloatArray

Float32Map = NDArray[np.float32]

_BLOCK = 8  # map pixels
_LEAST_BLOCKS = 10
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

    def correct(self, ratio: Float32Map, calm: BoolArray, flat: BoolArray) -> Float32Map:
        """Divide a ratio image (H, W, 3) by the lamps' gain.

        Args:
            ratio: Image over the untouched background.
            calm: (H, W) untouched gel; empty where none is visible.
            flat: (H, W) gel that leans little, pressed in or not; it tells a common gain where there is no calm gel.
        """
        means, good = self._blocks(ratio, calm)
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
                self.gain = self._gain_0 * np.median(means[both] / means_0[both], axis=0)
            else:
                self._from_flat(ratio, flat)
        return np.asarray(ratio / self.gain.astype(np.float32), dtype=np.float32)

    def forget(self) -> None:
        """Start anew with the next image."""
        self._first = None

    def _from_flat(self, ratio: Float32Map, flat: BoolArray) -> None:
        means, good = self._blocks(ratio, flat)
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

    def _blocks(self, ratio: Float32Map, calm: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Mean ratio over the calm pixels of each block, (b, 3), and which blocks have enough of them."""
        weight = calm.astype(np.float32)
        share = cv2.resize(weight, self._size, interpolation=cv2.INTER_AREA).ravel()
        total = cv2.resize(ratio * weight[..., None], self._size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
        return total / np.maximum(share, 1e-3)[:, None], np.asarray(share > 0.4)

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


class Level:
    """Plane through untouched gel, taken away from depth maps; its tilt is averaged over frames."""

    def __init__(self, shape: tuple[int, int], metres_per_px: tuple[float, float]) -> None:
        """For maps of shape (H, W)."""
        H, W = shape
        self._x = (np.arange(W) - (W - 1) / 2) * metres_per_px[0]
        self._y = (np.arange(H) - (H - 1) / 2) * metres_per_px[1]
        self._tilt: FloatArray | None = None

    def apply(self, h: Float32Map, untouched: BoolArray | None) -> Float32Map:
        """Depth map (H, W) with untouched gel (H, W) at 0.

        Where none is visible (None), the last tilt is taken away and the border's lowest decile is 0.
        """
        if untouched is not None:
            tilt = self._plane(h, untouched)
            self._tilt = tilt if self._tilt is None else self._tilt + _TILT_RATE * (tilt - self._tilt)
        z = h
        if self._tilt is not None:
            z = h - self._tilt[0] * self._x[None, :] - self._tilt[1] * self._y[:, None]
        if untouched is not None:
            zero = np.median(z[untouched])
        else:
            zero = np.percentile(np.concatenate([z[0], z[-1], z[:, 0], z[:, -1]]), 10)
        return np.asarray(z - zero, dtype=np.float32)

    def forget(self) -> None:
        """Start anew with the next map."""
        self._tilt = None

    def _plane(self, h: Float32Map, untouched: BoolArray) -> FloatArray:
        """Tilt (2,) of the robust plane, with a prior of zero: gel seen on one side only hardly tilts the rest."""
        v, u = np.nonzero(untouched[::_THIN, ::_THIN])
        z = h[::_THIN, ::_THIN][v, u].astype(np.float64)
        A = np.stack([np.ones(len(v)), self._x[_THIN * u], self._y[_THIN * v]], axis=1)  # (n, 3)
        prior = np.diag([0.0, 1.0, 1.0]) * (_LEVEL_SIGMA_M / _TILT_SIGMA) ** 2 / _INDEPENDENT
        w = np.ones(len(v))
        x: FloatArray = np.zeros(3)
        for _ in range(3):
            w = w / w.mean()
            x = np.linalg.solve((A.T * w) @ A / len(v) + prior, (A.T * w) @ z / len(v))
            r = np.abs(z - A @ x)
            w = 1.0 / np.maximum(1.0, r / (2.0 * float(np.median(r)) + 1e-7))
        return x[1:]
