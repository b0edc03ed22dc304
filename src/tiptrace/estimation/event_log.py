"""Events as intervals: a condition that flickers is one event."""

from __future__ import annotations

from tiptrace.types import Event


class EventLog:
    """Keeps the list of events; the last one of a kind grows while its condition holds.

    Memory is bounded by the number of distinct intervals, not by the length of the trial.
    """

    def __init__(self, events: list[Event], bridge_s: float = 0.2) -> None:
        self._events, self._bridge_ns = events, round(bridge_s * 1e9)
        self._last: dict[str, int] = {}  # kind → index of its last event

    def note(self, kind: str, start_ns: int, end_ns: int, detail: str) -> None:
        """The condition held from start to end; joined to the kind's last event where they nearly touch."""
        index = self._last.get(kind)
        if index is not None:
            last = self._events[index]
            if start_ns - last.end_ns <= self._bridge_ns:
                self._events[index] = Event(kind, last.start_ns, max(last.end_ns, end_ns), last.detail)
                return
        self._last[kind] = len(self._events)
        self._events.append(Event(kind, start_ns, end_ns, detail))
