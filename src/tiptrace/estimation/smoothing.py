"""Fixed-interval smoothing of the in-grasp motion in F_E, offline (``docs/estimation.md``, Smoothing).

The hand is known well and moves fast; the motion of the tool in the grasp is small and slow, and only its share of
white noise can be smoothed away. Each of its six coordinates is a random walk of its velocity; the walk's strength
and the white share of the measured covariance are the likeliest given the data. What is not white (slow tilt of a
depth map, bias, anchor, map) keeps its whole covariance. A jump, as of a slip, is let through.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tiptrace.estimation.carry_over import StageTwoStep
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.motion import Motions
from tiptrace.estimation.propagation import Tip, propagate
from tiptrace.geometry.transforms import rotation_exp, rotation_log
from tiptrace.types import Anchor, BoolArray, Event, FloatArray, Phase, SensedPair, Status, TipEstimate

_WALKS = 10.0 ** np.arange(-4.0, 3.1)  # strength of the walk over the white noise, per frame interval
_WHITE = np.array([0.03, 0.1, 0.2, 0.4, 0.7, 1.0])  # share of the measured covariance
_JUMP = 6.0  # sigmas
_GAP_S, _FEWEST = 0.3, 8


@dataclass(slots=True)
class Recorded:
    """An estimator with a memory: passes everything through and keeps what a smoother needs."""

    full: FullEstimator
    rows: list[tuple[TipEstimate, StageTwoStep | None]] = field(default_factory=list)
    _step: StageTwoStep | None = None

    def __post_init__(self) -> None:
        self.full.on_step = self._take

    def _take(self, step: StageTwoStep) -> None:
        self._step = step

    @property
    def events(self) -> list[Event]:
        """The estimator's."""
        return self.full.events

    @events.setter
    def events(self, events: list[Event]) -> None:
        self.full.events = events

    @property
    def anchor(self) -> Anchor | None:
        """The estimator's."""
        return self.full.anchor

    def update(self, pair: SensedPair) -> TipEstimate:
        """Process the next pair."""
        self._step = None
        estimate = self.full.update(pair)
        self.rows.append((estimate, self._step))
        return estimate


def smooth(recorded: Recorded, estimates: Sequence[TipEstimate], noise_m: float = 1e-4) -> list[TipEstimate]:
    """Estimates with all data of the trial, in place of the causal ones; row by row the same instants.

    Positions that were not claimed stay so. In Stage I the tip rests: its rows get the anchor. Frames between the end
    of Stage I and its detection, where no mark told it, lose their position: they were taken for Stage I.

    Args:
        recorded: The estimator that made them.
        estimates: What it returned, ``loop_ms`` filled in.
        noise_m: Hand pose and model at the tip, per frame (as in the estimator's settings).
    """
    out = [_rested(e, recorded) for e in estimates]
    first: Tip | None = None
    for rows in _runs(recorded):
        steps = [step for k in rows if (step := recorded.rows[k][1]) is not None]
        motions = smoothed_motions(steps)
        tips = _tips(steps, motions, noise_m)
        for k, step, tip, motion in zip(rows, steps, tips, motions, strict=True):
            e = out[k]
            R_B_E = step.hand.T_B_E[0, :3, :3] @ motion.R[0]
            if e.p_B is None:
                out[k] = replace(e, R_B_E=R_B_E)
                continue
            first = first or tip
            if e.status is Status.RELATIVE:
                J = tip.jacobian - first.jacobian
                covariance = J @ step.anchoring.tip_map.covariance @ J.T + tip.own + first.own
                p = tip.p_B - first.p_B
            else:
                covariance, p = tip.covariance, tip.p_B
            out[k] = replace(e, p_B=p, covariance=covariance + step.extra, R_B_E=R_B_E)
    return out


def _rested(e: TipEstimate, recorded: Recorded) -> TipEstimate:
    """A row of Stage I with what is known at its end."""
    anchor, end = recorded.anchor, recorded.full.anchoring_end_ns
    if e.status is not Status.ANCHORING or anchor is None or anchor.frames == 0:
        return e
    if end is not None and e.stamp_ns > end:
        return replace(e, p_B=None, covariance=None, status=Status.LOST, phase=Phase.RECONSTRUCTION)
    return replace(e, p_B=anchor.p_B, covariance=anchor.covariance)


def _runs(recorded: Recorded) -> list[list[int]]:
    """Rows without a gap and with one anchoring."""
    runs: list[list[int]] = []
    last: StageTwoStep | None = None
    for k, (_, step) in enumerate(recorded.rows):
        if step is None:
            continue
        new = last is None or step.anchoring is not last.anchoring
        if new or (last is not None and (step.pair_ns - last.pair_ns) * 1e-9 > _GAP_S):
            runs.append([])
        runs[-1].append(k)
        last = step
    return runs


def smoothed_motions(steps: Sequence[StageTwoStep]) -> list[Motions]:
    """In-grasp motions of consecutive steps, smoothed; too few are returned as they are."""
    motions = [s.motions for s in steps]
    if len(motions) < _FEWEST:
        return motions
    t = np.array([s.pair_ns for s in steps], dtype=np.float64) * 1e-9
    R = np.concatenate([m.R for m in motions])  # (T, 3, 3)
    g = np.einsum("ji,j->i", R[0], motions[0].centre[0] - motions[0].t[0])  # template's centroid
    y = np.concatenate([rotation_log(R), np.concatenate([m.centre for m in motions]) - g], axis=1)  # (T, 6)
    P = np.concatenate([m.covariance for m in motions])  # (T, 6, 6)
    filters = _Filters(np.diff(t), y, P)
    walk, white = filters.likeliest()
    x, P_x = filters.smooth(walk, white)
    covariance = (1.0 - white) * P + P_x
    R_s = rotation_exp(x[:, :3])
    t_s = x[:, 3:] + g - np.einsum("tij,j->ti", R_s, g)
    return [
        replace(
            m,
            R=R_s[k : k + 1],
            t=t_s[k : k + 1],
            centre=x[k : k + 1, 3:] + g,
            covariance=covariance[k : k + 1],
        )
        for k, m in enumerate(motions)
    ]


class _Filters:
    """Random walk of the velocity, measured in position; one filter per coordinate to choose, one for all to smooth."""

    def __init__(self, dt: FloatArray, y: FloatArray, P: FloatArray) -> None:
        self._dt, self._y, self._P = dt, y, P
        self._typical = float(np.median(dt))
        self._scale = np.median(np.diagonal(P, axis1=1, axis2=2), axis=0)  # (6,) variance
        self._jump: BoolArray = np.zeros(len(y), dtype=bool)

    def likeliest(self) -> tuple[FloatArray, float]:
        """Walk (6,) relative to the noise, and the white share; frames at which the tool jumped are noted."""
        for _ in range(2):
            score, innovation = self._score()
            white = int(score.max(axis=0).sum(axis=0).argmax())
            walk = score[:, :, white].argmax(axis=0)  # (6,)
            size = np.abs(innovation[:, walk, np.arange(6), white])  # (T, 6)
            self._jump = np.asarray((size > _JUMP).any(axis=1))
        return _WALKS[walk], float(_WHITE[white])

    def _score(self) -> tuple[FloatArray, FloatArray]:
        """Log likelihood (walks, 6, white) and normalised innovations (T, walks, 6, white)."""
        shape = (len(_WALKS), 6, len(_WHITE))
        variance = np.diagonal(self._P, axis1=1, axis2=2)  # (T, 6)
        q = _WALKS[:, None, None] * self._scale[None, :, None] * np.ones(shape) / self._typical**3
        x, v = np.broadcast_to(self._y[0][None, :, None], shape).copy(), np.zeros(shape)
        a = np.broadcast_to((variance[0][:, None] * _WHITE)[None], shape).copy()  # var x, cov, var v
        b, c = np.zeros(shape), np.broadcast_to(self._fast()[None, :, None], shape).copy()
        score, out = np.zeros(shape), np.zeros((len(self._y), *shape))
        for k, dt in enumerate(self._dt, start=1):
            x, a = x + v * dt, a + 2 * b * dt + c * dt * dt + q * dt**3 / 3
            b, c = b + c * dt + q * dt * dt / 2, c + q * dt
            if self._jump[k]:
                a, c = a + self._leap(k)[None, :, None], c + self._fast()[None, :, None]
            S = a + variance[k][None, :, None] * _WHITE
            e = self._y[k][None, :, None] - x
            z = e / np.sqrt(S)
            out[k] = z
            score -= 0.5 * (np.log(S) + np.minimum(z * z, _JUMP**2))
            K, L = a / S, b / S
            x, v = x + K * e, v + L * e
            a, b, c = a - K * a, b - K * b, c - L * b
        return score, out

    def _fast(self) -> FloatArray:
        """(6,) variance of a velocity that nothing is known of."""
        return np.asarray(np.mean((np.diff(self._y, axis=0) / self._dt[:, None]) ** 2, axis=0) * 4 + 1e-12)

    def _leap(self, k: int) -> FloatArray:
        """(6,) variance that lets a jump at frame k through."""
        return np.asarray(4.0 * (self._y[k] - self._y[k - 1]) ** 2 + self._scale)

    def smooth(self, walk: FloatArray, white: float) -> tuple[FloatArray, FloatArray]:
        """Forward filter and backward pass over all six together: (T, 6) and its covariance (T, 6, 6)."""
        T, eye = len(self._y), np.eye(6)
        q = np.diag(walk * self._scale / self._typical**3)
        H = np.concatenate([eye, np.zeros((6, 6))], axis=1)
        m, P = np.concatenate([self._y[0], np.zeros(6)]), np.zeros((12, 12))
        P[:6, :6], P[6:, 6:] = white * self._P[0], np.diag(self._fast())
        means, covs = [m], [P]
        predicted: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        for k, dt in enumerate(self._dt, start=1):
            F = np.eye(12)
            F[:6, 6:] = dt * eye
            Q = np.block([[q * dt**3 / 3, q * dt**2 / 2], [q * dt**2 / 2, q * dt]])
            if self._jump[k]:
                Q += np.diag(np.concatenate([self._leap(k), self._fast()]))
            m, P = F @ m, F @ P @ F.T + Q
            predicted.append((F, m, P))
            S = P[:6, :6] + white * self._P[k]
            gain = np.linalg.solve(S, P[:6]).T  # (12, 6)
            m = m + gain @ (self._y[k] - m[:6])
            I_KH = np.eye(12) - gain @ H
            P = I_KH @ P @ I_KH.T + gain @ (white * self._P[k]) @ gain.T
            means.append(m)
            covs.append(P)
        out, cov = np.zeros((T, 6)), np.zeros((T, 6, 6))
        out[-1], cov[-1] = m[:6], P[:6, :6]
        for k in range(T - 2, -1, -1):
            F, m_p, P_p = predicted[k]
            G = np.linalg.solve(P_p, F @ covs[k]).T
            m = means[k] + G @ (m - m_p)
            P = covs[k] + G @ (P - P_p) @ G.T
            out[k], cov[k] = m[:6], P[:6, :6]
        return out, cov


def _tips(steps: Sequence[StageTwoStep], motions: Sequence[Motions], noise_m: float) -> list[Tip]:
    """The tip at every step, its time's uncertainty included."""
    tips = [
        propagate(s.anchoring.tip_map, m, 0, s.hand, s.anchoring.phase(s.pair_ns), noise_m)
        for s, m in zip(steps, motions, strict=True)
    ]
    if len(tips) < 2:
        return tips
    t = np.array([s.pair_ns for s in steps], dtype=np.float64) * 1e-9
    v_E = np.gradient(np.array([tip.moved_E for tip in tips]), t, axis=0)
    out = []
    for step, tip, v in zip(steps, tips, v_E, strict=True):
        v_B = step.hand.T_B_E[0, :3, :3] @ v
        late = step.anchoring.tip_map.covariance[15, 15] * np.outer(v_B, v_B)
        out.append(replace(tip, covariance=tip.covariance + late))
    return out
