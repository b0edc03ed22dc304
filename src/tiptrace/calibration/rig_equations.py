"""What one calibration wiggle says of the rig: its residuals, their derivatives, its own unknowns eliminated.

The model and its symbols: :mod:`tiptrace.calibration.rig_solve`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tiptrace.calibration.rig_data import Segment
from tiptrace.estimation.robust import huber_weight
from tiptrace.geometry.transforms import apply, invert, rotation_exp, rotation_log, skew, transform
from tiptrace.types import SIDES, BoolArray, FloatArray, Side

SIZE = 12  # unknowns of a sensor: rotation 3, translation 3, ln k_x, ln k_y, ln g_x, ln g_y, ln g_z, latency
ROT, POS, K, G, TAU = slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 11), 11
_STEP = np.array([*[1e-5] * 3, *[1e-6] * 3, *[1e-5] * 5, 1e-4])
_TILT_RAD, _OFFSET_M = 0.1, 1e-4  # slow changes of a pad's depth map; wide, since neighbours say the same
_HUBER = 2.5


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


def _mean_pose(T: FloatArray) -> FloatArray:
    """Mean of poses (T, 4, 4) that differ little."""
    R = T[0, :3, :3]
    turn = np.mean(rotation_log(R.T @ T[:, :3, :3]), axis=0)
    return transform(R @ rotation_exp(turn), T[:, :3, 3].mean(axis=0))


class SegmentEquations:
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
