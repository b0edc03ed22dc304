"""Motion of the tool against the pads' surface, which the markers cannot show: measured, and made by creep."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from tiptrace.sim.grasp import GraspState
from tiptrace.sim.pad_forces import PadForces
from tiptrace.sim.pads import Pads
from tiptrace.types import FloatArray

_WINDOW_S = 0.4
_CREEPING_DEG = 0.3  # within the window
_CREEPING_M = 0.1e-3


def drift_anchors(pads: Pads, state: GraspState, angle_rad: float) -> GraspState:
    """Turn the points that the pads hold about the closing axis: slow creep between tool and gel."""
    if angle_rad == 0.0:
        return state
    x = pads.X[:, 1:]  # (n, 2) y_E, z_E
    centre = x.mean(axis=0)
    turn = np.stack([-(x[:, 1] - centre[1]), x[:, 0] - centre[0]], axis=1) * angle_rad
    shift = np.concatenate([np.zeros((len(x), 1)), turn], axis=1)  # (n, 3) in F_E
    moved = state.pads.q + np.where(state.pads.anchored[:, None], shift @ state.R, 0.0)
    return replace(state, pads=replace(state.pads, q=moved))


@dataclass(slots=True)
class SlipMeter:
    """Adds up the rigid part of the slip, weighted by the normal force."""

    pads: Pads
    rotation_deg: float = 0.0
    translation_m: float = 0.0
    _recent: deque[tuple[float, float, float]] = field(default_factory=deque)

    def reset(self) -> None:
        """Start from zero."""
        self.rotation_deg = self.translation_m = 0.0
        self._recent.clear()

    def add(self, before: GraspState, after: GraspState, forces: PadForces, dt_s: float) -> None:
        """Account for a converged step."""
        held = before.pads.anchored & after.pads.anchored
        slip = np.where(held[:, None], (after.pads.q - before.pads.q) @ after.R.T, 0.0)  # (n, 3) in F_E
        turn, shift = self._rigid(slip, forces.normal_n)
        self.rotation_deg -= turn
        self.translation_m += shift
        self._recent.append((dt_s, turn, shift))
        while sum(r[0] for r in self._recent) > _WINDOW_S and len(self._recent) > 1:
            self._recent.popleft()

    def _rigid(self, slip: FloatArray, weight: FloatArray) -> tuple[float, float]:
        """Rotation about the closing axis (deg) and mean translation (m) of the slip."""
        total = float(weight.sum())
        if total <= 0.0 or not np.any(slip):
            return 0.0, 0.0
        x, d = self.pads.X[:, 1:], slip[:, 1:]
        r = x - weight @ x / total
        mean = weight @ d / total
        d = d - mean
        spin = float(weight @ (r[:, 0] * d[:, 1] - r[:, 1] * d[:, 0]) / (weight @ np.sum(r * r, axis=1)))
        return float(np.degrees(spin)), float(np.linalg.norm(mean))

    def creeping(self) -> bool:
        """Whether the tool has moved as a whole within the last moments."""
        turn = abs(sum(r[1] for r in self._recent))
        return bool(turn > _CREEPING_DEG or sum(r[2] for r in self._recent) > _CREEPING_M)
