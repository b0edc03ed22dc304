"""Recording without estimating."""

from __future__ import annotations

import time
from dataclasses import dataclass

from tiptrace.drivers.base import DeviceHealth
from tiptrace.live.phases import PhaseMarker
from tiptrace.live.recorder import Recorder, RecorderState
from tiptrace.streams.live import LiveStream
from tiptrace.types import ImageSample, Phase, PoseSample


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """What was recorded.

    Attributes:
        seconds: Length.
        images: Of both cameras.
        poses: Of the robot.
        devices: State at the end.
        recorder: State at the end.
    """

    seconds: float
    images: int
    poses: int
    devices: dict[str, DeviceHealth]
    recorder: RecorderState


class RecordingSession:
    """Runs in the caller's thread; marks and :meth:`stop` come from any.

    Args:
        stream: Opened already.
        recorder: Not yet entered.
        wait_for_mark: Begin with the first phase mark.
    """

    def __init__(self, stream: LiveStream, recorder: Recorder, *, wait_for_mark: bool = False) -> None:
        self.stream, self.recorder = stream, recorder
        self.phases = PhaseMarker(self._emit_phase, waiting=wait_for_mark)
        stream.standby, stream.tap = wait_for_mark, recorder
        stream.on_idle, stream.on_phase = self._idle, self.phases.mark
        self._deadline: float | None = None

    def advance(self) -> Phase | None:
        """Mark the next phase, as the space key does; the one marked."""
        return self.phases.advance()

    def stop(self) -> None:
        """End the recording."""
        self.stream.stop()

    def run(self, duration_s: float | None = None) -> RecordingSummary:
        """Record until stopped.

        Raises:
            TipTraceError: a full disk, a device that changes its meaning, phases in a wrong order. What was recorded is
                kept.
        """
        images = poses = 0
        begin = time.monotonic()
        with self.recorder:
            self._deadline = None if duration_s is None else begin + duration_s
            if not self.stream.standby:
                self.stream.begin()
            for sample in self.stream:
                images += isinstance(sample, ImageSample)
                poses += isinstance(sample, PoseSample)
        if self.recorder.error is not None:
            raise self.recorder.error
        seconds = time.monotonic() - begin
        return RecordingSummary(seconds, images, poses, self.stream.health(), self.recorder.state())

    def _emit_phase(self, phase: Phase) -> None:
        self.stream.mark(phase)
        if phase is Phase.END:
            self.stream.stop()

    def _idle(self) -> None:
        late = self._deadline is not None and time.monotonic() > self._deadline
        if late or self.recorder.error is not None:
            self.stop()
