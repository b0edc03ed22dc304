"""A Zarr group (format 3): arrays over the frames of all episodes, one after the other.

::

    DIR/                        attributes: the record of the dataset
      data/observation.tip.position    (n, 3) float64
      data/observation.tip.covariance  (n, 3, 3) float64
      data/observation.tip.valid       (n,) bool
      data/observation.tip.status      (n,) int8, index into the attribute status_values
      data/phase                       (n,) int8, index into phase_values
      data/frame.stamp_ns              (n,) int64; also .left_stamp_ns, .right_stamp_ns
      data/episode_index, data/frame_index  (n,) int64
      meta/episode_ends                (episodes,) int64, frames up to the end of each
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiptrace.errors import MissingExtraError
from tiptrace.export.episodes import Episode, dataset_record, episode_record

_CHUNK_ROWS = 4096


def write_zarr(path: Path, episodes: Iterable[Episode]) -> dict[str, Any]:
    """Write episodes one at a time; returns the record that the group holds.

    Raises:
        MissingExtraError: no zarr.
    """
    try:
        zarr: Any = import_module("zarr")
    except ImportError:
        raise MissingExtraError("zarr", "export") from None
    group = zarr.open_group(str(path), mode="w", zarr_format=3)
    data = group.create_group("data")
    records: list[dict[str, Any]] = []
    empty = dataset_record([])
    arrays: dict[str, Any] = {}
    for index, episode in enumerate(episodes):
        for name, values in _columns(index, episode, empty).items():
            if name not in arrays:
                shape, chunks = (0, *values.shape[1:]), (_CHUNK_ROWS, *values.shape[1:])
                arrays[name] = data.create_array(name, shape=shape, chunks=chunks, dtype=values.dtype)
            arrays[name].append(values)
        records.append(episode_record(episode))
    ends = np.cumsum([r["frames"] for r in records], dtype=np.int64)
    group.create_group("meta").create_array("episode_ends", data=ends)
    record = dataset_record(records)
    group.attrs.update(record)
    return record


def _columns(index: int, episode: Episode, record: dict[str, Any]) -> dict[str, NDArray[Any]]:
    n = len(episode)
    status, phase = record["status_values"], record["phase_values"]
    return {
        "observation.tip.position": episode.position,
        "observation.tip.covariance": episode.covariance,
        "observation.tip.valid": episode.valid,
        "observation.tip.status": np.array([status.index(s) for s in episode.status], dtype=np.int8),
        "phase": np.array([phase.index(p) for p in episode.phase], dtype=np.int8),
        "frame.stamp_ns": episode.stamps[:, 0],
        "frame.left_stamp_ns": episode.stamps[:, 1],
        "frame.right_stamp_ns": episode.stamps[:, 2],
        "episode_index": np.full(n, index, dtype=np.int64),
        "frame_index": np.arange(n, dtype=np.int64),
    }
