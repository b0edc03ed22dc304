"""Quasi-static equilibrium of the grasped tool: pads, groove and gravity in balance, six degrees of freedom."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tiptrace.geometry.transforms import rotation_exp
from tiptrace.sim.groove import Groove
from tiptrace.sim.pad_forces import PadForces, advance_pads, pad_forces
from tiptrace.sim.pads import Pads, PadState
from tiptrace.sim.tip import TipForce, TipLaw, TipState, advance_tip, tip_force
from tiptrace.sim.tools import ToolShape
from tiptrace.types import FloatArray

FORCE_TOLERANCE_N = 1e-3
MOMENT_TOLERANCE_NM = 1e-5
_LEVER_M = 0.02  # scales moments against forces in the merit and caps rotations in a Newton step


@dataclass(frozen=True, slots=True)
class World:
    """What surrounds the tool during a step.

    Attributes:
        T_B_E: (4, 4) hand.
        friction: Pad friction coefficient now.
        push_B: (3,) extra force on the tip, N.
        tip_friction: Kinetic coefficient at the tip now; None: the law's.
    """

    T_B_E: FloatArray
    friction: float
    push_B: FloatArray = field(default_factory=lambda: np.zeros(3))
    tip_friction: float | None = None


@dataclass(frozen=True, slots=True)
class GraspState:
    """Pose of the tool in F_E and the contacts' memory."""

    R: FloatArray
    p: FloatArray
    pads: PadState
    tip: TipState


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """A converged step (or not).

    Attributes:
        R: (3, 3) tool in F_E.
        p: (3,) tip in F_E.
        pads: Pad forces there.
        tip: Tip force there.
        force_residual_n: |ΣF|.
        moment_residual_nm: |ΣM| about the tip.
        iterations: Newton steps taken.
    """

    R: FloatArray
    p: FloatArray
    pads: PadForces
    tip: TipForce
    force_residual_n: float
    moment_residual_nm: float
    iterations: int

    @property
    def converged(self) -> bool:
        """Within the tolerances that every written frame keeps."""
        return self.force_residual_n <= FORCE_TOLERANCE_N and self.moment_residual_nm <= MOMENT_TOLERANCE_NM


@dataclass(frozen=True, slots=True)
class Grasp:
    """The mechanical system: two pads, a tool, a groove.

    Attributes:
        pads: Springs in F_E.
        tool: The tool.
        groove: The plate.
        tip_law: Contact at the tip.
        origin_B: (3,) plate origin in the base.
    """

    pads: Pads
    tool: ToolShape
    groove: Groove
    tip_law: TipLaw
    origin_B: FloatArray

    def balance(
        self, state: GraspState, world: World, R: FloatArray, p: FloatArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray, PadForces, TipForce]:
        """Net wrench (6,) on the tool about its tip in F_E, its stiffness (6, 6), and the contacts."""
        R_B_E, t_B_E = world.T_B_E[:3, :3], world.T_B_E[:3, 3]
        pads = pad_forces(self.pads, self.tool, state.pads, R, p, dt_s, world.friction)
        p_plate = R_B_E @ p + t_B_E - self.origin_B
        tip = tip_force(
            self.groove, self.tool.tip_radius_m, self.tip_law, state.tip, p_plate, world.tip_friction
        )
        wrench, J = pads.wrench.copy(), pads.stiffness
        wrench[:3] += R_B_E.T @ (tip.force + world.push_B)
        J[:3, :3] += R_B_E.T @ tip.stiffness @ R_B_E
        weight = R_B_E.T @ np.array([0.0, 0.0, -self.tool.weight_n])
        g = R @ self.tool.centre_of_mass_T
        wrench[:3] += weight
        wrench[3:] += np.cross(g, weight)
        J[3:, 3:] += np.outer(g, weight) - np.eye(3) * float(g @ weight)
        return wrench, J, pads, tip

    def solve(
        self, state: GraspState, world: World, R: FloatArray, p: FloatArray, dt_s: float, limit: int = 30
    ) -> Equilibrium:
        """Newton's method with line search from the pose (R, p)."""
        wrench, J, pads, tip = self.balance(state, world, R, p, dt_s)
        merit, taken = _merit(wrench), 0
        while merit >= _DONE and taken < limit:
            step = _newton_step(wrench, J, 0.0)
            fraction = 1.0
            for _ in range(7):
                R_new, p_new = rotation_exp(fraction * step[3:]) @ R, p + fraction * step[:3]
                trial = self.balance(state, world, R_new, p_new, dt_s)
                merit_new = _merit(trial[0])
                if merit_new < merit * (1.0 - 1e-3 * fraction):
                    break
                fraction *= 0.5
            R, p, merit = R_new, p_new, merit_new
            wrench, J, pads, tip = trial
            taken += 1
        return _result(R, p, wrench, pads, tip, taken)

    def relax(
        self, state: GraspState, world: World, R: FloatArray, p: FloatArray, dt_s: float, limit: int = 250
    ) -> Equilibrium:
        """Overdamped motion from (R, p) until it rests: follows the tool through a snap, where Newton's method
        is thrown back and forth across the fold.

        Each step is implicit, with a damping that shrinks with the residual, so that it ends as Newton's method.
        """
        wrench, J, pads, tip = self.balance(state, world, R, p, dt_s)
        merit, taken = _merit(wrench), 0
        while merit >= _DONE and taken < limit:
            damping = _DAMPING * min(1.0, float(np.sqrt(merit)) / 0.3) ** 2
            step = _newton_step(wrench, J, damping)
            R, p = rotation_exp(step[3:]) @ R, p + step[:3]
            wrench, J, pads, tip = self.balance(state, world, R, p, dt_s)
            merit = _merit(wrench)
            taken += 1
        return _result(R, p, wrench, pads, tip, taken)

    def take_hold(self, state: GraspState, world: World) -> GraspState:
        """The pads touch the tool where it is, without shear: the fingers close on a tool held by someone."""
        _, _, pads, _ = self.balance(state, world, state.R, state.p, 1e-3)
        return replace(state, pads=advance_pads(self.pads, state.pads, pads, state.R, state.p, 1e-3))

    def advance(self, state: GraspState, equilibrium: Equilibrium, dt_s: float) -> GraspState:
        """State after a converged step."""
        R, p = equilibrium.R, equilibrium.p
        return GraspState(
            R,
            p,
            advance_pads(self.pads, state.pads, equilibrium.pads, R, p, dt_s),
            advance_tip(state.tip, equilibrium.tip, dt_s),
        )


_DONE = (5e-5) ** 2  # N²: well below the tolerance, so that a frame's residual is not the solver's luck


def _merit(wrench: FloatArray) -> float:
    """Squared residual, moments as forces at the lever, N²."""
    return float(wrench[:3] @ wrench[:3] + wrench[3:] @ wrench[3:] / _LEVER_M**2)


def _newton_step(wrench: FloatArray, J: FloatArray, damping: float) -> FloatArray:
    """(6,) step, its length capped at 1 mm and 3°; damping in N/m."""
    A = J - damping * _METRIC
    try:
        step = np.linalg.solve(A, -wrench)
    except np.linalg.LinAlgError:
        step = np.linalg.lstsq(A, -wrench, rcond=None)[0]
    size = max(float(np.linalg.norm(step[:3])) / 1e-3, float(np.linalg.norm(step[3:])) / 0.05, 1.0)
    return np.asarray(step / size)


_METRIC = np.diag([1.0, 1.0, 1.0, _LEVER_M**2, _LEVER_M**2, _LEVER_M**2])
_DAMPING = 2e3  # N/m, the order of the pads' own stiffness


def _result(
    R: FloatArray, p: FloatArray, wrench: FloatArray, pads: PadForces, tip: TipForce, taken: int
) -> Equilibrium:
    force, moment = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
    return Equilibrium(R, p, pads, tip, force, moment, taken)
