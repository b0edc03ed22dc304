"""The rig from a calibration wiggle, all unknowns at once (``docs/calibration.md``, Rig).

A marker that rides on the clamped rod is at y in F_S at the reference instant. When the hand moves, the rod moves
in F_E by M(t) = T_B_E(t)⁻¹ T_B_E(0), and the marker is seen at ``c + K G (T_S_E M(t) T_E_S y − y)`` with c where it
is seen at the reference, ``c = K y`` along the gel and ``g_z y_z`` across it. K is the scale that the rig states
over the true one, G what the gel shows of its surface's motion. Robot poses are noisy regressors: every frame carries
its own correction of the pose and of the slow tilt of both depth maps, eliminated frame by frame (Gauss–Helmert),
with the Jacobian taken at the corrected pose. The markers' c are eliminated next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.calibration.rig_data import Segment
from tiptrace.calibration.rig_equations import SIZE, SegmentEquations, SensorState
from tiptrace.calibration.rig_start import Look
from tiptrace.config import Rig
from tiptrace.errors import CalibrationError
from tiptrace.types import SIDES, FloatArray, Side

_PRIOR = np.array(
    [*[0.35] * 3, *[0.02] * 3, 0.1, 0.1, 0.5, 0.5, 0.7, 0.3]
)  # so that a weak axis stays finite
_SIGMA_M = (3e-5, 1.2e-4)  # first guess of the markers' noise, along the gel and across it
_ROUNDS, _CONVERGED = 12, 0.02  # the last: of a sigma


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
    parts = [SegmentEquations(s, about_E) for s in segments]
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


def _noise(parts: list[SegmentEquations]) -> FloatArray:
    """(2,) noise of the markers along the gel and across it, deaf to outliers."""
    flat = np.concatenate([p.left[..., :2].ravel() for p in parts])
    deep = np.concatenate([p.left[:, p.deep, 2].ravel() for p in parts])
    spread = [1.48 * float(np.nanmedian(np.abs(x))) if x.size else 1e-4 for x in (flat, deep)]
    return np.asarray(np.maximum(np.array(spread), [2e-6, 5e-6]))
