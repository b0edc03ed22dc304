"""The live loop: the same as offline, with a recorder, phases, and snapshots for whoever watches."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np

from tiptrace.drivers.base import DeviceHealth, DeviceStatus
from tiptrace.errors import PerceptionError
from tiptrace.live.monitor import StageOneMonitor, StageOneView
from tiptrace.live.phases import PhaseMarker
from tiptrace.live.recorder import Recorder, RecorderState
from tiptrace.pipeline import Step, open_tracer, steps
from tiptrace.streams.live import LiveStream
from tiptrace.streams.sync_report import SyncReport
from tiptrace.tracer import TipTracer
from tiptrace.types import (
    SIDES,
    Anchor,
    Event,
    FingerObservation,
    FingerView,
    FloatArray,
    ImageSample,
    Observation,
    Phase,
    Side,
    Snapshot,
    Status,
    TipEstimate,
)

_RATE_WINDOW = 64
_RATE_MEMORY_S = 3.0
_LATENCIES = 20_000
_LAST_EVENTS = 50
_SILENT_S = 0.3  # without a pair; then a snapshot says so

Subscriber = Callable[[Snapshot], None]


@dataclass(frozen=True, slots=True)
class LiveSummary:
    """A session in numbers.

    Attributes:
        pairs: Estimated.
        seconds: From the first to the last pair.
        bad_pairs: Left out because an image could not be used.
        latency_ms: (p50, p99, max) from the later image's arrival to the estimate; None without pairs.
        anchor: Stage I result.
        events: Of the whole session, in order.
        sentences: What synchronisation dropped.
        devices: State at the end.
        recorder: State at the end, where there was one.
    """

    pairs: int
    seconds: float
    bad_pairs: int
    latency_ms: tuple[float, float, float] | None
    anchor: Anchor | None
    events: tuple[Event, ...]
    sentences: tuple[str, ...]
    devices: dict[str, DeviceHealth]
    recorder: RecorderState | None


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
        self._views = _Views(stream)
        self._latencies: deque[float] = deque(maxlen=_LATENCIES)
        self._bad: list[str] = []
        self._bad_pairs = self._pairs = 0
        self._first_ns = self._last_ns = 0
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
            if self.recorder is not None:
                stack.enter_context(self.recorder)
            tracer = stack.enter_context(open_tracer(self.stream, self.method))
            if not self.stream.standby:
                self.stream.begin()
            self.tracer, monitor = tracer, StageOneMonitor(tracer)
            if self.on_open is not None:
                self.on_open()
            self._deadline = None if duration_s is None else time.monotonic() + duration_s
            for step in steps(self.stream, tracer, self.report, self.stream.settings, self._bad_pair):
                self.stage_one = monitor.update(step.estimate)
                self._show(step)
        return self.summary()

    def summary(self) -> LiveSummary:
        """The session so far."""
        latency = None
        if self._latencies:
            p50, p99, most = np.percentile(np.asarray(self._latencies), [50, 99, 100])
            latency = (float(p50), float(p99), float(most))
        return LiveSummary(
            pairs=self._pairs,
            seconds=(self._last_ns - self._first_ns) * 1e-9,
            bad_pairs=self._bad_pairs,
            latency_ms=latency,
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
        arrivals = [
            self.stream.arrived_ns(side, step.observation.finger(side).sample.stamp_ns) for side in SIDES
        ]
        known = [arrival for arrival in arrivals if arrival is not None]
        latency_ms = (done_ns - max(known)) * 1e-6 if known else None
        if latency_ms is not None:
            self._latencies.append(latency_ms)
        self._pairs += 1
        self._first_ns = self._first_ns or step.observation.stamp_ns
        self._last_ns = step.observation.stamp_ns
        self._bad.clear()
        self._shown = time.monotonic()
        advice = "" if self.stage_one is None else self.stage_one.sentence
        self._publish(
            self._views.snapshot(step, latency_ms, self._events()[-_LAST_EVENTS:], advice, self._notes())
        )

    def _bad_pair(self, observation: Observation, error: PerceptionError) -> None:
        """A pair whose images cannot be used: told, and no position claimed."""
        self._bad_pairs += 1
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
        notes = self._notes() or (("waiting for the first mark",) if self.stream.standby else ())
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
        return tuple(sorted([*told, *self.report.gaps], key=lambda event: event.start_ns))

    def _notes(self) -> tuple[str, ...]:
        """What is wrong at this moment."""
        devices = [health for health in self.stream.health().values() if health.status is not DeviceStatus.OK]
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


class _Views:
    """Makes a snapshot of a turn of the loop."""

    def __init__(self, stream: LiveStream) -> None:
        self._stream = stream
        self._start: dict[Side, FloatArray | None] = {}
        self._times: deque[float] = deque(maxlen=_RATE_WINDOW)

    def snapshot(
        self,
        step: Step,
        latency_ms: float | None,
        events: tuple[Event, ...],
        advice: str,
        notes: tuple[str, ...],
    ) -> Snapshot:
        """What a viewer is shown of it."""
        fingers: dict[str, Any] = {side: self._finger(step, side) for side in SIDES}
        return Snapshot(
            estimate=step.estimate,
            T_B_E=step.observation.left.T_B_E,
            rate_hz=self._rate_hz(),
            latency_ms=latency_ms,
            events=events,
            advice=advice,
            notes=notes,
            **fingers,
        )

    def _finger(self, step: Step, side: Side) -> FingerView:
        sample, uv_px = step.observation.finger(side).sample, step.sensed.finger(side).markers.uv_px
        start = self._start.setdefault(side, uv_px)
        image = sample.image if isinstance(sample, ImageSample) else None
        return FingerView(image, uv_px, start)

    def _rate_hz(self) -> float | None:
        now = time.monotonic()
        self._times.append(now)
        while now - self._times[0] > _RATE_MEMORY_S:
            self._times.popleft()
        if len(self._times) < 2:
            return None
        return (len(self._times) - 1) / (self._times[-1] - self._times[0])
