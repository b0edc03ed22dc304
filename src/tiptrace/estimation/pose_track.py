"""The hand at any past instant: a short memory of pose samples, smoothed where they are read.

Linear interpolation of noisy poses has its smallest error half way between samples, which draws a latency estimate
there; a local quadratic through a window of samples has no such preference.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.errors import GeometryError
from tiptrace.geometry.transforms import rotation_exp, rotation_log, transform
from tiptrace.types import FloatArray, PoseSample

_FEWEST = 4


@dataclass(frozen=True, slots=True)
class HandStates:
    """Poses and velocities at T instants.

    Attributes:
        T_B_E: (T, 4, 4).
        velocity_B: (T, 3) of the origin of F_E, m/s, in F_B.
        rate_E: (T, 3) angular velocity in F_E, rad/s.
    """

    T_B_E: FloatArray
    velocity_B: FloatArray
    rate_E: FloatArray


class PoseTrack:
    """Pose samples of the last seconds, read by local quadratic regression."""

    def __init__(self, memory_s: float = 1.0, half_width_s: float = 0.05) -> None:
        self._memory_ns, self._half_s = int(memory_s * 1e9), half_width_s
        self._stamps: FloatArray = np.zeros(64)  # ns; the first _size rows hold samples, in order
        self._T: FloatArray = np.zeros((64, 4, 4))
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the last sample."""
        return int(self._stamps[self._size - 1]) if self._size else None

    def extend(self, samples: Iterable[PoseSample]) -> None:
        """Take in samples, in order; those that step back in time are left out, old ones forgotten."""
        for sample in samples:
            if self._size and sample.stamp_ns <= self._stamps[self._size - 1]:
                continue
            if self._size == len(self._stamps):
                self._make_room(sample.stamp_ns)
            self._stamps[self._size], self._T[self._size] = sample.stamp_ns, sample.T_B_E
            self._size += 1

    def _make_room(self, now_ns: int) -> None:
        """Forget what is older than the memory; grow while the memory holds more."""
        first = int(np.searchsorted(self._stamps[: self._size], now_ns - self._memory_ns))
        kept = self._size - first
        capacity = max(64, 2 * kept)
        stamps, T = np.zeros(capacity), np.zeros((capacity, 4, 4))
        stamps[:kept], T[:kept] = self._stamps[first : self._size], self._T[first : self._size]
        self._stamps, self._T, self._size = stamps, T, kept

    def covers(self, stamp_ns: float) -> bool:
        """Whether there are samples about an instant."""
        if self._size < _FEWEST:
            return False
        return bool(self._stamps[0] <= stamp_ns <= self._stamps[self._size - 1] + 5e6)

    def gap_s(self, stamp_ns: float) -> float:
        """Distance between the samples on either side of an instant, s."""
        k = int(np.clip(np.searchsorted(self._stamps[: self._size], stamp_ns), 1, max(self._size - 1, 1)))
        return float(self._stamps[k] - self._stamps[k - 1]) * 1e-9

    def at(self, stamps_ns: ArrayLike) -> HandStates:
        """Smoothed hand at instants (T,), ns.

        Raises:
            GeometryError: fewer than four samples in memory.
        """
        if self._size < _FEWEST:
            raise GeometryError(
                f"the pose stream has {self._size} samples in memory, at least {_FEWEST} are needed"
            )
        at = np.atleast_1d(np.asarray(stamps_ns, dtype=np.float64))
        return smooth_at(self._stamps[: self._size], self._T[: self._size], at, self._half_s)


def smooth_at(stamps_ns: FloatArray, T_B_E: FloatArray, at_ns: FloatArray, half_s: float) -> HandStates:
    """Local quadratic regression of poses (K,), (K, 4, 4) at instants (T,)."""
    spacing = float(np.median(np.diff(stamps_ns[-64:]))) * 1e-9
    half = max(half_s, 2.5 * spacing)
    width = min(2 * int(np.ceil(half / spacing)) + 1, len(stamps_ns))
    first = np.clip(np.searchsorted(stamps_ns, at_ns) - width // 2, 0, len(stamps_ns) - width)
    index = first[:, None] + np.arange(width)  # (T, W)
    x = (stamps_ns[index] - at_ns[:, None]) * 1e-9 / half  # (T, W)
    weight = np.clip(1.0 - x * x, 1e-6, None)
    R_ref = T_B_E[index[:, width // 2], :3, :3]  # (T, 3, 3)
    R_rel = np.swapaxes(R_ref, 1, 2)[:, None] @ T_B_E[index, :3, :3]
    y = np.concatenate(
        [_small_log(R_rel), T_B_E[index, :3, 3] - T_B_E[index[:, :1], :3, 3]], axis=2
    )  # (T, W, 6)
    V = np.stack([np.ones_like(x), x, x * x], axis=2)  # (T, W, 3)
    VW = V * weight[..., None]
    N = np.swapaxes(VW, 1, 2) @ V + 1e-9 * np.eye(3)
    beta = np.linalg.solve(N, np.swapaxes(VW, 1, 2) @ y)  # (T, 3, 6)
    R = R_ref @ rotation_exp(beta[:, 0, :3])
    t = beta[:, 0, 3:] + T_B_E[index[:, 0], :3, 3]
    return HandStates(transform(R, t), beta[:, 1, 3:] / half, beta[:, 1, :3] / half)


def _small_log(R: FloatArray) -> FloatArray:
    """Rotation vectors; a cheap form where all rotations are small, (..., 3, 3) → (..., 3)."""
    v = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )
    s2 = np.sum(v * v, axis=-1, keepdims=True)
    if s2.max() > 0.04:
        return rotation_log(R)
    return np.asarray(v * (1.0 + s2 / 6.0 + 0.075 * s2 * s2))  # arcsin(s) / s
