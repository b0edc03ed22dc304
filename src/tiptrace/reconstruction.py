"""From one recording to its results folder: trajectories, metrics and the report."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import tiptrace
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.paper import PaperEstimator
from tiptrace.estimation.smoothing import Recorded, smooth
from tiptrace.evaluation.metrics import TrialMetrics, evaluate
from tiptrace.evaluation.quality import Quality, assess
from tiptrace.evaluation.report_data import AnchoringFit, MethodResult, ReportData, TactileView
from tiptrace.evaluation.trial_report import write_trial_report
from tiptrace.evaluation.truth import Truth
from tiptrace.frames import FrameWatch, write_frames
from tiptrace.grasp_file import GRASP, write_grasp
from tiptrace.outputs import write_results
from tiptrace.pipeline import STEPS, Step, open_tracer, replay, trace
from tiptrace.streams.sync_report import SyncReport
from tiptrace.tracer import TipTracer, TracerOptions, make_tracer, sensing_of
from tiptrace.types import (
    SIDES,
    FloatArray,
    ImageSample,
    Phase,
    SensedPair,
    Side,
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
    traced = _trace(stream, method, using, threads, _Watch(on_pair, bool(beside), report, on_step))
    watch, trajectory = traced.watch, traced.trajectory
    others = (MethodResult(m, _beside(stream, m, method, watch.pairs, truth, using)) for m in beside)
    methods = (MethodResult(method, trajectory), *others)
    notes = (*stream.notes, *traced.notes)
    metrics, quality = evaluate(trajectory, truth), _with_notes(assess(trajectory), notes)
    write_results(out, trajectory, method, metrics, quality, using.as_text())
    write_frames(out, watch.frames.stamps)
    _keep_grasp(out, traced, stream)
    page = None
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
    watch: _Watch
    notes: tuple[str, ...]


def _trace(stream: Trial, method: str, using: Using, threads: bool, watch: _Watch) -> _Traced:
    """Trace a stream; where there turns out to be no Stage I at all, once more for displacements."""
    traced = _trace_once(stream, method, using.options(stream), using.smooth, threads, watch)
    anchored = using.tip or using.anchor_from or using.relative
    if method != "full" or anchored or watch.marked or _full(traced.tracer).anchoring is not None:
        return traced
    options = TracerOptions(depth=using.sensed_depth, use_stage_one=False, relative=True)
    watch = _Watch(watch.on_pair, watch.keep_pairs, watch.keep_images, watch.on_step)
    again = _trace_once(stream, method, options, using.smooth, threads, watch)
    note = (
        "no phase marks and no anchoring motion: positions are displacements from the first contact; --tip or "
        "--anchor-from would tell where it is"
    )
    return replace(again, notes=(*again.notes, note))


def _trace_once(
    stream: Trial, method: str, options: TracerOptions, smoothed: bool, threads: bool, watch: _Watch
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


@dataclass
class _Watch:
    """Keeps what the report shows: step times, first and last pair, Stage I motions."""

    on_pair: Callable[[int], None] | None
    keep_pairs: bool
    keep_images: bool
    on_step: Callable[[Step], None] | None = None
    tracer: TipTracer | None = None
    times_ms: list[tuple[float, float, float]] = field(default_factory=list)
    pairs: list[SensedPair] = field(default_factory=list)
    frames: FrameWatch = field(default_factory=FrameWatch)
    marked: bool = False
    _first: tuple[Step, dict[Side, FloatArray | None]] | None = None
    _last: Step | None = None
    _motions: list[tuple[int, FloatArray, FloatArray]] = field(default_factory=list)

    def show(self, step: Step) -> None:
        """Keep what the report needs of a pair."""
        self.times_ms.append(step.times_ms)
        self.frames.show(step)
        self.marked |= step.observation.phase is not None
        if self.keep_pairs:
            self.pairs.append(step.sensed)
        if self._first is None and step.estimate.markers:
            self._first = (step, {side: self._depth_mm(side) for side in SIDES})
        self._last = step
        self._keep_motion(step)
        if self.on_pair is not None:
            self.on_pair(len(self.times_ms))
        if self.on_step is not None:
            self.on_step(step)

    def _keep_motion(self, step: Step) -> None:
        assert self.tracer is not None
        estimator = self.tracer.estimator
        if isinstance(estimator, PaperEstimator) and step.estimate.phase is Phase.ANCHORING:
            motion = estimator.motion
            if motion is not None:
                self._motions.append((step.estimate.stamp_ns, motion.R, motion.d))

    def _depth_mm(self, side: Side) -> FloatArray | None:
        assert self.tracer is not None
        finger = self.tracer.sensing.fingers.get(side)
        if not self.keep_images or finger is None or finger.depth_m is None:
            return None
        return finger.depth_m.astype(np.float64) * 1e3

    def tactile(self) -> tuple[TactileView, ...]:
        """Both fingers at the first and last pair; empty for streams without images."""
        if self._first is None or self._last is None:
            return ()
        first, depth_first = self._first
        views = []
        for side in SIDES:
            start, end = first.observation.finger(side).sample, self._last.observation.finger(side).sample
            if not isinstance(start, ImageSample) or not isinstance(end, ImageSample):
                return ()
            uv_first = first.sensed.finger(side).markers.uv_px
            views.append(
                TactileView(
                    side=side,
                    first_image=start.image,
                    last_image=end.image,
                    uv_first_px=uv_first,
                    uv_last_px=self._last.sensed.finger(side).markers.uv_px,
                    selected=self._selected(side, 0 if uv_first is None else len(uv_first)),
                    depth_first_mm=depth_first[side],
                    depth_last_mm=self._depth_mm(side),
                )
            )
        return tuple(views)

    def _selected(self, side: Side, count: int) -> np.ndarray[Any, np.dtype[np.bool_]] | None:
        assert self.tracer is not None
        chosen = (
            self.tracer.estimator.chosen.get(side)
            if isinstance(self.tracer.estimator, PaperEstimator)
            else None
        )
        return None if chosen is None else np.isin(np.arange(count), chosen)

    def anchoring(self) -> AnchoringFit | None:
        """Residuals of Stage I with the final anchor."""
        anchor = self.tracer.anchor if self.tracer else None
        if anchor is None or not self._motions:
            return None
        stamps, R, d = (np.asarray(values) for values in zip(*self._motions, strict=True))
        rows = anchor.p_B - R @ anchor.p_B - d  # (n, 3) (I − R_t) p̂ − d_t
        return AnchoringFit(stamps.astype(np.int64), np.linalg.norm(rows, axis=1) * 1e3)
