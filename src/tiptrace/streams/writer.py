"""Writes the recording format: one trial, one MCAP file that ros2 bag, Foxglove and Rerun open as it is."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal, Self

import cv2
import yaml

from tiptrace.config import Rig, Tool, dump_yaml
from tiptrace.errors import RecordingError
from tiptrace.streams import messages
from tiptrace.streams.topics import (
    FRAME_ID,
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
)
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
    Stream,
)

_CHUNK_BYTES = 64 * 1024  # about 0.1 s of two 25 Hz image streams: what a crash or a cut can cost


def unfinished(path: Path) -> Path:
    """What a recording is called while it is written."""
    return path.with_name(f"{path.stem}.partial.mcap")


class RecordingWriter:
    """Context manager that writes one trial.

    Everything goes to ``<name>.partial.mcap`` beside the target, which takes its name only when the block
    ends without an exception. Otherwise the partial file is closed properly and stays, readable as far as
    it goes; the target is never half-written.

    Args:
        path: Target, ``*.mcap``.
        rig: What the user believes about the rig.
        tool: What is known of the tool.
        trial: Free metadata for reports.
        references: Images of the untouched gels.
        gel_models: ONNX files by the names under which the rig mentions them.
        image_format: ``jpeg`` or (ten times slower, lossless) ``png``.
        jpeg_quality: 0 to 100.
        overwrite: Whether a target or an unfinished file of that name may be replaced.
        chunk_bytes: What is buffered before it is handed to the file.
    """

    def __init__(
        self,
        path: Path,
        *,
        rig: Rig,
        tool: Tool | None = None,
        trial: Mapping[str, Any] | None = None,
        references: Mapping[Side, Image] | None = None,
        gel_models: Mapping[str, bytes] | None = None,
        image_format: Literal["jpeg", "png"] = "jpeg",
        jpeg_quality: int = 95,
        overwrite: bool = True,
        chunk_bytes: int = _CHUNK_BYTES,
    ) -> None:
        self.path = path
        self._overwrite, self._chunk_bytes = overwrite, chunk_bytes
        self.partial_path = unfinished(path)
        self._base = rig.frames.base
        self._image_format = image_format
        self._jpeg_quality = jpeg_quality
        self._attachments = _attachments(rig, tool, trial, references or {}, gel_models or {})
        self._schemas: dict[str, Any] = {}
        self._sequence: dict[str, int] = {}
        self._file: IO[bytes] | None = None
        self._writer: Any = None

    def __enter__(self) -> Self:
        """Open the partial file and put the attachments first, so that a file cut off still has them.

        Raises:
            RecordingError: it cannot be opened, or is there already and must not be overwritten.
        """
        from mcap_ros2.writer import Writer

        if not self._overwrite:
            self._refuse_to_overwrite()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.partial_path.open("wb")
        except OSError as error:
            raise self._refused(error) from None
        self._writer = Writer(self._file, chunk_size=self._chunk_bytes)
        for name, (media_type, data) in self._attachments.items():
            self._writer.add_attachment(0, 0, name, media_type, data)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file; give it its name if all went well."""
        assert self._file is not None
        try:
            try:
                self._writer.finish()
            finally:
                self._file.close()
            if kind is None:
                os.replace(self.partial_path, self.path)
        except OSError as error:
            raise self._refused(error) from None

    def write(self, sample: Sample, *, log_time_ns: int | None = None, encoded: bytes | None = None) -> None:
        """Add one sample, logged at its own stamp unless told otherwise.

        Args:
            sample: What to write.
            log_time_ns: The recorder's clock.
            encoded: An image as it is to be stored, in the writer's format; else it is encoded here.

        Raises:
            RecordingError: a stamp before 1970, which the format cannot hold; a disk that is full.
        """
        log_time_ns = sample.stamp_ns if log_time_ns is None else log_time_ns
        if min(sample.stamp_ns, log_time_ns) < 0:
            raise RecordingError(f"{self.path}: stamp {sample.stamp_ns} ns is negative; count from 1970")
        topic, message_type, message = (
            self._message(sample) if encoded is None else self._stored(sample, encoded)
        )
        if message_type not in self._schemas:
            text = messages.schema_text(message_type)
            self._schemas[message_type] = self._writer.register_msgdef(message_type, text)
        sequence = self._sequence[topic] = self._sequence.get(topic, -1) + 1
        try:
            self._writer.write_message(
                topic, self._schemas[message_type], message, log_time_ns, sample.stamp_ns, sequence
            )
        except OSError as error:
            raise self._refused(error) from None

    def sync(self, note: Mapping[str, str] | None = None) -> None:
        """Put on the disk what was written; ``note`` is kept as metadata ``sync``.

        Raises:
            RecordingError: the disk is full.
        """
        assert self._file is not None
        try:
            if note is not None:
                self._writer.add_metadata("sync", dict(note))
            self._writer._writer.flush()  # ends the chunk, too; the ROS 2 writer does not pass it on
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._refused(error) from None

    def _refuse_to_overwrite(self) -> None:
        for path in (self.path, self.partial_path):
            if path.exists():
                raise RecordingError(f"{path}: exists already; move it away, or give another name")

    def _refused(self, error: OSError) -> RecordingError:
        return RecordingError(f"{self.partial_path}: cannot be written ({error.strerror})")

    def _stored(self, sample: Sample, encoded: bytes) -> tuple[str, str, dict[str, Any]]:
        """The same for an image that is encoded already."""
        assert isinstance(sample, ImageSample)
        header = messages.header_message(sample.stamp_ns, FRAME_ID[sample.side])
        message = {"header": header, "format": self._image_format, "data": encoded}
        return IMAGE_TOPIC[sample.side], "sensor_msgs/msg/CompressedImage", message

    def _message(self, sample: Sample) -> tuple[str, str, dict[str, Any]]:
        """Topic, type and content of a sample."""
        stamp_ns, base = sample.stamp_ns, self._base
        if isinstance(sample, ImageSample):
            message = messages.compressed_message(
                sample.image, stamp_ns, FRAME_ID[sample.side], self._image_format, self._jpeg_quality
            )
            return IMAGE_TOPIC[sample.side], "sensor_msgs/msg/CompressedImage", message
        if isinstance(sample, MarkerSample):
            message = messages.marker_message(sample.x_S, stamp_ns, FRAME_ID[sample.side])
            return MARKER_TOPIC[sample.side], "sensor_msgs/msg/PointCloud2", message
        if isinstance(sample, PoseSample):
            message = messages.pose_message(sample.T_B_E, stamp_ns, base)
            return POSE_TOPIC, "geometry_msgs/msg/PoseStamped", message
        if isinstance(sample, PhaseSample):
            return PHASE_TOPIC, "std_msgs/msg/String", {"data": sample.phase.value}
        if isinstance(sample, OpeningSample):
            return OPENING_TOPIC, "std_msgs/msg/Float64", {"data": sample.opening_m}
        message = {
            "header": messages.header_message(stamp_ns, base),
            "point": messages.xyz_message(sample.p_B),
        }
        return TRUTH_TOPIC, "geometry_msgs/msg/PointStamped", message


def write_recording(
    path: Path,
    stream: Stream,
    *,
    trial: Mapping[str, Any] | None = None,
    image_format: Literal["jpeg", "png"] = "jpeg",
    jpeg_quality: int = 95,
    progress: Callable[[Sample], None] | None = None,
) -> None:
    """Write a whole stream; ``progress`` is called after each sample.

    Raises:
        RecordingError: the file cannot be written. Whatever the stream raises passes through; what came
            before it stays in ``<name>.partial.mcap``.
    """
    writer = RecordingWriter(
        path,
        rig=stream.rig,
        tool=stream.tool,
        trial=trial,
        references=stream.references,
        gel_models=stream.gel_models,
        image_format=image_format,
        jpeg_quality=jpeg_quality,
    )
    with writer:
        for sample in stream:
            writer.write(sample)
            if progress is not None:
                progress(sample)


def _attachments(
    rig: Rig,
    tool: Tool | None,
    trial: Mapping[str, Any] | None,
    references: Mapping[Side, Image],
    gel_models: Mapping[str, bytes],
) -> dict[str, tuple[str, bytes]]:
    """Attachment name → media type, content."""
    found = {RIG_FILE: ("application/yaml", dump_yaml(rig).encode())}
    if tool is not None:
        found[TOOL_FILE] = ("application/yaml", dump_yaml(tool).encode())
    if trial is not None:
        text: str = yaml.safe_dump(dict(trial), sort_keys=False)
        found[TRIAL_FILE] = ("application/yaml", text.encode())
    for side in SIDES:
        if side in references:
            _, data = cv2.imencode(".png", references[side])
            found[REFERENCE_FILE[side]] = ("image/png", data.tobytes())
    for name, content in gel_models.items():
        found[name] = ("application/octet-stream", content)
    return found
