"""Constant-velocity screw motions: the exponential coordinates of SE(3).

A twist (w, v) moves for unit time by ``T = [exp(w), V(w) v]``, V the left Jacobian of SO(3). Unlike rotation
and translation interpolated apart, a screw keeps a fixed point fixed: a hand that pivots about the tip goes
along an arc, not along its chord.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.geometry.transforms import invert, rotation_exp, rotation_log, skew, transform
from tiptrace.types import FloatArray


def left_jacobian(w: ArrayLike) -> FloatArray:
    """V(w) = I + (1 − cos θ)/θ² [w] + (θ − sin θ)/θ³ [w]²: (..., 3) rad → (..., 3, 3)."""
    w = np.asarray(w, dtype=np.float64)
    angle2 = np.sum(w * w, axis=-1)[..., None, None]
    small = angle2 < 1e-6
    safe = np.sqrt(np.where(small, 1.0, angle2))
    a = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - angle2 / 120.0, (safe - np.sin(safe)) / safe**3)
    S = skew(w)
    return np.asarray(np.eye(3) + a * S + b * (S @ S))


def interpolate_screw(T_0: ArrayLike, T_1: ArrayLike, fraction: ArrayLike) -> FloatArray:
    """Poses on the screw motion from T_0 to T_1: (..., 4, 4), fraction (...,) in [0, 1] → (..., 4, 4)."""
    T_0 = np.asarray(T_0, dtype=np.float64)
    s = np.asarray(fraction, dtype=np.float64)[..., None]
    T_step = invert(T_0) @ np.asarray(T_1, dtype=np.float64)
    w = rotation_log(T_step[..., :3, :3])  # (..., 3) rad
    v = np.linalg.solve(left_jacobian(w), T_step[..., :3, 3:])[..., 0]  # (..., 3) m
    sw = s * w
    t = (left_jacobian(sw) @ (s * v)[..., None])[..., 0]
    return np.asarray(T_0 @ transform(rotation_exp(sw), t))
