"""A robot's samples on their way from its thread to the loop; refuses a pose that changes its meaning."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from tiptrace.drivers.base import DeviceHealth, RobotSample, RobotTap, Wake
from tiptrace.drivers.meter import Meter
from tiptrace.drivers.timeline import NS, Timeline
from tiptrace.errors import DeviceError
from tiptrace.types import FloatArray, PoseSample

_QUEUE = 4000  # eight seconds at 500 Hz; the oldest goes first
_MAX_SPEED = 5.0  # m/s: no arm that holds a GelSight Mini is faster
_MAX_TURN = 20.0  # rad/s
_JUMP_M, _JUMP_RAD = 0.005, 0.1
_STALE_S = 0.2


class SampleQueue:
    """Bounded; written by one thread, read by another.

    Args:
        name: Of the robot.
        timeline: The session's.
    """

    def __init__(self, name: str, timeline: Timeline) -> None:
        self.meter = Meter(name, timeline, _STALE_S)
        self._name, self._timeline = name, timeline
        self._samples: deque[RobotSample] = deque()
        self._lock = threading.Lock()
        self._last: PoseSample | None = None
        self._error: DeviceError | None = None
        self.wake: Wake = lambda: None
        self.tap: RobotTap | None = None
        self.first = threading.Event()

    def put(self, sample: RobotSample) -> None:
        """Add a sample. Poses that repeat a stamp or go back in time are counted and left out."""
        now_ns = self._timeline.now_ns()
        if isinstance(sample, PoseSample):
            if self._last is not None and sample.stamp_ns <= self._last.stamp_ns:
                self.meter.fault("repeated" if sample.stamp_ns == self._last.stamp_ns else "late")
                return
            self._check_continuous(sample)
            self._last = sample
            self.meter.good(sample.stamp_ns, now_ns)
            self.first.set()
        if self.tap is not None:
            self.tap(sample, now_ns)
        with self._lock:
            if len(self._samples) >= _QUEUE:
                self._samples.popleft()
                self.meter.fault("dropped")
            self._samples.append(sample)
        self.wake()

    def restart(self) -> None:
        """The stream begins anew after a pause: stamps may start again."""
        self._last = None

    def fail(self, error: DeviceError) -> None:
        """End the stream: :meth:`take` raises from now on."""
        self._error = error
        self.first.set()
        self.wake()

    def take(self) -> list[RobotSample]:
        """Samples since the last call, oldest first.

        Raises:
            DeviceError: the pose is no longer what it was at the start.
        """
        with self._lock:
            samples = list(self._samples)
            self._samples.clear()
        if self._error is not None and not samples:
            raise self._error
        return samples

    def health(self) -> DeviceHealth:
        """State at this moment."""
        return self.meter.health()

    def _check_continuous(self, sample: PoseSample) -> None:
        """A pose that jumps belongs to another frame than before: someone changed the TCP or the base."""
        last = self._last
        if last is None or self._error is not None:
            return
        dt_s = (sample.stamp_ns - last.stamp_ns) / NS
        moved_m, turned_rad = _step(last.T_B_E, sample.T_B_E)
        if moved_m > _JUMP_M + _MAX_SPEED * dt_s or turned_rad > _JUMP_RAD + _MAX_TURN * dt_s:
            self.fail(
                DeviceError(
                    f"{self._name}: the pose jumped by {moved_m * 1e3:.0f} mm and {np.degrees(turned_rad):.0f}° within "
                    f"{dt_s * 1e3:.0f} ms, which no arm does: the active TCP or the base frame was changed in "
                    "mid-trial; keep it, and start again"
                )
            )


def _step(T_0: FloatArray, T_1: FloatArray) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two poses (4, 4)."""
    moved = T_1[:3, 3] - T_0[:3, 3]
    cosine = 0.5 * (float(np.vdot(T_0[:3, :3], T_1[:3, :3])) - 1.0)
    return float(np.sqrt(moved @ moved)), float(np.arccos(min(1.0, max(-1.0, cosine))))
