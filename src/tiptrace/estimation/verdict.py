"""From findings to a status, an honest covariance, and events."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.estimation.event_log import EventLog
from tiptrace.estimation.integrity import Findings
from tiptrace.types import FloatArray, Status

_DISAGREE = "the two pads' markers twist against each other: one of them slips on the tool"
_SLIP = (
    "the markers no longer move as one body: the tool slips in the grasp. Markers ride on the gel and not on the "
    "tool: how far it slipped they cannot show, positions from here on carry a larger covariance"
)
_MISFIT = (
    "the markers are far from moving as one body, or as one that leans as the tool never did in anchoring, as after a "
    "pause in which they leapt to their neighbours' places: "
    "positions are not to be relied on until they fit again"
)
_LOST = "the tool sprang out along its axis by {:.1f} mm: the tip does not touch"


@dataclass(slots=True)
class Verdict:
    """Status of frames; remembers that the tool has slipped until the tip is anchored anew.

    Attributes:
        log: Where events go.
        slip_sigma_m: Standard deviation added to a position after a slip.
        slipped: Whether the tool has moved in the grasp since the anchor.
    """

    log: EventLog
    slip_sigma_m: float
    slipped: bool = False
    _contact: bool = True
    _frame_ns: int = 0

    def of(self, stamp_ns: int, f: Findings) -> tuple[Status, FloatArray]:
        """Status, and covariance (3, 3) to add, m².

        Frames whose tip is in the air claim no contact point; old frames and slips leave a degraded position.
        """
        self._note_frames(stamp_ns, f)
        if f.slipping:
            self.slipped = True
            self.log.note("grasp-slip", stamp_ns, stamp_ns, _SLIP)
        if f.disagree:
            self.log.note("left-right-disagreement", stamp_ns, stamp_ns, _DISAGREE)
        if f.misfit:
            self.log.note("marker-jump", stamp_ns, stamp_ns, _MISFIT)
        vague = self.slipped or f.misfit
        extra = self.slip_sigma_m**2 * np.eye(3) if vague else np.zeros((3, 3))
        if not f.in_contact:
            self.log.note("contact-lost", stamp_ns, stamp_ns, _LOST.format(f.axial_m * 1e3))
            self._contact = False
            return Status.NO_CONTACT, extra
        if not self._contact:
            self._contact = True
            self.log.note("contact-regained", stamp_ns, stamp_ns, "the tip touches again")
        doubtful = vague or f.disagree or any(f.repeated) or bool(f.jumped.any())
        return (Status.DEGRADED if doubtful else Status.OK), extra

    def _note_frames(self, stamp_ns: int, f: Findings) -> None:
        names = [side for side, same in zip(("left", "right"), f.repeated, strict=True) if same]
        if names:
            kind = "frame-stale" if f.frozen else "frame-repeated"
            self.log.note(
                kind, stamp_ns, stamp_ns, f"the {' and '.join(names)} finger delivered an old frame"
            )
        if f.lost.any():
            gone = np.flatnonzero(f.lost)
            named = ", ".join(str(k) for k in gone[:5]) + (" and others" if len(gone) > 5 else "")
            self.log.note("marker-lost", stamp_ns, stamp_ns, f"markers {named} are no longer seen")
        if f.jumped.any():
            rows = ", ".join(str(k) for k in np.flatnonzero(f.jumped)[:5])
            self.log.note("marker-jump", stamp_ns, stamp_ns, f"markers {rows} jumped away from the rest")
