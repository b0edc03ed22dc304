"""A trial's physics: settle the grasp, press down, Stage I, Stage II; one state per image pair, or an error."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from tiptrace.errors import SimulationError
from tiptrace.geometry.transforms import transform
from tiptrace.sim.conditions import named_hold, named_wrist
from tiptrace.sim.grasp import Grasp, GraspState, World
from tiptrace.sim.groove import Groove, centreline_from_csv, named_centreline
from tiptrace.sim.guard import Guard
from tiptrace.sim.pad_forces import PadForces
from tiptrace.sim.pads import FACE_M, GelLaw, Pads, PadState
from tiptrace.sim.protocol import Hand, pad_friction, plan, tip_push
from tiptrace.sim.rig import PADS_E, Placement, true_opening_m, true_rig
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.stepper import Stepper
from tiptrace.sim.tip import TipForce, TipLaw, TipState
from tiptrace.sim.tools import ToolShape, make_tool
from tiptrace.types import SIDES, FloatArray, Phase

PLATE_ORIGIN_B = np.array([0.35, -0.15, 0.02])
MAX_STEP_S = 0.02
_PRESS_STEP_M = 0.1e-3
_PRESS_LIMIT_M = 6e-3
_LEAST_GRIP_N = 0.5
_MOST_SAG_M = 8e-3


@dataclass(frozen=True, slots=True)
class FrameState:
    """Truth at one exposure.

    Attributes:
        index: Frame number.
        t_s: Exposure time since the trial's start.
        phase: Segment of the trial.
        T_B_E: (4, 4) hand.
        T_E_T: (4, 4) tool in the hand.
        pads: Forces of the pads.
        tip: Force of the groove on the tip, plate axes.
        tip_B: (3,) tip.
        slip_deg: Rotation of the tool against the pads since the start, about the closing axis.
        slip_m: Its translation against the pads since the start.
        creeping: Whether the tool moves against the pads as a whole.
        force_residual_n: Of the equilibrium.
        moment_residual_nm: Of the equilibrium.
        retried: Whether the step had to be cut to converge.
    """

    index: int
    t_s: float
    phase: Phase
    T_B_E: FloatArray
    T_E_T: FloatArray
    pads: PadForces
    tip: TipForce
    tip_B: FloatArray
    slip_deg: float
    slip_m: float
    creeping: bool
    force_residual_n: float
    moment_residual_nm: float
    retried: bool

    @property
    def in_contact(self) -> bool:
        """Whether the tip touches the plate."""
        return self.tip.normal_n > 0.0


@dataclass(slots=True)
class TrialPhysics:
    """The virtual rig at work. Iterate :meth:`frames` once.

    Attributes:
        spec: The trial.
        nominal_offset_E: (3,) error of the tip that the hand believes in.
        groove: The plate; by default what the spec names.
        tool: The tool.
        T_E_S: True sensor poses at the gripper's opening, by side.
        stepper: The grasp as it goes.
        hand: The commanded motion, known once the grasp has settled and the tip is pressed down.
        guard: Height of the hand above its plan.
    """

    spec: TrialSpec
    nominal_offset_E: FloatArray
    groove: Groove | None = None
    tool: ToolShape = field(init=False)
    T_E_S: dict[str, FloatArray] = field(init=False)
    stepper: Stepper = field(init=False)
    hand: Hand = field(init=False)
    guard: Guard = field(init=False)

    def __post_init__(self) -> None:
        spec = self.spec
        self.tool = make_tool(spec.tool, spec.thickness_m, spec.tool_length_m)
        hold, wrist = named_hold(spec.grasp), named_wrist(spec.wrist)
        _check_reach(hold.above_tip_m, self.tool)
        _check_opening(spec, self.tool)
        rig = true_rig(spec)
        self.T_E_S = {side: rig.T_E_S(side, true_opening_m(spec, self.tool)) for side in SIDES}
        if self.groove is None:
            line = (
                named_centreline(spec.trajectory) if spec.curve is None else centreline_from_csv(spec.curve)
            )
            self.groove = Groove(line)
        self.groove.line.check(self.groove.radius_m)
        d = spec.disturbed_by
        law = GelLaw(youngs_pa=GelLaw().youngs_pa * d.gel_stiffness, stiffening=d.gel_stiffening)
        pads, place = Pads.at(self.T_E_S, law), Placement.of(hold, self.tool)
        grasp = Grasp(pads, self.tool, self.groove, TipLaw(), PLATE_ORIGIN_B)
        state = GraspState(place.R, place.p, PadState.fresh(len(pads)), TipState())
        self.stepper = Stepper(grasp, state, f"{spec.name}, seed {spec.seed}")
        self.guard = Guard(spec, self.groove.pit.depth_m)
        T_B_E = self._press_down(self._settle(wrist.R_B_E))
        if spec.anchoring_s == 0.0:
            T_B_E = self._rise(T_B_E)
        self.hand = Hand(spec, plan(spec), T_B_E, self.stepper.state.p + self.nominal_offset_E, PADS_E)

    @property
    def grasp(self) -> Grasp:
        """The mechanical system."""
        return self.stepper.grasp

    # --- before the first frame -----------------------------------------------------------------------------

    def _settle(self, R_B_E: FloatArray) -> FloatArray:
        """Close the fingers on the tool in the air and let the gel relax; returns the hand above the pit."""
        stepper, grasp = self.stepper, self.grasp
        start = grasp.groove.line.points(np.zeros(1))[0] + PLATE_ORIGIN_B
        placed = stepper.state.p
        world = World(transform(R_B_E, start + [0, 0, 5e-3] - R_B_E @ placed), grasp.pads.law.friction)
        stepper.state = grasp.take_hold(stepper.state, world)
        for _ in range(8):
            stepper.rest(world, 4.0, "closing the fingers")
        grip = stepper.last.pads.normal_n.sum() / 2
        sag = float(np.linalg.norm(stepper.state.p - placed))
        if grip < _LEAST_GRIP_N or sag > _MOST_SAG_M:
            raise SimulationError(
                f"the grasp does not hold the tool: {grip:.2f} N of grip per pad, the tip sagged {sag * 1e3:.1f} mm; "
                f"raise indentation_m or hold the tool nearer to its middle"
            )
        return transform(R_B_E, start + [0, 0, 0.1e-3] - R_B_E @ stepper.state.p)

    def _press_down(self, T_B_E: FloatArray) -> FloatArray:
        """Lower the hand until the groove pushes back with the anchoring force, then let it rest."""
        T, stepper = T_B_E.copy(), self.stepper
        mu, wanted = self.grasp.pads.law.friction, self.spec.anchor_force_n
        stepper.rest(World(T.copy(), mu), 0.05, "pressing down")
        force = lowered = 0.0
        stiffness = 3e3
        while force < wanted - 0.01:
            step = _PRESS_STEP_M
            if force > 0.3:
                step = float(np.clip((wanted - force) / stiffness, 1e-6, _PRESS_STEP_M))
            T[2, 3] -= step
            lowered += step
            stepper.rest(World(T.copy(), mu), 0.05, "pressing down")
            before, force = force, float(stepper.last.tip.force[2])
            if before > 0.3:
                stiffness = max((force - before) / step, 500.0)
            if lowered > _PRESS_LIMIT_M:
                raise SimulationError(
                    f"the grasp does not hold the tool: pressing down by {lowered * 1e3:.0f} mm gave only "
                    f"{force:.2f} N of the {wanted:.1f} N asked for"
                )
        for _ in range(10):
            stepper.rest(World(T, mu), 0.2, "resting")
        self._probe(T)
        return T

    def _probe(self, T_B_E: FloatArray) -> None:
        """Measure the grasp's stiffness along z by a small lift."""
        T, mu, stepper = T_B_E.copy(), self.grasp.pads.law.friction, self.stepper
        pressed = float(stepper.last.tip.force[2])
        T[2, 3] += _PRESS_STEP_M
        stepper.rest(World(T, mu), 0.05, "probing")
        self.guard.stiffness = max((pressed - float(stepper.last.tip.force[2])) / _PRESS_STEP_M, 500.0)
        stepper.rest(World(T_B_E, mu), 0.05, "probing")

    def _rise(self, T_B_E: FloatArray) -> FloatArray:
        """Without Stage I the trial starts at the height of the travel."""
        rise = self.guard.plan_travel(0.0, float(self.stepper.last.tip.force[2]))
        T, mu = T_B_E.copy(), self.grasp.pads.law.friction
        steps = int(np.ceil(abs(rise) / _PRESS_STEP_M)) + 1
        for _ in range(steps):
            T[2, 3] += rise / steps
            self.stepper.rest(World(T.copy(), mu), 0.05, "rising")
        return T

    # --- the trial ------------------------------------------------------------------------------------------

    @property
    def frame_count(self) -> int:
        """Image pairs in the trial."""
        return int(np.floor(self.hand.duration_s * self.spec.fps + 1e-6)) + 1

    def frames(self) -> Iterator[FrameState]:
        """States at the exposures, in order.

        Raises:
            SimulationError: no equilibrium, the tool torn out of the pads; the frame is named.
        """
        spec, stepper = self.spec, self.stepper
        substeps = int(np.ceil(1.0 / spec.fps / MAX_STEP_S - 1e-9))
        friction = pad_friction(spec, self.grasp.pads.law.friction)
        drift_rad_s = np.radians(spec.disturbed_by.grasp_drift_deg) / max(self.hand.duration_s, 1e-9)
        T_last, t_last = self.hand.pose(0.0), 0.0
        stepper.slip.reset()
        for index in range(self.frame_count):
            retried = False
            for k in range(substeps if index else 1):
                t = (index - 1 + (k + 1) / substeps) / spec.fps if index else 0.0
                dt = max(t - t_last, 1e-4)
                T = self.hand.pose(t)
                T[2, 3] += self.guard.update(t, self.hand.segment(t), float(stepper.last.tip.force[2]))
                stepper.drift(drift_rad_s * dt)
                world = World(T, friction(t), tip_push(spec, t))
                retried |= stepper.move(T_last, world, dt, f"frame {index}")
                T_last, t_last = T, t
            yield self._frame(index, t_last, T_last, retried)

    def _frame(self, index: int, t: float, T_B_E: FloatArray, retried: bool) -> FrameState:
        e, slip = self.stepper.last, self.stepper.slip
        if e.pads.normal_n.sum() < _LEAST_GRIP_N:
            raise SimulationError(f"{self.spec.name}: the grasp lost the tool at frame {index}")
        return FrameState(
            index=index,
            t_s=t,
            phase=self.hand.phase(t),
            T_B_E=T_B_E,
            T_E_T=transform(e.R, e.p),
            pads=e.pads,
            tip=e.tip,
            tip_B=T_B_E[:3, :3] @ e.p + T_B_E[:3, 3],
            slip_deg=slip.rotation_deg,
            slip_m=slip.translation_m,
            creeping=slip.creeping(),
            force_residual_n=e.force_residual_n,
            moment_residual_nm=e.moment_residual_nm,
            retried=retried,
        )


def _check_opening(spec: TrialSpec, tool: ToolShape) -> None:
    if true_opening_m(spec, tool) <= 0.0:
        raise SimulationError(
            f"an indentation of {spec.indentation_m * 1e3:.1f} mm per pad closes the gripper on a tool of "
            f"{tool.thickness_m * 1e3:.1f} mm; use less than half its thickness"
        )


def _check_reach(above_tip_m: float, tool: ToolShape) -> None:
    """The pads must find a straight shank.

    Raises:
        SimulationError: the grasp lies beyond the tool's ends.
    """
    half = 0.5 * FACE_M[0]
    lowest = tool.bend_above_tip_m + 4e-3 if tool.bend_deg else 12e-3
    if above_tip_m - half < lowest or above_tip_m + 0.3 * half > -tool.top_m:
        raise SimulationError(
            f"the pads do not reach the tool: a grasp {above_tip_m * 1e3:.0f} mm above the tip needs a shank from "
            f"{(above_tip_m - half) * 1e3:.0f} to {(above_tip_m + half) * 1e3:.0f} mm, {tool.name} of "
            f"{tool.length_m * 1e3:.0f} mm has one from {lowest * 1e3:.0f} to {-tool.top_m * 1e3:.0f} mm"
        )
