"""The paper's ground truth: an analytic groove centreline anchored at a measured start (Sec. III-B)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.errors import TipTraceError
from tiptrace.types import FloatArray, PoseSample, TruthSample

GROOVE_LENGTH_M = 0.200


@dataclass(frozen=True, slots=True)
class Centreline:
    """Lateral deviation y(x) of a groove, x from 0 at its start along its direction, both m."""

    name: str
    lateral: Callable[[FloatArray], FloatArray]

    def offset(self, x: ArrayLike, yaw_rad: float = 0.0) -> FloatArray:
        """Offsets from the start in the base frame: (n,) m → (n, 3) m, turned by ``yaw_rad`` about z."""
        x = np.asarray(x, dtype=np.float64)
        y = self.lateral(x)
        y = y - self.lateral(np.zeros(1))
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        return np.stack([c * x - s * y, s * x + c * y, np.zeros_like(x)], axis=-1)


def straight() -> Centreline:
    """T1."""
    return Centreline("straight", np.zeros_like)


def arc(sagitta_m: float, chord_m: float = GROOVE_LENGTH_M) -> Centreline:
    """Circular arc over a chord with the given greatest lateral deviation (T2: 8 mm)."""
    radius = (chord_m**2 / 4 + sagitta_m**2) / (2 * sagitta_m)
    half = chord_m / 2

    def lateral(x: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.maximum(radius**2 - (x - half) ** 2, 0.0)) - (radius - sagitta_m))

    return Centreline("arc", lateral)


def sine(period_m: float, amplitude_m: float) -> Centreline:
    """``y = A sin(2πx/P)`` with A the peak (T3 to T5)."""
    return Centreline("sine", lambda x: np.asarray(amplitude_m * np.sin(2 * np.pi * x / period_m)))


CENTRELINES: dict[str, Centreline] = {
    "T1": straight(),
    "T2": arc(0.008),
    "T3": sine(0.050, 0.004),
    "T4": sine(0.020, 0.002),
    "T5": sine(0.100, 0.008),
}


def analytic_truth(
    centreline: Centreline,
    start_B: ArrayLike,
    poses: Sequence[PoseSample],
    anchoring_end_ns: int,
    yaw_rad: float = 0.0,
) -> list[TruthSample]:
    """Truth of the paper's evaluation, one sample per end-effector pose.

    ``x_gt(t) = x_gt(0) + x_E(t) − x_E(τ_cal)`` along the groove and the centreline across it; before
    τ_cal the start. Friction makes the tip trail the end effector, which counts as error in this mode.

    Args:
        centreline: Groove.
        start_B: (3,) measured start p^gt(0), m.
        poses: End-effector poses.
        anchoring_end_ns: τ_cal.
        yaw_rad: Direction of the groove in the base frame.

    Raises:
        TipTraceError: no pose at or after τ_cal.
    """
    start = np.asarray(start_B, dtype=np.float64)
    poses = sorted(poses, key=lambda pose: pose.stamp_ns)
    after = [pose for pose in poses if pose.stamp_ns >= anchoring_end_ns]
    if not after:
        raise TipTraceError(
            "analytic ground truth needs end-effector poses after the end of anchoring; there are none"
        )
    forward = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
    x_cal = float(after[0].T_B_E[:3, 3] @ forward)
    x_E = np.array([pose.T_B_E[:3, 3] @ forward for pose in poses])  # (n,)
    x = np.where([pose.stamp_ns >= anchoring_end_ns for pose in poses], x_E - x_cal, 0.0)
    p_B = start + centreline.offset(x, yaw_rad)  # (n, 3)
    return [TruthSample(pose.stamp_ns, p) for pose, p in zip(poses, p_B, strict=True)]
