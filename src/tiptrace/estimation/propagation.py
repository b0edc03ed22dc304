"""Stage II: the tip through hand and grasp, with its covariance (``docs/estimation.md``, Propagation).

``p_B(s − τ) = T_B_E(s − τ) [c_t + G⁻¹ D_t(c_t)]``, ``D_t(c) = R^E_t c + t^E_t − c``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.estimation.motion import Motions
from tiptrace.estimation.pose_track import HandStates
from tiptrace.estimation.tip_map import TipMap
from tiptrace.estimation.tip_map_config import DRIFT, G_, C
from tiptrace.geometry.transforms import skew
from tiptrace.types import FloatArray


@dataclass(frozen=True, slots=True)
class Tip:
    """The tip at one frame.

    Attributes:
        p_B: (3,) m.
        covariance: (3, 3) m²: anchor, map, latency, motion and its nuisances.
        shown_E: (3,) D_t, the displacement in the grasp that the markers show, m.
        moved_E: (3,) G⁻¹ D_t, what the tool really did, m.
        jacobian: (3, 19) of p_B with respect to the unknowns of the tip map.
        own: (3, 3) m², the part of the covariance that is this frame's alone, as noisy as Stage I was.
    """

    p_B: FloatArray
    covariance: FloatArray
    shown_E: FloatArray
    moved_E: FloatArray
    jacobian: FloatArray
    own: FloatArray


def propagate(
    tip_map: TipMap, motions: Motions, k: int, hand: HandStates, phase: float, noise_m: float
) -> Tip:
    """Tip of frame k of ``motions`` with the hand at its exposure.

    Args:
        tip_map: Stage I.
        motions: In-grasp motions.
        k: Frame.
        hand: One hand state.
        phase: t/T_I − 1, for the drift.
        noise_m: Assumed standard deviation of the hand pose at the tip, and of what the model leaves out.
    """
    R, t = motions.R[k], motions.t[k]
    R_BE, t_BE = hand.T_B_E[0, :3, :3], hand.T_B_E[0, :3, 3]
    c_t = tip_map.c + phase * tip_map.drift
    shown_at = R @ c_t + t
    D = shown_at - c_t
    G_inv = np.linalg.inv(tip_map.G)
    moved = G_inv @ D
    p_B = R_BE @ (c_t + moved) + t_BE

    L = R_BE @ G_inv  # (3, 3) ∂p_B/∂D
    J = np.zeros((3, 19))  # ∂p_B/∂θ
    J[:, C] = R_BE + L @ R - L
    J[:, G_] = -(L[:, :, None] * moved).reshape(3, 9)  # ∂(G⁻¹ D)/∂G_jk = −G⁻¹ e_j moved_k
    J[:, DRIFT] = phase * J[:, C]
    # The estimate is stamped s − τ and the hand read there: a wrong τ only misplaces the in-grasp part, which the
    # caller adds from its rate.
    LB = np.concatenate([-L @ skew(shown_at - motions.centre[k]), L], axis=1)  # (3, 6) ∂p_B/∂(ω, v)
    own = tip_map.noise * (LB @ motions.covariance[k] @ LB.T + noise_m**2 * np.eye(3))
    return Tip(p_B, J @ tip_map.covariance @ J.T + own, D, moved, J, own)


class Velocity:
    """Velocity of a point from its positions, smoothed over about a tenth of a second."""

    def __init__(self) -> None:
        self._last: tuple[int, FloatArray] | None = None
        self._v: FloatArray = np.zeros(3)

    def update(self, stamp_ns: int, x: FloatArray) -> FloatArray:
        """Velocity (3,) m/s with the point at x (3,) m now."""
        if self._last is not None and stamp_ns > self._last[0]:
            dt = (stamp_ns - self._last[0]) * 1e-9
            keep = np.exp(-dt / 0.1)
            self._v = keep * self._v + (1.0 - keep) * (x - self._last[1]) / dt
        self._last = (stamp_ns, x)
        return self._v
