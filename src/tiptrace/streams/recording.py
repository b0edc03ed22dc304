"""Reads the recording format: one trial, one MCAP file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tiptrace.config import Rig, Tool, parse_yaml, read_yaml
from tiptrace.errors import ConfigError, RecordingError
from tiptrace.streams.image_bytes import decode_image
from tiptrace.streams.mcap_source import McapSource
from tiptrace.streams.sample_reader import TrialTopics
from tiptrace.streams.survey import TopicSurvey
from tiptrace.streams.topics import (
    IMAGE_TOPIC,
    MARKER_TOPIC,
    OPENING_TOPIC,
    PHASE_TOPIC,
    POSE_TOPIC,
    REFERENCE_FILE,
    RIG_FILE,
    TOOL_FILE,
    TRIAL_FILE,
    TRUTH_TOPIC,
    Stamps,
)
from tiptrace.streams.trial_reader import TrialReader
from tiptrace.types import SIDES, Image, Sample, Side, TruthSample

STANDARD_TOPICS = TrialTopics(
    images=IMAGE_TOPIC,
    markers=MARKER_TOPIC,
    pose=POSE_TOPIC,
    phase=PHASE_TOPIC,
    opening=OPENING_TOPIC,
    truth=TRUTH_TOPIC,
)
_REMEDY = "; for other topics: tiptrace inspect SRC --write-map map.yaml, then --map map.yaml --rig rig.yaml"


class Recording:
    """A trial in the recording format, as a stream; can be iterated several times.

    Opening it reads everything once but the pixels and refuses what cannot give a right trajectory. A file
    that is cut off or damaged is used as far as it goes and :attr:`notes` says so.

    Args:
        path: The MCAP file.
        stamps: Which clock dates the messages: their headers', the recorder's (``log``), or ``auto``: the
            headers' if the two agree within a second.
        rig: In place of the attached ``rig.yaml``.
        tool: In place of the attached ``tool.yaml``.
        references: In place of the attached images of the untouched gels.

    Raises:
        RecordingError: cannot be read, or lacks what a trial needs.
        ConfigError: an attached settings file is wrong.
    """

    def __init__(
        self,
        path: Path,
        *,
        stamps: Stamps = "auto",
        rig: Rig | None = None,
        tool: Tool | None = None,
        references: Mapping[Side, Image] | None = None,
    ) -> None:
        self.path = path
        self._source = McapSource(path)
        self._rig = rig or self._read_rig()
        self._tool = tool or self._read_tool()
        self._reader = TrialReader(self._source, STANDARD_TOPICS, self._rig, stamps, remedy=_REMEDY)
        self._references = self._read_references(references or {})

    def __iter__(self) -> Iterator[Sample]:
        """Samples in log-time order, images decoded one by one; the truth is not among them."""
        return self._reader.samples()

    @property
    def rig(self) -> Rig:
        """What the user believes about the rig."""
        return self._rig

    @property
    def tool(self) -> Tool | None:
        """What is known of the tool."""
        return self._tool

    @property
    def references(self) -> dict[Side, Image]:
        """Images of the untouched gels."""
        return dict(self._references)

    @property
    def gel_models(self) -> dict[str, bytes]:
        """Attached ONNX files by name."""
        named = {self._rig.sensor(side).gel_model for side in SIDES}
        found = self._source.attachments
        return {name: data for name, data in found.items() if name.endswith(".onnx") or name in named}

    @property
    def trial(self) -> dict[str, Any]:
        """``trial.yaml``: free metadata, for reports only."""
        data = self._source.attachments.get(TRIAL_FILE)
        try:
            content = read_yaml(data, TRIAL_FILE) if data is not None else {}
        except ConfigError:
            content = None
        return content if isinstance(content, dict) else {}

    @property
    def notes(self) -> list[str]:
        """What a user should know about how far the recording could be used."""
        return self._reader.notes

    @property
    def survey(self) -> dict[str, TopicSurvey]:
        """Topics, counts and clocks."""
        return self._reader.survey

    def truth(self) -> list[TruthSample]:
        """The true tip, in order; empty where nobody knows it."""
        return self._reader.truth()

    # --- attachments ---------------------------------------------------------------------------------------

    def _read_rig(self) -> Rig:
        data = self._source.attachments.get(RIG_FILE)
        if data is None:
            cut = f" (it is {self._source.damage})" if self._source.damage else ""
            raise RecordingError(f"{self.path}: has no {RIG_FILE} attached{cut}; give one with --rig")
        return parse_yaml(Rig, data, f"{self.path}: {RIG_FILE}")

    def _read_tool(self) -> Tool | None:
        data = self._source.attachments.get(TOOL_FILE)
        return None if data is None else parse_yaml(Tool, data, f"{self.path}: {TOOL_FILE}")

    def _read_references(self, given: Mapping[Side, Image]) -> dict[Side, Image]:
        found: dict[Side, Image] = {}
        for side in SIDES:
            name = REFERENCE_FILE[side]
            where = f"{self.path}: {name}"
            if side in given:
                found[side], where = given[side], f"{side} reference"
            elif name in self._source.attachments:
                found[side] = decode_reference(self._source.attachments[name], where)
            if side in found:
                check_reference(found[side], self._rig, side, where)
        return found


def decode_reference(data: bytes, where: str) -> Image:
    """Image of an untouched gel from a file's bytes.

    Raises:
        RecordingError: not an image.
    """
    image = decode_image(data)
    if image is None:
        raise RecordingError(f"{where}: is not an image that can be decoded; give a png or jpeg file")
    return image


def check_reference(image: Image, rig: Rig, side: Side, where: str) -> None:
    """A reference must have the size of the images.

    Raises:
        RecordingError: it has not.
    """
    expected = rig.sensor(side).image_size_px
    if (image.shape[1], image.shape[0]) != tuple(expected):
        raise RecordingError(
            f"{where}: reference is {image.shape[1]}x{image.shape[0]} px, the {side} images are "
            f"{expected[0]}x{expected[1]}: take it with the same crop and size"
        )
