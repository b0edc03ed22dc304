"""The sound files that ``fuzz_inputs.py`` mutates: a short trial, its settings, a gel model, bags."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import yaml
from fuzz_models import weights_file

from tiptrace.config import dump_yaml
from tiptrace.sim.spec import TrialSpec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.writer import RecordingWriter
from tiptrace.types import ImageSample, Phase, PhaseSample

PAIRS = 10
MAP = """format: tiptrace-map/1
left:
  topic: /tactile/left/image/compressed
  crop_px: [0, 0, 320, 240]
  flip: none
  resize_px: [320, 240]
right:
  topic: /tactile/right/image/compressed
pose: /ee_pose
phase: /trial/phase
opening: /gripper/opening
"""


@dataclass(frozen=True)
class Sound:
    """Paths of the sound files."""

    trial: Path
    rig: Path
    tool: Path
    map_file: Path
    model: Path
    reference: Path
    reference_right: Path
    weights: Path
    bags: tuple[Path, ...]

    @property
    def foreign(self) -> list[str]:
        """Options with which a bag is read."""
        references = ["--reference-left", str(self.reference), "--reference-right", str(self.reference_right)]
        return ["--map", str(self.map_file), "--rig", str(self.rig), *references]


def make_sound(folder: Path) -> Sound:
    """Write them; the trial is the beginning of a simulated one, its left model attached."""
    folder.mkdir()
    stream = SimulatedStream(TrialSpec(seed=3, level="nominal"))
    model = (files("tiptrace") / "models" / "gelsight-mini-virtual.onnx").read_bytes()
    left = stream.rig.sensors.left.model_copy(update={"gel_model": "gel_left.onnx"})
    rig = stream.rig.model_copy(update={"sensors": stream.rig.sensors.model_copy(update={"left": left})})
    paths = Sound(
        folder / "trial.mcap",
        folder / "rig.yaml",
        folder / "tool.yaml",
        folder / "map.yaml",
        folder / "gel.onnx",
        folder / "left.png",
        folder / "right.png",
        folder / "weights.pt",
        (folder / "bag_sqlite", folder / "bag_mcap"),
    )
    samples = [sample for frame in islice(stream.frames(), PAIRS) for sample in frame.samples]
    stamps = sorted(s.stamp_ns for s in samples if isinstance(s, ImageSample))
    middle = PhaseSample(stamps[len(stamps) // 2], Phase.RECONSTRUCTION)
    with RecordingWriter(
        paths.trial,
        rig=rig,
        tool=stream.tool,
        trial={"seed": 3},
        references=stream.references,
        gel_models={"gel_left.onnx": model},
    ) as writer:
        for sample in [*samples, middle]:
            writer.write(sample)
    paths.rig.write_text(dump_yaml(stream.rig))
    paths.tool.write_text(dump_yaml(stream.tool) if stream.tool else "format: tiptrace-tool/1\n")
    paths.map_file.write_text(MAP)
    paths.model.write_bytes(model)
    cv2.imwrite(str(paths.reference), stream.references["left"])
    cv2.imwrite(str(paths.reference_right), stream.references["right"])
    paths.weights.write_bytes(weights_file())
    for path in paths.bags:
        _write_bag(paths.trial, path)
    return paths


def _write_bag(trial: Path, folder: Path) -> None:
    """The same messages as a rosbag2 folder."""
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    plugin = StoragePlugin.SQLITE3 if "sqlite" in folder.name else StoragePlugin.MCAP
    source = AnyReader([trial], default_typestore=store)
    source.open()
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connections: dict[Any, Any] = {}
        for connection, stamp_ns, data in source.messages():
            if connection.id not in connections:
                connections[connection.id] = writer.add_connection(
                    connection.topic, connection.msgtype, typestore=store
                )
            writer.write(connections[connection.id], stamp_ns, data)
    source.close()
    metadata = folder / "metadata.yaml"
    assert yaml.safe_load(metadata.read_text())
