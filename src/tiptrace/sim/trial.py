"""A trial's physics: settle the grasp, press down, Stage I, Stage II; one state per image pair, or an error."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from tiptrace.errors import SimulationError
from tiptrace.geometry.transforms import interpolate, rotation_exp, transform
from tiptrace.sim.conditions import named_hold, named_wrist
from tiptrace.sim.contact import FACE_M, GelLaw, PadForces, Pads, PadState, TipForce, TipLaw, TipState
from tiptrace.sim.grasp import Equilibrium, Grasp, GraspState, World
from tiptrace.sim.groove import Groove, centreline_from_csv, named_centreline
from tiptrace.sim.protocol import Hand, pad_friction, plan, tip_push
from tiptrace.sim.rig import PADS_E, Placement, true_opening_m, true_rig
from tiptrace.sim.slip import SlipMeter, drift_anchors
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.tools import ToolShape, make_tool
from tiptrace.types import SIDES, FloatArray, Phase

PLATE_ORIGIN_B = np.array([0.35, -0.15, 0.02])
MAX_STEP_S = 0.02
_BISECTIONS = 6
_PRESS_STEP_M = 0.1e-3
_PRESS_LIMIT_M = 6e-3
_GUARD_BAND = (0.8, 1.4)  # of the anchoring force
_GUARD_GAIN = 0.7 / 3000.0  # m/N per step: a little under the grasp's own compliance along the tool
_LEAST_GRIP_N = 0.5
_FAST_MPS = 0.06  # a tip that moves faster has jumped: its speed predicts nothing


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
        tool: The tool.
        grasp: The mechanical system.
        hand: The commanded motion, known once the grasp has settled and the tip is pressed down.
    """

    spec: TrialSpec
    nominal_offset_E: FloatArray
    groove: Groove | None = None
    tool: ToolShape = field(init=False)
    grasp: Grasp = field(init=False)
    hand: Hand = field(init=False)
    T_E_S: dict[str, FloatArray] = field(init=False)
    _state: GraspState = field(init=False)
    _guard_m: float = field(init=False, default=0.0)
    _guard_end_m: float = field(init=False, default=0.0)
    _travel_rise_m: float = field(init=False, default=0.0)
    _stiffness: float = field(init=False, default=4e3)
    _anchored: bool = field(init=False, default=False)
    _tip_B: FloatArray | None = field(init=False, default=None)
    _velocity_B: FloatArray = field(init=False, default_factory=lambda: np.zeros(3))
    _slip: SlipMeter = field(init=False)

    def __post_init__(self) -> None:
        spec = self.spec
        self.tool = make_tool(spec.tool, spec.thickness_m, spec.tool_length_m)
        hold = named_hold(spec.grasp)
        _check_reach(hold.above_tip_m, self.tool)
        wrist = named_wrist(spec.wrist)
        opening = true_opening_m(spec, self.tool)
        if opening <= 0.0:
            raise SimulationError(
                f"an indentation of {spec.indentation_m * 1e3:.1f} mm per pad closes the gripper on a tool of "
                f"{self.tool.thickness_m * 1e3:.1f} mm; use less than half its thickness"
            )
        rig = true_rig(spec)
        self.T_E_S = {side: rig.T_E_S(side, opening) for side in SIDES}
        d = spec.disturbed_by
        law = GelLaw(youngs_pa=GelLaw().youngs_pa * d.gel_stiffness, stiffening=d.gel_stiffening)
        if self.groove is None:
            line = (
                named_centreline(spec.trajectory) if spec.curve is None else centreline_from_csv(spec.curve)
            )
            self.groove = Groove(line)
        self.groove.line.check(self.groove.radius_m)
        self.grasp = Grasp(Pads.at(self.T_E_S, law), self.tool, self.groove, TipLaw(), PLATE_ORIGIN_B)
        placement = Placement.of(hold, self.tool)
        self._state = GraspState(placement.R, placement.p, PadState.fresh(len(self.grasp.pads)), TipState())
        self._slip = SlipMeter(self.grasp.pads)
        T_B_E = self._press_down(self._settle(wrist.R_B_E))
        if spec.anchoring_s == 0.0:
            T_B_E = self._rise(T_B_E)
        nominal = self._state.p + self.nominal_offset_E
        self.hand = Hand(spec, plan(spec), T_B_E, nominal, PADS_E)

    # --- before the first frame -----------------------------------------------------------------------------

    def _settle(self, R_B_E: FloatArray) -> FloatArray:
        """Close the fingers on the tool in the air and let the gel relax; returns the hand above the pit."""
        assert self.groove is not None
        start = self.groove.line.points(np.zeros(1))[0] + PLATE_ORIGIN_B
        T = transform(R_B_E, start + [0, 0, 5e-3] - R_B_E @ self._state.p)
        world = World(T, self.grasp.pads.law.friction)
        self._state = self.grasp.take_hold(self._state, world)
        for _ in range(8):
            self._to_equilibrium(world, 4.0, "closing the fingers")
        grip = self._last.pads.normal_n.sum() / 2
        moved = float(np.linalg.norm(self._state.p - Placement.of(named_hold(self.spec.grasp), self.tool).p))
        if grip < _LEAST_GRIP_N or moved > 8e-3:
            raise SimulationError(
                f"the grasp does not hold the tool: {grip:.2f} N of grip per pad, the tip sagged {moved * 1e3:.1f} mm; "
                f"raise indentation_m or hold the tool nearer to its middle"
            )
        T[:3, 3] = start - R_B_E @ self._state.p
        T[2, 3] += 0.1e-3
        return T

    def _press_down(self, T_B_E: FloatArray) -> FloatArray:
        """Lower the hand until the groove pushes back with the anchoring force, then let it rest."""
        T = T_B_E.copy()
        mu, wanted = self.grasp.pads.law.friction, self.spec.anchor_force_n
        self._to_equilibrium(World(T, mu), 0.05, "pressing down")
        force = lowered = 0.0
        stiffness = 3e3
        while force < wanted - 0.01:
            step = (
                _PRESS_STEP_M
                if force < 0.3
                else float(np.clip((wanted - force) / stiffness, 1e-6, _PRESS_STEP_M))
            )
            T[2, 3] -= step
            lowered += step
            self._to_equilibrium(World(T.copy(), mu), 0.05, "pressing down")
            before, force = force, float(self._last.tip.force[2])
            if before > 0.3:
                stiffness = max((force - before) / step, 500.0)
            if lowered > _PRESS_LIMIT_M:
                raise SimulationError(
                    f"the grasp does not hold the tool: pressing down by {lowered * 1e3:.0f} mm gave only "
                    f"{force:.2f} N of the {wanted:.1f} N asked for"
                )
        for _ in range(10):
            self._to_equilibrium(World(T, mu), 0.2, "resting")
        self._probe(T)
        return T

    def _probe(self, T_B_E: FloatArray) -> None:
        """Measure the grasp's stiffness along z by a small lift."""
        T, mu = T_B_E.copy(), self.grasp.pads.law.friction
        pressed = float(self._last.tip.force[2])
        T[2, 3] += _PRESS_STEP_M
        self._to_equilibrium(World(T, mu), 0.05, "probing")
        self._stiffness = max((pressed - float(self._last.tip.force[2])) / _PRESS_STEP_M, 500.0)
        self._to_equilibrium(World(T_B_E, mu), 0.05, "probing")

    def _rise(self, T_B_E: FloatArray) -> FloatArray:
        """Without Stage I the trial starts at the height of the travel."""
        self._plan_rise(0.0)
        rise, T, mu = self._travel_rise_m, T_B_E.copy(), self.grasp.pads.law.friction
        self._travel_rise_m = 0.0
        steps = int(np.ceil(abs(rise) / _PRESS_STEP_M)) + 1
        for _ in range(steps):
            T[2, 3] += rise / steps
            self._to_equilibrium(World(T.copy(), mu), 0.05, "rising")
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
        spec = self.spec
        substeps = int(np.ceil(1.0 / spec.fps / MAX_STEP_S - 1e-9))
        friction = pad_friction(spec, self.grasp.pads.law.friction)
        drift_rad_s = np.radians(spec.disturbed_by.grasp_drift_deg) / max(self.hand.duration_s, 1e-9)
        T_last, t_last = self.hand.pose(0.0), 0.0
        self._slip.reset()
        for index in range(self.frame_count):
            retried = False
            for k in range(substeps if index else 1):
                t = (
                    index / spec.fps
                    if k == substeps - 1 or not index
                    else ((index - 1) + (k + 1) / substeps) / spec.fps
                )
                dt = max(t - t_last, 1e-4)
                T = self.hand.pose(t)
                self._guard(t)
                T[2, 3] += self._guard_m
                self._state = drift_anchors(self.grasp.pads, self._state, drift_rad_s * dt)
                self._slip.rotation_deg -= float(np.degrees(drift_rad_s * dt))
                mu, push = friction(t), tip_push(spec, t)
                retried |= self._move(T_last, T, mu, push, dt, f"frame {index}")
                T_last, t_last = T, t
            yield self._frame(index, t_last, T_last, retried)

    def _guard(self, t: float) -> None:
        """Height of the hand above its plan: a force guard in Stage I, then what the travel's preload needs.

        While the hand turns about a tip that it knows badly, it yields along z whenever the contact force leaves
        its band; then it moves to the height of the travel and stays there.
        """
        segment = self.hand.segment(t)
        if not segment.anchoring:
            if t > 0.0 and not self._anchored:
                self._plan_rise(segment.from_m)
                self._guard_m = self._travel_rise_m
            return
        moving_until = segment.end_s - segment.rest_s
        if t <= moving_until:
            self._anchored = False
            if self.spec.anchor_guard:
                N = float(self._last.tip.force[2])
                force = self.spec.anchor_force_n if segment.start_s == 0.0 else self.spec.preload_n
                low, high = (b * force for b in _GUARD_BAND)
                self._guard_m += _GUARD_GAIN * (max(N - high, 0.0) - max(low - N, 0.0))
            return
        if not self._anchored:
            self._plan_rise(segment.from_m)
        u = (t - moving_until) / segment.rest_s
        self._guard_m = self._guard_end_m + (self._travel_rise_m - self._guard_end_m) * u * u * (
            3.0 - 2.0 * u
        )

    def _plan_rise(self, travelled_m: float) -> None:
        """Decide on the height of the travel: from the force now to the preload, and out of the pit."""
        assert self.groove is not None
        self._anchored = True
        self._guard_end_m = self._guard_m
        climb = self.groove.pit.depth_m if travelled_m == 0.0 else 0.0
        excess = float(self._last.tip.force[2]) - self.spec.preload_n
        self._travel_rise_m = self._guard_m + climb + excess / self._stiffness

    def _move(
        self, T_from: FloatArray, T_to: FloatArray, mu: float, push: FloatArray, dt: float, where: str
    ) -> bool:
        """One step of the hand, cut into halves where the solver needs it. True if it did."""
        if self._try(World(T_to, mu, push), dt):
            return False
        pieces = [(0.0, 1.0, 0)]
        while pieces:
            a, b, depth = pieces.pop()
            T = interpolate(T_from, T_to, b)
            world, step = World(T, mu, push), dt * (b - a)
            if (depth and self._try(world, step)) or self._relaxes(world, step):
                continue
            if depth == _BISECTIONS:
                self._fail(where)
            middle = 0.5 * (a + b)
            pieces += [(middle, b, depth + 1), (a, middle, depth + 1)]
        return True

    def _try(self, world: World, dt: float) -> bool:
        R, p = self._predict(world, dt)
        equilibrium = self.grasp.solve(self._state, world, R, p, dt)
        if not equilibrium.converged:
            return False
        self._accept(equilibrium, world, dt)
        return True

    def _predict(self, world: World, dt: float) -> tuple[FloatArray, FloatArray]:
        """First guess: the tip goes on as it went in the base, the tool turns about the pads to follow it."""
        R, p = self._state.R, self._state.p
        if self._tip_B is None:
            return R, p
        T = world.T_B_E
        p_new = T[:3, :3].T @ (self._tip_B + self._velocity_B * dt - T[:3, 3])
        lever = p - PADS_E
        w = np.cross(lever, p_new - p) / float(lever @ lever)
        R_new = rotation_exp(w)
        along = lever / np.linalg.norm(lever)
        return R_new @ R, PADS_E + R_new @ lever + along * float(along @ (p_new - p))

    def _relaxes(self, world: World, dt: float) -> bool:
        equilibrium = self.grasp.relax(self._state, world, self._state.R, self._state.p, dt)
        if not equilibrium.converged:
            return False
        self._accept(equilibrium, world, dt)
        return True

    def _accept(self, equilibrium: Equilibrium, world: World, dt: float) -> None:
        before = self._state
        self._state = self.grasp.advance(before, equilibrium, dt)
        self._slip.add(before, self._state, equilibrium.pads, dt)
        self._last = equilibrium
        tip_B = world.T_B_E[:3, :3] @ equilibrium.p + world.T_B_E[:3, 3]
        if self._tip_B is not None:
            velocity = (tip_B - self._tip_B) / dt
            self._velocity_B = velocity if np.linalg.norm(velocity) < _FAST_MPS else np.zeros(3)
        self._tip_B = tip_B

    def _to_equilibrium(self, world: World, dt: float, where: str) -> None:
        self._tip_B, self._velocity_B = None, np.zeros(3)
        if not (self._try(world, dt) or self._relaxes(world, dt)):
            self._fail(where)

    def _fail(self, where: str) -> None:
        raise SimulationError(
            f"{self.spec.name}, seed {self.spec.seed}: no equilibrium at {where}; the tool is being torn out of the "
            f"pads or the groove: lower preload_n or speed_mps, or raise indentation_m"
        )

    _last: Equilibrium = field(init=False)

    def _frame(self, index: int, t: float, T_B_E: FloatArray, retried: bool) -> FrameState:
        e = self._last
        tip_B = T_B_E[:3, :3] @ e.p + T_B_E[:3, 3]
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
            tip_B=tip_B,
            slip_deg=self._slip.rotation_deg,
            slip_m=self._slip.translation_m,
            creeping=self._slip.creeping(),
            force_residual_n=e.force_residual_n,
            moment_residual_nm=e.moment_residual_nm,
            retried=retried,
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
