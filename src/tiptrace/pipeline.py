"""The one loop, for recordings, simulation and hardware alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

from tiptrace.errors import PerceptionError, RecordingError
from tiptrace.streams.sync_report import SyncReport
from tiptrace.streams.synchronise import SyncSettings, synchronise
from tiptrace.tracer import DEFAULT_OPTIONS, TipTracer, TracerOptions, make_tracer
from tiptrace.types import (
    Observation,
    Phase,
    SensedFinger,
    SensedPair,
    Side,
    Stream,
    TipEstimate,
    TipTrajectory,
)

STEPS = ("acquire", "sense", "estimate")


@dataclass(frozen=True, slots=True)
class Step:
    """One turn of the loop, for whoever watches.

    Attributes:
        observation: The synchronised pair.
        sensed: Its markers.
        estimate: What was made of them.
        times_ms: (3,) acquire (or decode and pair), sense, estimate.
    """

    observation: Observation
    sensed: SensedPair
    estimate: TipEstimate
    times_ms: tuple[float, float, float]


class Viewer(Protocol):
    """Something that watches the loop; its time is not counted."""

    def show(self, step: Step) -> None:
        """See what was made of a pair."""
        ...


class NullViewer:
    """Watches nothing."""

    def show(self, step: Step) -> None:
        """Do nothing."""


BadPair = Callable[[Observation, PerceptionError], None]


def trace(
    stream: Stream,
    tracer: TipTracer,
    viewer: Viewer | None = None,
    report: SyncReport | None = None,
    settings: SyncSettings | None = None,
) -> TipTrajectory:
    """Run a tracer over a stream.

    Args:
        stream: Where samples come from.
        tracer: The method.
        viewer: Watches.
        report: Collects what synchronisation dropped and why.
        settings: Limits of synchronisation.

    Returns:
        An estimate for every pair, in order; ``loop_ms`` includes acquisition or decoding.

    Raises:
        RecordingError: no pair at all, or no anchoring frames.
    """
    viewer, report = viewer or NullViewer(), report or SyncReport()
    trajectory = TipTrajectory()
    for step in steps(stream, tracer, report, settings):
        trajectory.append(step.estimate)
        viewer.show(step)
    _finish(trajectory, tracer)
    trajectory.events = sorted([*trajectory.events, *report.gaps], key=lambda event: event.start_ns)
    return trajectory


def steps(
    stream: Stream,
    tracer: TipTracer,
    report: SyncReport | None = None,
    settings: SyncSettings | None = None,
    on_bad_pair: BadPair | None = None,
) -> Iterator[Step]:
    """The loop, turn by turn, in constant memory.

    Args:
        stream: Where samples come from.
        tracer: The method.
        report: Collects what synchronisation dropped and why.
        settings: Limits of synchronisation.
        on_bad_pair: Told of a pair whose images cannot be used, which is then left out; without it that ends the loop.

    Raises:
        PerceptionError: images that cannot be used, and nobody to tell.
    """
    for observation, acquired_ms in _timed(synchronise(stream, settings, report)):
        start = time.perf_counter()
        try:
            sensed = tracer.sensing(observation)
        except PerceptionError as error:
            if on_bad_pair is None:
                raise
            on_bad_pair(observation, error)
            continue
        middle = time.perf_counter()
        estimate = tracer.estimate(sensed)
        end = time.perf_counter()
        times_ms = (acquired_ms, (middle - start) * 1e3, (end - middle) * 1e3)
        yield Step(observation, sensed, replace(estimate, loop_ms=sum(times_ms)), times_ms)


def replay(pairs: Iterable[SensedPair], tracer: TipTracer) -> TipTrajectory:
    """Run another estimator over markers already sensed, without ``loop_ms``."""
    trajectory = TipTrajectory([tracer.estimator.update(pair) for pair in pairs])
    return _finish(trajectory, tracer)


@contextmanager
def open_tracer(stream: Stream, method: str, options: TracerOptions = DEFAULT_OPTIONS) -> Iterator[TipTracer]:
    """A tracer with one thread per finger; OpenCV, which would share out each small call, keeps to these meanwhile.

    Raises:
        ConfigError: an unknown method; the valid ones are listed.
    """
    from concurrent.futures import ThreadPoolExecutor, wait

    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="finger") as pool:

            def both(sense: Callable[[Side], SensedFinger], sides: Iterable[Side]) -> list[SensedFinger]:
                """The first side here, the other beside it."""
                here, beside = sides
                other = pool.submit(sense, beside)
                try:
                    return [sense(here), other.result()]
                finally:
                    wait([other])

            yield make_tracer(stream, method, both=both, options=options)
    finally:
        cv2.setNumThreads(threads)


def _timed(observations: Iterator[Observation]) -> Iterator[tuple[Observation, float]]:
    """Each observation with the time that it took to come, ms."""
    while True:
        start = time.perf_counter()
        try:
            observation = next(observations)
        except StopIteration:
            return
        yield observation, (time.perf_counter() - start) * 1e3


def _finish(trajectory: TipTrajectory, tracer: TipTracer) -> TipTrajectory:
    """Anchor and events; refuse what would otherwise end as an empty table without a word."""
    trajectory.anchor = tracer.anchor
    trajectory.events = list(tracer.events)
    if not trajectory.estimates:
        raise RecordingError(
            "no pair of left and right images with an end-effector pose: the streams do not overlap in time, or "
            "one of them is empty; `tiptrace inspect` shows their intervals"
        )
    if any(estimate.p_B is not None for estimate in trajectory.estimates):
        return trajectory
    phases = {estimate.phase for estimate in trajectory.estimates}
    if phases == {None}:
        raise RecordingError(
            "no phase marks: this method needs to be told where anchoring ends; publish 'anchoring' and "
            "'reconstruction' on /trial/phase"
        )
    if Phase.ANCHORING not in phases:
        raise RecordingError("no anchoring frames: no image pair falls into the phase 'anchoring'")
    return trajectory
