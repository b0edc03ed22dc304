"""Runs one trial with several methods: a recording, or a trial of the virtual rig. Workers call this by name."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.config import Rig, Tool
from tiptrace.errors import ConfigError, TipTraceError
from tiptrace.evaluation.analytic import CENTRELINES, analytic_truth
from tiptrace.evaluation.conditions import Condition
from tiptrace.evaluation.error_series import initial_point
from tiptrace.evaluation.runner import TrialRun, TrialTask
from tiptrace.evaluation.suite_tables import BASELINES
from tiptrace.evaluation.truth import Truth
from tiptrace.evaluation.truth_files import read_truth
from tiptrace.pipeline import Step, open_tracer, replay, trace
from tiptrace.reconstruction import Trial, reconstruct
from tiptrace.sim.simulation import START_NS, Frame
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.sources import open_recording
from tiptrace.tracer import make_tracer
from tiptrace.types import (
    Event,
    Image,
    Phase,
    PoseSample,
    Sample,
    SensedPair,
    Side,
    Stream,
    TipTrajectory,
    TruthSample,
)

_LEAST_EVENT_S = 0.1


def run_trial(task: TrialTask, methods: Sequence[str]) -> TrialRun:
    """Run a trial; its source is JSON of :func:`recording_source` or :func:`simulated_source`.

    Raises:
        TipTraceError: the trial cannot be read or simulated; the failure of a single method is in the result.
    """
    source = json.loads(task.source)
    stream, events = _open(source)
    task = described(task, stream.trial)
    samples = read_truth(Path(source["truth"])) if source.get("truth") else stream.truth()
    found = _Traced(stream)
    for method in methods:
        found.add(method)
    truth = Truth.from_samples(samples) if samples else None
    analytic = _analytic(found, truth, source["analytic"], task) if source.get("analytic") else None
    return TrialRun(found.trajectories, truth, analytic, found.failures, events, task)


def report_trial(task: TrialTask, methods: Sequence[str], folder: Path) -> Path | None:
    """Results and report of a single trial in a folder of its own.

    Raises:
        TipTraceError: the trial cannot be run.
    """
    stream, _ = _open(json.loads(task.source))
    result = reconstruct(stream, folder, methods[0], beside=methods[1:], title=task.name, source=task.name)
    return result.report


def simulated_source(spec: dict[str, Any], analytic: dict[str, Any] | None = None) -> str:
    """Source of a trial of the virtual rig, from the values of its spec."""
    return json.dumps({"spec": spec, "analytic": analytic}, sort_keys=True)


def recording_source(
    path: Path,
    truth: Path | None = None,
    analytic: dict[str, Any] | None = None,
    options: dict[str, str] | None = None,
) -> str:
    """Source of a recording; ``options`` are those of ``open_recording``, as text."""
    values = {
        "path": str(path),
        "truth": truth and str(truth),
        "analytic": analytic,
        "options": options or {},
    }
    return json.dumps(values, sort_keys=True)


def _open(source: dict[str, Any]) -> tuple[Trial, tuple[Event, ...] | None]:
    """The trial of a source, and what really happened in it, where that is known."""
    if "spec" in source:
        simulated = _Collected.simulate(source["spec"])
        return simulated, simulated.true_events
    plain = {"reference_frames", "stamps"}
    options: dict[str, Any] = {k: v if k in plain else Path(v) for k, v in source.get("options", {}).items()}
    return open_recording(Path(source["path"]), **options), None


def described(task: TrialTask, trial: dict[str, Any]) -> TrialTask:
    """The task with condition, level and seed where a recording's metadata name them."""
    parts = [trial.get(key) for key in ("trajectory", "tool", "wrist", "grasp")]
    condition = Condition(*map(str, parts)) if all(parts) else task.condition
    seed = trial.get("seed", task.seed)
    level = str(trial.get("level", task.level))
    return replace(task, condition=condition, level=level, seed=seed if isinstance(seed, int) else None)


@dataclass
class _Traced:
    """Trajectories of a stream, method by method. Baselines, which add no sensing, reuse the pairs of the first."""

    stream: Stream
    trajectories: dict[str, TipTrajectory] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    pairs: list[SensedPair] = field(default_factory=list)
    poses: list[PoseSample] = field(default_factory=list)

    def add(self, method: str) -> None:
        """Run a method; its failure is noted."""
        try:
            if method in BASELINES and self.pairs:
                self.trajectories[method] = replay(self.pairs, make_tracer(self.stream, method))
            else:
                self.trajectories[method] = self._trace(method)
        except TipTraceError as error:
            self.failures[method] = str(error)

    def _trace(self, method: str) -> TipTrajectory:
        watch = _Watch()
        with open_tracer(self.stream, method) as tracer:
            trajectory = trace(self.stream, tracer, watch)
        if not self.pairs:
            self.pairs, self.poses = watch.pairs, watch.poses
        return trajectory


@dataclass
class _Watch:
    """Keeps what was sensed, and the robot's poses."""

    pairs: list[SensedPair] = field(default_factory=list)
    poses: list[PoseSample] = field(default_factory=list)

    def show(self, step: Step) -> None:
        self.pairs.append(step.sensed)
        self.poses.extend(step.observation.poses)


@dataclass
class _Collected:
    """A simulated trial kept in memory, so that every method sees the same samples."""

    rig: Rig
    tool: Tool | None
    references: dict[Side, Image]
    gel_models: dict[str, bytes]
    trial: dict[str, Any]
    samples: list[Sample]
    true_events: tuple[Event, ...]
    notes: list[str] = field(default_factory=list)

    @classmethod
    def simulate(cls, values: dict[str, Any]) -> _Collected:
        frames: list[Frame] = []
        stream = SimulatedStream(make_spec(**values), frames.append)
        samples = list(stream)
        events = (*_runs(frames, "contact-lost"), *_runs(frames, "grasp-slip"))
        trial = stream.trial_metadata
        return cls(stream.rig, stream.tool, stream.references, stream.gel_models, trial, samples, events)

    def __iter__(self) -> Iterator[Sample]:
        return iter(self.samples)

    def truth(self) -> list[TruthSample]:
        return [s for s in self.samples if isinstance(s, TruthSample)]


def _runs(frames: Sequence[Frame], kind: str) -> Iterator[Event]:
    """Intervals of the reconstruction segment in which the tip is off the plate, or the tool creeps in the grasp."""
    late = [f.state for f in frames if f.state.phase is Phase.RECONSTRUCTION]
    flags = [not s.in_contact if kind == "contact-lost" else s.creeping for s in late]
    for flag, group in groupby(zip(flags, late, strict=True), key=lambda pair: pair[0]):
        states = [state for _, state in group]
        if flag and states[-1].t_s - states[0].t_s >= _LEAST_EVENT_S:
            start, end = (START_NS + round(s.t_s * 1e9) for s in (states[0], states[-1]))
            yield Event(kind, start, end, "true")


def _analytic(found: _Traced, truth: Truth | None, wanted: dict[str, Any], task: TrialTask) -> Truth | None:
    """The paper's ground truth: a named centreline from a measured start."""
    name = wanted["centreline"]
    if name == "auto":
        name = task.condition.trajectory if task.condition else "auto"
    if name not in CENTRELINES:
        raise ConfigError(f"unknown centreline '{name}'; valid: {', '.join(CENTRELINES)}")
    trajectory = next(iter(found.trajectories.values()), None)
    if trajectory is None or not found.poses:
        return None
    start = wanted.get("start_m")
    if start is None:
        start = initial_point(trajectory, truth)[1] if truth is not None else np.full(3, np.nan)
    if not np.isfinite(start).all():
        raise ConfigError("an analytic ground truth needs a measured start: give --start x,y,z in metres")
    end = max(e.stamp_ns for e in trajectory.estimates if e.phase is Phase.ANCHORING)
    yaw_rad = float(np.radians(wanted.get("yaw_deg", 0.0)))
    return Truth.from_samples(analytic_truth(CENTRELINES[name], start, found.poses, end, yaw_rad))
