"""Writes a LeRobot dataset, v3.0 or v2.1, episode by episode; needs pyarrow and not the ``lerobot`` package."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.errors import MissingExtraError, OutputError
from tiptrace.export import lerobot_format as layout
from tiptrace.export.episodes import Episode, dataset_record, episode_record
from tiptrace.export.lerobot_format import Feature, Stats

DEFAULT_TASK = "trace a surface with a grasped tool"
_FILE_MB = 100
_TASKS_INDEX = {  # LeRobot looks tasks up by a pandas index of their names
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, kind, numpy_type in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ],
    "pandas_version": "2.2.0",
}


class LikeTheFirst:
    """All episodes of a LeRobot dataset have the same columns and the same rate."""

    def __init__(self) -> None:
        self._first: dict[str, Feature] | None = None
        self._fps = 0

    def __call__(self, episode: Episode) -> None:
        """Check an episode.

        Raises:
            OutputError: it does not fit those before it.
        """
        features, fps = layout.features_of(episode), rate_of(episode)
        if self._first is None:
            self._first, self._fps = features, fps
        elif features != self._first:
            odd = sorted(k for k in {*features, *self._first} if features.get(k) != self._first.get(k))
            raise OutputError(f"differs from the first episode in {', '.join(odd)}; export it apart")
        elif fps != self._fps:
            raise OutputError(f"has {fps} frames/s, the first episode {self._fps}; export it apart")


def rate_of(episode: Episode) -> int:
    """Nominal frames per second.

    Raises:
        OutputError: fewer than two frames, or stamps that do not rise.
    """
    steps = np.diff(episode.stamps[:, 0])
    if len(steps) == 0 or np.median(steps) <= 0:
        raise OutputError("has no frame rate: fewer than two frames, or stamps that do not rise")
    return max(1, round(1e9 / float(np.median(steps))))


def write_lerobot(
    folder: Path, episodes: Iterable[Episode], version: str = "v3.0", task: str = DEFAULT_TASK
) -> dict[str, Any]:
    """Write episodes, which :class:`LikeTheFirst` has let pass; returns the record kept in ``meta/tiptrace.json``.

    Timestamps are nominal, frame_index / fps, as LeRobot wants them; the recording's own are in ``frame.*stamp_ns``.

    Raises:
        ConfigError: an unknown version.
        MissingExtraError: no pyarrow.
    """
    layout.check_version(version)
    writer = _Writer(folder, version, task)
    for episode in episodes:
        writer.add(episode)
    return writer.finish()


class _Writer:
    def __init__(self, folder: Path, version: str, task: str) -> None:
        try:
            self._pa: Any = import_module("pyarrow")
            self._parquet: Any = import_module("pyarrow.parquet")
        except ImportError:
            raise MissingExtraError("pyarrow", "lerobot") from None
        self._folder, self._version, self._task = folder, version, task
        self._features: dict[str, Feature] = {}
        self._fps = 0
        self._records: list[dict[str, Any]] = []
        self._stats: list[Stats] = []
        self._rows: list[dict[str, Any]] = []  # of the table of episodes
        self._frames = 0
        self._file: tuple[Any, int, int] | None = None  # open parquet file (v3.0), its index, its bytes

    def add(self, episode: Episode) -> None:
        if not self._features:
            self._features, self._fps = layout.features_of(episode), rate_of(episode)
        columns = self._columns(episode)
        table = layout.table_of(self._pa, self._features, columns)
        index, n = len(self._rows), len(episode)
        place = self._write(index, table)
        stats = layout.stats_of(self._features, columns)
        stats |= {layout.IMAGE.format(side=side): images.stats() for side, images in episode.images.items()}
        self._stats.append(stats)
        span = {"dataset_from_index": self._frames, "dataset_to_index": self._frames + n}
        self._rows.append({"episode_index": index, "tasks": [self._task], "length": n, **place, **span})
        self._records.append(episode_record(episode))
        self._frames += n

    def _columns(self, episode: Episode) -> dict[str, Any]:
        n, index = len(episode), len(self._rows)
        columns = layout.tip_columns(episode, dataset_record([]))
        columns |= dict(zip(layout.STAMPS, episode.stamps.T, strict=True))
        if episode.state is not None:
            columns[layout.STATE] = episode.state.astype(np.float32)
        for side, images in episode.images.items():
            columns[layout.IMAGE.format(side=side)] = images.encoded
        return columns | {
            "timestamp": (np.arange(n) / self._fps).astype(np.float32),
            "frame_index": np.arange(n),
            "episode_index": np.full(n, index),
            "index": self._frames + np.arange(n),
            "task_index": np.zeros(n, dtype=np.int64),
        }

    def _write(self, index: int, table: Any) -> dict[str, int]:
        """Write an episode's rows; returns where, as the table of episodes tells it."""
        if self._version == "v2.1":
            name = layout.DATA["v2.1"].format(episode_chunk=index // layout.CHUNK, episode_index=index)
            path = self._made(name)
            self._parquet.write_table(table, path, row_group_size=max(1, len(table)))
            return {}
        if self._file is None or self._file[2] > _FILE_MB * 2**20:
            number = 0 if self._file is None else self._file[1] + 1
            self._close()
            place = {"chunk_index": number // layout.CHUNK, "file_index": number % layout.CHUNK}
            path = self._made(layout.DATA["v3.0"].format(**place))
            self._file = (self._parquet.ParquetWriter(path, table.schema), number, 0)
        file, number, size = self._file
        file.write_table(table, row_group_size=max(1, len(table)))
        self._file = (file, number, size + table.nbytes)
        return {"data/chunk_index": number // layout.CHUNK, "data/file_index": number % layout.CHUNK}

    def _close(self) -> None:
        if self._file is not None:
            self._file[0].close()

    def _made(self, name: str) -> Path:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def finish(self) -> dict[str, Any]:
        self._close()
        record = dataset_record(self._records)
        if not self._rows:
            return record
        write_json(self._made(layout.RECORD), record)
        write_json(self._made(layout.INFO), self._info())
        if self._version == "v2.1":
            self._finish_v21()
        else:
            self._finish_v30()
        return record

    def _info(self) -> dict[str, Any]:
        old = self._version == "v2.1"
        n = len(self._rows)
        sizes = {"data_files_size_in_mb": _FILE_MB, "video_files_size_in_mb": 200}
        return {
            "codebase_version": self._version,
            "robot_type": None,
            "total_episodes": n,
            "total_frames": self._frames,
            "total_tasks": 1,
            **({"total_videos": 0, "total_chunks": -(-n // layout.CHUNK)} if old else sizes),
            "chunks_size": layout.CHUNK,
            "fps": self._fps,
            "splits": {"train": f"0:{n}"},
            "data_path": layout.DATA[self._version],
            "video_path": None,
            "features": {name: feature.info() for name, feature in self._features.items()},
        }

    def _finish_v21(self) -> None:
        write_lines(self._made(layout.TASKS["v2.1"]), [{"task_index": 0, "task": self._task}])
        keys = ("episode_index", "tasks", "length")
        write_lines(self._made(layout.EPISODES["v2.1"]), [{k: row[k] for k in keys} for row in self._rows])
        empty = {
            n for n, s in layout.pooled(self._stats).items() if s["count"] == [0]
        }  # lerobot divides by it
        rows = [
            {name: {**s, "count": [1]} if name in empty else s for name, s in stats.items()}
            for stats in self._stats
        ]
        stats = [{"episode_index": k, "stats": row} for k, row in enumerate(rows)]
        write_lines(self._made(layout.EPISODES_STATS), stats)

    def _finish_v30(self) -> None:
        pa = self._pa
        tasks = pa.table({"task_index": pa.array([0], pa.int64()), "task": [self._task]})
        tasks = tasks.replace_schema_metadata({"pandas": json.dumps(_TASKS_INDEX)})
        self._parquet.write_table(tasks, self._made(layout.TASKS["v3.0"]))
        rows = [
            {
                **row,
                **{f"stats/{name}/{key}": v for name, kinds in stats.items() for key, v in kinds.items()},
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for row, stats in zip(self._rows, self._stats, strict=True)
        ]
        self._parquet.write_table(pa.Table.from_pylist(rows), self._made(layout.EPISODES["v3.0"]))
        write_json(self._made(layout.STATS), layout.pooled(self._stats))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a readable JSON file."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_lines(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write JSON lines."""
    path.write_text("".join(json.dumps(row, allow_nan=False) + "\n" for row in rows), encoding="utf-8")
