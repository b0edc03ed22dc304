"""Rates, jitter and fault counts of a device; shared by its thread and whoever asks."""

from __future__ import annotations

import threading
from collections import Counter, deque

import numpy as np

from tiptrace.drivers.base import DeviceHealth, DeviceStatus
from tiptrace.drivers.timeline import NS, Timeline

_WINDOW = 256
_RATE_EVERY_NS = NS // 4  # rate and jitter are worked out anew


class Meter:
    """What :class:`DeviceHealth` reports.

    Args:
        name: Of the device.
        timeline: The session's.
        stale_s: Silence that counts as stale.
    """

    def __init__(self, name: str, timeline: Timeline, stale_s: float) -> None:
        self.name = name
        self._timeline, self._stale_s = timeline, stale_s
        self._lock = threading.Lock()
        self._stamps: deque[int] = deque(maxlen=_WINDOW)
        self._last_arrival: int | None = None
        self._count = 0
        self._faults: Counter[str] = Counter()
        self._status, self._detail = DeviceStatus.STARTING, ""
        self._rate: tuple[float | None, float | None] = (None, None)
        self._rate_ns = 0

    def good(self, stamp_ns: int, arrived_ns: int) -> None:
        """A new sample was delivered."""
        with self._lock:
            if self._stamps and stamp_ns - self._stamps[-1] > 2 * NS:
                self._stamps.clear()  # the rate after a pause is the rate since it
            self._stamps.append(stamp_ns)
            self._last_arrival = arrived_ns
            self._count += 1
            self._status, self._detail = DeviceStatus.OK, ""

    def bad(self, status: DeviceStatus, detail: str, count_as: str | None = None) -> None:
        """Something else was."""
        with self._lock:
            self._status, self._detail = status, detail
            self._faults[count_as or status.value] += 1

    def fault(self, kind: str, count: int = 1) -> None:
        """Count a fault that does not change the status."""
        with self._lock:
            self._faults[kind] += count

    def faults(self, kind: str) -> int:
        """How often a fault was seen."""
        with self._lock:
            return self._faults[kind]

    def health(self) -> DeviceHealth:
        """State at this moment; rate and jitter are those of the last quarter of a second."""
        now_ns = self._timeline.now_ns()
        with self._lock:
            stamps: list[int] | None = None
            if now_ns - self._rate_ns > _RATE_EVERY_NS or None in self._rate:
                stamps, self._rate_ns = list(self._stamps), now_ns
            count, faults = self._count, tuple(sorted(self._faults.items()))
            status, detail, last = self._status, self._detail, self._last_arrival
        if stamps is not None:
            self._rate = _rate(stamps)
        rate_hz, jitter_ms = self._rate
        age_s = None if last is None else (now_ns - last) / NS
        if status is DeviceStatus.OK and age_s is not None and age_s > self._stale_s:
            status, detail = DeviceStatus.STALE, f"{self.name}: nothing new for {age_s:.1f} s"
        return DeviceHealth(self.name, status, detail, count, rate_hz, jitter_ms, age_s, faults)


def _rate(stamps: list[int]) -> tuple[float | None, float | None]:
    """Hz, and the standard deviation of the time between samples, ms; None before there are three."""
    if len(stamps) <= 2:
        return None, None
    steps_s = np.diff(np.array(stamps, dtype=np.int64)) / NS
    return float(1.0 / max(float(steps_s.mean()), 1e-9)), float(steps_s.std() * 1e3)
