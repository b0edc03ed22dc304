"""The point that stays: Stage I of the paper and pivot calibration, by linear least squares.

The paper's form ``(I − R_t) p = d_t`` refers every motion to frame 0, whose noise enters all rows. The joint
form ``R_i c + t_i = p`` treats all poses alike and also yields the tip in the tool frame; prefer it where
absolute poses exist.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.errors import GeometryError
from tiptrace.types import FloatArray

_RANK_TOLERANCE = 1e-9  # smallest over largest eigenvalue of the normal matrix that still counts as full rank
_STILL_RAD = np.deg2rad(0.05)  # less rotation than this in the whole set is none


@dataclass(frozen=True, slots=True)
class FixedPoint:
    """Solution of ``(I − R_t) p = d_t``.

    Attributes:
        p: (3,) fixed point, m.
        residual_m: Root mean square of ‖(I − R_t) p − d_t‖ over frames, m.
        frames: Number of motions.
        information: (3, 3) normal matrix Σ (I − R_t)ᵀ(I − R_t), dimensionless.
    """

    p: FloatArray
    residual_m: float
    frames: int
    information: FloatArray


class FixedPointAccumulator:
    """Normal equations of the paper's Eq. (fixedpoint_ls), one motion at a time, in constant memory."""

    def __init__(self) -> None:
        self._AtA = np.zeros((3, 3))
        self._Atb = np.zeros(3)
        self._btb = 0.0
        self.frames = 0

    def add(self, R: ArrayLike, d: ArrayLike) -> None:
        """Accumulate ``(I − R_t) p ≈ d_t``: R (3, 3), d (3,) m."""
        A = np.eye(3) - np.asarray(R)  # (3, 3)
        b = np.asarray(d)  # (3,)
        self._AtA += A.T @ A
        self._Atb += A.T @ b
        self._btb += float(b @ b)
        self.frames += 1

    def solve(self) -> FixedPoint | None:
        """Least-squares fixed point, or None while the motions leave it undetermined (rank below 3)."""
        eigenvalues = np.linalg.eigvalsh(self._AtA)
        if self.frames == 0 or eigenvalues[0] <= _RANK_TOLERANCE * max(eigenvalues[2], _STILL_RAD**2):
            return None
        p = np.asarray(np.linalg.solve(self._AtA, self._Atb), dtype=np.float64)
        squared = max(self._btb - float(p @ self._Atb), 0.0)  # ‖A p − b‖² at the optimum
        return FixedPoint(p, float(np.sqrt(squared / self.frames)), self.frames, self._AtA.copy())


@dataclass(frozen=True, slots=True)
class Pivot:
    """Solution of ``R_i c + t_i = p``.

    Attributes:
        tip: (3,) c in the tool frame, m.
        pivot: (3,) p in the base frame, m.
        residuals: (n, 3) R_i c + t_i − p, m.
        covariance: (6, 6) of (c, p), m², from the residuals' own variance.
        weak_axes: Unit vectors in the tool frame along which the poses do not determine the tip.
    """

    tip: FloatArray
    pivot: FloatArray
    residuals: FloatArray
    covariance: FloatArray
    weak_axes: tuple[FloatArray, ...]

    @property
    def residual_m(self) -> float:
        """Root mean square length of the residuals, m."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=1))))


def solve_pivot(T: ArrayLike) -> Pivot:
    """Tip and pivot from poses of a tool turned about its fixed tip: T_B_T (n, 4, 4), m.

    Directions that the poses leave open get the smallest tip (minimum norm) and are listed as weak axes.

    Raises:
        GeometryError: fewer than three poses, or no rotation between them.
    """
    T = np.asarray(T, dtype=np.float64)
    n = len(T)
    if n < 3:
        raise GeometryError(f"pivot calibration needs at least 3 poses, got {n}")
    R, t = T[:, :3, :3], T[:, :3, 3]
    cosine = (np.einsum("nij,ij->n", R, R[0]) - 1.0) / 2.0  # angle to the first pose
    if np.max(1.0 - cosine) < 1.0 - np.cos(_STILL_RAD):
        raise GeometryError(
            "the poses do not rotate: turn the tool about its resting tip, about two axes or more"
        )
    A = np.concatenate([R, np.broadcast_to(-np.eye(3), R.shape)], axis=2).reshape(-1, 6)  # (3n, 6)
    b = -t.reshape(-1)  # (3n,)
    U, s, Vt = np.linalg.svd(A, full_matrices=False)
    kept = s > 1e-6 * s[0]
    x = Vt.T[:, kept] @ ((U.T @ b)[kept] / s[kept])  # (6,)
    residuals = (A @ x - b).reshape(n, 3)
    variance = float(np.sum(residuals**2)) / max(3 * n - 6, 1)
    covariance = variance * (Vt.T[:, kept] / s[kept] ** 2) @ Vt[kept]
    return Pivot(x[:3], x[3:], residuals, covariance, _weak_tip_axes(R))


def _weak_tip_axes(R: FloatArray, *, spread_deg: float = 2.0) -> tuple[FloatArray, ...]:
    """Tool-frame axes a that the rotations leave (nearly) unmoved: R_i a is the same in all poses."""
    mean = R.mean(axis=0)  # (3, 3)
    scatter = np.eye(3) - mean.T @ mean  # aᵀ S a = mean ‖R_i a − R̄ a‖²
    values, vectors = np.linalg.eigh(scatter)
    return tuple(vectors[:, k] for k in range(3) if values[k] < np.deg2rad(spread_deg) ** 2)


def relative_motions(T: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Motions from the first pose, as the paper uses them: T_B_T (n, 4, 4) → R_t (n, 3, 3), d_t (n, 3)."""
    T = np.asarray(T, dtype=np.float64)
    R_t = T[:, :3, :3] @ T[0, :3, :3].T
    d_t = T[:, :3, 3] - np.einsum("nij,j->ni", R_t, T[0, :3, 3])
    return R_t, d_t
