"""LeRobot datasets with tactile images as input: each episode a stream, at the dataset's own frames."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tiptrace.config import Rig, Tool
from tiptrace.errors import ConfigError, MissingExtraError, RecordingError
from tiptrace.export.lerobot_format import EPISODES, INFO, PHASE, STAMPS, STATE
from tiptrace.geometry.transforms import rotation_from_quaternion, transform
from tiptrace.types import (
    SIDES,
    FloatArray,
    Image,
    ImageSample,
    Phase,
    PhaseSample,
    PoseSample,
    Sample,
    Side,
)

_PHASES = ("", *(p.value for p in Phase))


@dataclass(frozen=True, slots=True)
class LeRobotInput:
    """A dataset and the columns of it that a tracer needs.

    Attributes:
        root: Its folder.
        info: Content of ``meta/info.json``.
        tactile: Image column of each finger.
        pose: Column of the end effector's pose in the base frame: x y z in m, qx qy qz qw.
        episodes: Row of each episode in the table of episodes.
    """

    root: Path
    info: Mapping[str, Any]
    tactile: Mapping[Side, str]
    pose: str
    episodes: tuple[Mapping[str, Any], ...]

    @property
    def version(self) -> str:
        """``v3.0`` or ``v2.1``."""
        return str(self.info["codebase_version"])

    def data_file(self, index: int) -> Path:
        """Parquet file with the rows of an episode."""
        return self.root / str(self.info["data_path"]).format(**self._place(index, "data"))

    def video_file(self, index: int, key: str) -> tuple[Path, float]:
        """Video with an episode's frames of a camera, and the second at which they begin."""
        begin = float(self.episodes[index].get(f"videos/{key}/from_timestamp", 0.0))
        name = self.info["video_path"].format(video_key=key, **self._place(index, f"videos/{key}"))
        return self.root / name, begin

    def _place(self, index: int, what: str) -> dict[str, int]:
        if self.version == "v2.1":
            return {"episode_chunk": index // int(self.info["chunks_size"]), "episode_index": index}
        return {k: int(self.episodes[index][f"{what}/{k}"]) for k in ("chunk_index", "file_index")}


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file()


def open_lerobot(root: Path, columns: Mapping[str, str] | None = None) -> LeRobotInput:
    """Open a dataset.

    Args:
        root: Its folder.
        columns: Which columns are ``left``, ``right`` and ``pose``, where their names do not tell.

    Raises:
        RecordingError: not a dataset of version 2.1 or 3.0, or damaged.
        ConfigError: it has no tactile images or no poses.
    """
    given = columns or {}
    try:
        info = json.loads((root / INFO).read_text(encoding="utf-8"))
        version, features = info["codebase_version"], info["features"]
        if version not in EPISODES:
            raise RecordingError(f"{root}: LeRobot {version}; tiptrace reads {', '.join(EPISODES)}")
        episodes = _episodes(root / EPISODES[version])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{root}: not a LeRobot dataset that can be read ({error!r})") from None
    tactile: dict[Side, str] = {side: _tactile(root, features, side, given.get(side)) for side in SIDES}
    pose = given.get("pose", STATE)
    if pose not in features or list(features[pose]["shape"]) != [7]:
        what = f"has the shape {features[pose]['shape']}" if pose in features else "is not in it"
        raise ConfigError(
            f"{root}: '{pose}' {what}; a tracer needs the end effector's pose, x y z qx qy qz qw in the base "
            "frame: name its column with --columns pose=NAME"
        )
    return LeRobotInput(root, info, tactile, pose, episodes)


def _tactile(root: Path, features: Mapping[str, Any], side: Side, given: str | None) -> str:
    images = [name for name, f in features.items() if f["dtype"] in ("image", "video")]
    found = [n for n in images if "tactile" in n.lower() and side in n.lower()] if given is None else [given]
    if len(found) != 1 or found[0] not in images:
        has = ", ".join(images) or "no images at all"
        raise ConfigError(
            f"{root}: no tactile images of the {side} finger (it has {has}); name the column with "
            f"--columns {side}=NAME"
        )
    return found[0]


def _episodes(path: Path) -> tuple[Mapping[str, Any], ...]:
    if path.suffix == ".jsonl":
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]
    else:
        files = sorted(path.parent.parent.rglob("*.parquet"))
        rows = [row for file in files for row in arrow("parquet").read_table(file).to_pylist()]
    return tuple(sorted(rows, key=lambda row: int(row["episode_index"])))


def arrow(part: str = "") -> Any:
    """``pyarrow`` or a part of it.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        return import_module(f"pyarrow.{part}" if part else "pyarrow")
    except ImportError:
        raise MissingExtraError("pyarrow", "lerobot") from None


@dataclass
class LeRobotStream:
    """An episode as a stream; implements ``types.Stream``.

    Attributes:
        source: The dataset.
        index: Episode.
        rig: What the user believes about the rig.
        tool: What is known of the tool.
        references: Images of the untouched gels.
        gel_models: None travel with such a dataset.
        stamps: (n, 3) of each row: frame, left and right image, ns; the recording's where the dataset has them.
    """

    source: LeRobotInput
    index: int
    rig: Rig
    tool: Tool | None = None
    references: dict[Side, Image] = field(default_factory=dict)
    gel_models: dict[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        path, wanted = self.source.data_file(self.index), [("episode_index", "=", self.index)]
        try:
            self._table = arrow("parquet").read_table(path, filters=wanted)
        except (OSError, ValueError) as error:
            raise RecordingError(f"{path}: cannot be read ({error})") from None
        names = self._table.column_names
        if set(STAMPS) <= set(names):
            self.stamps = np.array([self._table[n].to_pylist() for n in STAMPS], dtype=np.int64).T
        else:
            seconds = np.array(self._table["timestamp"].to_pylist(), dtype=np.float64)
            self.stamps = np.repeat(np.round(seconds * 1e9).astype(np.int64)[:, None], 3, axis=1)

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[Sample]:
        """Deliver the samples, row by row."""
        poses = np.array(self._table[self.source.pose].to_pylist(), dtype=np.float64)  # (n, 7)
        phases = self._table[PHASE].to_pylist() if PHASE in self._table.column_names else [0] * len(self)
        images = {side: self.images(side) for side in SIDES}
        before = ""
        for stamps, pose, phase in zip(self.stamps.tolist(), poses, phases, strict=True):
            if _PHASES[phase] != before:
                before = _PHASES[phase]
                yield PhaseSample(min(stamps), Phase(before))
            yield PoseSample(stamps[0], _matrix(pose))
            for side, stamp in zip(SIDES, stamps[1:], strict=True):
                yield ImageSample(side, stamp, next(images[side]))

    def images(self, side: Side) -> Iterator[Image]:
        """Images of a finger, (h, w, 3) BGR, one per row.

        Raises:
            RecordingError: one cannot be decoded, or there are too few.
        """
        key = self.source.tactile[side]
        if self.source.info["features"][key]["dtype"] == "video":
            yield from _video(*self.source.video_file(self.index, key), len(self))
            return
        for cell in self._table[key].to_pylist():
            data = cell["bytes"] or (self.source.root / cell["path"]).read_bytes()
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            if image is None:
                raise RecordingError(f"{self.source.root}: an image of '{key}' cannot be decoded")
            yield np.asarray(image, dtype=np.uint8)


def _matrix(pose: FloatArray) -> FloatArray:
    q = pose[3:] / max(float(np.linalg.norm(pose[3:])), 1e-12)  # single precision
    return transform(rotation_from_quaternion(q), pose[:3])


def _video(path: Path, begin_s: float, count: int) -> Iterator[Image]:
    try:
        av: Any = import_module("av")
    except ImportError:
        raise MissingExtraError("av", "lerobot") from None
    given = 0
    try:
        with av.open(str(path)) as container:
            container.seek(
                round(begin_s * av.time_base)
            )  # to the key frame before: many episodes share a file
            for frame in container.decode(video=0):
                if frame.time < begin_s - 1e-4:
                    continue
                if given == count:
                    return
                given += 1
                yield np.asarray(frame.to_ndarray(format="bgr24"), dtype=np.uint8)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be decoded ({error})") from None
    if given < count:
        raise RecordingError(f"{path}: holds {given} of the episode's {count} frames")
