"""A trial as its user would have recorded it: what the sensors deliver, and the truth beside it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tiptrace.config import Rig, Tool
from tiptrace.geometry.transforms import interpolate, rotation_exp
from tiptrace.sim.gels import Gel, MarkerSensor, make_gels
from tiptrace.sim.rig import believed_rig, believed_tool, true_opening_m, true_rig
from tiptrace.sim.seeds import stream
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.trial import PLATE_ORIGIN_B, FrameState, TrialPhysics
from tiptrace.types import (
    SIDES,
    FloatArray,
    Image,
    ImageSample,
    MarkerSample,
    OpeningSample,
    Phase,
    PhaseSample,
    PoseSample,
    Sample,
    Side,
    TactileSample,
    TruthSample,
)

START_NS = 1_767_225_600_000_000_000  # 2026-01-01: a fixed date, so that the same seed gives the same bytes
_LEAD_S = 0.2  # poses before the first and after the last exposure
_OPENING_HZ = 10.0


@dataclass(frozen=True, slots=True)
class Frame:
    """One exposure: truth and what was delivered.

    Attributes:
        state: The physics.
        markers_S: True dots (n, 3) in F_S by side, m.
        samples: What the sensors deliver since the frame before.
        stamps_ns: Stamps of its two tactile samples; empty where the pair was lost.
    """

    state: FrameState
    markers_S: dict[Side, FloatArray]
    samples: tuple[Sample, ...]
    stamps_ns: dict[Side, int]


@dataclass(slots=True)
class Simulation:
    """A trial that can be run once: iterate :meth:`frames`.

    Attributes:
        spec: The trial.
        physics: Its mechanics.
        rig: What the user believes of the rig.
        tool: What the user believes of the tool.
        true_rig: The rig as it is.
        gels: The two gels.
    """

    spec: TrialSpec
    physics: TrialPhysics = field(init=False)
    rig: Rig = field(init=False)
    tool: Tool = field(init=False)
    true_rig: Rig = field(init=False)
    gels: dict[Side, Gel] = field(init=False)
    _sensors: dict[Side, MarkerSensor] = field(init=False)
    _timing: np.random.Generator = field(init=False)
    _pose_rng: np.random.Generator = field(init=False)
    _pose_bias: FloatArray = field(init=False)
    _last_image: dict[Side, Image] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        spec, d = self.spec, self.spec.disturbed_by
        offset = d.nominal_tip_m * stream(spec.seed, "nominal-tip").normal(size=3)
        self.physics = TrialPhysics(spec, offset)
        self.true_rig = true_rig(spec)
        self.rig = believed_rig(self.true_rig, d, stream(spec.seed, "rig"))
        self.tool = believed_tool(self.physics.tool, self.physics.hand.nominal_tip_E, d.nominal_tip_m)
        self.gels = make_gels(spec, self.physics.T_E_S, self.physics.tool)
        rng = stream(spec.seed, "markers")
        self._sensors = {
            side: MarkerSensor(
                d.markers,
                np.array(self.rig.sensor(side).mm_per_px) / np.array(self.true_rig.sensor(side).mm_per_px),
                np.random.default_rng(rng.integers(2**63)),
            )
            for side in SIDES
        }
        self._timing = stream(spec.seed, "timing")
        self._pose_rng = stream(spec.seed, "pose")
        bias = self._pose_rng.normal(size=3)
        self._pose_bias = d.pose_bias_m * bias / np.linalg.norm(bias)

    @property
    def duration_s(self) -> float:
        """Length of the trial."""
        return self.physics.hand.duration_s

    @property
    def frame_count(self) -> int:
        """Exposures in the trial."""
        return self.physics.frame_count

    @property
    def references(self) -> dict[Side, Image]:
        """Images of the untouched gels; none in mode ``markers``."""
        if self.spec.mode == "markers":
            return {}
        return {side: gel.renderer.reference() for side, gel in self.gels.items()}

    def frames(self) -> Iterator[Frame]:
        """All exposures with what the sensors deliver, in order of exposure.

        Raises:
            SimulationError: a frame without equilibrium; the error names it.
        """
        T_last: FloatArray | None = None
        t_last = -_LEAD_S
        for state in self.physics.frames():
            before = T_last if T_last is not None else state.T_B_E
            samples: list[Sample] = self._poses(before, state.T_B_E, t_last, state.t_s)
            samples += self._marks(t_last, state.t_s)
            samples.append(TruthSample(_ns(state.t_s), state.tip_B))
            markers, tactile = self._tactile(state)
            samples += tactile
            if state.index == self.frame_count - 1:
                samples += self._poses(state.T_B_E, state.T_B_E, state.t_s, state.t_s + _LEAD_S)
                end = state.t_s + self.spec.disturbed_by.latency_s + 0.5 / self.spec.fps
                samples.append(PhaseSample(_ns(end), Phase.END))
            T_last, t_last = state.T_B_E, state.t_s
            stamps: dict[Side, int] = {s.side: s.stamp_ns for s in tactile}
            yield Frame(state, markers, tuple(samples), stamps)

    # --- sensors --------------------------------------------------------------------------------------------

    def _tactile(self, state: FrameState) -> tuple[dict[Side, FloatArray], list[TactileSample]]:
        """True dots, and the two tactile samples (none where the pair is lost)."""
        d = self.spec.disturbed_by
        lost, repeat, jitter = self._timing.random(), self._timing.random(2), self._timing.normal(size=2)
        frozen = abs(state.t_s - 0.6 * self.duration_s) < 0.5 * d.frozen_s
        markers: dict[Side, FloatArray] = {}
        samples: list[TactileSample] = []
        for k, side in enumerate(SIDES):
            gel = self.gels[side]
            deformation = gel.deformation(state)
            markers[side] = gel.true_dots(deformation)
            stamp = _ns(state.t_s + d.latency_s + d.jitter_s * float(jitter[k]))
            if self.spec.mode == "markers":
                samples.append(
                    MarkerSample(side, stamp, self._sensors[side].measure(markers[side], state.t_s))
                )
                continue
            image = gel.image(deformation, state)
            stale = repeat[k] < d.repeated or (frozen and side == "left")
            if stale and side in self._last_image:
                image = self._last_image[side]
            self._last_image[side] = image
            samples.append(ImageSample(side, stamp, image))
        return markers, [] if lost < d.dropped and state.index > 0 else samples

    def _poses(self, T_0: FloatArray, T_1: FloatArray, t_0: float, t_1: float) -> list[Sample]:
        """Reported poses in (t_0, t_1], interpolated between two exposures."""
        d, rate = self.spec.disturbed_by, self.spec.pose_hz
        first, last = int(np.floor(t_0 * rate + 1e-9)) + 1, int(np.floor(t_1 * rate + 1e-9))
        samples: list[Sample] = []
        for k in range(first, last + 1):
            T = interpolate(T_0, T_1, (k / rate - t_0) / (t_1 - t_0))
            noise = self._pose_rng.normal(size=6)
            T[:3, :3] = rotation_exp(np.radians(d.pose_noise_deg) * noise[3:]) @ T[:3, :3]
            T[:3, 3] += d.pose_noise_m * noise[:3] + self._pose_bias
            samples.append(PoseSample(_ns(k / rate), T))
        return samples

    def _marks(self, t_0: float, t_1: float) -> list[Sample]:
        """Phase changes and openings in (t_0, t_1]."""
        samples: list[Sample] = []
        start = self.spec.anchoring_s
        if start > 0.0 and t_0 < 0.0:
            samples.append(PhaseSample(_ns(0.0), Phase.ANCHORING))
        if t_0 < start <= t_1 or (start == 0.0 and t_0 < 0.0):
            samples.append(PhaseSample(_ns(start), Phase.RECONSTRUCTION))
        opening = true_opening_m(self.spec, self.physics.tool) + self.spec.disturbed_by.opening_m
        first, last = int(np.floor(t_0 * _OPENING_HZ + 1e-9)) + 1, int(np.floor(t_1 * _OPENING_HZ + 1e-9))
        samples += [OpeningSample(_ns(k / _OPENING_HZ), opening) for k in range(first, last + 1)]
        return samples

    # --- truth ----------------------------------------------------------------------------------------------

    def metadata(self) -> dict[str, Any]:
        """Content of ``trial.yaml``: the settings, the condition and what is true of the rig."""
        spec, physics = self.spec, self.physics
        return {
            "trajectory": spec.trajectory if spec.curve is None else spec.curve.stem,
            "tool": spec.tool,
            "wrist": spec.wrist,
            "grasp": spec.grasp,
            "seed": spec.seed,
            "level": spec.level,
            "mode": spec.mode,
            "source": "tiptrace virtual rig",
            "spec": spec.model_dump(mode="json", exclude_none=True),
            "truth": {
                "disturbances": spec.disturbed_by.model_dump(mode="json"),
                "rig": self.true_rig.model_dump(mode="json", exclude_none=True),
                "opening_m": true_opening_m(spec, physics.tool),
                "nominal_tip_error_E_m": [float(v) for v in physics.nominal_offset_E],
                "plate_origin_B_m": [float(v) for v in PLATE_ORIGIN_B],
                "latency_s": spec.disturbed_by.latency_s,
            },
        }


def _ns(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)
