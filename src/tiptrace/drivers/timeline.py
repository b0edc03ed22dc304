"""One timeline for everything live: the machine's monotonic clock, shifted once so that it counts from 1970."""

from __future__ import annotations

import time
from collections import deque

NS = 1_000_000_000
_WINDOW_NS = 2 * NS  # of arrivals among which the least delay is looked for
_SETTLED_NS = NS // 2  # of arrivals that tell the least delay well enough


class Timeline:
    """The session's clock. Setting the wall clock during a session does not touch it.

    Attributes:
        offset_ns: Stamp minus monotonic clock: what the wall clock said when the session began.
    """

    def __init__(self) -> None:
        self.offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """This instant."""
        return time.monotonic_ns() + self.offset_ns

    def from_monotonic(self, monotonic_ns: int) -> int:
        """Stamp of an instant on the monotonic clock, as the kernel gives for a camera's buffer."""
        return monotonic_ns + self.offset_ns

    def wall_error_ns(self) -> int:
        """Wall clock minus timeline: zero at the start; how far the wall clock was set or drifted since."""
        return time.time_ns() - self.now_ns()


class ClockMap:
    """Stamps of a device's own clock on the session's timeline.

    A message arrives never too early: arrival minus device stamp is the clocks' offset plus a delay, and its least
    value over the last two seconds is the offset with the least delay. So the jitter of a network does not reach the
    stamps. A device clock that is set starts the search anew.
    """

    def __init__(self) -> None:
        self._offsets: deque[tuple[int, int]] = deque()  # arrival, offset: increasing, the first is the least
        self._last_ns: int | None = None
        self._since_ns: int | None = None
        self.jumps = 0

    @property
    def settled(self) -> bool:
        """Whether the search has gone on for long enough to trust the stamps."""
        return bool(self._offsets) and self._offsets[-1][0] - (self._since_ns or 0) >= _SETTLED_NS

    def stamp_ns(self, device_ns: int, arrived_ns: int) -> int:
        """When a message was stamped by its device, on the session's timeline, ns; at most ``arrived_ns``."""
        offset = arrived_ns - device_ns
        if self._jumped(device_ns, offset):
            self._offsets.clear()
            self._since_ns = arrived_ns
            self.jumps += 1
        elif self._since_ns is None:
            self._since_ns = arrived_ns
        self._last_ns = device_ns
        offsets = self._offsets
        while offsets and offsets[-1][1] >= offset:
            offsets.pop()
        offsets.append((arrived_ns, offset))
        while offsets[0][0] < arrived_ns - _WINDOW_NS:
            offsets.popleft()
        return device_ns + offsets[0][1]

    def _jumped(self, device_ns: int, offset: int) -> bool:
        """Backwards, or further ahead of the arrivals than any jitter explains."""
        if self._last_ns is None or not self._offsets:
            return False
        return device_ns < self._last_ns or offset < self._offsets[0][1] - NS // 2
