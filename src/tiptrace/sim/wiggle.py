"""Calibration wiggle: the held rod is clamped in the world, the hand moves a little about the pads in all six axes.

Nothing is solved for: the rod does not move, so its pose in the hand follows from the hand's, the pads' springs shear
as they must, and the gels, the camera, the clocks and the robot's noise are those of a trial.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.config import Rig, Tool
from tiptrace.errors import SimulationError
from tiptrace.geometry.transforms import invert, rotation_exp, transform
from tiptrace.sim.conditions import named_hold, named_wrist
from tiptrace.sim.gels import Gel, MarkerSensor, make_gels
from tiptrace.sim.pad_forces import PadForces, advance_pads, pad_forces
from tiptrace.sim.pads import GelLaw, Pads, PadState
from tiptrace.sim.rig import PADS_E, Placement, believed_rig, believed_tool, true_opening_m, true_rig
from tiptrace.sim.seeds import stream
from tiptrace.sim.simulation import START_NS
from tiptrace.sim.spec import TrialSpec, make_spec
from tiptrace.sim.tip import TipForce
from tiptrace.sim.tools import ToolShape, make_tool
from tiptrace.sim.trial import PLATE_ORIGIN_B, FrameState
from tiptrace.sim.wiring import Fault, delivered, flipped, signs
from tiptrace.types import (
    SIDES,
    FloatArray,
    Image,
    ImageSample,
    MarkerSample,
    OpeningSample,
    Phase,
    PoseSample,
    Sample,
    Side,
)

_LEAD_S, _RAMP_S, _STEP_S = 0.4, 1.0, 0.02
_OPENING_HZ = 10.0


class Wiggle(BaseModel):
    """The motion of the hand about the middle of the pads.

    Attributes:
        shift_m: Amplitude along each axis of F_E at the start.
        rotation_deg: Amplitude about each.
        duration_s: Length.
        cycles: Periods of shift x, y, z and rotation x, y, z within the duration; all different, so that the six
            motions are told apart.
        fault: What is wrong with how the sensors are connected.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    shift_m: float = Field(default=0.5e-3, ge=0, lt=2e-3)
    rotation_deg: float = Field(default=2.0, ge=0, lt=10)
    duration_s: float = Field(default=30.0, gt=2, lt=600)
    cycles: tuple[int, int, int, int, int, int] = (5, 7, 9, 6, 8, 11)
    fault: Fault = "none"

    def T_E0_E(self, t: float) -> FloatArray:
        """Hand relative to its start, (4, 4): zero at both ends, with a smooth start."""
        s = float(np.clip(t, 0.0, self.duration_s))
        swell = min(1.0, s / _RAMP_S, (self.duration_s - s) / _RAMP_S)
        swell = swell * swell * (3.0 - 2.0 * swell)
        wave = swell * np.sin(2.0 * np.pi * np.array(self.cycles) * s / self.duration_s)
        R = rotation_exp(np.radians(self.rotation_deg) * wave[3:])
        return transform(R, PADS_E - R @ PADS_E + self.shift_m * wave[:3])


@dataclass(slots=True)
class WiggleStream:
    """A calibration wiggle as a stream; implements ``types.Stream``.

    Attributes:
        wiggle: The motion.
        spec: Rod, grasp, disturbances, rates and seed, as of a trial; its trajectory and Stage I are not used.
        rig: What the user believes of the rig.
        true_rig: The rig as it is.
        tool: What the user believes of the rod.
        gel_models: None travel with it.
    """

    wiggle: Wiggle = field(default_factory=Wiggle)
    spec: TrialSpec = field(default_factory=lambda: make_spec(mode="markers"))
    rig: Rig = field(init=False)
    true_rig: Rig = field(init=False)
    tool: Tool | None = field(init=False)
    gel_models: dict[str, bytes] = field(init=False, default_factory=dict)
    _shape: ToolShape = field(init=False)
    _gels: dict[Side, Gel] = field(init=False)
    _T_E_S: dict[str, FloatArray] = field(init=False)

    def __post_init__(self) -> None:
        spec, d = self.spec, self.spec.disturbed_by
        self._shape = make_tool(spec.tool, spec.thickness_m, spec.tool_length_m)
        self.true_rig = true_rig(spec)
        opening = true_opening_m(spec, self._shape)
        if opening <= 0.0:
            raise SimulationError("an indentation of more than half the rod's thickness closes the gripper")
        self._T_E_S = {side: self.true_rig.T_E_S(side, opening) for side in SIDES}
        self.rig = believed_rig(self.true_rig, d, stream(spec.seed, "rig"))
        place = Placement.of(named_hold(spec.grasp), self._shape)
        self.tool = believed_tool(self._shape, place.p, d.nominal_tip_m)
        self._gels = make_gels(spec, self._T_E_S, self._shape)

    @property
    def frame_count(self) -> int:
        """Image pairs."""
        return int(np.floor(self.wiggle.duration_s * self.spec.fps + 1e-6)) + 1

    @property
    def references(self) -> dict[Side, Image]:
        """Images of the untouched gels; none in mode ``markers``."""
        if self.spec.mode == "markers":
            return {}
        found = {side: gel.renderer.reference() for side, gel in self._gels.items()}
        return {
            delivered(side, self.wiggle.fault): flipped(image, side, self.wiggle.fault)
            for side, image in found.items()
        }

    @property
    def untouched(self) -> dict[Side, FloatArray]:
        """(n, 2) dots of the untouched gels in F_S with the scale that the rig states, m: what a reference shows."""
        found: dict[Side, FloatArray] = {}
        for side, gel in self._gels.items():
            dots = gel.renderer.dots
            assert dots is not None
            scale = np.array(self.rig.sensor(side).mm_per_px) / self.true_rig.sensor(side).mm_per_px
            found[side] = dots.rest_xy * scale
        return found

    @property
    def trial_metadata(self) -> dict[str, Any]:
        """Content of ``trial.yaml``."""
        return {
            "source": "tiptrace virtual rig, calibration wiggle",
            "seed": self.spec.seed,
            "level": self.spec.level,
            "mode": self.spec.mode,
            "wiggle": self.wiggle.model_dump(mode="json"),
            "truth": {
                "disturbances": self.spec.disturbed_by.model_dump(mode="json"),
                "rig": self.true_rig.model_dump(mode="json", exclude_none=True),
                "opening_m": true_opening_m(self.spec, self._shape),
                "latency_s": self.spec.disturbed_by.latency_s,
            },
        }

    def __iter__(self) -> Iterator[Sample]:
        """Deliver the samples, exposure by exposure."""
        sensors, pose_rng, timing = self._sensors(), stream(self.spec.seed, "pose"), self._timing()
        t_last, last = -_LEAD_S, self.frame_count - 1
        for state in self._states():
            yield from self._poses(pose_rng, t_last, state.t_s)
            yield from self._openings(t_last, state.t_s)
            for side, jitter in zip(SIDES, timing.normal(size=2), strict=True):
                yield self._tactile(side, state, sensors[side], float(jitter))
            t_last = state.t_s
            if state.index == last:
                yield from self._poses(pose_rng, t_last, t_last + _LEAD_S)

    # --- mechanics ------------------------------------------------------------------------------------------

    def _hand(self, t: float) -> FloatArray:
        T_B_E0 = transform(named_wrist(self.spec.wrist).R_B_E, PLATE_ORIGIN_B + [0.0, 0.0, 0.3])
        return np.asarray(T_B_E0 @ self.wiggle.T_E0_E(t))

    def _states(self) -> Iterator[FrameState]:
        """The clamped rod in the moving hand, with the shear of the pads' springs."""
        d = self.spec.disturbed_by
        law = GelLaw(youngs_pa=GelLaw().youngs_pa * d.gel_stiffness, stiffening=d.gel_stiffening)
        pads = Pads.at(self._T_E_S, law)
        T_B_T = self._hand(0.0) @ Placement.of(named_hold(self.spec.grasp), self._shape).T_E_T
        held, dt = PadState.fresh(len(pads)), 1e-3
        t_last = 0.0
        for index in range(self.frame_count):
            t = index / self.spec.fps
            steps = max(1, int(np.ceil((t - t_last) / _STEP_S - 1e-9)))
            for k in range(steps):
                at = t_last + (t - t_last) * (k + 1) / steps
                T_E_T = invert(self._hand(at)) @ T_B_T
                R, p = T_E_T[:3, :3], T_E_T[:3, 3]
                forces = pad_forces(pads, self._shape, held, R, p, dt, law.friction)
                held = advance_pads(pads, held, forces, R, p, dt)
                dt = max((t - t_last) / steps, 1e-3)
            t_last = t
            yield _state(index, t, self._hand(t), T_E_T, forces)

    # --- sensors --------------------------------------------------------------------------------------------

    def _sensors(self) -> dict[Side, MarkerSensor]:
        rng = stream(self.spec.seed, "markers")
        found: dict[Side, MarkerSensor] = {}
        for side in SIDES:
            believed, true = self.rig.sensor(side).mm_per_px, self.true_rig.sensor(side).mm_per_px
            own = np.random.default_rng(rng.integers(2**63))
            found[side] = MarkerSensor(
                self.spec.disturbed_by.markers, np.array(believed) / np.array(true), own
            )
        return found

    def _timing(self) -> np.random.Generator:
        return stream(self.spec.seed, "timing")

    def _tactile(
        self, side: Side, state: FrameState, sensor: MarkerSensor, jitter: float
    ) -> ImageSample | MarkerSample:
        d, fault, gel = self.spec.disturbed_by, self.wiggle.fault, self._gels[side]
        stamp = _ns(state.t_s + d.latency_s + d.jitter_s * jitter)
        as_side = delivered(side, fault)
        deformation = gel.deformation(state)
        if self.spec.mode == "markers":
            x_S = sensor.measure(gel.true_dots(deformation), state.t_s)
            return MarkerSample(as_side, stamp, x_S * signs(side, fault))
        return ImageSample(as_side, stamp, flipped(gel.image(deformation, state), side, fault))

    def _poses(self, rng: np.random.Generator, t_0: float, t_1: float) -> Iterator[PoseSample]:
        """Reported poses in (t_0, t_1]."""
        d, rate = self.spec.disturbed_by, self.spec.pose_hz
        first, last = int(np.floor(t_0 * rate + 1e-9)) + 1, int(np.floor(t_1 * rate + 1e-9))
        for k in range(first, last + 1):
            T, noise = self._hand(k / rate), rng.normal(size=6)
            T[:3, :3] = rotation_exp(np.radians(d.pose_noise_deg) * noise[3:]) @ T[:3, :3]
            T[:3, 3] += d.pose_noise_m * noise[:3]
            yield PoseSample(_ns(k / rate), invert(T) if self.wiggle.fault == "poses-inverted" else T)

    def _openings(self, t_0: float, t_1: float) -> Iterator[OpeningSample]:
        opening = true_opening_m(self.spec, self._shape) + self.spec.disturbed_by.opening_m
        first, last = int(np.floor(t_0 * _OPENING_HZ + 1e-9)) + 1, int(np.floor(t_1 * _OPENING_HZ + 1e-9))
        for k in range(first, last + 1):
            yield OpeningSample(_ns(k / _OPENING_HZ), opening)


def _state(index: int, t: float, T_B_E: FloatArray, T_E_T: FloatArray, forces: PadForces) -> FrameState:
    return FrameState(
        index=index,
        t_s=t,
        phase=Phase.ANCHORING,
        T_B_E=T_B_E,
        T_E_T=T_E_T,
        pads=forces,
        tip=_NO_TIP,
        tip_B=T_B_E[:3, :3] @ T_E_T[:3, 3] + T_B_E[:3, 3],
        slip_deg=0.0,
        slip_m=0.0,
        creeping=False,
        force_residual_n=0.0,
        moment_residual_nm=0.0,
        retried=False,
    )


_NO_TIP = TipForce(
    force=np.zeros(3),
    stiffness=np.zeros((3, 3)),
    normal_n=0.0,
    friction=np.zeros(3),
    normal=np.array([0.0, 0.0, 1.0]),
    slipping=False,
    anchor=np.zeros(3),
    penetration_m=0.0,
    where="free",
    stored_j=0.0,
)


def _ns(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)
