"""What a recording holds, whether it is usable, and a proposed map: the matter of ``tiptrace inspect``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from tiptrace.config import Frames
from tiptrace.errors import TipTraceError
from tiptrace.streams.checks import MAX_DISAGREEMENT_S
from tiptrace.streams.foreign import open_source
from tiptrace.streams.mapping import MapFile
from tiptrace.streams.mcap_source import McapSource
from tiptrace.streams.proposal import Probe, propose_map, role_name, roles_of
from tiptrace.streams.raw_messages import MessageSource
from tiptrace.streams.recording import STANDARD_TOPICS, Recording
from tiptrace.streams.survey import TopicSurvey, survey
from tiptrace.streams.topics import NS
from tiptrace.types import SIDES


@dataclass(frozen=True, slots=True)
class TopicReport:
    """One line of the table; times in seconds since the recording's first message.

    Attributes:
        topic: Name.
        type: ROS 2 type.
        count: Messages.
        rate_hz: Mean rate by the messages' own stamps, where they have any.
        longest_gap_s: Longest time between neighbours.
        first_s: First message, by the recorder's clock.
        last_s: Last message.
        clock_difference_s: Header minus recorder's clock where they differ most.
        frame_ids: Frames named in the headers.
        size_px: Width and height of the first image.
        role: What tiptrace uses it for, or would.
    """

    topic: str
    type: str
    count: int
    rate_hz: float | None
    longest_gap_s: float | None
    first_s: float
    last_s: float
    clock_difference_s: float | None
    frame_ids: tuple[str, ...]
    size_px: tuple[int, int] | None
    role: str


@dataclass(frozen=True, slots=True)
class Inspection:
    """Everything about a recording that decides what can be made of it.

    Attributes:
        path: File or folder.
        own_format: Whether it is in tiptrace's format.
        duration_s: From first to last message.
        topics: In alphabetic order.
        attachments: Name → bytes.
        usable: Whether ``tiptrace reconstruct`` can read it: as it is, or for others' recordings with the
            proposed map and a rig file.
        problems: What stands in the way.
        notes: What to know besides.
        proposed_map: For others' recordings, as far as topics could be told apart.
    """

    path: str
    own_format: bool
    duration_s: float
    topics: tuple[TopicReport, ...]
    attachments: dict[str, int]
    usable: bool
    problems: tuple[str, ...]
    notes: tuple[str, ...]
    proposed_map: MapFile | None


def inspect_recording(path: Path) -> Inspection:
    """Read a recording once and judge it.

    Raises:
        RecordingError: not a recording, or it cannot be opened.
    """
    source = open_source(path)
    probe = Probe(source)
    found = survey(source, probe)
    attachments = source.attachments if isinstance(source, McapSource) else {}
    roles = STANDARD_TOPICS.roles()
    own = "rig.yaml" in attachments or sum(topic in roles for topic in found) >= 3
    if own:
        problems, notes = _judge_own(path)
        proposal = None
        names = {topic: role_name(role.kind, role.side) for topic, role in roles.items()}
    else:
        proposal, problems = propose_map(found, probe)
        notes = [*_damage_note(source), *_clock_notes(found.values()), *_value_notes(found, probe, proposal)]
        names = roles_of(proposal)
    if not found:
        problems = [*problems, "holds no messages"]
    start = min((int(t.log_ns.min()) for t in found.values()), default=0)
    end = max((int(t.log_ns.max()) for t in found.values()), default=0)
    return Inspection(
        path=str(path),
        own_format=own,
        duration_s=(end - start) / NS,
        topics=tuple(_report(found[topic], start, probe, names) for topic in sorted(found)),
        attachments={name: len(data) for name, data in attachments.items()},
        usable=not problems,
        problems=tuple(problems),
        notes=tuple(notes),
        proposed_map=proposal,
    )


def _judge_own(path: Path) -> tuple[list[str], list[str]]:
    """Problems and notes of a file in the recording format."""
    try:
        recording = Recording(path)
    except TipTraceError as error:
        return [str(error).removeprefix(f"{path}: ")], []
    notes = list(recording.notes)
    if STANDARD_TOPICS.phase not in recording.survey:
        notes.append("no phase marks: a method must find the end of the anchoring by itself")
    if recording.tool is None:
        notes.append("no tool.yaml: nothing is known of the tool beforehand")
    has_images = any(topic in recording.survey for topic in STANDARD_TOPICS.images.values())
    missing = [side for side in SIDES if side not in recording.references]
    if missing and has_images:
        notes.append(f"no reference image of {' and '.join(missing)}: give one with --reference-left/-right")
    return [], notes


def _damage_note(source: MessageSource) -> list[str]:
    return [f"recording is {source.damage}; used as far as it goes"] if source.damage else []


def _clock_notes(topics: Iterable[TopicSurvey]) -> list[str]:
    found = []
    for topic in topics:
        difference = topic.disagreement_s
        if difference is not None and abs(difference) > MAX_DISAGREEMENT_S:
            found.append(
                f"{topic.topic}: header and recorder's clock differ by {difference:.1f} s: "
                "choose with --stamps header or --stamps log"
            )
    return found


def _value_notes(found: dict[str, TopicSurvey], probe: Probe, proposal: MapFile | None) -> list[str]:
    """What the proposed pose topic needs of the rig file, or of its publisher."""
    pose = proposal.pose if proposal is not None else None
    if pose is None:
        return []
    notes = [f"{pose}: {probe.refused[pose]}"] if pose in probe.refused else []
    others = [
        frame_id for frame_id in found[pose].frame_ids if frame_id.strip("/") not in ("", Frames().base)
    ]
    notes += [
        f"{pose}: frame_id is {frame_id!r}: the rig file must say so in frames.base" for frame_id in others
    ]
    return notes


def _report(entry: TopicSurvey, start_ns: int, probe: Probe, names: dict[str, str]) -> TopicReport:
    return TopicReport(
        topic=entry.topic,
        type=entry.type,
        count=entry.count,
        rate_hz=entry.rate_hz,
        longest_gap_s=entry.longest_gap_s,
        first_s=(int(entry.log_ns.min()) - start_ns) / NS,
        last_s=(int(entry.log_ns.max()) - start_ns) / NS,
        clock_difference_s=entry.disagreement_s,
        frame_ids=tuple(entry.frame_ids),
        size_px=probe.sizes.get(entry.topic),
        role=names.get(entry.topic, ""),
    )


def to_dict(inspection: Inspection) -> dict[str, object]:
    """As plain data, for JSON."""
    data: dict[str, object] = {
        item.name: getattr(inspection, item.name)
        for item in fields(inspection)
        if item.name not in ("topics", "proposed_map")
    }
    data["topics"] = [asdict(topic) for topic in inspection.topics]
    proposal = inspection.proposed_map
    data["proposed_map"] = None if proposal is None else proposal.model_dump(mode="json", exclude_none=True)
    return data
