"""The hand at any past instant: a short memory of pose samples, smoothed where they are read.

Linear interpolation of noisy poses has its smallest error half way between samples, which draws a latency estimate
there; a local quadratic through a window of samples has no such preference.
"""

from __future__ import annotations

from collections import deque
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
        self._samples: deque[PoseSample] = deque()
        self._stamps: FloatArray = np.zeros(0)
        self._T: FloatArray = np.zeros((0, 4, 4))
        self._stale = False

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the last sample."""
        return self._samples[-1].stamp_ns if self._samples else None

    def extend(self, samples: Iterable[PoseSample]) -> None:
        """Take in samples, in order; those that step back in time are left out, old ones forgotten."""
        for sample in samples:
            if self._samples and sample.stamp_ns <= self._samples[-1].stamp_ns:
                continue
            self._samples.append(sample)
            self._stale = True
        while self._samples and self._samples[0].stamp_ns < self._samples[-1].stamp_ns - self._memory_ns:
            self._samples.popleft()

    def covers(self, stamp_ns: float) -> bool:
        """Whether there are samples about an instant."""
        return (
            len(self._samples) >= _FEWEST
            and self._samples[0].stamp_ns <= stamp_ns <= self._samples[-1].stamp_ns + 5e6
        )

    def at(self, stamps_ns: ArrayLike) -> HandStates:
        """Smoothed hand at instants (T,), ns.

        Raises:
            GeometryError: fewer than four samples in memory.
        """
        if len(self._samples) < _FEWEST:
            raise GeometryError(
                f"the pose stream has {len(self._samples)} samples in memory, at least 4 are needed"
            )
        if self._stale:
            self._stamps = np.array([s.stamp_ns for s in self._samples], dtype=np.float64)
            self._T = np.array([s.T_B_E for s in self._samples])
            self._stale = False
        return smooth_at(
            self._stamps, self._T, np.atleast_1d(np.asarray(stamps_ns, dtype=np.float64)), self._half_s
        )


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
