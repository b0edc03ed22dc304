"""One pass over all messages: which topics there are, how often, when, by which clock."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tiptrace.streams.raw_messages import MessageSource, RawMessage, peek_header
from tiptrace.streams.topics import NS

Stamps_ns = NDArray[np.int64]


@dataclass(slots=True)
class TopicSurvey:
    """What one topic holds.

    Attributes:
        topic: Name.
        type: ROS 2 type.
        frame_ids: Frames named in the headers, in order of appearance.
        bytes: Serialised size.
    """

    topic: str
    type: str
    frame_ids: list[str] = field(default_factory=list)
    bytes: int = 0
    _log: array[int] = field(default_factory=lambda: array("q"))
    _header: array[int] = field(default_factory=lambda: array("q"))

    def add(self, message: RawMessage) -> None:
        """Count one message."""
        self._log.append(message.log_time_ns)
        self.bytes += len(message.data)
        header = peek_header(message)
        if header is not None:
            self._header.append(header.stamp_ns)
            if header.frame_id not in self.frame_ids:
                self.frame_ids.append(header.frame_id)

    @property
    def count(self) -> int:
        """Messages."""
        return len(self._log)

    @property
    def has_header(self) -> bool:
        """Whether every message carries a stamp of its own."""
        return len(self._header) == len(self._log)

    @property
    def log_ns(self) -> Stamps_ns:
        """Recorder's stamps in the order of delivery."""
        return np.array(self._log, dtype=np.int64)

    @property
    def header_ns(self) -> Stamps_ns:
        """The messages' own stamps in the order of delivery; empty without headers."""
        return np.array(self._header, dtype=np.int64) if self.has_header else np.empty(0, dtype=np.int64)

    @property
    def disagreement_s(self) -> float | None:
        """Header minus log clock where they differ most; None without headers."""
        if not self.has_header or not self.count:
            return None
        difference = self.header_ns - self.log_ns
        return float(difference[np.argmax(np.abs(difference))]) / NS

    @property
    def offset_ns(self) -> int:
        """Median of header minus log clock; 0 without headers."""
        return round(float(np.median(self.header_ns - self.log_ns))) if self.has_header and self.count else 0

    def stamps_ns(self, use_log: bool) -> Stamps_ns:
        """Stamps by the chosen clock, in the order of delivery."""
        return self.log_ns if use_log or not self.has_header else self.header_ns

    @property
    def rate_hz(self) -> float | None:
        """Mean rate; None for fewer than two messages or no duration."""
        stamps = self.stamps_ns(use_log=False)
        span = int(stamps.max() - stamps.min()) if len(stamps) > 1 else 0
        return (len(stamps) - 1) * NS / span if span else None

    @property
    def longest_gap_s(self) -> float | None:
        """Longest time between neighbours; None for fewer than two messages."""
        stamps = np.sort(self.stamps_ns(use_log=False))
        return float(np.diff(stamps).max()) / NS if len(stamps) > 1 else None


def survey(
    source: MessageSource, visit: Callable[[RawMessage], None] | None = None
) -> dict[str, TopicSurvey]:
    """Read everything once; ``visit`` sees every message."""
    found: dict[str, TopicSurvey] = {}
    for message in source.messages():
        entry = found.get(message.topic)
        if entry is None:
            entry = found[message.topic] = TopicSurvey(message.topic, message.type)
        entry.add(message)
        if visit is not None:
            visit(message)
    return found
