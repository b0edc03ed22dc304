"""Rigid alignment of corresponding points (paper, Sec. II-D; Kabsch 1976)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.errors import GeometryError
from tiptrace.types import FloatArray

_COLLINEAR = 1e-6  # second singular value over the first, below which points lie on a line


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """(R, d) with ``x_t = R x_0 + d``.

    Attributes:
        R: (3, 3) rotation.
        d: (3,) translation, m.
        residual_m: Root mean square distance left, m.
    """

    R: FloatArray
    d: FloatArray
    residual_m: float


def kabsch(X_0: ArrayLike, X_t: ArrayLike) -> RigidMotion:
    """Least-squares rigid motion from X_0 to X_t, (N, 3) each, m.

    Raises:
        GeometryError: fewer than three points, or all points on a line.
    """
    X_0, X_t = np.asarray(X_0, dtype=np.float64), np.asarray(X_t, dtype=np.float64)
    if X_0.shape != X_t.shape or X_0.ndim != 2 or X_0.shape[1] != 3:
        raise GeometryError(f"point sets must both be (N, 3), got {X_0.shape} and {X_t.shape}")
    if len(X_0) < 3:
        raise GeometryError(f"a rigid motion needs at least 3 markers, got {len(X_0)}")
    mean_0, mean_t = X_0.mean(axis=0), X_t.mean(axis=0)
    spread = np.linalg.svd(X_0 - mean_0, compute_uv=False)  # (3,)
    if spread[1] <= _COLLINEAR * spread[0]:
        raise GeometryError("markers lie on a line: the rotation about it cannot be seen")
    H = (X_0 - mean_0).T @ (X_t - mean_t)  # (3, 3)
    U, _, Vt = np.linalg.svd(H)
    sign = np.sign(np.linalg.det(Vt.T @ U.T))
    R = Vt.T @ np.diag([1.0, 1.0, sign]) @ U.T  # proper rotation
    d = mean_t - R @ mean_0
    residual = X_0 @ R.T + d - X_t
    return RigidMotion(R=R, d=d, residual_m=float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))))
