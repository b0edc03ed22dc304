"""From one equilibrium to the next as the hand moves; steps that do not converge are cut, never passed over."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tiptrace.errors import SimulationError
from tiptrace.geometry.transforms import interpolate, rotation_exp
from tiptrace.sim.grasp import Equilibrium, Grasp, GraspState, World
from tiptrace.sim.rig import PADS_E
from tiptrace.sim.slip import SlipMeter, drift_anchors
from tiptrace.types import FloatArray

_BISECTIONS = 6
_FAST_MPS = 0.06  # a tip that moves faster has jumped: its speed predicts nothing


@dataclass(slots=True)
class Stepper:
    """The grasp's state as it goes.

    Attributes:
        grasp: The mechanical system.
        state: Tool and contacts now.
        label: Names the trial in errors.
        slip: Slip of the tool against the pads so far.
        last: The latest equilibrium.
    """

    grasp: Grasp
    state: GraspState
    label: str
    slip: SlipMeter = field(init=False)
    last: Equilibrium = field(init=False)
    _tip_B: FloatArray | None = field(init=False, default=None)
    _velocity_B: FloatArray = field(init=False, default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        self.slip = SlipMeter(self.grasp.pads)

    def rest(self, world: World, dt_s: float, doing: str) -> None:
        """Find the equilibrium with the hand at rest in a place that it was put to.

        Raises:
            SimulationError: there is none.
        """
        self._tip_B, self._velocity_B = None, np.zeros(3)
        if not (self._newton(world, dt_s) or self._relaxation(world, dt_s)):
            self._fail(doing)

    def move(self, T_from: FloatArray, world: World, dt_s: float, doing: str) -> bool:
        """One step of the hand to ``world.T_B_E``; True if it had to be cut.

        Raises:
            SimulationError: not even the smallest piece has an equilibrium.
        """
        if self._newton(world, dt_s):
            return False
        pieces = [(0.0, 1.0, 0)]
        while pieces:
            a, b, depth = pieces.pop()
            piece, step = replace(world, T_B_E=interpolate(T_from, world.T_B_E, b)), dt_s * (b - a)
            if (depth and self._newton(piece, step)) or self._relaxation(piece, step):
                continue
            if depth == _BISECTIONS:
                self._fail(doing)
            middle = 0.5 * (a + b)
            pieces += [(middle, b, depth + 1), (a, middle, depth + 1)]
        return True

    def drift(self, angle_rad: float) -> None:
        """Slow creep of the tool against the pads, about the closing axis."""
        if angle_rad != 0.0:
            self.state = drift_anchors(self.grasp.pads, self.state, angle_rad)
            self.slip.rotation_deg -= float(np.degrees(angle_rad))

    def _newton(self, world: World, dt_s: float) -> bool:
        R, p = self._predict(world, dt_s)
        return self._accept(self.grasp.solve(self.state, world, R, p, dt_s), world, dt_s)

    def _relaxation(self, world: World, dt_s: float) -> bool:
        found = self.grasp.relax(self.state, world, self.state.R, self.state.p, dt_s)
        return self._accept(found, world, dt_s)

    def _predict(self, world: World, dt_s: float) -> tuple[FloatArray, FloatArray]:
        """First guess: the tip goes on as it went in the base, the tool turns about the pads to follow it."""
        R, p = self.state.R, self.state.p
        if self._tip_B is None:
            return R, p
        T = world.T_B_E
        p_new = T[:3, :3].T @ (self._tip_B + self._velocity_B * dt_s - T[:3, 3])
        lever = p - PADS_E
        turn = rotation_exp(np.cross(lever, p_new - p) / float(lever @ lever))
        along = lever / np.linalg.norm(lever)
        return turn @ R, PADS_E + turn @ lever + along * float(along @ (p_new - p))

    def _accept(self, found: Equilibrium, world: World, dt_s: float) -> bool:
        if not found.converged:
            return False
        before = self.state
        self.state = self.grasp.advance(before, found, dt_s)
        self.slip.add(before, self.state, found.pads, dt_s)
        self.last = found
        tip_B = world.T_B_E[:3, :3] @ found.p + world.T_B_E[:3, 3]
        if self._tip_B is not None:
            velocity = (tip_B - self._tip_B) / dt_s
            self._velocity_B = velocity if np.linalg.norm(velocity) < _FAST_MPS else np.zeros(3)
        self._tip_B = tip_B
        return True

    def _fail(self, doing: str) -> None:
        raise SimulationError(
            f"{self.label}: no equilibrium at {doing}; the tool is being torn out of the pads or the groove: lower "
            f"anchor_force_n, preload_n or speed_mps, or raise indentation_m"
        )
