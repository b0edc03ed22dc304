"""The method as a fold over observations: no files, no threads, no clock, no drawing. Read this first.

Algorithm 1 of the paper in two halves. ``Sensing`` tracks the markers of both fingers and lifts them to 3-D in
the sensor frames (lines 3 and 5). An ``Estimator`` takes them to the base frame, estimates the rigid motion
(R_t, d_t), anchors the resting tip and propagates it (lines 6 to 15); ``estimation/paper.py`` is the paper's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

from tiptrace.config import Rig, Tool
from tiptrace.errors import ConfigError
from tiptrace.estimation.anchor import TipPrior
from tiptrace.estimation.baselines import EeOracleEstimator, LocalAnchoringEstimator, NominalTipEstimator
from tiptrace.estimation.ee_only import EeOnlyEstimator, Estimator
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.full_config import FullConfig
from tiptrace.estimation.paper import PaperEstimator
from tiptrace.estimation.stage_one import Anchoring
from tiptrace.perception.finger import Finger
from tiptrace.perception.gel_model import GelModel, load_gel_model
from tiptrace.perception.settings import SensingConfig
from tiptrace.perception.warm_up import warm_up
from tiptrace.types import (
    SIDES,
    Anchor,
    Event,
    FingerMarkers,
    FloatArray,
    ImageSample,
    Observation,
    SensedFinger,
    SensedPair,
    Side,
    Stream,
    TipEstimate,
)

TruthAt = Callable[[int], FloatArray]
"""True tip (3,) in F_B at a stamp, ns."""

Map = Callable[[Callable[[Side], Any], Iterable[Side]], Iterable[Any]]
"""Applies a function to both sides: the built-in ``map``, or an executor's for one thread per finger."""


class Sensing:
    """Both fingers: images in, 3-D markers and sensor poses out.

    Samples that carry measured markers instead of images pass through unchanged.
    """

    def __init__(self, stream: Stream, config: SensingConfig | None = None, both: Map = map) -> None:
        """Prepare both fingers with what travels with the stream: rig, references, gel models."""
        self._rig: Rig = stream.rig
        self._references, self._gel_models = stream.references, stream.gel_models
        self._config = config or SensingConfig()
        self._both = both
        self.fingers: dict[Side, Finger] = {}
        self._loaded: dict[str, GelModel] = {}
        self._sensor_poses: dict[Side, tuple[float | None, FloatArray]] = {}
        if stream.references:  # images will come: the first one should not wait
            warm_up()

    def __call__(self, observation: Observation) -> SensedPair:
        """Track and lift the markers of a pair.

        Raises:
            PerceptionError: an image that cannot be used; the message names the finger.
        """
        left, right = self._both(lambda side: self._sense(side, observation), SIDES)
        return SensedPair(observation.stamp_ns, observation.phase, left, right, observation.poses)

    def prepare(self) -> None:
        """Set up both fingers before images come, so that the first one does not wait for that.

        Raises:
            PerceptionError: a reference or gel model that cannot be used.
        """
        for side in SIDES:
            self._finger(side)

    def match_anew(self) -> None:
        """Forget whose dots the markers are on; they are matched to all dots in the frames to come."""
        for finger in self.fingers.values():
            finger.match_anew()

    def _sense(self, side: Side, observation: Observation) -> SensedFinger:
        seen = observation.finger(side)
        if isinstance(seen.sample, ImageSample):
            markers = self._finger(side).sense(seen.sample.image)
        else:
            x_S = seen.sample.x_S
            markers = FingerMarkers(x_S=x_S, tracked=~(x_S != x_S).any(axis=1))
        return SensedFinger(markers, seen.T_B_E, self._T_E_S(side, observation.opening_m))

    def _finger(self, side: Side) -> Finger:
        if side not in self.fingers:
            sensor = self._rig.sensor(side)
            gel = None
            if self._config.depth == "network":
                gel = self._gel(sensor.gel_model)
            self.fingers[side] = Finger(sensor, gel, self._references.get(side), self._config, side=side)
        return self.fingers[side]

    def _T_E_S(self, side: Side, opening_m: float | None) -> FloatArray:
        """Sensor pose (4, 4) in F_E; it changes with the opening only."""
        known = self._sensor_poses.get(side)
        if known is None or known[0] != opening_m:
            known = self._sensor_poses[side] = (opening_m, self._rig.T_E_S(side, opening_m))
        return known[1]

    def _gel(self, name: str) -> GelModel:
        """A gel model by the rig's name for it; two gels of one model share it."""
        if name not in self._loaded:
            self._loaded[name] = load_gel_model(self._gel_models.get(name, name))
        return self._loaded[name]


class TipTracer:
    """Where the tip is, pair by pair: ``estimate = tracer.update(observation)``."""

    def __init__(self, sensing: Sensing, estimator: Estimator) -> None:
        self.sensing = sensing
        self.estimator = estimator

    def update(self, observation: Observation) -> TipEstimate:
        """One step of Algorithm 1: constant cost, constant memory, causal."""
        return self.estimate(self.sensing(observation))

    def estimate(self, pair: SensedPair) -> TipEstimate:
        """The second half of :meth:`update`; where markers have long been astray, they are matched to dots anew."""
        estimate = self.estimator.update(pair)
        if isinstance(self.estimator, FullEstimator) and self.estimator.bewildered:
            self.sensing.match_anew()
        return estimate

    @property
    def anchor(self) -> Anchor | None:
        """Stage I result, None before there is one."""
        return self.estimator.anchor

    @property
    def events(self) -> list[Event]:
        """What a user should know about the trial so far."""
        return self.estimator.events


@dataclass(frozen=True, slots=True)
class TracerOptions:
    """What stands in for the usual means: gel network, Stage I, tip.

    Attributes:
        depth: ``none`` measures in the gels' planes only.
        tool: In place of the stream's.
        use_stage_one: Else the tip comes from the tool, from ``anchor_from``, or from nowhere.
        relative: Without Stage I, tip and ``anchor_from``: displacements from the first contact.
        anchor_from: Another trial's grasp (same grasp) or tip (regrasp).
    """

    depth: Literal["network", "none"] = "network"
    tool: Tool | None = None
    use_stage_one: bool = True
    relative: bool = False
    anchor_from: TipPrior | Anchoring | None = None

    @property
    def anchored_elsewhere(self) -> bool:
        """Whether Stage I is not used."""
        return not self.use_stage_one or self.anchor_from is not None


DEFAULT_OPTIONS = TracerOptions()

METHODS: dict[str, str] = {
    "full": "maximum-likelihood anchor, weighted motion, tip map, covariance, integrity",
    "paper": "the paper's method to the letter",
    "ee-only": "baseline: end-effector pose with the tip constant, from full's anchor",
    "ee-oracle": "baseline: end-effector pose with the tip constant, from the true anchor",
    "nominal-tip": "baseline: end-effector pose with the tip of tool.yaml",
    "local-anchoring": "baseline: the paper's Stage I in a sliding window",
}


def require_methods(*names: str) -> None:
    """Before any work is done.

    Raises:
        ConfigError: a name that is none of :data:`METHODS`, which are listed.
    """
    unknown = [f"'{name}'" for name in names if name not in METHODS]
    if unknown:
        raise ConfigError(f"unknown method {', '.join(unknown)}; valid: {', '.join(METHODS)}")


def sensing_of(method: str) -> Literal["paper", "full"]:
    """Which sensing chain a method runs on."""
    return "paper" if method == "paper" else "full"


def make_estimator(
    method: str, stream: Stream, truth_at: TruthAt | None = None, options: TracerOptions = DEFAULT_OPTIONS
) -> Estimator:
    """The estimator of a method.

    Args:
        method: One of :data:`METHODS`.
        stream: For its rig and tool.
        truth_at: True tip at a stamp, for ``ee-oracle`` only.
        options: Where the tip comes from.

    Raises:
        ConfigError: an unknown name (the valid ones are listed), no truth for the oracle, or a method that anchors by
            its own Stage I and is told not to.
        GeometryError: ``nominal-tip`` or ``use_stage_one = False`` without a tip in the tool's file.
    """
    require_methods(method)
    tool = options.tool or stream.tool
    if method == "nominal-tip":
        return NominalTipEstimator(tool)
    if method == "full":
        return _full(stream, tool, options)
    if options.anchored_elsewhere:
        raise ConfigError(
            f"method '{method}' anchors by its own Stage I; --tip and --anchor-from need method full"
        )
    if method == "paper":
        return PaperEstimator()
    if method == "ee-only":
        return EeOnlyEstimator(_full(stream, tool, options))
    if method == "local-anchoring":
        return LocalAnchoringEstimator()
    if truth_at is None:  # what is left is ee-oracle
        raise ConfigError("method 'ee-oracle' needs a ground truth, which this trial does not have")
    return EeOracleEstimator(truth_at)


def _full(stream: Stream, tool: Tool | None, options: TracerOptions) -> FullEstimator:
    config = FullConfig(use_stage_one=options.use_stage_one, relative=options.relative)
    return FullEstimator(config, rig=stream.rig, tool=tool, anchor_from=options.anchor_from)


def sensing_config(method: str, stream: Stream, options: TracerOptions = DEFAULT_OPTIONS) -> SensingConfig:
    """Settings of the sensing chain; without depth the indentation follows from the tool's thickness."""
    config = SensingConfig(method=sensing_of(method), depth=options.depth)
    tool, gripper = options.tool or stream.tool, stream.rig.gripper
    if options.depth == "network" or tool is None or tool.thickness_m is None or gripper is None:
        return config
    pressed_m = 0.5 * (tool.thickness_m - gripper.opening_m)
    return config.model_copy(update={"indentation_m": pressed_m}) if 0.0 < pressed_m < 5e-3 else config


def make_tracer(
    stream: Stream,
    method: str,
    both: Map = map,
    truth_at: TruthAt | None = None,
    options: TracerOptions = DEFAULT_OPTIONS,
) -> TipTracer:
    """A tracer for a stream: sensing and estimator as a method wants them."""
    estimator = make_estimator(method, stream, truth_at, options)
    return TipTracer(Sensing(stream, sensing_config(method, stream, options), both), estimator)
