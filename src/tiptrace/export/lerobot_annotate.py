"""A LeRobot dataset copied with the tip at each of its frames: three columns and two more, nothing else changed."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tiptrace.config import Rig, Tool, load_yaml
from tiptrace.errors import ConfigError, OutputError, TipTraceError
from tiptrace.export import lerobot_format as layout
from tiptrace.export.dataset import Exported
from tiptrace.export.episodes import Episode, dataset_record, episode_record, traced_episode
from tiptrace.export.lerobot_reader import LeRobotInput, LeRobotStream, arrow
from tiptrace.export.lerobot_writer import write_json, write_lines
from tiptrace.streams.mapping import parse_frame_range
from tiptrace.types import SIDES, Image, Side, Status, TipEstimate


def annotate(
    source: LeRobotInput,
    out: Path,
    rig: Path,
    tool: Path | None = None,
    references: Mapping[Side, Path] | None = None,
    reference_frames: str | None = None,
    method: str = "full",
    on_done: Callable[[str], None] = lambda name: None,
) -> Exported:
    """Write the copy; an episode that cannot be traced keeps its rows, none of them valid, and is reported.

    Args:
        source: The dataset.
        out: Folder of the copy; must not exist.
        rig: ``rig.yaml``.
        tool: ``tool.yaml``, where it is known.
        references: Images of the untouched gels.
        reference_frames: Or the frames of each episode that show them, e.g. ``0:20``.
        method: Method.
        on_done: Called with the name of each episode.

    Raises:
        ConfigError: a settings file is wrong, or the dataset holds tip positions already.
        OutputError: the copy exists, cannot be written, or no episode at all could be traced.
    """
    there = sorted(set(layout.TIP_FEATURES) & set(source.info["features"]) - {layout.PHASE})
    if there:
        raise ConfigError(f"{source.root}: holds {', '.join(there)} already")
    if out.exists():
        raise OutputError(f"{out}: exists already; choose another --out, or remove it")
    partial = out.with_name(f".{out.name}.part")
    untouched: dict[Side, Image] = {side: _image(path) for side, path in (references or {}).items()}
    about = (load_yaml(Rig, rig), None if tool is None else load_yaml(Tool, tool), untouched)
    copy = _Copy(source, partial)
    failures: list[tuple[str, str]] = []
    try:
        copy.begin()
        for index in range(len(source.episodes)):
            name = f"episode {index}"
            try:
                episode = _traced(LeRobotStream(source, index, *about), reference_frames, method)
            except TipTraceError as error:
                failures.append((name, str(error)))
                episode = _nothing(source, index, method)
            copy.add(index, episode)
            on_done(name)
        if len(failures) == len(source.episodes):
            raise OutputError(
                f"{out}: not written, no episode could be traced ({failures[0][1] if failures else ''})"
            )
        record = copy.finish()
        partial.rename(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error})") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Exported(record, failures)


def _traced(stream: LeRobotStream, reference_frames: str | None, method: str) -> Episode:
    """An episode with a row for each of the dataset's, whatever the synchroniser left out."""
    if reference_frames is not None:
        stream.references = _references(stream, reference_frames)
    traced = traced_episode(f"episode {stream.index}", stream, method)
    row_of = {int(stamp): k for k, stamp in enumerate(traced.stamps[:, 1])}
    rows = [row_of.get(int(stamp), -1) for stamp in stream.stamps[:, 1]]
    known = np.array(rows) >= 0
    return Episode(
        name=traced.name,
        method=method,
        stamps=stream.stamps,
        position=np.where(known[:, None], traced.position[rows], np.nan),
        covariance=np.where(known[:, None, None], traced.covariance[rows], np.nan),
        valid=known & traced.valid[rows],
        status=tuple(traced.status[k] if k >= 0 else Status.LOST.value for k in rows),
        phase=tuple(traced.phase[k] if k >= 0 else "" for k in rows),
    )


def _image(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ConfigError(f"{path}: not an image that can be read")
    return np.asarray(image, dtype=np.uint8)


def _references(stream: LeRobotStream, frames: str) -> dict[Side, Image]:
    """Mean image of the frames that show the untouched gel."""
    start, end = parse_frame_range(frames)
    found: dict[Side, Image] = {}
    for side in SIDES:
        chosen = [image for k, image in zip(range(end), stream.images(side), strict=False) if k >= start]
        if not chosen:
            raise ConfigError(f"reference frames {frames}: the episode has {len(stream)} frames")
        found[side] = np.asarray(np.round(np.mean(chosen, axis=0)), dtype=np.uint8)
    return found


def _nothing(source: LeRobotInput, index: int, method: str) -> Episode:
    n = int(source.episodes[index]["length"])
    rows = [TipEstimate(k, None, Status.LOST) for k in range(n)]
    return Episode.of(f"episode {index}", method, np.zeros((n, 3), dtype=np.int64), rows)


class _Copy:
    """The copied dataset as it grows; files without rows are linked, not copied, where that can be."""

    def __init__(self, source: LeRobotInput, folder: Path) -> None:
        self._source, self._folder = source, folder
        self._features = {k: f for k, f in layout.TIP_FEATURES.items() if k not in source.info["features"]}
        self._waiting: dict[Path, dict[int, Mapping[str, Any]]] = {}
        self._stats: list[layout.Stats] = []
        self._records: list[dict[str, Any]] = []

    def begin(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        changed = [self._source.root / "data", self._source.root / "meta"]

        def link(old: str, new: str) -> str:
            if not any(Path(old).is_relative_to(folder) for folder in changed):
                try:
                    os.link(old, new)
                    return new
                except OSError:
                    pass
            return str(shutil.copyfile(old, new))

        shutil.copytree(self._source.root, self._folder, copy_function=link)

    def add(self, index: int, episode: Episode) -> None:
        """Take an episode; a file is rewritten when all of its episodes are there."""
        columns = layout.tip_columns(episode, dataset_record([]))
        self._stats.append(layout.stats_of(self._features, columns))
        self._records.append(episode_record(episode))
        file = self._source.data_file(index)
        self._waiting.setdefault(file, {})[index] = columns
        following = index + 1
        if following == len(self._source.episodes) or self._source.data_file(following) != file:
            self._rewrite(file, self._waiting.pop(file))

    def _rewrite(self, file: Path, episodes: Mapping[int, Mapping[str, Any]]) -> None:
        pa, parquet = arrow(), arrow("parquet")
        table = parquet.read_table(file)
        order = list(dict.fromkeys(table["episode_index"].to_pylist()))
        for name, feature in self._features.items():
            values = np.concatenate([episodes[index][name] for index in order])
            kind = feature.arrow(pa)
            if feature.shape == (1,):
                column = pa.array(values, kind)
            else:
                column = pa.FixedSizeListArray.from_arrays(np.ravel(values), feature.shape[0])
            table = table.append_column(pa.field(name, kind), column)
        metadata = dict(table.schema.metadata or {})
        if b"huggingface" in metadata:
            known = json.loads(metadata[b"huggingface"])
            known["info"]["features"] |= {n: f.hugging_face() for n, f in self._features.items()}
            metadata[b"huggingface"] = json.dumps(known).encode()
            table = table.replace_schema_metadata(metadata)
        parquet.write_table(table, self._folder / file.relative_to(self._source.root))

    def finish(self) -> dict[str, Any]:
        record = dataset_record(self._records)
        meta, features = self._folder, {n: f.info() for n, f in self._features.items()}
        info = {**self._source.info, "features": {**self._source.info["features"], **features}}
        write_json(meta / layout.INFO, info)
        write_json(meta / layout.RECORD, record)
        if self._source.version == "v2.1":
            self._add_stats_v21()
        elif (meta / layout.STATS).exists():
            stats = json.loads((meta / layout.STATS).read_text(encoding="utf-8"))
            (meta / layout.STATS).write_text(json.dumps(stats | layout.pooled(self._stats), indent=1) + "\n")
        return record

    def _add_stats_v21(self) -> None:
        path = self._folder / layout.EPISODES_STATS
        if path.exists():
            rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]
            for row in rows:
                row["stats"] |= self._stats[int(row["episode_index"])]
            write_lines(path, rows)
