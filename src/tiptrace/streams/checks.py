"""What a recording must satisfy before a trajectory is made of it; a refusal is one sentence and a remedy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tiptrace.errors import RecordingError
from tiptrace.geometry.transforms import rotation_from_quaternion
from tiptrace.streams.survey import Stamps_ns, TopicSurvey
from tiptrace.streams.topics import FRAME_ID, NS, Stamps
from tiptrace.types import FloatArray, Phase, Side

MAX_DISAGREEMENT_S = 1.0
MAX_JUMP_BACK_S = 1.0
_MIN_ROTATION_DEG = 2.0
_MIN_MISFIT_M = 0.002
_CLEARLY_BETTER = 0.3


def choose_clock(where: str, topics: Sequence[TopicSurvey], stamps: Stamps) -> tuple[bool, int]:
    """Whether to use log times, and what to add to the log times of messages without header, ns.

    Raises:
        RecordingError: the two clocks disagree and nobody said which to use, or the headers are not set.
    """
    headed = [topic for topic in topics if topic.has_header]
    if stamps == "log":
        return True, 0
    for topic in headed:
        if not np.any(topic.header_ns):
            raise RecordingError(
                f"{where}: {topic.topic}: header stamps are not set; use the recorder's with --stamps log"
            )
    differing = [t for t in headed if abs(t.disagreement_s or 0.0) > MAX_DISAGREEMENT_S]
    if not differing:
        return False, 0
    if stamps == "auto":
        worst = max(differing, key=lambda t: abs(t.disagreement_s or 0.0))
        raise RecordingError(
            f"{where}: {worst.topic}: header stamps differ from the recorder's clock by "
            f"{worst.disagreement_s:.1f} s; say which to use with --stamps header or --stamps log"
        )
    return False, round(float(np.median([topic.offset_ns for topic in headed])))


def check_overlap(where: str, images: dict[str, Stamps_ns], poses: tuple[str, Stamps_ns]) -> None:
    """Both image streams and the poses must have time in common.

    Raises:
        RecordingError: they do not; tells by how much they miss each other.
    """
    streams = [*images.items(), poses]
    for k, (topic, stamps) in enumerate(streams):
        for other_topic, other in streams[k + 1 :]:
            apart_ns = max(stamps.min() - other.max(), other.min() - stamps.max())
            if apart_ns > 0:
                raise RecordingError(
                    f"{where}: {topic} and {other_topic} have no time in common (they are "
                    f"{apart_ns / NS:.3f} s apart): synchronise the clocks of camera and robot, or try --stamps log"
                )


def check_order(where: str, topic: str, stamps: Stamps_ns) -> list[str]:
    """Notes on repeated and unordered stamps of one topic.

    Raises:
        RecordingError: a jump back too far for reordering, as when a clock is set during the recording.
    """
    back_s = float(np.max(np.maximum.accumulate(stamps) - stamps)) / NS
    if back_s > MAX_JUMP_BACK_S:
        raise RecordingError(
            f"{where}: {topic}: stamps jump back by {back_s:.1f} s: a clock was set during the recording; "
            "try --stamps log, or record again"
        )
    notes = []
    repeats = len(stamps) - len(np.unique(stamps))
    if repeats:
        notes.append(f"{topic}: repeated stamps, left out: {repeats} of {len(stamps)}")
    if back_s > 0:
        notes.append(f"{topic}: stamps are out of order by up to {back_s:.3f} s; sorted")
    return notes


def check_frame(where: str, topic: str, frame_ids: Sequence[str], expected: str, setting: str) -> None:
    """The stream's frame must be the one that the rig file means.

    Raises:
        RecordingError: it is another.
    """
    for frame_id in frame_ids:
        if frame_id.strip("/") not in ("", expected.strip("/")):
            raise RecordingError(
                f"{where}: {topic}: frame_id is {frame_id!r}, but {setting} is {expected!r}: correct the rig "
                "file, or publish the pose that it means"
            )


def check_side(where: str, topic: str, frame_ids: Sequence[str], side: Side) -> None:
    """An image stream must not name the other finger.

    Raises:
        RecordingError: it does.
    """
    other = FRAME_ID["right" if side == "left" else "left"]
    if other in frame_ids:
        raise RecordingError(
            f"{where}: {topic}: frame_id is {other!r} on the {side} topic: left and right are exchanged"
        )


def check_phases(where: str, topic: str, phases: Sequence[Phase]) -> None:
    """Anchoring, if any, comes first; nothing follows the end.

    Raises:
        RecordingError: phases in another order.
    """
    said = ", ".join(phase.value for phase in phases)
    if Phase.END in phases[:-1] and any(p is not Phase.END for p in phases[phases.index(Phase.END) :]):
        raise RecordingError(
            f"{where}: {topic}: phases go on after 'end' ({said}); one recording holds one trial: split it"
        )
    if Phase.ANCHORING in phases and phases[0] is not Phase.ANCHORING:
        raise RecordingError(
            f"{where}: {topic}: the first phase is {phases[0].value!r}, not 'anchoring' ({said}); "
            "mark the anchoring before the reconstruction, or leave the marks out"
        )


def check_quaternion_order(where: str, topic: str, q: FloatArray, t: FloatArray) -> None:
    """While the tip rests the hand turns about a fixed point: it must do so in the order x, y, z, w.

    Args:
        where: File, for the message.
        topic: Topic, for the message.
        q: (n, 4) quaternions of the anchoring segment as read, xyzw.
        t: (n, 3) positions, m.

    Raises:
        RecordingError: the poses pivot about a point if, and only if, the fields are taken as w, x, y, z.
    """
    if len(q) < 20:
        return
    pick = np.linspace(0, len(q) - 1, min(len(q), 300)).round().astype(int)
    q, t = q[pick], t[pick]
    turn = 2.0 * np.arccos(np.clip(np.abs(q @ q[0]), 0.0, 1.0))  # (n,) rad, the same for both orders
    if np.degrees(turn.max()) < _MIN_ROTATION_DEG:
        return
    misfit = _pivot_misfit_m(rotation_from_quaternion(q), t)
    other = _pivot_misfit_m(rotation_from_quaternion(np.roll(q, -1, axis=-1)), t)
    if misfit > _MIN_MISFIT_M and other < _CLEARLY_BETTER * misfit:
        raise RecordingError(
            f"{where}: {topic}: quaternions look like w, x, y, z: read so, the anchoring motion pivots about "
            f"a point within {other * 1e3:.1f} mm, as x, y, z, w only within {misfit * 1e3:.1f} mm; publish "
            "x, y, z, w"
        )


def _pivot_misfit_m(R: FloatArray, t: FloatArray) -> float:
    """Root mean square of R_i c + t_i − p over the best c and p: R (n, 3, 3), t (n, 3)."""
    n = len(R)
    A = np.concatenate([R, np.broadcast_to(-np.eye(3), (n, 3, 3))], axis=-1).reshape(3 * n, 6)
    b = -t.reshape(3 * n)
    solution = np.linalg.lstsq(A, b, rcond=1e-6)[0]
    return float(np.sqrt(np.mean(np.sum((A @ solution - b).reshape(n, 3) ** 2, axis=1))))
