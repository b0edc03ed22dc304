"""Runs one trial with several methods: a recording, or a trial of the virtual rig. Workers call this by name."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.config import Rig, Tool
from tiptrace.errors import ConfigError, MissingExtraError, TipTraceError
from tiptrace.evaluation.analytic import CENTRELINES, analytic_truth
from tiptrace.evaluation.conditions import Condition
from tiptrace.evaluation.error_series import initial_point
from tiptrace.evaluation.runner import TrialRun, TrialTask
from tiptrace.evaluation.suite_values import BASELINES
from tiptrace.evaluation.truth import Truth
from tiptrace.evaluation.truth_files import read_truth
from tiptrace.pipeline import Step, replay, trace
from tiptrace.reconstruction import Trial, reconstruct
from tiptrace.sim.simulation import Frame
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.sources import open_recording
from tiptrace.streams.sync_report import SyncReport
from tiptrace.streams.true_events import TrueEvents, from_frames, from_table, truth_table_of
from tiptrace.tracer import TruthAt, make_tracer, sensing_of
from tiptrace.types import (
    SIDES,
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


def run_trial(task: TrialTask, methods: Sequence[str]) -> TrialRun:
    """Run a trial; its source is JSON of :func:`recording_source` or :func:`simulated_source`.

    Raises:
        TipTraceError: the trial cannot be read or simulated; the failure of a single method is in the result.
    """
    source = json.loads(task.source)
    stream, real = _open(source)
    task = described(task, stream.trial)
    samples = read_truth(Path(source["truth"])) if source.get("truth") else stream.truth()
    truth = Truth.from_samples(samples) if samples else None
    found = _Traced(stream, truth)
    found.run(methods)
    analytic = _analytic(found, truth, source["analytic"], task) if source.get("analytic") else None
    events, slight = (None, ()) if real is None else (real.events, real.slight)
    return TrialRun(found.trajectories, truth, analytic, found.failures, events, slight, task)


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


def inputs_of(task: TrialTask) -> tuple[Path, ...]:
    """Files that a trial comes from; none of a simulated one."""
    source = json.loads(task.source)
    if "spec" in source:
        return ()
    path = Path(source["path"])
    truth = (Path(source["truth"]),) if source.get("truth") else ()
    return (path, truth_table_of(path), *truth)


def _open(source: dict[str, Any]) -> tuple[Trial, TrueEvents | None]:
    """The trial of a source, and what really happened in it, where that is known."""
    if "spec" in source:
        simulated = _Collected.simulate(source["spec"])
        return simulated, simulated.true_events
    plain = {"reference_frames", "stamps"}
    options: dict[str, Any] = {k: v if k in plain else Path(v) for k, v in source.get("options", {}).items()}
    path = Path(source["path"])
    return open_recording(path, **options), _recorded_events(truth_table_of(path))


def _recorded_events(table: Path) -> TrueEvents | None:
    """From the truth that a simulated recording has beside it, where there is one and it can be read."""
    try:
        return from_table(table) if table.is_file() else None
    except MissingExtraError:
        return None


def described(task: TrialTask, trial: dict[str, Any]) -> TrialTask:
    """The task with condition, level and seed where a recording's metadata name them."""
    parts = [trial.get(key) for key in ("trajectory", "tool", "wrist", "grasp")]
    condition = Condition(*map(str, parts)) if all(parts) else task.condition
    seed = trial.get("seed", task.seed)
    level = str(trial.get("level", task.level))
    return replace(task, condition=condition, level=level, seed=seed if isinstance(seed, int) else None)


@dataclass
class _Traced:
    """Trajectories of a stream, method by method.

    Images are sensed once for each chain: what runs on the same one, as all baselines do, reuses its pairs.
    """

    stream: Stream
    truth: Truth | None = None
    trajectories: dict[str, TipTrajectory] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    _sensed: dict[str, _Sensed] = field(default_factory=dict)  # by chain

    @property
    def poses(self) -> list[PoseSample]:
        """The robot's poses, in order."""
        chains = list(self._sensed.values())
        return [pose for pair in chains[0].pairs for pose in pair.poses] if chains else []

    def run(self, methods: Sequence[str]) -> None:
        """Run methods, those with a loop rate of their own first; the failure of one is noted."""
        for method in sorted(methods, key=lambda m: m in BASELINES):
            try:
                self.trajectories[method] = self._trajectory(method)
            except TipTraceError as error:
                self.failures[method] = str(error)
        self.trajectories = {m: self.trajectories[m] for m in methods if m in self.trajectories}

    def _trajectory(self, method: str) -> TipTrajectory:
        chain = sensing_of(method)
        sensed = self._sensed.get(chain)
        if sensed is not None:
            tracer = make_tracer(self.stream, method, truth_at=self._truth_at())
            trajectory = replay(sensed.pairs, tracer)
            trajectory.events = sorted([*trajectory.events, *sensed.gaps], key=lambda e: e.start_ns)
            return trajectory
        ending, watch, report = _Ending(self.stream), _Sensed(), SyncReport()
        try:
            with ThreadPoolExecutor(len(SIDES), "finger") as pool:
                tracer = make_tracer(self.stream, method, pool.map, self._truth_at())
                return trace(ending, tracer, watch, report)
        finally:
            if ending.reached:  # also where the method refused the trial after all pairs
                watch.gaps = list(report.gaps)
                self._sensed[chain] = watch

    def _truth_at(self) -> TruthAt | None:
        truth = self.truth
        return None if truth is None else lambda stamp_ns: truth.nearest(stamp_ns)[0]


@dataclass
class _Sensed:
    """What a chain sensed; a viewer of the loop."""

    pairs: list[SensedPair] = field(default_factory=list)
    gaps: list[Event] = field(default_factory=list)

    def show(self, step: Step) -> None:
        self.pairs.append(step.sensed)


@dataclass
class _Ending:
    """A stream that knows whether it was read to its end."""

    stream: Stream
    reached: bool = False

    @property
    def rig(self) -> Rig:
        return self.stream.rig

    @property
    def tool(self) -> Tool | None:
        return self.stream.tool

    @property
    def references(self) -> dict[Side, Image]:
        return self.stream.references

    @property
    def gel_models(self) -> dict[str, bytes]:
        return self.stream.gel_models

    def __iter__(self) -> Iterator[Sample]:
        yield from self.stream
        self.reached = True


@dataclass
class _Collected:
    """A simulated trial kept in memory, so that every method sees the same samples."""

    rig: Rig
    tool: Tool | None
    references: dict[Side, Image]
    gel_models: dict[str, bytes]
    trial: dict[str, Any]
    samples: list[Sample]
    true_events: TrueEvents
    notes: list[str] = field(default_factory=list)

    @classmethod
    def simulate(cls, values: dict[str, Any]) -> _Collected:
        frames: list[Frame] = []
        stream = SimulatedStream(make_spec(**values), frames.append)
        samples = list(stream)
        trial, real = stream.trial_metadata, from_frames(frames)
        return cls(stream.rig, stream.tool, stream.references, stream.gel_models, trial, samples, real)

    def __iter__(self) -> Iterator[Sample]:
        return iter(self.samples)

    def truth(self) -> list[TruthSample]:
        return [s for s in self.samples if isinstance(s, TruthSample)]


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
        if truth is None:
            raise ConfigError("an analytic ground truth needs a measured start: give --start x,y,z in metres")
        starts = (
            initial_point(t, truth)[1] for t in found.trajectories.values()
        )  # a refused method has none
        start = next((s for s in starts if np.isfinite(s).all()), None)
        if start is None:
            return None
    end = max(e.stamp_ns for e in trajectory.estimates if e.phase is Phase.ANCHORING)
    yaw_rad = float(np.radians(wanted.get("yaw_deg", 0.0)))
    return Truth.from_samples(analytic_truth(CENTRELINES[name], start, found.poses, end, yaw_rad))
