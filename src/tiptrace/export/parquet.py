"""One Parquet file: a row group per episode, the record of the dataset in the file's metadata."""

from __future__ import annotations

import json
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.errors import MissingExtraError
from tiptrace.export.episodes import Episode, dataset_record, episode_record

METADATA_KEY = "tiptrace"


def write_parquet(path: Path, episodes: Iterable[Episode]) -> dict[str, Any]:
    """Write episodes one at a time; returns the record that the file holds.

    Columns: ``episode``, ``episode_index``, ``frame_index``, ``frame.stamp_ns``, ``frame.left_stamp_ns``,
    ``frame.right_stamp_ns``, ``observation.tip.position`` (3), ``.covariance`` (9, row by row), ``.valid``,
    ``.status``, ``phase``.

    Raises:
        MissingExtraError: no pyarrow.
    """
    try:
        pa: Any = import_module("pyarrow")
        parquet: Any = import_module("pyarrow.parquet")
    except ImportError:
        raise MissingExtraError("pyarrow", "tables") from None
    records = []
    with parquet.ParquetWriter(path, _schema(pa), compression="zstd") as writer:
        for index, episode in enumerate(episodes):
            writer.write_table(_table(pa, index, episode), row_group_size=max(1, len(episode)))
            records.append(episode_record(episode))
        record = dataset_record(records)
        writer.add_key_value_metadata({METADATA_KEY: json.dumps(record)})
    return record


def _schema(pa: Any) -> Any:
    return pa.schema(
        [
            ("episode", pa.string()),
            ("episode_index", pa.int64()),
            ("frame_index", pa.int64()),
            ("frame.stamp_ns", pa.int64()),
            ("frame.left_stamp_ns", pa.int64()),
            ("frame.right_stamp_ns", pa.int64()),
            ("observation.tip.position", pa.list_(pa.float64(), 3)),
            ("observation.tip.covariance", pa.list_(pa.float64(), 9)),
            ("observation.tip.valid", pa.bool_()),
            ("observation.tip.status", pa.string()),
            ("phase", pa.string()),
        ]
    )


def _table(pa: Any, index: int, episode: Episode) -> Any:
    n = len(episode)
    columns = [
        pa.array([episode.name] * n, pa.string()),
        pa.array(np.full(n, index), pa.int64()),
        pa.array(np.arange(n), pa.int64()),
        *(pa.array(column, pa.int64()) for column in episode.stamps.T),
        pa.FixedSizeListArray.from_arrays(episode.position.ravel(), 3),
        pa.FixedSizeListArray.from_arrays(episode.covariance.ravel(), 9),
        pa.array(episode.valid),
        pa.array(episode.status, pa.string()),
        pa.array(episode.phase, pa.string()),
    ]
    return pa.Table.from_arrays(columns, schema=_schema(pa))
