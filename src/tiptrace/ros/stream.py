"""ROS 2 messages as a stream: what callbacks put in, the loop takes out."""

from __future__ import annotations

import queue
import threading
from collections import Counter
from collections.abc import Iterator

from tiptrace.config import Rig, Tool
from tiptrace.types import Image, ImageSample, Phase, PhaseSample, PoseSample, Sample, Side

_QUEUE = 4000
_BACK_NS = 1_000_000_000  # stamps that go back by more begin anew: a bag that loops


class RosStream:
    """Implements ``types.Stream``; one trial ends where stamps go back, or anchoring begins again after the end.

    Args:
        rig: What the user believes about the rig.
        tool: What is known of the tool.
        references: Images of the untouched gels.
    """

    def __init__(self, rig: Rig, tool: Tool | None, references: dict[Side, Image]) -> None:
        self.rig, self.tool, self.references = rig, tool, references
        self.gel_models: dict[str, bytes] = {}
        self.faults: Counter[str] = Counter()
        self._queue: queue.Queue[Sample | None] = queue.Queue(maxsize=_QUEUE)
        self._stopped = threading.Event()
        self._held: Sample | None = None
        self._newest_ns: dict[str, int] = {}
        self._ended = False

    @property
    def stopped(self) -> bool:
        """Whether no more will come."""
        return self._stopped.is_set()

    def put(self, sample: Sample) -> None:
        """Take a sample from a callback; the oldest goes where the loop cannot follow."""
        while True:
            try:
                return self._queue.put_nowait(sample)
            except queue.Full:
                self.faults["dropped"] += 1
                try:
                    self._queue.get_nowait()
                except queue.Empty:
                    continue

    def stop(self) -> None:
        """End the stream."""
        self._stopped.set()

    def __iter__(self) -> Iterator[Sample]:
        """Samples of one trial, as they come."""
        self._newest_ns.clear()
        self._ended = False
        if self._held is not None:
            held, self._held = self._held, None
            self._begins_anew(held)
            yield held
        while True:
            try:
                sample = self._queue.get(timeout=0.1)
            except queue.Empty:
                if self.stopped:
                    return
                continue
            if sample is None:
                return
            if self._begins_anew(sample):
                self._held = sample
                return
            yield sample

    def _begins_anew(self, sample: Sample) -> bool:
        if isinstance(sample, PhaseSample):
            again = self._ended and sample.phase is Phase.ANCHORING
            self._ended = self._ended or sample.phase is Phase.END
            return again
        if not isinstance(sample, ImageSample | PoseSample):
            return False
        key = sample.side if isinstance(sample, ImageSample) else "pose"
        newest = self._newest_ns.get(key)
        if newest is not None and sample.stamp_ns < newest - _BACK_NS:
            return True
        self._newest_ns[key] = max(sample.stamp_ns, newest or sample.stamp_ns)
        return False
