"""The solve behind the tip map: Gauss-Helmert over c, p, G, τ and ċ, with robust weights and gates' priors kept.

Unknowns in order: c (3), p (3), G (9, row-major), τ (1), ċ (3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tiptrace.estimation.anchor import TipPrior, fixed_point_ml
from tiptrace.estimation.gauss_helmert_kernels import corrections, linearise, normal_equations, spurious
from tiptrace.estimation.information import residual_noise, scaled_inverse
from tiptrace.estimation.motion import Motions
from tiptrace.estimation.pose_track import HandStates
from tiptrace.estimation.robust import scale_from_median, tukey_weight
from tiptrace.estimation.tip_map_config import (
    DRIFT,
    G_,
    I9,
    SIZE,
    TAU,
    C,
    P,
    TipMapConfig,
    map_prior,
)
from tiptrace.types import AnchorChecks, BoolArray, FloatArray, IntArray

_MAP_CHANGE = 0.02  # of the map after a slip

HandAt = Callable[[float], HandStates]
"""Latency in s → the hand at every frame's exposure."""


@dataclass(frozen=True, slots=True)
class Solution:
    """Result of one solve.

    Attributes:
        theta: (19,) unknowns.
        covariance: (19, 19).
        learned: (19,) which of them were free.
        rms: Root mean square residual, m.
        factor: How many frames say the same.
        noise: Variance of the frames' residuals over the assumed.
        r: (T, 3) residuals in F_E, m.
        delta: (T, 6) corrections of the motions.
        weights: (T,) robust weights.
    """

    theta: FloatArray
    covariance: FloatArray
    learned: BoolArray
    rms: float
    factor: float
    noise: float
    r: FloatArray
    delta: FloatArray
    weights: FloatArray

    @property
    def drift(self) -> FloatArray:
        """(3,) displacement in the grasp over Stage I, m."""
        return self.theta[DRIFT]


class Solver:
    """Stage I as equations; a few solves over different free unknowns share it."""

    def __init__(
        self,
        motions: Motions,
        hand_at: HandAt,
        phase: FloatArray,
        config: TipMapConfig,
        latency: tuple[float, float],
        prior: TipPrior | None,
        normal: FloatArray,
        steps: FloatArray | None = None,
        known: tuple[FloatArray, FloatArray] | None = None,
        noise: float = 1.0,
    ) -> None:
        """Weigh the priors.

        Args:
            motions: In-grasp motions of T frames.
            hand_at: Hand poses of the T frames for a latency.
            phase: (T,) t/T_I − 1.
            config: Priors and gates.
            latency: Calibrated (mean, std) in s.
            prior: Known tip in F_E.
            normal: (3,) closing axis in F_E.
            steps: (T, K) −1 before and 0 after each slip.
            known: G (3, 3) of an earlier solve and its covariance (9, 9), in place of the prior of G.
            noise: Variance of the frames over the assumed.
        """
        self._steps = np.zeros((len(phase), 0)) if steps is None else steps
        self.size: int = SIZE + 3 * self._steps.shape[1]
        self._m = replace(motions, covariance=noise * motions.covariance)
        self._hand_at, self._phase, self._config = hand_at, phase, config
        self._variance = noise * (config.pose_sigma_m**2 + config.model_sigma_m**2)
        self._shares = np.column_stack([phase, self._steps])  # (T, 1 + K) of drift and steps in c_t
        self._read: tuple[float, HandStates] | None = None
        self._latency, self._prior = latency, prior
        self._mean = np.concatenate([np.zeros(6), I9, [latency[0]], np.zeros(self.size - 16)])
        self._prior_P = np.zeros((self.size, self.size))  # of what has a prior; c and p have none here
        self._prior_P[G_, G_] = map_prior(config, normal)
        self._prior_P[TAU, TAU] = latency[1] ** 2
        across = np.outer(normal, normal)
        along = np.eye(3) - across
        for k, part in enumerate(self._moving):
            sigma = (config.drift_normal_sigma_m, config.step_normal_sigma_m)[k > 0]
            self._prior_P[part, part] = config.drift_sigma_m**2 * along + sigma**2 * across
        self._prior_N = np.zeros((self.size, self.size))
        if known is not None:
            G, covariance = known
            self._mean[G_] = G.ravel()
            self._prior_P[G_, G_] = covariance + _MAP_CHANGE**2 * np.eye(9)
        self._prior_N[6:, 6:] = np.linalg.inv(self._prior_P[6:, 6:])
        if prior is not None:
            self._mean[C] = prior.c
            self._prior_N[C, C] = np.linalg.inv(prior.covariance)

    @property
    def stepped(self) -> bool:
        """Whether the tool slipped: a drift that hides behind the steps must stay free, or it is missed."""
        return self.size > SIZE

    def slips_ahead(self, theta: FloatArray) -> FloatArray:
        """Covariance (3, 3) of the drift: a tool that slipped in Stage I slips on, as far and either way, m²."""
        steps = theta[SIZE:].reshape(-1, 3)
        return np.asarray(self._config.slip_again**2 * steps.T @ steps)

    @property
    def _moving(self) -> list[slice]:
        """Where drift and steps stand among the unknowns."""
        return [DRIFT] + [slice(k, k + 3) for k in range(SIZE, self.size, 3)]

    def start(self) -> FloatArray:
        """Maximum likelihood with the gel taken at its word and the latency at its prior."""
        T = self._hand(self._latency[0]).T_B_E
        R_BE = T[:, :3, :3]
        rotate = np.zeros((len(T), 6, 6))
        rotate[:, :3, :3] = rotate[:, 3:, 3:] = R_BE
        t = np.einsum("tij,tj->ti", R_BE, self._m.t) + T[:, :3, 3]
        centre = np.einsum("tij,tj->ti", R_BE, self._m.centre) + T[:, :3, 3]
        Sigma = rotate @ self._m.covariance @ np.swapaxes(rotate, 1, 2)
        Sigma[:, range(3, 6), range(3, 6)] += self._variance
        point = fixed_point_ml(R_BE @ self._m.R, t, Sigma, centre, prior=self._prior, outliers=True)
        theta = self._mean.copy()
        theta[C], theta[P] = point.c, point.p
        return theta

    def map_is_absurd(self, solution: Solution) -> bool:
        """Whether the fit left its prior by more than four sigmas: the tip did not rest, or the map diverged."""
        off = solution.theta[G_] - self._mean[G_]
        return bool(off @ np.linalg.solve(self._prior_P[G_, G_], off) > 4.0**2 + 9.0)

    def moved(self, theta: FloatArray) -> FloatArray:
        """Standard deviation of the enforced motion along each axis of F_E, (3,) m."""
        T = self._hand(float(theta[15])).T_B_E
        u = np.einsum("tji,tj->ti", T[:, :3, :3], theta[P] - T[:, :3, 3])
        return np.asarray(u.std(axis=0))

    def solve(self, theta: FloatArray, free: BoolArray) -> Solution:
        """Gauss-Helmert iterations over the free unknowns; the others stay at their prior."""
        theta = np.where(free, theta, self._mean)
        delta = np.zeros((len(self._phase), 6))
        weights = np.ones(len(self._phase))
        index = np.flatnonzero(free)
        for iteration in range(self._config.iterations):
            A, S_inv, w, lever = self._linearise(theta, delta)
            N, b = normal_equations(A, S_inv, w, weights)
            N, b = N + self._prior_N, b + self._prior_N @ (self._mean - theta)
            N_ff = N[np.ix_(index, index)]
            step = np.zeros(self.size)
            step[index] = np.linalg.solve(N_ff + 1e-12 * np.diag(np.diag(N_ff)), b[index])
            length, delta = corrections(A, S_inv, w, lever, self._m.covariance, step)
            scale = max(1.0, scale_from_median(length))
            weights = tukey_weight(length, max(self._config.outlier, 20.0 * 0.7**iteration) * scale)
            theta = theta + step
            if iteration > 4 and np.abs(step[:6]).max() < 1e-6:
                break
        return self._finish(theta, free, delta, weights)

    def _linearise(
        self, theta: FloatArray, delta: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """A (T, 3, 19), S⁻¹ (T, 3, 3), misclosure (T, 3), lever (T, 3) at the corrected motions."""
        m, hand = self._m, self._hand(float(theta[15]))
        return linearise(
            theta,
            delta,
            hand.T_B_E,
            hand.velocity_B,
            hand.rate_E,
            m.R,
            m.t,
            m.centre,
            m.covariance,
            self._shares,
            self._variance,
        )

    def _hand(self, latency_s: float) -> HandStates:
        """The hand for a latency; reading it costs as much as all other equations, so the last one is kept."""
        if self._read is None or self._read[0] != latency_s:
            self._read = (latency_s, self._hand_at(latency_s))
        return self._read[1]

    def _finish(self, theta: FloatArray, free: BoolArray, delta: FloatArray, weights: FloatArray) -> Solution:
        """Covariance with correlated residuals, rotation noise not counted as motion, gates' priors kept."""
        A, S_inv, _, _ = self._linearise(theta, delta)
        r = self._linearise(theta, np.zeros_like(delta))[2]
        rested = weights > 0.1
        variance, correlation = residual_noise(r[rested], S_inv[rested])
        noise = max(variance, self._config.least_noise)
        correlated = max(1.0, variance * correlation)
        N, _ = normal_equations(A, S_inv, r, weights)
        N[C, C] -= spurious(np.ascontiguousarray(self._m.covariance[:, :3, :3]), S_inv, self._m.R, weights)
        covariance = self._covariance(N / (noise * correlation), free)
        cautious = self._covariance(N / max(correlated, noise * correlation), free)
        for part in (TAU, DRIFT):  # gels lag, and creep is no straight line: no less than assumed
            covariance[part, part] = cautious[part, part]
        for part in (C, P):
            covariance[part, part] += self._config.common_sigma_m**2 * np.eye(3)
        rms = float(np.sqrt(np.average(np.sum(r * r, axis=1), weights=np.maximum(weights, 1e-9))))
        return Solution(theta, covariance, free, rms, correlated, noise, r, delta, weights)

    def _covariance(self, N: FloatArray, free: BoolArray) -> FloatArray:
        """From what the frames say (19, 19); unknowns that a gate holds keep their prior and are considered."""
        N = N + self._prior_N
        f, h = np.flatnonzero(free), np.flatnonzero(~free)
        h = h[(h >= 6) & (h < 16)]  # a drift that no evidence speaks for is not considered
        P_ff = scaled_inverse(N[np.ix_(f, f)])
        covariance = np.zeros((self.size, self.size))
        covariance[np.ix_(f, f)] = P_ff
        if len(h):
            K = -P_ff @ N[np.ix_(f, h)]
            P_h = self._prior_P[np.ix_(h, h)]
            covariance[np.ix_(f, f)] += K @ P_h @ K.T
            covariance[np.ix_(f, h)] = K @ P_h
            covariance[np.ix_(h, f)] = P_h @ K.T
            covariance[np.ix_(h, h)] = P_h
        return covariance

    def checks(self, best: Solution) -> AnchorChecks:
        """Stage I against itself: its halves, frames predicted from the others, and the prior (one step each)."""
        A, S_inv, w, _ = self._linearise(best.theta, best.delta)
        T, f = len(w), np.flatnonzero(best.learned)
        halves = [
            self._step(A, S_inv, w, best, f, part) for part in (np.arange(T) < T // 2, np.arange(T) >= T // 2)
        ]
        apart = halves[0][0][P] - halves[1][0][P]
        sigma = best.factor * (halves[0][1] + halves[1][1])
        block = np.arange(T) * 8 // max(T, 1) % 2 == 0
        squares, total = 0.0, 1e-9
        for part in (block, ~block):  # solved on the others, judged here
            step, _ = self._step(A, S_inv, w, best, f, ~part)
            r = best.r[part] + A[part] @ step
            squares += float(best.weights[part] @ np.sum(r * r, axis=1))
            total += float(best.weights[part].sum())
        whole, own = self._step(A, S_inv, w, best, f, np.ones(T, dtype=bool), C)
        prior = None
        if self._prior is not None:
            off = best.theta[C] + whole[C] - self._prior.c
            prior = float(
                np.sqrt(off @ np.linalg.solve(self._prior.covariance + best.factor * own, off) / 3.0)
            )
        return AnchorChecks(
            residual_m=best.rms,
            held_out_m=float(np.sqrt(squares / total)),
            halves_m=float(np.linalg.norm(apart)),
            halves_sigma=float(np.sqrt(apart @ np.linalg.solve(sigma, apart) / 3.0)),
            prior_sigma=prior,
        )

    def _step(
        self,
        A: FloatArray,
        S_inv: FloatArray,
        w: FloatArray,
        best: Solution,
        free: IntArray,
        part: BoolArray,
        block: slice = P,
    ) -> tuple[FloatArray, FloatArray]:
        """From the solution to that of some frames alone, without the tip's prior: (19,), and a (3, 3) covariance."""
        prior = self._prior_N.copy()
        prior[C, C] = np.eye(3)  # 1 m
        N, b = normal_equations(A, S_inv, w, part * best.weights)
        own = b[C].copy()
        N, b = (N + prior)[np.ix_(free, free)], b + self._prior_N @ (self._mean - best.theta)
        b[C] = own
        inverse = scaled_inverse(N)
        step = np.zeros(self.size)
        step[free] = inverse @ b[free]
        here = np.flatnonzero(np.isin(free, np.arange(self.size)[block]))
        return step, inverse[np.ix_(here, here)]
