"""Other people's recordings, read with a map file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from tiptrace.config import Rig, Tool
from tiptrace.errors import RecordingError
from tiptrace.streams.bag_source import BagSource
from tiptrace.streams.mapping import MapFile
from tiptrace.streams.mcap_source import MAGIC, McapSource
from tiptrace.streams.raw_messages import MessageSource, RawMessage
from tiptrace.streams.recording import check_reference
from tiptrace.streams.survey import TopicSurvey
from tiptrace.streams.tf_poses import TfPoses
from tiptrace.streams.topics import Stamps
from tiptrace.streams.trial_reader import TrialReader
from tiptrace.types import SIDES, FloatArray, Image, ImageSample, PoseSample, Sample, Side, TruthSample

_REMEDY = "; correct the map file (tiptrace inspect SRC lists what is there)"


def open_source(path: Path) -> MessageSource:
    """An MCAP file, a rosbag2 folder or a ``.db3`` file.

    Raises:
        RecordingError: none of these, or it cannot be opened.
    """
    if path.is_file():
        with path.open("rb") as file:
            is_mcap = file.read(len(MAGIC)) == MAGIC
        if is_mcap or path.suffix == ".mcap":
            return McapSource(path)
    if path.is_file() and path.suffix not in (".db3", ".bag"):
        raise RecordingError(
            f"{path}: is not a recording; give an MCAP file, a rosbag2 folder or a .db3 file"
        )
    return BagSource(path)


class ForeignRecording:
    """A rosbag2 recording with topics of its own, as a stream; can be iterated several times.

    Args:
        path: MCAP file, rosbag2 folder or ``.db3`` file.
        map_file: Which topics play which part.
        rig: What the user believes about the rig.
        tool: What is known of the tool.
        references: Images of the untouched gels as the camera gave them; they pass through the same crop, flip
            and resize as the images.
        reference_frames: In their place: (start, stop) of the frames whose mean is the reference, when the gels
            are untouched at the beginning.
        gel_models: ONNX files by the names under which the rig mentions them.
        stamps: Which clock dates the messages.

    Raises:
        RecordingError: cannot be read, or lacks what a trial needs.
        ConfigError: the map does not fit the images.
    """

    def __init__(
        self,
        path: Path,
        map_file: MapFile,
        rig: Rig,
        *,
        tool: Tool | None = None,
        references: Mapping[Side, Image] | None = None,
        reference_frames: tuple[int, int] | None = None,
        gel_models: Mapping[str, bytes] | None = None,
        stamps: Stamps = "auto",
    ) -> None:
        self.path = path
        self._map = map_file
        self._rig = rig
        self._tool = tool
        self._gel_models = dict(gel_models or {})
        self._stamps = stamps
        source = open_source(path)
        self._tf = TfPoses(source) if map_file.tf is not None else None
        self._reader = TrialReader(
            source,
            map_file.topics(),
            rig,
            stamps,
            prepare={side: map_file.image(side).prepare for side in SIDES},
            poses=self._chain_poses if self._tf is not None else None,
            watch=self._watch if self._tf is not None else None,
            remedy=_REMEDY,
        )
        self._references: dict[Side, Image] = {}
        if reference_frames is not None:
            self._references = self._mean_images(*reference_frames)
        for side, image in (references or {}).items():
            self._references[side] = map_file.image(side).prepare(image)
            check_reference(self._references[side], rig, side, f"{side} reference")

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
        """ONNX files by name."""
        return dict(self._gel_models)

    @property
    def trial(self) -> dict[str, object]:
        """Nothing: foreign recordings have no trial file."""
        return {}

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

    # --- poses from TF, references from frames -------------------------------------------------------------

    def _watch(self, raw: RawMessage) -> None:
        assert self._tf is not None
        assert self._map.tf is not None
        if raw.topic in self._map.tf.topics:
            self._tf.add(raw)

    def _chain_poses(self, use_log: bool) -> list[PoseSample]:
        assert self._tf is not None
        assert self._map.tf is not None
        frames = self._rig.frames
        for said, meant, key in (
            (self._map.tf.base, frames.base, "base"),
            (self._map.tf.end_effector, frames.end_effector, "end_effector"),
        ):
            if "frames" in self._rig.model_fields_set and said.strip("/") != meant.strip("/"):
                raise RecordingError(
                    f"{self.path}: the map file takes tf.{key} {said!r}, but frames.{key} of the rig file is "
                    f"{meant!r}: make them the same"
                )
        return self._tf.poses(self._map.tf, use_log, trust_header=self._stamps == "header")

    def _mean_images(self, start: int, stop: int) -> dict[Side, Image]:
        """Mean of frames start … stop − 1 of each side."""
        sums: dict[Side, FloatArray] = {}
        counts: dict[Side, int] = {"left": 0, "right": 0}
        for sample in self._reader.samples():
            if not isinstance(sample, ImageSample):
                continue
            counts[sample.side] += 1
            if start < counts[sample.side] <= stop:
                sums[sample.side] = sums.get(sample.side, np.zeros(1)) + sample.image
            if min(counts.values()) >= stop:
                break
        for side in SIDES:
            if counts[side] < stop:
                raise RecordingError(
                    f"{self.path}: {self._map.image(side).topic}: has {counts[side]} images, the reference frames "
                    f"{start}:{stop} ask for more"
                )
        return {
            side: np.asarray(np.rint(total / (stop - start)), dtype=np.uint8) for side, total in sums.items()
        }
