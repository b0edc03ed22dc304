"""The one loop, for recordings, simulation and hardware alike."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Protocol

from tiptrace.errors import RecordingError
from tiptrace.streams.sync_report import SyncReport
from tiptrace.streams.synchronise import synchronise
from tiptrace.tracer import TipTracer, make_tracer
from tiptrace.types import Observation, Phase, Stream, TipEstimate, TipTrajectory


class Viewer(Protocol):
    """Something that watches the loop."""

    def show(self, observation: Observation, estimate: TipEstimate) -> None:
        """See a pair and what was made of it."""
        ...


class NullViewer:
    """Watches nothing."""

    def show(self, observation: Observation, estimate: TipEstimate) -> None:
        """Do nothing."""


def trace(
    stream: Stream, tracer: TipTracer, viewer: Viewer | None = None, report: SyncReport | None = None
) -> TipTrajectory:
    """Run a tracer over a stream.

    Args:
        stream: Where samples come from.
        tracer: The method.
        viewer: Watches; its time is not counted.
        report: Collects what synchronisation dropped and why.

    Returns:
        An estimate for every pair, in order; ``loop_ms`` includes acquisition or decoding.

    Raises:
        RecordingError: no pair at all, or no phase marks.
    """
    viewer = viewer or NullViewer()
    trajectory = TipTrajectory()
    start = time.perf_counter()
    for observation in synchronise(stream, report=report):
        estimate = tracer.update(observation)
        estimate = replace(estimate, loop_ms=(time.perf_counter() - start) * 1e3)
        trajectory.append(estimate)
        viewer.show(observation, estimate)
        start = time.perf_counter()
    trajectory.anchor = tracer.anchor
    trajectory.events = list(tracer.events)
    _check(trajectory)
    return trajectory


def trace_method(
    stream: Stream, method: str, viewer: Viewer | None = None, report: SyncReport | None = None
) -> tuple[TipTrajectory, TipTracer]:
    """Run a method over a stream with one thread per finger; also returns the tracer with its last state."""
    with ThreadPoolExecutor(max_workers=2, thread_name_prefix="finger") as pool:
        tracer = make_tracer(stream, method, both=pool.map)
        return trace(stream, tracer, viewer, report), tracer


def _check(trajectory: TipTrajectory) -> None:
    """Refuse what would otherwise end as an empty table without a word."""
    if not trajectory.estimates:
        raise RecordingError(
            "no pair of left and right images with an end-effector pose: the streams do not overlap in time, or "
            "one of them is empty; `tiptrace inspect` shows their intervals"
        )
    phases = {estimate.phase for estimate in trajectory.estimates}
    if phases == {None}:
        raise RecordingError(
            "no phase marks: this method needs to be told where anchoring ends; publish 'anchoring' and "
            "'reconstruction' on /trial/phase"
        )
    if Phase.ANCHORING not in phases:
        raise RecordingError("no anchoring frames: no image pair falls into the phase 'anchoring'")
