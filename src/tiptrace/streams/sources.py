"""Opens a recording of any origin from what a user gives on the command line."""

from __future__ import annotations

from pathlib import Path

from tiptrace.config import Rig, Tool, load_yaml
from tiptrace.errors import ConfigError, RecordingError
from tiptrace.streams.foreign import ForeignRecording
from tiptrace.streams.mapping import MapFile, parse_frame_range
from tiptrace.streams.recording import Recording, decode_reference
from tiptrace.streams.topics import Stamps
from tiptrace.types import Image, Side


def open_recording(
    path: Path,
    *,
    map_file: Path | None = None,
    rig: Path | None = None,
    tool: Path | None = None,
    reference_left: Path | None = None,
    reference_right: Path | None = None,
    reference_frames: str | None = None,
    stamps: Stamps = "auto",
) -> Recording | ForeignRecording:
    """A recording in tiptrace's format, or with a map file anybody's.

    Args:
        path: MCAP file, rosbag2 folder or ``.db3`` file.
        map_file: ``map.yaml``; needs ``rig``. Without it the file must be in the recording format.
        rig: ``rig.yaml``, in place of the attached one.
        tool: ``tool.yaml``, in place of the attached one.
        reference_left: Image of the untouched left gel, in place of the attached one.
        reference_right: Image of the untouched right gel.
        reference_frames: ``0:20``: the mean of these frames is the reference (with a map file).
        stamps: Which clock dates the messages.

    Raises:
        RecordingError: cannot be read, or lacks what a trial needs.
        ConfigError: a settings file is wrong, or arguments do not go together.
    """
    rig_model = load_yaml(Rig, rig) if rig is not None else None
    tool_model = load_yaml(Tool, tool) if tool is not None else None
    given: dict[Side, Path | None] = {"left": reference_left, "right": reference_right}
    references = {side: _load_image(p) for side, p in given.items() if p is not None}
    if map_file is None:
        if reference_frames is not None:
            raise ConfigError(
                "reference frames need a map file; a recording in tiptrace's format has references"
            )
        if path.is_dir() or path.suffix == ".db3":
            raise RecordingError(
                f"{path}: is not in tiptrace's format; read it with a map and a rig file: "
                f"tiptrace inspect {path} --write-map map.yaml, then --map map.yaml --rig rig.yaml"
            )
        return Recording(path, stamps=stamps, rig=rig_model, tool=tool_model, references=references)
    if rig_model is None:
        raise ConfigError(
            f"{map_file}: a recording read with a map file needs a rig file too: --rig rig.yaml"
        )
    return ForeignRecording(
        path,
        load_yaml(MapFile, map_file),
        rig_model,
        tool=tool_model,
        references=references,
        reference_frames=parse_frame_range(reference_frames) if reference_frames is not None else None,
        stamps=stamps,
    )


def _load_image(path: Path) -> Image:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    return decode_reference(data, str(path))
