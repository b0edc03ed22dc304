"""The live loop: the same as offline, with a recorder, phases, and snapshots for whoever watches."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np

from tiptrace.drivers.base import DeviceHealth, DeviceStatus
from tiptrace.errors import PerceptionError
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.warm_up import warm_up as warm_up_estimation
from tiptrace.live.monitor import StageOneMonitor, StageOneView
from tiptrace.live.phases import PhaseMarker
from tiptrace.live.recorder import Recorder
from tiptrace.live.source_watch import SourceWatch
from tiptrace.live.summary import LiveSummary, Tally
from tiptrace.live.views import Views
from tiptrace.perception.warm_up import warm_up as warm_up_sensing
from tiptrace.pipeline import Step, open_tracer, steps
from tiptrace.snapshot import Snapshot
from tiptrace.streams.live import LiveStream
from tiptrace.streams.sync_report import SyncReport
from tiptrace.tracer import TipTracer
from tiptrace.types import (
    SIDES,
    Event,
    FingerObservation,
    ImageSample,
    Observation,
    Phase,
    Status,
    TipEstimate,
)

_LAST_EVENTS = 50
_SILENT_S = 0.3  # without a pair; then a snapshot says so

Subscriber = Callable[[Snapshot], None]


class LiveSession:
    """Runs the loop in the caller's thread; everything else may be called from any.

    Args:
        stream: Opened by :meth:`run`.
        method: As offline.
        recorder: Writes everything that the loop sees.
        wait_for_mark: Begin with the first phase mark; else at once, and the first mark ends Stage I.
    """

    def __init__(
        self,
        stream: LiveStream,
        method: str = "full",
        *,
        recorder: Recorder | None = None,
        wait_for_mark: bool = False,
    ) -> None:
        warm_up_sensing()  # what is slow the first time is over before the devices open
        warm_up_estimation()
        self.stream, self.method, self.recorder = stream, method, recorder
        self.phases = PhaseMarker(self._emit_phase, waiting=wait_for_mark)
        self.report = SyncReport()
        self.snapshot: Snapshot | None = None
        self.stage_one: StageOneView | None = None
        self.tracer: TipTracer | None = None
        stream.standby = wait_for_mark
        stream.on_idle, stream.on_phase = self._idle, self.phases.mark
        if recorder is not None:
            stream.tap = recorder
        self._subscribers: list[Subscriber] = []
        self._views, self._tally = Views(), Tally()
        self._watch = SourceWatch(None)
        self._bad: list[str] = []
        self._shown = 0.0
        self._deadline: float | None = None
        self.on_open: Callable[[], None] | None = None

    # --- from any thread -----------------------------------------------------------------------------------

    def subscribe(self, subscriber: Subscriber) -> Callable[[], None]:
        """Call ``subscriber`` with every snapshot, from the loop's thread: it must return at once.

        One that raises is left out from then on.

        Returns:
            Ends the subscription.
        """
        self._subscribers.append(subscriber)

        def unsubscribe() -> None:
            if subscriber in self._subscribers:
                self._subscribers.remove(subscriber)

        return unsubscribe

    def advance(self) -> Phase | None:
        """Mark the next phase, as the space key does; the one marked."""
        return self.phases.advance()

    def mark(self, phase: Phase) -> None:
        """Mark a phase.

        Raises:
            ConfigError: not in order.
        """
        self.phases.mark(phase)

    def stop(self) -> None:
        """End the session."""
        self.stream.stop()

    # --- the loop ------------------------------------------------------------------------------------------

    def run(self, duration_s: float | None = None, *, opened: bool = False) -> LiveSummary:
        """Open the devices, run until stopped, and close everything.

        Args:
            duration_s: End by itself after so long.
            opened: The stream has been entered already, and is left open.

        Raises:
            TipTraceError: a device that is missing or changes its meaning, a reference that cannot be used, phases in a
                wrong order. What was recorded is kept.
        """
        with ExitStack() as stack:
            if not opened:
                stack.enter_context(self.stream)
            _rehearse(self.stream, self.method)
            self.stream.forget()
            if self.recorder is not None:
                stack.enter_context(self.recorder)
            tracer = stack.enter_context(open_tracer(self.stream, self.method))
            if self.stream.first_images:
                tracer.sensing.prepare()
                self.stream.forget()
            stack.enter_context(_no_sweeps())
            if not self.stream.standby:
                self.stream.begin()
            self.tracer, monitor = tracer, StageOneMonitor(tracer)
            self._watch = SourceWatch(self.stream.period_s)
            if self.on_open is not None:
                self.on_open()
            self._deadline = None if duration_s is None else time.monotonic() + duration_s
            for step in steps(self.stream, tracer, self.report, self.stream.settings, self._bad_pair):
                self.stage_one = monitor.update(step.estimate)
                self._show(step)
                self._use_pause(tracer)
        return self.summary()

    def _use_pause(self, tracer: TipTracer) -> None:
        """Until the next images come: what no estimate waits for, and would only hold up."""
        if self.recorder is not None:
            self.recorder.nudge()
        if isinstance(tracer.estimator, FullEstimator):
            tracer.estimator.use_pause()

    def summary(self) -> LiveSummary:
        """The session so far."""
        return LiveSummary(
            pairs=self._tally.pairs,
            seconds=self._tally.seconds,
            bad_pairs=self._tally.bad_pairs,
            latency_ms=self._tally.latency_ms,
            anchor=None if self.tracer is None else self.tracer.anchor,
            events=self._events(),
            sentences=tuple(self.report.sentences()),
            devices=self.stream.health(),
            recorder=None if self.recorder is None else self.recorder.state(),
        )

    def _emit_phase(self, phase: Phase) -> None:
        self.stream.mark(phase)
        if phase is Phase.END:
            self.stream.stop()

    def _show(self, step: Step) -> None:
        done_ns = self.stream.timeline.now_ns()
        arrivals = {
            side: self.stream.arrival(side, step.observation.finger(side).sample.stamp_ns) for side in SIDES
        }
        known = [arrival.arrived_ns for arrival in arrivals.values() if arrival is not None]
        latency_ms = (done_ns - max(known)) * 1e-6 if known else None
        self._tally.add(step.observation.stamp_ns, latency_ms)
        health = self.stream.health()
        marked = self._watch.mark(step.observation, step.estimate, arrivals, health["robot"])
        self._bad.clear()
        self._shown = time.monotonic()
        advice = "" if self.stage_one is None else self.stage_one.sentence
        notes, events = self._notes(health), self._events()[-_LAST_EVENTS:]
        self._publish(self._views.snapshot(replace(step, estimate=marked), latency_ms, events, advice, notes))

    def _bad_pair(self, observation: Observation, error: PerceptionError) -> None:
        """A pair whose images cannot be used: told, and no position claimed."""
        self._tally.bad_pairs += 1
        self._bad = [str(error)]
        self._publish_nothing(observation.stamp_ns, observation.phase)

    def _idle(self) -> None:
        """Several times a second: the deadline, and word that nothing comes."""
        if self._deadline is not None and time.monotonic() > self._deadline:
            self.stop()
        if time.monotonic() - self._shown > _SILENT_S:
            self._shown = time.monotonic()
            self._publish_nothing(self.stream.timeline.now_ns(), self.phases.phase)

    def _publish_nothing(self, stamp_ns: int, phase: Phase | None) -> None:
        last = self.snapshot
        notes = self._notes(self.stream.health()) or (
            ("waiting for the first mark",) if self.stream.standby else ()
        )
        estimate = TipEstimate(stamp_ns, phase, Status.LOST)
        events = () if last is None else last.events
        self._publish(Snapshot(estimate, rate_hz=0.0, events=events, notes=notes))

    def _publish(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot
        for subscriber in list(self._subscribers):
            try:
                subscriber(snapshot)
            except Exception:  # noqa: BLE001  a viewer must not end a trial
                self._subscribers.remove(subscriber)

    def _events(self) -> tuple[Event, ...]:
        told = [] if self.tracer is None else self.tracer.events
        return tuple(
            sorted([*told, *self.report.gaps, *self._watch.events], key=lambda event: event.start_ns)
        )

    def _notes(self, found: Mapping[str, DeviceHealth]) -> tuple[str, ...]:
        """What is wrong at this moment."""
        devices = [health for health in found.values() if health.status is not DeviceStatus.OK]
        notes = [
            *self._bad,
            *(health.detail or f"{health.name}: {health.status.value}" for health in devices),
        ]
        if self.recorder is not None:
            state = self.recorder.state()
            if state.error:
                notes.append(state.error)
            elif state.dropped:
                notes.append(
                    f"the disk does not keep up: {state.dropped} samples are missing in the recording"
                )
        return tuple(notes)


@contextmanager
def _no_sweeps() -> Iterator[None]:
    """Everything that is there already is never looked at by the garbage collector: a sweep takes many frames' time."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _rehearse(stream: LiveStream, method: str) -> None:
    """Sense the first images once and forget it: what is slow the first time is over when the trial begins.

    Raises:
        PerceptionError: the images or references cannot be used.
    """
    if len(stream.first_images) < 2:
        return
    left, right = (
        FingerObservation(ImageSample(side, 0, stream.first_images[side]), np.eye(4)) for side in SIDES
    )
    with open_tracer(stream, method) as tracer:
        for _ in range(2):
            tracer.sensing(Observation(0, left, right))
