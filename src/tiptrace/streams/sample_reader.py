"""One stored message to one sample, by the part that its topic plays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from tiptrace.config import Rig
from tiptrace.errors import RecordingError
from tiptrace.streams import messages
from tiptrace.streams.messages import MessageError
from tiptrace.streams.raw_messages import MessageSource, RawMessage
from tiptrace.streams.topics import NS
from tiptrace.types import (
    SIDES,
    Image,
    ImageSample,
    MarkerSample,
    OpeningSample,
    PhaseSample,
    PoseSample,
    Sample,
    Side,
    TruthSample,
)

Kind = Literal["image", "markers", "pose", "phase", "opening", "truth"]
ImageStep = Callable[[Image], Image]

_READERS: dict[Kind, Mapping[str, Callable[[Any], Any]]] = {
    "image": messages.IMAGE_READERS,
    "markers": messages.MARKER_READERS,
    "pose": messages.POSE_READERS,
    "phase": messages.PHASE_READERS,
    "opening": messages.OPENING_READERS,
    "truth": messages.TRUTH_READERS,
}
_SAMPLES: dict[Kind, Callable[[int, Any], Sample]] = {
    "pose": PoseSample,
    "phase": PhaseSample,
    "opening": OpeningSample,
    "truth": TruthSample,
}


@dataclass(frozen=True, slots=True)
class TrialTopics:
    """Which topic plays which part."""

    images: Mapping[Side, str]
    markers: Mapping[Side, str] = field(default_factory=dict)
    pose: str | None = None
    phase: str | None = None
    opening: str | None = None
    truth: str | None = None

    def roles(self) -> dict[str, Role]:
        """Topic → part."""
        found = {self.images[side]: Role("image", side) for side in SIDES if side in self.images}
        found |= {self.markers[side]: Role("markers", side) for side in SIDES if side in self.markers}
        single: tuple[tuple[Kind, str | None], ...] = (
            ("pose", self.pose),
            ("phase", self.phase),
            ("opening", self.opening),
            ("truth", self.truth),
        )
        return found | {topic: Role(kind) for kind, topic in single if topic is not None}


@dataclass(frozen=True, slots=True)
class Role:
    """The part of a topic, and the finger where there are two."""

    kind: Kind
    side: Side = "left"


class SampleReader:
    """Decodes messages of the topics in use.

    Args:
        source: Where the messages are.
        topics: Which topic plays which part.
        rig: Tells the image size.
        prepare: Crop, flip and scale an image, per side.
    """

    def __init__(
        self, source: MessageSource, topics: TrialTopics, rig: Rig, prepare: Mapping[Side, ImageStep]
    ) -> None:
        self.roles = topics.roles()
        self.undecodable: dict[str, list[int]] = {}
        self.start_ns: int | None = None
        self._source = source
        self._rig = rig
        self._prepare = prepare

    def sample(self, raw: RawMessage, stamp_ns: int) -> Sample | None:
        """The sample in a message; None for an image that cannot be decoded, which is remembered.

        Raises:
            RecordingError: wrong type, wrong size, or values that cannot be meant.
        """
        role = self.roles[raw.topic]
        if role.kind == "image":
            return self._image(raw, stamp_ns, role.side)
        if role.kind == "markers":
            return MarkerSample(role.side, stamp_ns, self.value(raw))
        return _SAMPLES[role.kind](stamp_ns, self.value(raw))

    def value(self, raw: RawMessage) -> Any:
        """Content of a message, checked.

        Raises:
            RecordingError: wrong type, or values that cannot be meant.
        """
        if self.start_ns is None:
            self.start_ns = raw.log_time_ns
        try:
            return self._read(raw)
        except MessageError as error:
            when = (raw.log_time_ns - self.start_ns) / NS
            raise RecordingError(f"{self._source.path}: {raw.topic}: at {when:.3f} s: {error}") from None

    def _read(self, raw: RawMessage) -> Any:
        readers = _READERS[self.roles[raw.topic].kind]
        reader = readers.get(raw.type)
        if reader is None:
            valid = " or ".join(readers)
            raise RecordingError(
                f"{self._source.path}: {raw.topic}: type is {raw.type or 'unknown'}, expected {valid}"
            )
        message = self._source.decode(raw)
        try:
            return reader(message)
        except AttributeError as error:
            raise RecordingError(
                f"{self._source.path}: {raw.topic}: the file's definition of {raw.type} is not ROS 2's ({error})"
            ) from None

    def _image(self, raw: RawMessage, stamp_ns: int, side: Side) -> ImageSample | None:
        try:
            image: Image = self._read(raw)
        except MessageError:
            self.undecodable.setdefault(raw.topic, []).append(raw.log_time_ns)
            return None
        if side in self._prepare:
            image = self._prepare[side](image)
        size, expected = (image.shape[1], image.shape[0]), self._rig.sensor(side).image_size_px
        if size != tuple(expected):
            raise RecordingError(
                f"{self._source.path}: {raw.topic}: images are {size[0]}x{size[1]} px, the rig file says "
                f"{expected[0]}x{expected[1]}: correct sensors.{side}.image_size_px and mm_per_px, or crop "
                "and resize with a map file"
            )
        return ImageSample(side, stamp_ns, image)
