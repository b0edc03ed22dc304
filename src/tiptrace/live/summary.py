"""A session in numbers."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from tiptrace.drivers.base import DeviceHealth
from tiptrace.live.recorder import RecorderState
from tiptrace.types import Anchor, Event

_LATENCIES = 20_000


@dataclass(frozen=True, slots=True)
class LiveSummary:
    """A session in numbers.

    Attributes:
        pairs: Estimated.
        seconds: From the first to the last pair.
        bad_pairs: Left out because an image could not be used.
        latency_ms: (p50, p99, max) from the later image's arrival to the estimate, of the last 20,000 pairs; None
            without pairs.
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


class Tally:
    """Counts along the way, in constant memory."""

    def __init__(self) -> None:
        self.pairs = self.bad_pairs = 0
        self._latencies: deque[float] = deque(maxlen=_LATENCIES)
        self._first_ns = self._last_ns = 0

    def add(self, stamp_ns: int, latency_ms: float | None) -> None:
        """Count a pair."""
        if latency_ms is not None:
            self._latencies.append(latency_ms)
        self.pairs += 1
        self._first_ns = self._first_ns or stamp_ns
        self._last_ns = stamp_ns

    @property
    def seconds(self) -> float:
        """From the first to the last pair."""
        return (self._last_ns - self._first_ns) * 1e-9

    @property
    def latency_ms(self) -> tuple[float, float, float] | None:
        """(p50, p99, max); None without pairs."""
        if not self._latencies:
            return None
        p50, p99, most = np.percentile(np.asarray(self._latencies), [50, 99, 100])
        return float(p50), float(p99), float(most)
