"""LeRobot's layouts v2.1 and v3.0, as far as a dataset without video files needs them.

::

    v3.0                                    v2.1
      meta/info.json                          meta/info.json
      meta/stats.json                         meta/episodes_stats.jsonl
      meta/tasks.parquet                      meta/tasks.jsonl
      meta/episodes/chunk-000/file-000.parquet  meta/episodes.jsonl
      data/chunk-000/file-000.parquet         data/chunk-000/episode_000000.parquet
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tiptrace.errors import ConfigError
from tiptrace.export.episodes import Episode

VERSIONS = ("v3.0", "v2.1")
CHUNK = 1000
INFO, STATS, EPISODES_STATS = "meta/info.json", "meta/stats.json", "meta/episodes_stats.jsonl"
TASKS = {"v3.0": "meta/tasks.parquet", "v2.1": "meta/tasks.jsonl"}
EPISODES = {"v3.0": "meta/episodes/chunk-000/file-000.parquet", "v2.1": "meta/episodes.jsonl"}
DATA = {
    "v3.0": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "v2.1": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
}
RECORD = "meta/tiptrace.json"
POSITION, COVARIANCE, VALID = (f"observation.tip.{name}" for name in ("position", "covariance", "valid"))
STATUS, PHASE, STATE = "observation.tip.status", "observation.tip.phase", "observation.state"
STAMPS = ("frame.stamp_ns", "frame.left_stamp_ns", "frame.right_stamp_ns")
IMAGE = "observation.images.tactile_{side}"
STATE_NAMES = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]

Stats = dict[str, dict[str, list[Any]]]


@dataclass(frozen=True, slots=True)
class Feature:
    """One column of a dataset, as ``info.json`` describes it."""

    dtype: str
    shape: tuple[int, ...] = (1,)
    names: list[str] | None = None

    def info(self) -> dict[str, Any]:
        """Entry of ``info.json``."""
        return {"dtype": self.dtype, "shape": list(self.shape), "names": self.names}

    def arrow(self, pa: Any) -> Any:
        """Arrow type of the column."""
        if self.dtype == "image":
            return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        value = pa.bool_() if self.dtype == "bool" else getattr(pa, self.dtype)()
        return value if self.shape == (1,) else pa.list_(value, self.shape[0])

    def hugging_face(self) -> dict[str, Any]:
        """Entry of the metadata by which the ``datasets`` library knows the column again."""
        if self.dtype == "image":
            return {"_type": "Image"}
        value = {"dtype": self.dtype, "_type": "Value"}
        if self.shape == (1,):
            return value
        return {"feature": value, "length": self.shape[0], "_type": "Sequence"}


TIP_FEATURES: dict[str, Feature] = {
    POSITION: Feature("float32", (3,), ["x_m", "y_m", "z_m"]),
    COVARIANCE: Feature("float32", (9,), [f"{a}{b}_m2" for a in "xyz" for b in "xyz"]),
    VALID: Feature("bool"),
    STATUS: Feature("int64"),
    PHASE: Feature("int64"),
}
_INDEX_FEATURES: dict[str, Feature] = {
    "timestamp": Feature("float32"),
    **{name: Feature("int64") for name in ("frame_index", "episode_index", "index", "task_index")},
}


def features_of(episode: Episode) -> dict[str, Feature]:
    """Columns that an episode can fill."""
    features = dict(TIP_FEATURES) | {name: Feature("int64") for name in STAMPS}
    if episode.state is not None:
        features[STATE] = Feature("float32", (7,), STATE_NAMES)
    for side, images in episode.images.items():
        features[IMAGE.format(side=side)] = Feature("image", images.shape, ["height", "width", "channels"])
    return features | _INDEX_FEATURES


def tip_columns(episode: Episode, record: Mapping[str, Any]) -> dict[str, Any]:
    """Values of :data:`TIP_FEATURES`, row by row."""
    status, phase = record["status_values"], record["phase_values"]
    return {
        POSITION: episode.position.astype(np.float32),
        COVARIANCE: episode.covariance.reshape(-1, 9).astype(np.float32),
        VALID: episode.valid,
        STATUS: np.array([status.index(s) for s in episode.status], dtype=np.int64),
        PHASE: np.array([phase.index(p) for p in episode.phase], dtype=np.int64),
    }


def table_of(pa: Any, features: Mapping[str, Feature], columns: Mapping[str, Any]) -> Any:
    """Arrow table with the metadata of the ``datasets`` library."""
    arrays = []
    for name, feature in features.items():
        values, kind = columns[name], feature.arrow(pa)
        if feature.dtype == "image":
            arrays.append(pa.array([{"bytes": v, "path": None} for v in values], kind))
        elif feature.shape == (1,):
            arrays.append(pa.array(values, kind))
        else:
            arrays.append(pa.FixedSizeListArray.from_arrays(np.ravel(values), feature.shape[0]))
    known = {"info": {"features": {name: f.hugging_face() for name, f in features.items()}}}
    schema = pa.schema(
        [(name, f.arrow(pa)) for name, f in features.items()], {"huggingface": json.dumps(known)}
    )
    return pa.Table.from_arrays(arrays, schema=schema)


def stats_of(features: Mapping[str, Feature], columns: Mapping[str, Any]) -> Stats:
    """Least, greatest, mean, standard deviation and count of each column; rows without a value are left out."""
    found: Stats = {}
    for name, feature in features.items():
        if feature.dtype != "image":
            found[name] = _numeric(
                np.asarray(columns[name], dtype=np.float64).reshape(len(columns[name]), -1)
            )
    return found


def pooled(parts: Sequence[Stats]) -> Stats:
    """Statistics over all episodes from those of each."""
    pooled_stats: Stats = {}
    for name in parts[0] if parts else ():
        n = np.array([p[name]["count"][0] for p in parts], dtype=np.float64)
        n = n.reshape(-1, *[1] * np.ndim(parts[0][name]["mean"]))
        mean, std = (np.array([p[name][key] for p in parts], dtype=np.float64) for key in ("mean", "std"))
        total = max(float(n.sum()), 1.0)
        centre = (n * mean).sum(axis=0) / total
        variance = (n * (std**2 + (mean - centre) ** 2)).sum(axis=0) / total
        some = [p[name] for p in parts if p[name]["count"][0]] or [parts[0][name]]
        pooled_stats[name] = {
            "min": np.min([s["min"] for s in some], axis=0).tolist(),
            "max": np.max([s["max"] for s in some], axis=0).tolist(),
            "mean": centre.tolist(),
            "std": np.sqrt(variance).tolist(),
            "count": [int(n.sum())],
        }
    return pooled_stats


def check_version(version: str) -> None:
    """Refuse a layout that is not written.

    Raises:
        ConfigError: it is unknown.
    """
    if version not in VERSIONS:
        raise ConfigError(f"unknown LeRobot version '{version}'; valid: {', '.join(VERSIONS)}")


def _numeric(values: Any) -> dict[str, list[Any]]:
    known = values[np.isfinite(values).all(axis=1)]
    if not len(known):  # nothing to tell: neutral for whoever normalises
        zero = [0.0] * values.shape[1]
        return {"min": zero, "max": zero, "mean": zero, "std": [1.0] * values.shape[1], "count": [0]}
    kinds = {
        "min": known.min(axis=0),
        "max": known.max(axis=0),
        "mean": known.mean(axis=0),
        "std": known.std(axis=0),
    }
    return {**{key: value.tolist() for key, value in kinds.items()}, "count": [len(known)]}
