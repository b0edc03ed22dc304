"""Which true events a method saw, and which of its events were none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tiptrace.types import Event

DEFAULT_TOLERANCE_S = 0.5


@dataclass(frozen=True, slots=True)
class EventScore:
    """Events of one kind in one or more trials.

    Attributes:
        hits: True events that overlap a detected one.
        misses: True events that do not.
        false_alarms: Detected events that overlap no true one.
        delays_s: From the start of a true event to that of its detection, for each hit.
    """

    hits: int = 0
    misses: int = 0
    false_alarms: int = 0
    delays_s: tuple[float, ...] = ()

    @property
    def mean_delay_s(self) -> float:
        """Over the hits; NaN without any."""
        return sum(self.delays_s) / len(self.delays_s) if self.delays_s else float("nan")


def score_events(
    detected: Sequence[Event],
    true: Sequence[Event],
    kind: str,
    tolerance_s: float = DEFAULT_TOLERANCE_S,
    slight: Sequence[Event] = (),
) -> EventScore:
    """Match events of one kind that overlap when both are widened by a tolerance.

    One long detection may cover several true events, and one true event may be told in several pieces. Events that
    are too ``slight`` to be told count in nothing: neither missed, nor is one that is told false.
    """
    slack = round(tolerance_s * 1e9)
    seen = [e for e in detected if e.kind == kind]
    real = [e for e in true if e.kind == kind]
    happened = real + [e for e in slight if e.kind == kind]
    delays = []
    for event in real:
        matches = [e for e in seen if _overlap(e, event, slack)]
        if matches:
            delays.append((min(e.start_ns for e in matches) - event.start_ns) * 1e-9)
    return EventScore(
        hits=len(delays),
        misses=len(real) - len(delays),
        false_alarms=sum(not any(_overlap(e, event, slack) for event in happened) for e in seen),
        delays_s=tuple(delays),
    )


def _overlap(a: Event, b: Event, slack_ns: int) -> bool:
    return a.start_ns - slack_ns <= b.end_ns and b.start_ns - slack_ns <= a.end_ns
