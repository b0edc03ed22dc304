"""The hand at any past instant: a short memory of pose samples, smoothed where they are read.

Linear interpolation of noisy poses has its smallest error half way between samples, which draws a latency estimate
there; a local quadratic through a window of samples has no such preference.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.errors import GeometryError
from tiptrace.estimation.kernels import smooth_poses
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
        k = int(np.searchsorted(self._stamps[: self._size], stamp_ns))
        k = min(max(k, 1), max(self._size - 1, 1))
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
    steps = np.sort(np.diff(stamps_ns[-64:]))
    spacing = 0.5 * float(steps[(len(steps) - 1) // 2] + steps[len(steps) // 2]) * 1e-9  # median
    half = max(half_s, 2.5 * spacing)
    width = min(2 * math.ceil(half / spacing) + 1, len(stamps_ns))
    first = np.searchsorted(stamps_ns, at_ns) - width // 2
    first = np.minimum(np.maximum(first, 0), len(stamps_ns) - width)
    return HandStates(*smooth_poses(stamps_ns, T_B_E, at_ns, first, width, half))
