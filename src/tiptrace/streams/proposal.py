"""Guesses a map file for somebody else's recording from types, names and sizes."""

from __future__ import annotations

from dataclasses import dataclass, field

from tiptrace.errors import TipTraceError
from tiptrace.streams import messages
from tiptrace.streams.mapping import ImageMap, MapFile, TfChain
from tiptrace.streams.raw_messages import MessageSource, RawMessage
from tiptrace.streams.survey import TopicSurvey
from tiptrace.streams.tf_poses import TF_TYPE, TfPoses
from tiptrace.types import SIDES, Side

_SIZE_PX = (320, 240)  # processing size of the recording format
_SIDE_WORDS: dict[Side, tuple[str, ...]] = {
    "left": ("left", "_l/", "/l/", "_l_", "finger_0", "finger0", "/gelsight0", "_0/", "/0/"),
    "right": ("right", "_r/", "/r/", "_r_", "finger_1", "finger1", "/gelsight1", "_1/", "/1/"),
}
_POSE_WORDS = ("ee_pose", "tcp_pose", "tcp", "ee", "tool", "flange", "pose")
_BASE_WORDS = ("base", "base_link", "robot_base", "panda_link0", "world")
_TOOL_WORDS = ("tool0", "tcp", "flange", "ee_link", "tool", "panda_hand", "panda_link8", "wrist_3_link", "ee")


@dataclass(slots=True)
class Probe:
    """Collects image sizes, TF links and poses that cannot be meant during the survey."""

    source: MessageSource
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    tf: TfPoses | None = None
    refused: dict[str, str] = field(default_factory=dict)

    def __call__(self, raw: RawMessage) -> None:
        """Look at one message; what cannot be decoded is passed over."""
        try:
            if raw.type in messages.IMAGE_READERS and raw.topic not in self.sizes:
                image = messages.IMAGE_READERS[raw.type](self.source.decode(raw))
                self.sizes[raw.topic] = (image.shape[1], image.shape[0])
            elif raw.type == TF_TYPE:
                self.tf = self.tf or TfPoses(self.source)
                self.tf.add(raw)
            elif raw.type in messages.POSE_READERS and raw.topic not in self.refused:
                messages.POSE_READERS[raw.type](self.source.decode(raw))
        except (TipTraceError, messages.MessageError) as error:
            self.refused[raw.topic] = str(error)


def propose_map(found: dict[str, TopicSurvey], probe: Probe) -> tuple[MapFile | None, list[str]]:
    """The best guess at a map, and what is missing for one."""
    problems = []
    images = [t for t in found.values() if t.type in messages.IMAGE_READERS]
    left, right = _pick_sides([t.topic for t in images])
    for side, topic in (("left", left), ("right", right)):
        if topic is None:
            there = ", ".join(t.topic for t in images) or "none"
            problems.append(
                f"no image topic that can be told to be the {side} finger's (image topics: {there})"
            )
    pose = _best([t for t in found.values() if t.type in messages.POSE_READERS], _POSE_WORDS)
    chain = _pick_chain(found, probe) if pose is None else None
    if pose is None and chain is None:
        problems.append(
            "no end-effector pose: neither a PoseStamped topic nor TF between a base and a tool frame"
        )
    if left is None or right is None or (pose is None and chain is None):
        return None, problems
    sized = {side: _image_map(topic, probe) for side, topic in (("left", left), ("right", right))}
    proposal = MapFile(
        left=sized["left"],
        right=sized["right"],
        pose=pose,
        tf=chain,
        phase=_best([t for t in found.values() if t.type in messages.PHASE_READERS], ("phase",), strict=True),
        opening=_best(
            [t for t in found.values() if t.type in messages.OPENING_READERS],
            ("opening", "gripper", "width", "gap"),
            strict=True,
        ),
        truth=_best(
            [t for t in found.values() if t.type in messages.TRUTH_READERS], ("truth", "tip"), strict=True
        ),
    )
    return proposal, []


def _pick_sides(topics: list[str]) -> tuple[str | None, str | None]:
    """Left and right image topics by their names; compressed ones where both exist."""
    chosen: dict[Side, str | None] = {"left": None, "right": None}
    for side in SIDES:
        named = [t for t in topics if any(word in f"{t}/" for word in _SIDE_WORDS[side])]
        tactile = [t for t in named if any(word in t for word in ("tactile", "gelsight", "digit", "finger"))]
        pool = sorted(tactile or named, key=lambda t: ("compressed" not in t, len(t)))
        chosen[side] = pool[0] if pool else None
    if chosen["left"] == chosen["right"]:
        return None, None
    return chosen["left"], chosen["right"]


def _best(topics: list[TopicSurvey], words: tuple[str, ...], *, strict: bool = False) -> str | None:
    """The topic whose name fits best; with ``strict`` only one whose name fits at all."""

    def rank(topic: TopicSurvey) -> tuple[int, int]:
        fits = [k for k, word in enumerate(words) if word in topic.topic.lower()]
        return (min(fits, default=len(words)), -topic.count)

    ranked = sorted(topics, key=rank)
    if not ranked or (strict and rank(ranked[0])[0] == len(words)):
        return None
    return ranked[0].topic


def _pick_chain(found: dict[str, TopicSurvey], probe: Probe) -> TfChain | None:
    """Base and tool frame by their names, if TF connects and moves them."""
    collected = probe.tf
    if collected is None:
        return None
    bases = [word for word in _BASE_WORDS if word in collected.frames]
    tools = [word for word in _TOOL_WORDS if word in collected.frames]
    topics = tuple(topic for topic, entry in found.items() if entry.type == TF_TYPE)
    for base in bases:
        for tool in tools:
            if collected.connects(base, tool):
                return TfChain(base=base, end_effector=tool, topics=topics)
    return None


def _image_map(topic: str, probe: Probe) -> ImageMap:
    """Central crop to 4:3 and resize, where the image is not of processing size."""
    size = probe.sizes.get(topic)
    if size is None or size == _SIZE_PX:
        return ImageMap(topic=topic)
    width, height = size
    crop_width, crop_height = min(width, height * 4 // 3), min(height, width * 3 // 4)
    left, top = (width - crop_width) // 2, (height - crop_height) // 2
    crop = (left, top, crop_width, crop_height) if (crop_width, crop_height) != size else None
    return ImageMap(topic=topic, crop_px=crop, resize_px=_SIZE_PX)


def role_name(kind: str, side: Side) -> str:
    """How the table calls a part."""
    return f"{side} {kind}" if kind in ("image", "markers") else kind


def roles_of(proposal: MapFile | None) -> dict[str, str]:
    """Topic → part, by a map."""
    if proposal is None:
        return {}
    names = {topic: role_name(role.kind, role.side) for topic, role in proposal.topics().roles().items()}
    if proposal.tf is not None:
        names |= dict.fromkeys(proposal.tf.topics, f"pose: {proposal.tf.base} → {proposal.tf.end_effector}")
    return names
