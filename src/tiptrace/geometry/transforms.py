"""Rotations and rigid transforms as plain arrays; quaternions are xyzw.

Frames are in the names: ``T_B_E`` maps E coordinates to B, ``p_B = T_B_E @ p_E``, adjacent letters cancel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.errors import GeometryError
from tiptrace.types import FloatArray

_UNIT_TOLERANCE = 1e-3


def skew(v: ArrayLike) -> FloatArray:
    """Cross-product matrices: (..., 3) → (..., 3, 3) with ``skew(a) @ b = a × b``."""
    v = np.asarray(v, dtype=np.float64)
    S = np.zeros((*v.shape, 3))
    S[..., 0, 1], S[..., 0, 2] = -v[..., 2], v[..., 1]
    S[..., 1, 0], S[..., 1, 2] = v[..., 2], -v[..., 0]
    S[..., 2, 0], S[..., 2, 1] = -v[..., 1], v[..., 0]
    return S


def rotation_exp(w: ArrayLike) -> FloatArray:
    """Rotation matrices from rotation vectors (Rodrigues): (..., 3) rad → (..., 3, 3)."""
    w = np.asarray(w, dtype=np.float64)
    angle2 = np.sum(w * w, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle2 < 1e-8
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle2 / 6.0, np.sin(safe) / safe)  # sin θ / θ
    b = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(safe)) / safe**2)  # (1 − cos θ) / θ²
    S = skew(w)
    return np.asarray(np.eye(3) + a * S + b * (S @ S))


def rotation_log(R: ArrayLike) -> FloatArray:
    """Rotation vectors, angle in [0, π]: (..., 3, 3) → (..., 3) rad."""
    q = quaternion_from_rotation(R)  # (..., 4), w ≥ 0
    xyz, w = q[..., :3], q[..., 3]
    s = np.linalg.norm(xyz, axis=-1)
    angle = 2.0 * np.arctan2(s, w)
    scale = np.where(s < 1e-9, 2.0, angle / np.where(s < 1e-9, 1.0, s))
    return scale[..., None] * xyz


def rotation_from_quaternion(q_xyzw: ArrayLike) -> FloatArray:
    """Rotation matrices from unit quaternions: (..., 4) xyzw → (..., 3, 3).

    Raises:
        GeometryError: a quaternion whose norm is not 1 within 1e-3.
    """
    q = np.asarray(q_xyzw, dtype=np.float64)
    norm = np.linalg.norm(q, axis=-1)
    if not np.all(np.abs(norm - 1.0) < _UNIT_TOLERANCE):
        raise GeometryError(
            f"quaternion is not a unit quaternion (norm {float(np.max(norm)):.4g}); expected x, y, z, w"
        )
    x, y, z, w = np.moveaxis(q / norm[..., None], -1, 0)
    R = np.empty((*q.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
    )
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = (
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
    )
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = (
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )
    return R


def quaternion_from_rotation(R: ArrayLike) -> FloatArray:
    """Unit quaternions xyzw with w ≥ 0: (..., 3, 3) → (..., 4).

    Uses the largest of the four quaternion components as pivot, stable for every rotation.
    """
    R = np.asarray(R, dtype=np.float64)
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    a, b, c = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    d, e, f = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    candidates = np.stack(  # (..., 4 pivots, 4), each proportional to q
        [
            np.stack([1 + m00 - m11 - m22, d, e, a], axis=-1),
            np.stack([d, 1 - m00 + m11 - m22, f, b], axis=-1),
            np.stack([e, f, 1 - m00 - m11 + m22, c], axis=-1),
            np.stack([a, b, c, 1 + m00 + m11 + m22], axis=-1),
        ],
        axis=-2,
    )
    pivot = np.argmax(np.stack([candidates[..., k, k] for k in range(4)], axis=-1), axis=-1)
    q = np.take_along_axis(candidates, pivot[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))


def transform(R: ArrayLike, t: ArrayLike) -> FloatArray:
    """Homogeneous transforms from R (..., 3, 3) and t (..., 3): (..., 4, 4)."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def invert(T: ArrayLike) -> FloatArray:
    """Inverse rigid transforms: T_A_B → T_B_A, (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    R_T = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_T, -np.einsum("...ij,...j->...i", R_T, T[..., :3, 3]))


def apply(T: ArrayLike, x: ArrayLike) -> FloatArray:
    """Transform points: T_A_B (4, 4), x_B (..., 3) → x_A (..., 3)."""
    T = np.asarray(T, dtype=np.float64)
    return np.asarray(np.asarray(x, dtype=np.float64) @ T[:3, :3].T + T[:3, 3])


def interpolate(T_0: ArrayLike, T_1: ArrayLike, fraction: ArrayLike) -> FloatArray:
    """Interpolate poses: geodesic in SO(3), linear in translation; fraction in [0, 1], (...,) → (..., 4, 4)."""
    T_0, T_1 = np.asarray(T_0, dtype=np.float64), np.asarray(T_1, dtype=np.float64)
    s = np.asarray(fraction, dtype=np.float64)[..., None]
    R_0 = T_0[..., :3, :3]
    w = rotation_log(np.swapaxes(R_0, -1, -2) @ T_1[..., :3, :3])  # (..., 3) rad
    t = (1 - s) * T_0[..., :3, 3] + s * T_1[..., :3, 3]
    return transform(R_0 @ rotation_exp(s * w), t)
