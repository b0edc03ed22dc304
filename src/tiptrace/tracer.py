"""The method as a fold over observations: no files, no threads, no clock, no drawing. Read this first.

Algorithm 1 of the paper in two halves. ``Sensing`` tracks the markers of both fingers and lifts them to 3-D in
the sensor frames (lines 3 and 5). An ``Estimator`` takes them to the base frame, estimates the rigid motion
(R_t, d_t), anchors the resting tip and propagates it (lines 6 to 15); ``estimation/paper.py`` is the paper's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Literal

from tiptrace.config import Rig
from tiptrace.errors import ConfigError
from tiptrace.estimation.baselines import EeOracleEstimator, LocalAnchoringEstimator, NominalTipEstimator
from tiptrace.estimation.ee_only import EeOnlyEstimator, Estimator
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.paper import PaperEstimator
from tiptrace.perception.finger import Finger
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.perception.settings import SensingConfig
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

    def __call__(self, observation: Observation) -> SensedPair:
        """Track and lift the markers of a pair.

        Raises:
            PerceptionError: an image that cannot be used; the message names the finger.
        """
        left, right = self._both(lambda side: self._sense(side, observation), SIDES)
        return SensedPair(observation.stamp_ns, observation.phase, left, right, observation.poses)

    def _sense(self, side: Side, observation: Observation) -> SensedFinger:
        seen = observation.finger(side)
        if isinstance(seen.sample, ImageSample):
            markers = self._finger(side).sense(seen.sample.image)
        else:
            x_S = seen.sample.x_S
            markers = FingerMarkers(x_S=x_S, tracked=~(x_S != x_S).any(axis=1))
        return SensedFinger(markers, seen.T_B_E, self._rig.T_E_S(side, observation.opening_m))

    def _finger(self, side: Side) -> Finger:
        if side not in self.fingers:
            sensor = self._rig.sensor(side)
            gel = None
            if self._config.depth == "network":
                gel = load_gel_model(self._gel_models.get(sensor.gel_model, sensor.gel_model))
            self.fingers[side] = Finger(sensor, gel, self._references.get(side), self._config, side=side)
        return self.fingers[side]


class TipTracer:
    """Where the tip is, pair by pair: ``estimate = tracer.update(observation)``."""

    def __init__(self, sensing: Sensing, estimator: Estimator) -> None:
        self.sensing = sensing
        self.estimator = estimator

    def update(self, observation: Observation) -> TipEstimate:
        """One step of Algorithm 1: constant cost, constant memory, causal."""
        return self.estimator.update(self.sensing(observation))

    @property
    def anchor(self) -> Anchor | None:
        """Stage I result, None before there is one."""
        return self.estimator.anchor

    @property
    def events(self) -> list[Event]:
        """What a user should know about the trial so far."""
        return self.estimator.events


METHODS: dict[str, str] = {
    "full": "maximum-likelihood anchor, weighted motion, tip map, covariance, integrity",
    "paper": "the paper's method to the letter",
    "ee-only": "baseline: end-effector pose with the tip constant, from full's anchor",
    "ee-oracle": "baseline: end-effector pose with the tip constant, from the true anchor",
    "nominal-tip": "baseline: end-effector pose with the tip of tool.yaml",
    "local-anchoring": "baseline: the paper's Stage I in a sliding window",
}


def sensing_of(method: str) -> Literal["paper", "full"]:
    """Which sensing chain a method runs on."""
    return "paper" if method == "paper" else "full"


def make_estimator(method: str, stream: Stream, truth_at: TruthAt | None = None) -> Estimator:
    """The estimator of a method.

    Args:
        method: One of :data:`METHODS`.
        stream: For its rig and tool.
        truth_at: True tip at a stamp, for ``ee-oracle`` only.

    Raises:
        ConfigError: an unknown name (the valid ones are listed), or no truth for the oracle.
        GeometryError: ``nominal-tip`` without a tip in the tool's file.
    """
    if method == "full":
        return FullEstimator(rig=stream.rig, tool=stream.tool)
    if method == "paper":
        return PaperEstimator()
    if method == "ee-only":
        return EeOnlyEstimator(FullEstimator(rig=stream.rig, tool=stream.tool))
    if method == "nominal-tip":
        return NominalTipEstimator(stream.tool)
    if method == "local-anchoring":
        return LocalAnchoringEstimator()
    if method == "ee-oracle":
        if truth_at is None:
            raise ConfigError("method 'ee-oracle' needs a ground truth, which this trial does not have")
        return EeOracleEstimator(truth_at)
    raise ConfigError(f"unknown method '{method}'; valid: {', '.join(METHODS)}")


def make_tracer(stream: Stream, method: str, both: Map = map, truth_at: TruthAt | None = None) -> TipTracer:
    """A tracer for a stream: sensing and estimator as a method wants them."""
    estimator = make_estimator(method, stream, truth_at)
    return TipTracer(Sensing(stream, SensingConfig(method=sensing_of(method)), both), estimator)
