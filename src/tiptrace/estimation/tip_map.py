"""Stage I in one solve: tip, what the gel shows of its motion, latency, grasp drift (``docs/estimation.md``, Tip map).

The markers show the tip displaced against the hand by ``D_t(c) = R^E_t c + t^E_t − c``; a resting tip p enforces
``u_t = T_B_E(s − τ)⁻¹ p − c_t``. With a 3×3 map G of what the gel shows, ``D_t(c_t) = G u_t``. Unknowns in order:
c (3), p (3), G (9, row-major), τ (1), ċ (3). Motions are noisy in rotation and translation; each carries its own
correction, eliminated frame by frame (Gauss-Helmert), so that noisy rotations do not bias c.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tiptrace.estimation.anchor import TipPrior
from tiptrace.estimation.motion import Motions
from tiptrace.estimation.tip_map_config import (
    DIAGONAL,
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
from tiptrace.estimation.tip_map_solver import HandAt, Solution, Solver
from tiptrace.types import AnchorChecks, BoolArray, FloatArray


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
        checks: What Stage I says of itself; None without one.
        rested: Share of frames in which the tip rested, as far as the solution can tell.
        noise: Variance of Stage I's frames over the assumed, which those of Stage II share.
    """

    theta: FloatArray
    covariance: FloatArray
    learned: BoolArray
    residual_m: float
    correlation: float
    frames: int
    duration_s: float
    residual: FloatArray
    checks: AnchorChecks | None = None
    rested: float = 1.0
    noise: float = 1.0

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
    def unrest(self) -> float:
        """How little a resting tip explains: correlation, more where frames had to be left out; 1 is right."""
        return self.correlation * (1.0 + 20.0 * (1.0 - self.rested))

    @property
    def drift(self) -> FloatArray:
        """(3,) displacement of the tip in the grasp over the length of Stage I, m."""
        return self.theta[DRIFT]

    def inflated(self, factor: float) -> TipMap:
        """The same with a covariance larger by a factor, where that is above 1."""
        return replace(self, covariance=max(1.0, factor) * self.covariance)


def solve_tip_map(
    motions: Motions,
    hand_at: HandAt,
    phase: FloatArray,
    duration_s: float,
    config: TipMapConfig,
    latency: tuple[float, float] | None = None,
    prior: TipPrior | None = None,
    normal_E: FloatArray | None = None,
    known: TipMap | None = None,
    steps: FloatArray | None = None,
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
        known: An earlier map of the same gels, for the prior of G.
        steps: (T, K) −1 before and 0 after each slip of the tool: the tip stood elsewhere in the grasp before.

    Raises:
        GeometryError: fewer than 3 frames.
    """
    normal = np.array([1.0, 0.0, 0.0]) if normal_E is None else normal_E
    latency = latency or (config.latency_s, config.latency_std_s)
    earlier = None if known is None else (known.G, known.covariance[G_, G_])
    solver_of = partial(Solver, motions, hand_at, phase, config, latency, prior, normal, steps, earlier)
    solver = solver_of()
    theta = solver.start()
    free = np.ones(solver.size, dtype=bool)
    free[DRIFT] = False
    learned_column = solver.moved(theta) > config.map_gate_m
    free[G_] = (np.tile(learned_column, 3) | DIAGONAL) & config.learn_map & bool(learned_column.any())
    best = solver.solve(theta, free)
    rougher = 1.0
    if solver.map_is_absurd(best) and best.factor > 1.0:  # a tip that did not rest must not bend the map
        rougher = best.factor
        solver = solver_of(noise=rougher)
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
    if solver.stepped or np.any(np.abs(along @ candidate.drift) > config.drift_evidence * sigma):
        best = candidate
        best.covariance[DRIFT, DRIFT] += solver.slips_ahead(best.theta)
    else:  # less drift than three sigmas may still be there
        best.covariance[DRIFT, DRIFT] = config.hidden_drift**2 * candidate.covariance[DRIFT, DRIFT]
    return TipMap(
        best.theta[:SIZE],
        best.covariance[:SIZE, :SIZE],
        best.learned[:SIZE],
        best.rms,
        rougher * best.factor,
        len(phase),
        duration_s,
        best.r,
        solver.checks(best),
        float(np.mean(best.weights > 0.1)),
        rougher * best.noise,
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
    theta = np.concatenate([tip.c, np.zeros(3), I9, [mean_s], np.zeros(3)])
    covariance = np.zeros((SIZE, SIZE))
    covariance[C, C] = tip.covariance
    covariance[G_, G_] = map_prior(config, normal_E)
    covariance[TAU, TAU] = std_s**2
    nothing = np.zeros(SIZE, dtype=bool)
    return TipMap(theta, covariance, nothing, 0.0, 1.0, 0, 1.0, np.zeros((0, 3)))


def latency_too_vague(solution: Solution, config: TipMapConfig) -> bool:
    """Whether τ must stay at its calibrated value."""
    return bool(np.sqrt(solution.covariance[15, 15]) > config.latency_gate_s)
