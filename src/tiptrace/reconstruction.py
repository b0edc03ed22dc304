"""From one recording to its results folder: trajectories, metrics and the report."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import tiptrace
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.smoothing import Recorded, smooth
from tiptrace.evaluation.metrics import TrialMetrics, evaluate
from tiptrace.evaluation.quality import Quality, assess
from tiptrace.evaluation.report_data import MethodResult, ReportData
from tiptrace.evaluation.trial_report import REPORT, write_trial_report
from tiptrace.evaluation.truth import Truth
from tiptrace.frames import write_frames
from tiptrace.grasp_file import GRASP, write_grasp
from tiptrace.outputs import write_results
from tiptrace.pipeline import STEPS, Step, open_tracer, replay, trace
from tiptrace.streams.sync_report import SyncReport
from tiptrace.tracer import TipTracer, TracerOptions, make_tracer, sensing_of
from tiptrace.trial_watch import TrialWatch
from tiptrace.types import (
    SensedPair,
    Stream,
    TipTrajectory,
    TruthSample,
)
from tiptrace.using import Using


class Trial(Stream, Protocol):
    """A stream with what only evaluation and reports may see."""

    @property
    def trial(self) -> dict[str, Any]:
        """Free metadata."""
        ...

    @property
    def notes(self) -> list[str]:
        """How far the recording could be used."""
        ...

    def truth(self) -> list[TruthSample]:
        """The true tip, empty where nobody knows it."""
        ...


@dataclass(frozen=True, slots=True)
class Reconstruction:
    """What came out of a recording.

    Attributes:
        methods: Results, the asked one first.
        metrics: Of the asked method.
        quality: Of the asked method, judged without ground truth.
        truth: True tip, where the recording has it.
        report: The page; None where none was asked for.
        notes: Sentences that the user should read.
    """

    methods: tuple[MethodResult, ...]
    metrics: TrialMetrics
    quality: Quality
    truth: Truth | None
    report: Path | None
    notes: tuple[str, ...]


def reconstruct(
    stream: Trial,
    out: Path,
    method: str,
    *,
    beside: Sequence[str] = (),
    report: bool = True,
    title: str = "Trial",
    command: str = "",
    source: str = "",
    on_pair: Callable[[int], None] | None = None,
    on_step: Callable[[Step], None] | None = None,
    threads: bool = True,
    using: Using | None = None,
) -> Reconstruction:
    """Trace a stream and write the outputs of ``docs/data.md`` into a folder.

    Args:
        stream: Recording or simulation.
        out: Results folder.
        method: Which method the files hold.
        beside: Further methods for the table and the pictures.
        report: Whether to draw ``report.html``.
        title: Heading of the report.
        command: Command that reproduces it.
        source: File that it came from.
        on_pair: Called with the number of pairs done.
        on_step: Called with each turn of the loop.
        threads: One thread per finger; without them all runs in the caller's.
        using: What stands in for Stage I or the gel network, and whether to smooth.

    Raises:
        TipTraceError: the recording cannot give a trajectory; the message says why.
    """
    using = using or Using()
    using.check(method, tuple(beside))
    samples = stream.truth()
    truth = Truth.from_samples(samples) if samples else None
    traced = _trace(stream, method, using, threads, TrialWatch(on_pair, bool(beside), report, on_step))
    watch, trajectory = traced.watch, traced.trajectory
    others = (MethodResult(m, _beside(stream, m, method, watch.pairs, truth, using)) for m in beside)
    methods = (MethodResult(method, trajectory), *others)
    notes = (*stream.notes, *traced.notes)
    metrics, quality = evaluate(trajectory, truth), _with_notes(assess(trajectory), notes)
    write_results(out, trajectory, method, metrics, quality, using.as_text())
    write_frames(out, watch.frames.stamps)
    _keep_grasp(out, traced, stream)
    page = None
    (out / REPORT).unlink(missing_ok=True)  # of another run
    if report:
        data = ReportData(
            title=title,
            methods=methods,
            truth=truth,
            tactile=watch.tactile(),
            anchoring=watch.anchoring(),
            step_ms=dict(zip(STEPS, np.asarray(watch.times_ms).T, strict=True)),
            settings={
                "method": method,
                **using.as_text(),
                **{k: str(v) for k, v in stream.trial.items() if not isinstance(v, dict | list)},
            },
            versions=_versions(),
            command=command,
            source=source,
            notes=notes,
        )
        page = write_trial_report(out, data)
    return Reconstruction(methods, metrics, quality, truth, page, notes)


@dataclass(frozen=True, slots=True)
class _Traced:
    """A trajectory, who made it, and what the user should know."""

    trajectory: TipTrajectory
    tracer: TipTracer
    watch: TrialWatch
    notes: tuple[str, ...]


def _trace(stream: Trial, method: str, using: Using, threads: bool, watch: TrialWatch) -> _Traced:
    """Trace a stream; where there turns out to be no Stage I at all, once more for displacements."""
    traced = _trace_once(stream, method, using.options(stream), using.smooth, threads, watch)
    anchored = using.tip or using.anchor_from or using.relative
    if method != "full" or anchored or watch.marked or _full(traced.tracer).anchoring is not None:
        return traced
    options = TracerOptions(depth=using.sensed_depth, use_stage_one=False, relative=True)
    watch = TrialWatch(watch.on_pair, watch.keep_pairs, watch.keep_images, watch.on_step)
    again = _trace_once(stream, method, options, using.smooth, threads, watch)
    note = (
        "no phase marks and no anchoring motion: positions are displacements from the first contact; --tip or "
        "--anchor-from would tell where it is"
    )
    return replace(again, notes=(*again.notes, note))


def _trace_once(
    stream: Trial, method: str, options: TracerOptions, smoothed: bool, threads: bool, watch: TrialWatch
) -> _Traced:
    sync = SyncReport()
    opened = (
        open_tracer(stream, method, options)
        if threads
        else nullcontext(make_tracer(stream, method, options=options))
    )
    with opened as tracer:
        watch.tracer = tracer
        recorded = None
        if smoothed and isinstance(tracer.estimator, FullEstimator):
            recorded = tracer.estimator = Recorded(tracer.estimator)
        trajectory = trace(stream, tracer, watch, sync)
    if recorded is not None:
        trajectory.estimates = smooth(recorded, trajectory.estimates)
    return _Traced(trajectory, tracer, watch, tuple(sync.sentences()))


def _keep_grasp(out: Path, traced: _Traced, stream: Stream) -> None:
    """What another trial with the same grasp may take over; none where Stage I was not solved."""
    (out / GRASP).unlink(missing_ok=True)
    if not isinstance(traced.tracer.estimator, FullEstimator | Recorded):
        return
    full = _full(traced.tracer)
    if full.anchoring is not None and full.anchor is not None and full.anchoring.tip_map.frames > 0:
        write_grasp(out, full.anchoring, stream.tool)


def _full(tracer: TipTracer) -> FullEstimator:
    estimator = tracer.estimator
    full = estimator.full if isinstance(estimator, Recorded) else estimator
    assert isinstance(full, FullEstimator)
    return full


def _beside(
    stream: Stream,
    method: str,
    main: str,
    pairs: Sequence[SensedPair],
    truth: Truth | None,
    using: Using,
) -> TipTrajectory:
    """A further method: over the markers already sensed where it runs on the same chain."""
    truth_at = None if truth is None else lambda stamp_ns: truth.at([stamp_ns])[0]
    options = TracerOptions(depth=using.sensed_depth)
    if sensing_of(method) == sensing_of(main):
        return replay(pairs, make_tracer(stream, method, truth_at=truth_at, options=options))
    with open_tracer(stream, method, options) as tracer:
        return trace(stream, tracer)


def _with_notes(quality: Quality, notes: Sequence[str]) -> Quality:
    """What was not used of a recording makes its trace at least doubtful."""
    if not notes:
        return quality
    verdict = "warn" if quality.verdict == "pass" else quality.verdict
    return Quality(verdict, (*quality.reasons, *notes))


def _versions() -> dict[str, str]:
    libraries = ("numpy", "scipy", "opencv-python-headless", "onnxruntime")
    return {
        "tiptrace": tiptrace.__version__,
        "python": platform.python_version(),
        **{name: version(name) for name in libraries},
    }
