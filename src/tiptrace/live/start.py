"""From a rig file and addresses to a session: devices, references, gel models, and the health of the gels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tiptrace.calibration.gel_health import GelHealth, check_gel
from tiptrace.config import Rig, Tool, load_yaml
from tiptrace.drivers.opening import CAMERA_FORMS, open_camera, open_robot
from tiptrace.drivers.timeline import Timeline
from tiptrace.errors import ConfigError, PerceptionError, RecordingError
from tiptrace.live.recorder import Recorder
from tiptrace.live.session import LiveSession
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.streams.live import LiveStream
from tiptrace.streams.recording import check_reference, decode_reference
from tiptrace.streams.topics import REFERENCE_FILE, TOOL_FILE
from tiptrace.streams.writer import unfinished
from tiptrace.tracer import require_methods
from tiptrace.types import SIDES, Image, Side


@dataclass(frozen=True, slots=True)
class RigFolder:
    """A rig file and what lies beside it.

    Attributes:
        rig: The rig.
        tool: ``tool.yaml``, where there is one.
        references: ``reference_left.png`` and ``reference_right.png``, where there are.
        gel_models: Bytes of the gel models that are files, by the name in the rig file.
    """

    rig: Rig
    tool: Tool | None
    references: dict[Side, Image]
    gel_models: dict[str, bytes]


def read_rig_folder(rig_file: Path, tool_file: Path | None = None) -> RigFolder:
    """Read a rig file with the references, gel models and tool beside it.

    Raises:
        ConfigError: the rig or the tool is wrong.
        RecordingError: a reference is no image, or of another size than the images.
    """
    rig, folder = load_yaml(Rig, rig_file), rig_file.parent
    if tool_file is None and (folder / TOOL_FILE).is_file():
        tool_file = folder / TOOL_FILE
    references: dict[Side, Image] = {}
    for side in SIDES:
        path = folder / REFERENCE_FILE[side]
        if path.is_file():
            references[side] = decode_reference(path.read_bytes(), str(path))
            check_reference(references[side], rig, side, str(path))
    models = {}
    for side in SIDES:
        name = rig.sensor(side).gel_model
        found = [path for path in (folder / name, Path(name)) if path.is_file()]
        if found:
            models[name] = found[0].read_bytes()
    tool = None if tool_file is None else load_yaml(Tool, tool_file)
    return RigFolder(rig, tool, references, models)


def camera_addresses(rig: Rig, given: Mapping[Side, str | None]) -> dict[Side, str]:
    """Where each finger's camera is: as given, else as the rig file says.

    Raises:
        ConfigError: not told, or one camera for both fingers.
    """
    addresses: dict[Side, str] = {}
    for side in SIDES:
        camera = rig.sensor(side).camera
        told = given.get(side) or (camera.source if camera else None)
        if told is None and camera is not None and camera.serial:
            told = f"v4l2:{camera.serial}"
        if told is None:
            raise ConfigError(
                f"nothing says where the {side} camera is: run tiptrace setup, write sensors.{side}.camera.source "
                f"into the rig file, or give --{side}: {CAMERA_FORMS}"
            )
        addresses[side] = told
    if addresses["left"] == addresses["right"]:
        raise ConfigError(f"both fingers name the same camera, {addresses['left']!r}: give each its own")
    return addresses


def make_session(
    folder: RigFolder,
    addresses: Mapping[Side, str],
    robot: str,
    *,
    method: str = "full",
    out: Path | None = None,
    wait_for_mark: bool = False,
    trial: Mapping[str, Any] | None = None,
) -> LiveSession:
    """A session, nothing opened yet.

    Raises:
        TipTraceError: an address that means nothing, or a device that is not there.
    """
    require_methods(method)
    timeline, rig = Timeline(), folder.rig
    cameras = {
        side: open_camera(addresses[side], rig.sensor(side), timeline, encode=out is not None)
        for side in SIDES
    }
    stream = LiveStream(
        rig,
        cameras,
        open_robot(robot, timeline),
        timeline,
        tool=folder.tool,
        references=folder.references,
        gel_models=folder.gel_models,
    )
    recorder = None
    if out is not None:
        sources = {"robot": robot, **{str(side): address for side, address in addresses.items()}}
        recorder = Recorder(
            out,
            timeline,
            rig=rig,
            tool=folder.tool,
            references=folder.references,
            gel_models=folder.gel_models,
            trial={"sources": sources, **(trial or {})},
        )
    return LiveSession(stream, method, recorder=recorder, wait_for_mark=wait_for_mark)


def gel_health(stream: LiveStream) -> dict[Side, GelHealth | str]:
    """Health of each gel by the first image against the stored reference, or why it cannot be told."""
    found: dict[Side, GelHealth | str] = {}
    for side in SIDES:
        sensor, image = stream.rig.sensor(side), stream.first_images.get(side)
        reference = stream.references.get(side)
        if reference is None:
            found[side] = "no reference beside the rig file: run tiptrace setup"
            continue
        if image is None:
            found[side] = "no image yet"
            continue
        try:
            gel = load_gel_model(stream.gel_models.get(sensor.gel_model, sensor.gel_model))
            scale = (float(sensor.metres_per_px[0]), float(sensor.metres_per_px[1]))
            found[side] = check_gel([image], reference, gel, scale)[0]
        except PerceptionError as error:
            found[side] = str(error)
    return found


def refuse_to_overwrite(path: Path) -> None:
    """The target must be an ``.mcap`` file that is not there yet, nor an unfinished one of its name.

    Raises:
        RecordingError: it is, or it is none.
    """
    if path.suffix != ".mcap":
        raise RecordingError(f"{path}: recordings are MCAP files: give a name that ends in .mcap")
    for taken in (path, unfinished(path)):
        if taken.exists():
            raise RecordingError(f"{taken}: exists already; move it away, or give another name")
