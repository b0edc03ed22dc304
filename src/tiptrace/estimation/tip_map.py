"""Stage I in one solve: tip, what the gel shows of its motion, latency, grasp drift (``docs/estimation.md``, Tip map).

The markers show the tip displaced against the hand by ``D_t(c) = R^E_t c + t^E_t − c``; a resting tip p enforces
``u_t = T_B_E(s − τ)⁻¹ p − c_t``. With a 3×3 map G of what the gel shows, ``D_t(c_t) = G u_t``. Unknowns in order:
c (3), p (3), G (9, row-major), τ (1), ċ (3). Motions are noisy in rotation and translation; each carries its own
correction, eliminated frame by frame (Gauss-Helmert), so that noisy rotations do not bias c.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.estimation.anchor import TipPrior, fixed_point_ml
from tiptrace.estimation.motion import Motions
from tiptrace.estimation.pose_track import HandStates
from tiptrace.estimation.robust import scale_from_median, tukey_weight
from tiptrace.geometry.transforms import rotation_exp, skew
from tiptrace.types import BoolArray, FloatArray

C, P, G_, TAU, DRIFT = slice(0, 3), slice(3, 6), slice(6, 15), slice(15, 16), slice(16, 19)
_SIZE = 19
_I9 = np.eye(3).ravel()
_DIAGONAL = _I9 > 0


class TipMapConfig(BaseModel):
    """Priors and gates."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    learn_map: bool = True
    map_sigma: float = Field(default=0.10, gt=0)
    map_off_diagonal_sigma: float = Field(default=0.06, gt=0)
    map_shear_correlation: float = Field(default=0.8, ge=0, lt=1)  # of the two axes along the pads
    map_gate_m: float = Field(default=1e-3, gt=0)  # standard deviation of the enforced motion along an axis
    latency_s: float = 0.050  # where the rig says nothing
    latency_std_s: float = Field(default=0.030, gt=0)
    latency_gate_s: float = Field(default=0.010, gt=0)
    drift_sigma_m: float = Field(default=3e-3, gt=0)  # along the pads
    drift_normal_sigma_m: float = Field(default=1e-4, gt=0)  # across them, where the tool cannot slip
    hidden_drift: float = Field(default=0.3, ge=0)  # share of its σ that a drift without evidence still has
    drift_evidence: float = Field(default=3.0, gt=0)  # sigmas
    pose_sigma_m: float = Field(default=4e-5, gt=0)  # of the tip through the smoothed hand pose
    model_sigma_m: float = Field(default=1e-4, gt=0)  # what a linear map leaves
    outlier: float = Field(default=6.0, gt=0)  # whitened residual of a frame in which the tip did not rest
    iterations: int = Field(default=15, ge=3)


@dataclass(frozen=True, slots=True)
class TipMap:
    """Solution of Stage I.

    Attributes:
        theta: (19,) c, p, G row-major, τ (s), ċ.
        covariance: (19, 19); unknowns that a gate held at their prior keep its uncertainty.
        learned: (19,) which unknowns the data determined.
        residual_m: Root mean square of ``D_t(c_t) − G u_t``.
        correlation: How many frames say the same (1 = independent).
        frames: Frames used.
        duration_s: Length T_I of Stage I.
        residual: (T, 3) of ``D_t(c_t) − G u_t`` in F_E, m.
    """

    theta: FloatArray
    covariance: FloatArray
    learned: BoolArray
    residual_m: float
    correlation: float
    frames: int
    duration_s: float
    residual: FloatArray

    @property
    def c(self) -> FloatArray:
        """(3,) tip in F_E at the end of Stage I, m."""
        return self.theta[C]

    @property
    def p(self) -> FloatArray:
        """(3,) resting tip in F_B, m."""
        return self.theta[P]

    @property
    def G(self) -> FloatArray:
        """(3, 3) what the gel shows of a tip displacement in F_E."""
        return self.theta[G_].reshape(3, 3)

    @property
    def latency_s(self) -> float:
        """Capture stamp minus exposure."""
        return float(self.theta[15])

    @property
    def drift(self) -> FloatArray:
        """(3,) displacement of the tip in the grasp over the length of Stage I, m."""
        return self.theta[DRIFT]


HandAt = Callable[[float], HandStates]
"""Latency in s → the hand at every frame's exposure."""


def solve_tip_map(
    motions: Motions,
    hand_at: HandAt,
    phase: FloatArray,
    duration_s: float,
    config: TipMapConfig,
    latency: tuple[float, float] | None = None,
    prior: TipPrior | None = None,
    normal_E: FloatArray | None = None,
) -> TipMap:
    """Tip, map, latency and drift from Stage I.

    Args:
        motions: In-grasp motions of T frames.
        hand_at: Hand poses of the T frames for a latency.
        phase: (T,) t/T_I − 1: from −1 at the start of Stage I to 0 at its end.
        duration_s: T_I.
        config: Priors and gates.
        latency: Calibrated (mean, std) in s, where there is one.
        prior: Known tip in F_E.
        normal_E: (3,) closing axis in F_E; None: x.

    Raises:
        GeometryError: fewer than 3 frames.
    """
    normal = np.array([1.0, 0.0, 0.0]) if normal_E is None else normal_E
    latency = latency or (config.latency_s, config.latency_std_s)
    solver = _Solver(motions, hand_at, phase, config, latency, prior, normal)
    theta = solver.start()
    free = np.ones(_SIZE, dtype=bool)
    free[DRIFT] = False
    learned_column = solver.moved(theta) > config.map_gate_m
    free[G_] = (np.tile(learned_column, 3) | _DIAGONAL) & config.learn_map & bool(learned_column.any())
    best = solver.solve(theta, free)
    if solver.map_is_absurd(best):
        free[G_] = False
        best = solver.solve(theta, free)
    if latency_too_vague(best, config):
        free[TAU] = False
        best = solver.solve(theta, free)
    drifting = free.copy()
    drifting[DRIFT] = True
    candidate = solver.solve(best.theta, drifting)
    along = np.linalg.svd(normal[None])[2][1:]  # (2, 3) in the pads' plane: only there can a tool slip
    sigma = np.sqrt(np.diag(along @ candidate.covariance[DRIFT, DRIFT] @ along.T))
    if np.any(np.abs(along @ candidate.drift) > config.drift_evidence * sigma):
        best = candidate
    else:  # less drift than three sigmas may still be there
        best.covariance[DRIFT, DRIFT] = config.hidden_drift**2 * candidate.covariance[DRIFT, DRIFT]
    return TipMap(
        best.theta, best.covariance, best.learned, best.rms, best.factor, len(phase), duration_s, best.r
    )


def assumed_tip_map(
    tip: TipPrior, config: TipMapConfig, latency: tuple[float, float] | None, normal_E: FloatArray
) -> TipMap:
    """A tip taken from elsewhere, with everything else at its prior: there was no Stage I.

    Args:
        tip: Tip in F_E with its covariance.
        config: Priors.
        latency: Calibrated (mean, std) in s, where there is one.
        normal_E: (3,) closing axis in F_E.
    """
    mean_s, std_s = latency or (config.latency_s, config.latency_std_s)
    theta = np.concatenate([tip.c, np.zeros(3), _I9, [mean_s], np.zeros(3)])
    covariance = np.zeros((_SIZE, _SIZE))
    covariance[C, C] = tip.covariance
    covariance[G_, G_] = _map_prior(config, normal_E)
    covariance[TAU, TAU] = std_s**2
    nothing = np.zeros(_SIZE, dtype=bool)
    return TipMap(theta, covariance, nothing, 0.0, 1.0, 0, 1.0, np.zeros((0, 3)))


@dataclass(frozen=True, slots=True)
class _Solution:
    theta: FloatArray
    covariance: FloatArray
    learned: BoolArray
    rms: float
    factor: float
    r: FloatArray

    @property
    def drift(self) -> FloatArray:
        return self.theta[DRIFT]


def latency_too_vague(solution: _Solution, config: TipMapConfig) -> bool:
    """Whether τ must stay at its calibrated value."""
    return bool(np.sqrt(solution.covariance[15, 15]) > config.latency_gate_s)


class _Solver:
    def __init__(
        self,
        motions: Motions,
        hand_at: HandAt,
        phase: FloatArray,
        config: TipMapConfig,
        latency: tuple[float, float],
        prior: TipPrior | None,
        normal: FloatArray,
    ) -> None:
        self._m, self._hand_at, self._phase, self._config = motions, hand_at, phase, config
        self._latency, self._prior = latency, prior
        self._mean = np.concatenate([np.zeros(6), _I9, [latency[0]], np.zeros(3)])
        self._prior_P = np.zeros((_SIZE, _SIZE))  # of what has a prior; c and p have none here
        self._prior_P[G_, G_] = _map_prior(config, normal)
        self._prior_P[TAU, TAU] = latency[1] ** 2
        across = np.outer(normal, normal)
        self._prior_P[DRIFT, DRIFT] = (
            config.drift_sigma_m**2 * (np.eye(3) - across) + config.drift_normal_sigma_m**2 * across
        )
        self._prior_N = np.zeros((_SIZE, _SIZE))
        self._prior_N[6:, 6:] = np.linalg.inv(self._prior_P[6:, 6:])
        if prior is not None:
            self._mean[C] = prior.c
            self._prior_N[C, C] = np.linalg.inv(prior.covariance)

    def start(self) -> FloatArray:
        """Maximum likelihood with the gel taken at its word and the latency at its prior."""
        T = self._hand_at(self._latency[0]).T_B_E
        R_BE = T[:, :3, :3]
        rotate = np.zeros((len(T), 6, 6))
        rotate[:, :3, :3] = rotate[:, 3:, 3:] = R_BE
        t = np.einsum("tij,tj->ti", R_BE, self._m.t) + T[:, :3, 3]
        centre = np.einsum("tij,tj->ti", R_BE, self._m.centre) + T[:, :3, 3]
        Sigma = rotate @ self._m.covariance @ np.swapaxes(rotate, 1, 2)
        Sigma[:, range(3, 6), range(3, 6)] += self._config.pose_sigma_m**2 + self._config.model_sigma_m**2
        point = fixed_point_ml(R_BE @ self._m.R, t, Sigma, centre, prior=self._prior, outliers=True)
        theta = self._mean.copy()
        theta[C], theta[P] = point.c, point.p
        return theta

    def map_is_absurd(self, solution: _Solution) -> bool:
        """Whether the fit left its prior by more than four sigmas: the tip did not rest, or the map diverged."""
        off = solution.theta[G_] - _I9
        return bool(off @ np.linalg.solve(self._prior_P[G_, G_], off) > 4.0**2 + 9.0)

    def moved(self, theta: FloatArray) -> FloatArray:
        """Standard deviation of the enforced motion along each axis of F_E, (3,) m."""
        T = self._hand_at(float(theta[15])).T_B_E
        u = np.einsum("tji,tj->ti", T[:, :3, :3], theta[P] - T[:, :3, 3])
        return np.asarray(u.std(axis=0))

    def solve(self, theta: FloatArray, free: BoolArray) -> _Solution:
        """Gauss-Helmert iterations over the free unknowns; the others stay at their prior."""
        theta = np.where(free, theta, self._mean)
        k = np.zeros((len(self._phase), 3))
        delta = np.zeros((len(self._phase), 6))
        weights = np.ones(len(self._phase))
        index = np.flatnonzero(free)
        for iteration in range(self._config.iterations):
            A, S_inv, w, lever = self._linearise(theta, delta)
            WA = weights[:, None, None] * (S_inv @ A)
            N = np.einsum("tij,tik->jk", A, WA, optimize=True) + self._prior_N
            b = -np.einsum("tij,ti->j", WA, w) + self._prior_N @ (self._mean - theta)
            N_ff = N[np.ix_(index, index)]
            step = np.zeros(_SIZE)
            step[index] = np.linalg.solve(N_ff + 1e-12 * np.diag(np.diag(N_ff)), b[index])
            misfit = w + A @ step
            k = np.einsum("tij,tj->ti", S_inv, misfit)
            length = np.sqrt(np.maximum(np.einsum("ti,ti->t", misfit, k), 0.0))
            scale = max(1.0, scale_from_median(length))
            weights = tukey_weight(length, max(self._config.outlier, 20.0 * 0.7**iteration) * scale)
            delta = -np.einsum(
                "tij,tj->ti", self._m.covariance, np.concatenate([np.cross(lever, k), k], axis=1)
            )
            theta = theta + step
            if iteration > 4 and np.abs(step[:6]).max() < 1e-6:
                break
        return self._finish(theta, free, delta, weights)

    def _linearise(
        self, theta: FloatArray, delta: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """A (T, 3, 19), S⁻¹ (T, 3, 3), misclosure (T, 3), lever (T, 3) at the corrected motions."""
        m, T = self._m, len(self._phase)
        p, G, tau = theta[P], theta[G_].reshape(3, 3), float(theta[15])
        c_t = theta[C] + self._phase[:, None] * theta[DRIFT]  # (T, 3)
        hand = self._hand_at(tau)
        R_BE, t_BE = hand.T_B_E[:, :3, :3], hand.T_B_E[:, :3, 3]
        q = np.einsum("tji,tj->ti", R_BE, p - t_BE)  # resting tip in F_E
        u = q - c_t
        du_ds = -np.cross(hand.rate_E, q) - np.einsum("tji,tj->ti", R_BE, hand.velocity_B)
        E = rotation_exp(delta[:, :3])
        R = E @ m.R
        lever_0 = np.einsum("tij,tj->ti", m.R, c_t) + m.t - m.centre
        lever = np.einsum("tij,tj->ti", E, lever_0)
        y = lever + m.centre + delta[:, 3:]
        B = np.concatenate([-skew(lever), np.broadcast_to(np.eye(3), (T, 3, 3))], axis=2)
        S = B @ m.covariance @ np.swapaxes(B, 1, 2)
        S[:, range(3), range(3)] += self._config.pose_sigma_m**2 + self._config.model_sigma_m**2
        A = np.zeros((T, 3, _SIZE))
        A[:, :, C] = R - np.eye(3) + G
        A[:, :, P] = -G @ np.swapaxes(R_BE, 1, 2)
        for j in range(3):
            A[:, j, 6 + 3 * j : 9 + 3 * j] = -u
        A[:, :, 15] = du_ds @ G.T
        A[:, :, DRIFT] = self._phase[:, None, None] * A[:, :, C]
        r = y - c_t - u @ G.T
        return A, np.linalg.inv(S), r - np.einsum("tij,tj->ti", B, delta), lever

    def _finish(
        self, theta: FloatArray, free: BoolArray, delta: FloatArray, weights: FloatArray
    ) -> _Solution:
        """Covariance with correlated residuals, rotation noise not counted as motion, gates' priors kept."""
        A, S_inv, _, _ = self._linearise(theta, delta)
        r = self._linearise(theta, np.zeros_like(delta))[2]
        rested = weights > 0.1
        factor = _inflation(r[rested], S_inv[rested])
        N = np.einsum("tij,tik->jk", A, weights[:, None, None] * (S_inv @ A), optimize=True) / factor
        N[C, C] -= self._spurious(S_inv, weights) / factor
        N += self._prior_N
        f, h = np.flatnonzero(free), np.flatnonzero(~free)
        h = h[(h >= 6) & (h < 16)]  # a drift that no evidence speaks for is not considered
        P_ff = _scaled_inverse(N[np.ix_(f, f)])
        covariance = np.zeros((_SIZE, _SIZE))
        covariance[np.ix_(f, f)] = P_ff
        if len(h):
            K = -P_ff @ N[np.ix_(f, h)]
            P_h = self._prior_P[np.ix_(h, h)]
            covariance[np.ix_(f, f)] += K @ P_h @ K.T
            covariance[np.ix_(f, h)] = K @ P_h
            covariance[np.ix_(h, f)] = P_h @ K.T
            covariance[np.ix_(h, h)] = P_h
        rms = float(np.sqrt(np.average(np.sum(r * r, axis=1), weights=np.maximum(weights, 1e-9))))
        return _Solution(theta, covariance, free, rms, factor, r)

    def _spurious(self, S_inv: FloatArray, weights: FloatArray) -> FloatArray:
        """Information on c that mere rotation noise seems to carry, (3, 3)."""
        K = skew(np.eye(3))
        E = np.einsum("tmn,mki,tkl,nlj->tij", self._m.covariance[:, :3, :3], K, S_inv, K, optimize=True)
        return np.asarray(np.einsum("t,tki,tkl,tlj->ij", weights, self._m.R, E, self._m.R, optimize=True))


def _map_prior(config: TipMapConfig, normal: FloatArray) -> FloatArray:
    """Covariance (9, 9) of G, row-major: what the gel shows along the two axes in the pads' plane is alike."""
    basis = np.linalg.svd(normal[None])[2]  # rows: normal, two axes along the pads
    sigma = np.where(np.eye(3) > 0, config.map_sigma, config.map_off_diagonal_sigma).ravel()
    P = np.diag(sigma**2)
    P[4, 8] = P[8, 4] = config.map_shear_correlation * config.map_sigma**2
    turn = np.kron(basis.T, basis.T)  # G_E = basisᵀ G_pad basis
    return np.asarray(turn @ P @ turn.T)


def _scaled_inverse(N: FloatArray) -> FloatArray:
    """Inverse of an information matrix over unlike units, by scaling to a unit diagonal."""
    s = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-12))
    values, vectors = np.linalg.eigh(N * np.outer(s, s))
    values = np.maximum(values, 1e-9)
    return np.asarray(np.outer(s, s) * ((vectors / values) @ vectors.T))


def _inflation(r: FloatArray, S_inv: FloatArray) -> float:
    """How much less the frames say than independent frames of the assumed noise would, ≥ 1.

    Variance of the whitened residuals times the sum of their autocorrelation (Bartlett window), (T, 3) → 1.
    """
    L = np.linalg.cholesky(S_inv + 1e-9 * np.eye(3))
    z = np.einsum("tji,tj->ti", L, r)  # (T, 3)
    z = z - z.mean(axis=0)
    T = len(z)
    variance = float(np.mean(z * z))
    if T < 8 or variance < 1e-12:
        return 1.0
    reach = max(2, T // 5)
    lags = [float(np.mean(z[k:] * z[:-k])) * (T - k) / T / variance for k in range(1, reach)]
    correlation = 1.0 + 2.0 * sum((1.0 - k / reach) * rho for k, rho in enumerate(lags, start=1))
    return max(1.0, variance * max(correlation, 1.0))
