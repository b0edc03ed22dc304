"""What synchronisation dropped, and why."""

from __future__ import annotations

from dataclasses import dataclass, field

from tiptrace.streams.pose_track import PoseGap
from tiptrace.streams.topics import NS
from tiptrace.types import SIDES, Event, Side

_END_NS = round(0.2 * NS)  # so much later or earlier than the images the poses may begin or end


def _per_side() -> dict[Side, int]:
    return {"left": 0, "right": 0}


@dataclass(slots=True)
class SyncReport:
    """Counts of what came in, what went out and what was dropped.

    Attributes:
        images: Images delivered.
        pairs: Observations given.
        unpaired: Images without a partner within the limit.
        repeated: Images whose stamp had been seen.
        late: Images that came after their time had been decided.
        poses: Pose samples delivered.
        poses_dropped: Pose samples whose stamp had been seen or whose time had passed.
        pairs_without_pose: Pairs skipped because no pose could be claimed.
        gaps: One ``pose-gap`` event per hole in the pose stream that cost pairs; before its first and after its
            last sample only where that lasts.
    """

    images: dict[Side, int] = field(default_factory=_per_side)
    pairs: int = 0
    unpaired: dict[Side, int] = field(default_factory=_per_side)
    repeated: dict[Side, int] = field(default_factory=_per_side)
    late: dict[Side, int] = field(default_factory=_per_side)
    poses: int = 0
    poses_dropped: int = 0
    pairs_without_pose: int = 0
    gaps: list[Event] = field(default_factory=list)
    _last_gap: PoseGap | None = None
    _gap_start_ns: int = 0
    _causes: list[str] = field(default_factory=list)

    def add_gap(self, stamp_ns: int, gap: PoseGap) -> None:
        """Note a pair that had to be skipped."""
        self.pairs_without_pose += 1
        same = self._last_gap is not None and gap.before_ns == self._last_gap.before_ns
        start_ns = self._gap_start_ns if same else stamp_ns
        self._last_gap, self._gap_start_ns = gap, start_ns
        cause = _explain(gap)
        if cause not in self._causes and len(self._causes) < 3:
            self._causes.append(cause)
        at_an_end = gap.before_ns is None or gap.after_ns is None
        if at_an_end and stamp_ns - start_ns < _END_NS:
            return  # streams do not begin and end at the same instant
        if self.gaps and self.gaps[-1].start_ns == start_ns:
            self.gaps.pop()
        self.gaps.append(Event("pose-gap", start_ns, stamp_ns, cause))

    def sentences(self) -> list[str]:
        """What a user should know, one sentence each; empty if nothing was lost."""
        found = []
        for side in SIDES:
            for counts, what in (
                (self.unpaired, "without a partner"),
                (self.repeated, "that repeat a stamp"),
                (self.late, "that came too late"),
            ):
                if counts[side]:
                    found.append(f"{side} images {what}, left out: {counts[side]} of {self.images[side]}")
        if self.poses_dropped:
            found.append(f"poses that repeat a stamp or came too late: {self.poses_dropped} of {self.poses}")
        if self.pairs_without_pose:
            causes = "; ".join(self._causes)
            found.append(f"image pairs without a pose, left out: {self.pairs_without_pose} ({causes})")
        return found


def _explain(gap: PoseGap) -> str:
    if gap.before_ns is None:
        return "the images begin before the robot's poses" if gap.after_ns is not None else "no poses"
    if gap.after_ns is None:
        return "the images go on after the robot's poses"
    return f"the robot's poses pause for {(gap.after_ns - gap.before_ns) / NS:.2f} s"
