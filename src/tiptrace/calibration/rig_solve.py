"""The rig from a calibration wiggle, all unknowns at once (``docs/calibration.md``, Rig).

A marker that rides on the clamped rod is at y in F_S at the reference instant. When the hand moves, the rod moves
in F_E by M(t) = T_B_E(t)⁻¹ T_B_E(0), and the marker is seen at ``c + K G (T_S_E M(t) T_E_S y − y)`` with c where it
is seen at the reference, ``c = K y`` along the gel and ``g_z y_z`` across it. K is the scale that the rig states
over the true one, G what the gel shows of its surface's motion. Robot poses are noisy regressors: every frame carries
its own correction of the pose and of the slow tilt of both depth maps, eliminated frame by frame (Gauss–Helmert),
with the Jacobian taken at the corrected pose. The markers' c are eliminated next.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tiptrace.calibration.rig_data import Segment
from tiptrace.calibration.rig_start import Look
from tiptrace.config import Rig
from tiptrace.errors import CalibrationError
from tiptrace.estimation.robust import huber_weight
from tiptrace.geometry.transforms import apply, invert, rotation_exp, rotation_log, skew, transform
from tiptrace.types import SIDES, BoolArray, FloatArray, Side

SIZE = 12  # unknowns of a sensor: rotation 3, translation 3, ln k_x, ln k_y, ln g_x, ln g_y, ln g_z, latency
ROT, POS, K, G, TAU = slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 11), 11
_PRIOR = np.array(
    [*[0.35] * 3, *[0.02] * 3, 0.1, 0.1, 0.5, 0.5, 0.7, 0.3]
)  # so that a weak axis stays finite
_STEP = np.array([*[1e-5] * 3, *[1e-6] * 3, *[1e-5] * 5, 1e-4])
_TILT_RAD, _OFFSET_M = 0.1, 1e-4  # slow changes of a pad's depth map; wide, since neighbours say the same
_SIGMA_M = (3e-5, 1.2e-4)  # first guess of the markers' noise, along the gel and across it
_HUBER, _ROUNDS, _CONVERGED = 2.5, 12, 0.02  # the last: of a sigma


@dataclass(frozen=True, slots=True)
class SensorState:
    """One sensor's unknowns.

    Attributes:
        T_E_S: (4, 4) where the rig file's T_E_S holds.
        k: (2,) scale that the rig states over the true one.
        g: (3,) what the gel shows along x and y of its motion, and of depth.
        latency_s: Capture minus exposure.
    """

    T_E_S: FloatArray
    k: FloatArray
    g: FloatArray
    latency_s: float

    def moved(self, step: FloatArray) -> SensorState:
        """After a step (12,): rotation and translation in F_S."""
        T = self.T_E_S.copy()
        T[:3, 3] += T[:3, :3] @ step[POS]
        T[:3, :3] = T[:3, :3] @ rotation_exp(step[ROT])
        return SensorState(
            T, self.k * np.exp(step[K]), self.g * np.exp(step[G]), self.latency_s + float(step[TAU])
        )


@dataclass(frozen=True, slots=True)
class Solution:
    """All unknowns.

    Attributes:
        sensors: By side.
        covariance: (24, 24), left first, in the units of a step.
        in_plane_m: Noise of the markers found along the gel.
        depth_m: And across it.
        correlation: How many frames say the same.
    """

    sensors: dict[Side, SensorState]
    covariance: FloatArray
    in_plane_m: float
    depth_m: float
    correlation: float


@dataclass(frozen=True, slots=True)
class Pitch:
    """Scale from the printed pitch of the markers: ln k (2,) and its σ (2,); infinite where unknown."""

    log_k: FloatArray
    sigma: FloatArray


def start_state(rig: Rig, side: Side, found: Look, shift_E: FloatArray) -> SensorState:
    """From the linear look: gains from its rows, the rest as the rig states it."""
    T = rig.sensor(side).T_E_S.matrix()
    g = np.clip(np.linalg.norm(found.A, axis=1), 0.2, 1.5)
    return SensorState(T, np.ones(2), np.where(np.isfinite(g), g, 0.9), found.latency_s)


def solve_rig(
    segments: list[Segment], start: dict[Side, SensorState], pitch: dict[Side, Pitch], about_E: FloatArray
) -> Solution:
    """Gauss–Helmert over all unknowns.

    Raises:
        CalibrationError: it does not settle.
    """
    parts = [_Part(s, about_E) for s in segments]
    states, sigma = start, np.array(_SIGMA_M)
    for iteration in range(_ROUNDS):
        N, b = np.diag(np.concatenate([_PRIOR, _PRIOR]) ** -2.0), np.zeros(2 * SIZE)
        _add_pitch(N, b, states, pitch)
        for part in parts:
            part.normal_equations(N, b, states, sigma)
        step = np.asarray(np.linalg.solve(N, b), dtype=np.float64)
        states = {s: states[s].moved(step[k * SIZE : (k + 1) * SIZE]) for k, s in enumerate(SIDES)}
        for part in parts:
            part.accept(step)
        sigma = _noise(parts) if iteration > 1 else sigma
        if np.abs(step[:3]).max() > 1.0 or not np.isfinite(step).all():
            raise CalibrationError(
                "the rig's calibration does not settle: do the markers ride on the rod, and does the rod stand still?"
            )
        if iteration > 2 and float(step @ N @ step) < _CONVERGED**2:
            break
    factor = float(np.mean([part.correlation() for part in parts]))
    N_prior = np.diag(np.concatenate([_PRIOR, _PRIOR]) ** -2.0)
    _add_pitch(N_prior, np.zeros(2 * SIZE), states, pitch)
    data = N - N_prior
    covariance = np.asarray(np.linalg.inv(data / factor + N_prior), dtype=np.float64)
    return Solution(states, covariance, float(sigma[0]), float(sigma[1]), factor)


def _add_pitch(
    N: FloatArray, b: FloatArray, states: dict[Side, SensorState], pitch: dict[Side, Pitch]
) -> None:
    for n, side in enumerate(SIDES):
        known = pitch[side]
        for axis in (0, 1):
            at, information = n * SIZE + 6 + axis, float(known.sigma[axis]) ** -2.0
            N[at, at] += information
            b[at] += information * (known.log_k[axis] - np.log(states[side].k[axis]))


def _noise(parts: list[_Part]) -> FloatArray:
    """(2,) noise of the markers along the gel and across it, deaf to outliers."""
    flat = np.concatenate([p.left[..., :2].ravel() for p in parts])
    deep = np.concatenate([p.left[:, p.deep, 2].ravel() for p in parts])
    spread = [1.48 * float(np.nanmedian(np.abs(x))) if x.size else 1e-4 for x in (flat, deep)]
    return np.asarray(np.maximum(np.array(spread), [2e-6, 5e-6]))


def _mean_pose(T: FloatArray) -> FloatArray:
    """Mean of poses (T, 4, 4) that differ little."""
    R = T[0, :3, :3]
    turn = np.mean(rotation_log(R.T @ T[:, :3, :3]), axis=0)
    return transform(R @ rotation_exp(turn), T[:, :3, 3].mean(axis=0))


class _Part:
    """One segment: its frames' corrections, its markers' places, and what they add to the normal equations."""

    def __init__(self, segment: Segment, about_E: FloatArray) -> None:
        self._segment, self._p0 = segment, about_E
        pads = [segment.pads[s] for s in SIDES]
        T = min(len(p.stamps_ns) for p in pads)
        self._pads = [replace(p, stamps_ns=p.stamps_ns[:T], w=p.w[:T]) for p in pads]
        self._counts = [p.w.shape[1] for p in pads]
        self._rows = [slice(0, self._counts[0]), slice(self._counts[0], sum(self._counts))]
        self._W = np.concatenate([p.w for p in self._pads], axis=1)  # (T, N, 3)
        self._c = np.nanmean(self._W, axis=0)  # (N, 3)
        self._delta = np.zeros((T, 12))
        deep = [np.full(n, p.has_depth) for n, p in zip(self._counts, pads, strict=True)]
        self.deep: BoolArray = np.concatenate(deep)
        self.left: FloatArray = np.zeros_like(self._W)
        self._prior = self._nuisance_prior(segment)
        self._T_ref = _mean_pose(segment.hand.at(pads[0].stamps_ns).T_B_E)  # where the pads are sheared least
        self._solved: tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None = None

    def _nuisance_prior(self, segment: Segment) -> FloatArray:
        """(12, 12) information of a frame's corrections: pose about the pads, depth (offset, tilts) of each pad."""
        hand = segment.hand
        lever = skew(self._p0)
        cov = np.zeros((6, 6))
        cov[:3, :3] = hand.sigma_rad**2 * np.eye(3)
        cov[3:, :3] = -(hand.sigma_rad**2) * lever
        cov[:3, 3:] = cov[3:, :3].T
        cov[3:, 3:] = hand.sigma_m**2 * np.eye(3) + hand.sigma_rad**2 * lever @ lever.T
        out = np.zeros((12, 12))
        out[:6, :6] = np.linalg.inv(cov + 1e-16 * np.eye(6))
        out[6:, 6:] = np.diag(np.array([_OFFSET_M, _TILT_RAD, _TILT_RAD] * 2) ** -2.0)
        return out

    # --- model ----------------------------------------------------------------------------------------------

    def _rod(self, n: int, latency_s: float) -> FloatArray:
        """(T, 4, 4) motion of the rod in F_E since the reference, at the exposures of pad n."""
        hand = self._segment.hand.at(self._pads[n].stamps_ns - latency_s * 1e9).T_B_E
        return np.asarray(invert(hand) @ self._T_ref)

    def _predict(self, n: int, state: SensorState, M: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Markers of pad n as they should be measured (T, N, 3), and where they are in F_E (T, N, 3)."""
        pad = self._pads[n]
        c, T_E_S = self._c[self._rows[n]], state.T_E_S.copy()
        T_E_S[:3, 3] += pad.shift_E
        y = c / np.array([state.k[0], state.k[1], state.g[2]])  # at the reference
        x = apply(T_E_S, y) @ np.swapaxes(M[:, :3, :3], 1, 2) + M[:, None, :3, 3]  # (T, N, 3)
        E = rotation_exp(self._delta[:, :3])
        x = (x - self._p0) @ np.swapaxes(E, 1, 2) + self._p0 + self._delta[:, None, 3:6]
        moved = (x - T_E_S[:3, 3]) @ T_E_S[:3, :3] - y
        w = c + moved * self._gain(state)
        tilt = self._delta[:, 6 + 3 * n : 9 + 3 * n]  # offset, a, b
        w[..., 2] += tilt[:, :1] + tilt[:, 1:] @ (c[:, :2] - c[:, :2].mean(axis=0)).T
        return w, x

    @staticmethod
    def _gain(state: SensorState) -> FloatArray:
        return np.asarray(state.g * np.array([state.k[0], state.k[1], 1.0]))

    def normal_equations(
        self, N: FloatArray, b: FloatArray, states: dict[Side, SensorState], sigma: FloatArray
    ) -> None:
        """Add this segment's information on the 24 unknowns, its own unknowns eliminated."""
        T, n_all = self._W.shape[:2]
        J = np.zeros((T, n_all, 3, 2 * SIZE))
        B = np.zeros((T, n_all, 3, 12))
        r = np.zeros((T, n_all, 3))
        for n, side in enumerate(SIDES):
            here, state = self._rows[n], states[side]
            M = self._rod(n, state.latency_s)
            later = self._rod(n, state.latency_s + _STEP[TAU])
            w, x = self._predict(n, state, M)
            r[:, here] = self._W[:, here] - w
            for k in range(SIZE):
                moved = state.moved(np.eye(SIZE)[k] * _STEP)
                w_k = self._predict(n, moved, later if k == TAU else M)[0]
                J[:, here, :, n * SIZE + k] = (w_k - w) / _STEP[k]
            B[:, here] = self._nuisances(n, state, x)
        weight = self._weights(r, sigma)  # (T, N, 3)
        self._eliminate(N, b, J, B, np.where(weight > 0, r, 0.0), weight)
        self.left = np.where(weight > 0, r, np.nan)

    def _nuisances(self, n: int, state: SensorState, x: FloatArray) -> FloatArray:
        """(T, N, 3, 12) derivative of the measurement by the frame's corrections."""
        S = self._gain(state)[:, None] * state.T_E_S[:3, :3].T  # (3, 3) F_E → measured
        out = np.zeros((*x.shape, 12))
        out[..., :3] = -S @ skew(x - self._p0)
        out[..., 3:6] = S
        c = self._c[self._rows[n], :2]
        out[:, :, 2, 6 + 3 * n] = 1.0
        out[:, :, 2, 7 + 3 * n : 9 + 3 * n] = c - c.mean(axis=0)
        return out

    def _weights(self, r: FloatArray, sigma: FloatArray) -> FloatArray:
        """Information of each row; 0 where a marker was lost or a pad has no depth."""
        z = r / np.array([sigma[0], sigma[0], sigma[1]])
        z[:, ~self.deep, 2] = 0.0
        length = np.sqrt(np.nansum(z * z, axis=2))
        robust = huber_weight(length, _HUBER * 1.5)[..., None]
        weight = robust / np.array([sigma[0], sigma[0], sigma[1]]) ** 2
        weight = np.where(np.isfinite(r), weight, 0.0)
        weight[:, ~self.deep, 2] = 0.0
        return np.asarray(weight)

    def _eliminate(
        self,
        N: FloatArray,
        b: FloatArray,
        J: FloatArray,
        B: FloatArray,
        r: FloatArray,
        weight: FloatArray,
    ) -> None:
        """Frames' corrections first, then the markers' places; keeps what :meth:`accept` needs."""
        T, n = len(r), r.shape[1] * 3
        J, B, r, w = J.reshape(T, n, -1), B.reshape(T, n, 12), r.reshape(T, n), weight.reshape(T, n)
        WB = w[..., None] * B
        C = np.swapaxes(B, 1, 2) @ WB + self._prior  # (T, 12, 12)
        L_inv = np.linalg.inv(np.linalg.cholesky(C))
        e = np.einsum("tni,tn->ti", WB, r) - self._delta @ self._prior  # gradient by the corrections
        Y_c = (L_inv @ np.swapaxes(WB, 1, 2)).reshape(T * 12, n)
        Y_J = (L_inv @ (np.swapaxes(WB, 1, 2) @ J)).reshape(T * 12, -1)
        y = np.einsum("tij,tj->ti", L_inv, e).reshape(-1)
        Jw = (w[..., None] * J).reshape(T * n, -1)
        N_tt = Jw.T @ J.reshape(T * n, -1) - Y_J.T @ Y_J
        N_tc = np.einsum("tnk->kn", w[..., None] * J) - Y_J.T @ Y_c
        N_cc = np.diag(w.sum(axis=0) + 1e-3) - Y_c.T @ Y_c
        b_t = Jw.T @ r.reshape(-1) - Y_J.T @ y
        b_c = np.einsum("tn,tn->n", w, r) - Y_c.T @ y
        K_c = np.linalg.solve(N_cc + 1e-9 * np.trace(N_cc) / n * np.eye(n), np.column_stack([N_tc.T, b_c]))
        N += N_tt - N_tc @ K_c[:, :-1]
        b += b_t - N_tc @ K_c[:, -1]
        gain = np.einsum("tji,tjk->tik", L_inv, L_inv)  # C⁻¹
        self._solved = (
            K_c,
            gain @ e[..., None],
            gain @ np.swapaxes(WB, 1, 2) @ J,
            gain @ np.swapaxes(WB, 1, 2),
        )

    def accept(self, step: FloatArray) -> None:
        """Take the step of the common unknowns; the own ones follow."""
        assert self._solved is not None
        K_c, d_0, d_J, d_c = self._solved
        c = K_c[:, -1] - K_c[:, :-1] @ step
        self._c = self._c + c.reshape(-1, 3)
        self._delta = self._delta + d_0[..., 0] - d_J @ step - d_c @ c

    def correlation(self) -> float:
        """How many neighbouring frames say the same: 1 + 2 Σ autocorrelation of the pose corrections."""
        z = self._delta[:, :6] - self._delta[:, :6].mean(axis=0)
        variance = np.maximum(np.mean(z * z, axis=0), 1e-30)
        total = np.ones(6)
        for lag in range(1, min(25, len(z) // 4)):
            rho = np.mean(z[lag:] * z[:-lag], axis=0) / variance
            if (rho < 0.05).all():
                break
            total += 2.0 * np.maximum(rho, 0.0)
        return float(max(1.0, total.max()))
