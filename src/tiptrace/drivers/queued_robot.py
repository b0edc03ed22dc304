"""What all robots with a thread of their own share: a bounded queue out of it, and an orderly end."""

from __future__ import annotations

import threading
from collections.abc import Callable

from tiptrace.drivers.base import Closing, DeviceHealth, RobotSample, RobotTap, Wake
from tiptrace.drivers.sample_queue import SampleQueue
from tiptrace.drivers.timeline import Timeline
from tiptrace.errors import DeviceError

_JOIN_S = 3.0
_FIRST_POSE_S = 5.0


class QueuedRobot(Closing):
    """A robot whose thread puts samples into ``_queue`` until ``_stop`` is set.

    Args:
        name: As a user knows it.
        timeline: The session's.
    """

    def __init__(self, name: str, timeline: Timeline) -> None:
        self.name = name
        self._timeline = timeline
        self._queue = SampleQueue(name, timeline)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def take(self) -> list[RobotSample]:
        """Samples since the last call, oldest first."""
        return self._queue.take()

    def health(self) -> DeviceHealth:
        """State at this moment."""
        return self._queue.health()

    def close(self) -> None:
        """End the thread and release what it holds."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=_JOIN_S)
            self._thread = None

    def _begin(self, run: Callable[[], None], remedy: str) -> None:
        """Start the thread and wait for its first pose.

        Raises:
            DeviceError: none came; the message ends with the remedy.
        """
        self._thread = threading.Thread(target=run, name=f"robot {self.name}", daemon=True)
        self._thread.start()
        if not self._queue.first.wait(_FIRST_POSE_S):
            self.close()
            raise DeviceError(f"{self.name}: no pose within {_FIRST_POSE_S:g} s{remedy}")

    def _deliver_to(self, wake: Wake, tap: RobotTap | None) -> None:
        self._queue.wake, self._queue.tap = wake, tap
