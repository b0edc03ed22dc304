"""The resting tip by maximum likelihood: fixed point of noisy rigid poses (``docs/estimation.md``, Anchor).

Model: a tool with pose ``(R_t, t_t)`` turns about a tip that rests, ``R_t c + t_t = p``. Rotations and
translations are both noisy. Least squares takes the noisy rotations for exact and is pulled towards the markers;
here every pose carries its own correction, eliminated frame by frame (Schur complement), so that the Jacobian is
taken at the corrected rotations. This is the Gauss-Helmert form of maximum likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.errors import GeometryError
from tiptrace.estimation.gauss_helmert_kernels import (
    corrections,
    fixed_point_rows,
    normal_equations,
    spurious,
)
from tiptrace.estimation.robust import annealed_limits, huber_weight, scale_from_median, tukey_weight
from tiptrace.geometry.transforms import skew
from tiptrace.types import FloatArray

_UNKNOWN_M = 1.0  # a direction without information gets this standard deviation
_HUBER, _TUKEY = 2.5, 6.0  # Tukey wide: pointer poses have heavy tails that are no outliers
_CONVERGED_M = 1e-9


@dataclass(frozen=True, slots=True)
class TipPrior:
    """What is known of the tip in the moving frame beforehand: mean (3,) m and covariance (3, 3) m²."""

    c: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class FixedPointML:
    """Fixed point of a set of poses.

    Attributes:
        c: (3,) tip in the moving frame, m.
        p: (3,) tip in the fixed frame, m.
        covariance: (6, 6) of (c, p), m².
        weights: (T,) robust weight of each pose, 0 = outlier.
        residual_m: Root mean square of ``R_t c + t_t − p`` over the poses in use.
        scale: Factor found between assumed and actual noise (1 where it was not estimated).
    """

    c: FloatArray
    p: FloatArray
    covariance: FloatArray
    weights: FloatArray
    residual_m: float
    scale: float

    @property
    def covariance_c(self) -> FloatArray:
        """(3, 3) of the tip in the moving frame, m²."""
        return self.covariance[:3, :3]

    @property
    def covariance_p(self) -> FloatArray:
        """(3, 3) of the tip in the fixed frame, m²."""
        return self.covariance[3:, 3:]


def fixed_point_ml(
    R: ArrayLike,
    t: ArrayLike,
    covariance: ArrayLike | None = None,
    centre: ArrayLike | None = None,
    *,
    prior: TipPrior | None = None,
    outliers: bool = False,
    iterations: int = 30,
) -> FixedPointML:
    """Fixed point of poses ``x ↦ R_t x + t_t`` by maximum likelihood.

    Args:
        R: (T, 3, 3) rotations.
        t: (T, 3) translations, m.
        covariance: (T, 6, 6) or (6, 6) noise of a pose as (rotation vector rad, translation m), both in the fixed
            frame, the rotation about ``centre``. None: 1 mm and 1 mrad, scaled to the residuals.
        centre: (T, 3) or (3,) points of the fixed frame about which the rotation noise acts; None: t.
        prior: Gaussian knowledge of c.
        outliers: Expect gross errors (up to about 40 % of the poses): annealed Tukey weights; otherwise Huber.
        iterations: At most this many after the annealing.

    Raises:
        GeometryError: fewer than 3 poses, values that are not finite, or poses that no point fits.
    """
    problem = _Problem.of(R, t, covariance, centre, prior)
    try:
        return _solve(problem, outliers, iterations)
    except np.linalg.LinAlgError:
        raise GeometryError(
            "the poses determine no fixed point: the solution runs away; was the tip at rest, and did the tool turn?"
        ) from None


def _solve(problem: _Problem, outliers: bool, iterations: int) -> FixedPointML:
    """Weights and Gauss-Helmert steps in turn, until the point stays."""
    state = problem.start()
    scale = 1.0
    if outliers:
        longest = float(problem.lengths(state).max())
        for limit in annealed_limits(
            longest, _TUKEY * max(scale_from_median(problem.lengths(state)), 1e-9) / 3
        ):
            state = problem.step(state, tukey_weight(problem.lengths(state), limit))
    for _ in range(iterations):
        lengths = problem.lengths(state)
        if problem.scale_unknown:
            scale = max(scale_from_median(lengths), 1e-9)
        weigh = tukey_weight(lengths, _TUKEY * scale) if outliers else huber_weight(lengths, _HUBER * scale)
        previous, state = state, problem.step(state, weigh)
        if np.abs(state.theta - previous.theta).max() < _CONVERGED_M:
            break
    return problem.result(state, scale)


@dataclass(frozen=True, slots=True)
class _State:
    theta: FloatArray  # (6,) c, p
    delta: FloatArray  # (T, 6) corrections of the poses
    weights: FloatArray  # (T,)


@dataclass(frozen=True, slots=True)
class _Problem:
    R: FloatArray
    t: FloatArray
    Sigma: FloatArray  # (T, 6, 6)
    centre: FloatArray  # (T, 3)
    prior: TipPrior | None
    scale_unknown: bool

    @classmethod
    def of(
        cls,
        R: ArrayLike,
        t: ArrayLike,
        covariance: ArrayLike | None,
        centre: ArrayLike | None,
        prior: TipPrior | None,
    ) -> _Problem:
        R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
        if R.ndim != 3 or R.shape[1:] != (3, 3) or t.shape != (len(R), 3):
            raise GeometryError(f"poses must be R (T, 3, 3) and t (T, 3), got {R.shape} and {t.shape}")
        if len(R) < 3:
            raise GeometryError(f"a fixed point needs at least 3 poses, got {len(R)}")
        if not (np.isfinite(R).all() and np.isfinite(t).all()):
            raise GeometryError(
                "the poses contain values that are not finite: leave out frames without a pose"
            )
        default = np.diag([1e-3] * 6) ** 2
        Sigma = np.broadcast_to(default if covariance is None else np.asarray(covariance), (len(R), 6, 6))
        g = t if centre is None else np.broadcast_to(np.asarray(centre, dtype=np.float64), t.shape)
        return cls(
            np.ascontiguousarray(R),
            np.ascontiguousarray(t),
            np.ascontiguousarray(Sigma),
            np.ascontiguousarray(g),
            prior,
            covariance is None,
        )

    def start(self) -> _State:
        """Least squares on ``R_t c + t_t = p``, a prior (or 10 m) holding what the data leave open."""
        A = np.concatenate([self.R, np.broadcast_to(-np.eye(3), self.R.shape)], axis=2)  # (T, 3, 6)
        N = np.einsum("tij,tik->jk", A, A)
        b = -np.einsum("tij,ti->j", A, self.t)
        c_0 = np.zeros(3) if self.prior is None else self.prior.c
        hold = np.diag([1e-10 * len(self.R)] * 3 + [0.0] * 3)
        if self.prior is not None:
            hold[:3, :3] = np.linalg.inv(self.prior.covariance) * 1e-6
        b[:3] += hold[:3, :3] @ c_0
        theta = np.linalg.solve(N + hold, b)
        return _State(theta, np.zeros((len(self.R), 6)), np.ones(len(self.R)))

    def _linearise(self, state: _State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Jacobian A (T, 3, 6), S^{-1} (T, 3, 3), misclosure w (T, 3) at the corrected poses."""
        return fixed_point_rows(state.theta, state.delta, self.R, self.t, self.Sigma, self.centre)[:3]

    def step(self, state: _State, weights: FloatArray) -> _State:
        """One Gauss-Helmert step."""
        A, S_inv, w, lever = fixed_point_rows(
            state.theta, state.delta, self.R, self.t, self.Sigma, self.centre
        )
        N, b = normal_equations(A, S_inv, w, weights)
        if self.prior is not None:
            P = np.linalg.inv(self.prior.covariance)
            N[:3, :3] += P
            b[:3] += P @ (self.prior.c - state.theta[:3])
        N += max(1e-12 * float(np.trace(N)), 1e-9) * np.eye(6)
        step = np.asarray(np.linalg.solve(N, b), dtype=np.float64)
        _, delta = corrections(A, S_inv, w, lever, self.Sigma, step)
        return _State(state.theta + step, delta, weights)

    def lengths(self, state: _State) -> FloatArray:
        """Whitened lengths of the misclosure ``R_t c + t_t − p``, (T,)."""
        A, S_inv, w, lever = fixed_point_rows(
            state.theta, np.zeros_like(state.delta), self.R, self.t, self.Sigma, self.centre
        )
        return corrections(A, S_inv, w, lever, self.Sigma, np.zeros(6))[0]

    def result(self, state: _State, scale: float) -> FixedPointML:
        """Estimate with its covariance; the noise of the rotations is not counted as motion."""
        c, p = state.theta[:3], state.theta[3:]
        A, S_inv, _ = self._linearise(state)
        N = normal_equations(A, S_inv, np.zeros((len(A), 3)), state.weights)[0] / scale**2
        N[:3, :3] -= self._spurious(state, S_inv)  # S and the rotation noise scale alike
        if self.prior is not None:
            N[:3, :3] += np.linalg.inv(self.prior.covariance)
        r = self.R @ c + self.t - p
        mean_square = float(np.average(np.sum(r * r, axis=1), weights=np.maximum(state.weights, 1e-12)))
        return FixedPointML(c, p, covariance_from_information(N), state.weights, np.sqrt(mean_square), scale)

    def _spurious(self, state: _State, S_inv: FloatArray) -> FloatArray:
        """Information on c that mere rotation noise seems to carry, (3, 3)."""
        lever = self.R @ state.theta[:3] + self.t - self.centre
        Sigma_w = self.Sigma[:, :3, :3]
        B = np.concatenate([-skew(lever), np.broadcast_to(np.eye(3), self.R.shape)], axis=2)
        gain = self.Sigma[:, :3] @ np.swapaxes(B, 1, 2)  # (T, 3, 3)
        posterior = Sigma_w - gain @ S_inv @ np.swapaxes(gain, 1, 2)
        return spurious(np.ascontiguousarray(posterior), S_inv, self.R, state.weights)


def covariance_from_information(N: FloatArray) -> FloatArray:
    """Invert an information matrix; directions without information get a standard deviation of 1 m.

    The matrix over (c, p, ...) may be indefinite by rounding or by the subtraction of rotation noise.
    """
    values, vectors = np.linalg.eigh(0.5 * (N + N.T))
    values = np.maximum(values, 1.0 / _UNKNOWN_M**2)
    return np.asarray((vectors / values) @ vectors.T)
