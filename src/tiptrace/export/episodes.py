"""An episode: the tip at every image pair of a recording, estimated without looking ahead."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import tiptrace
from tiptrace.batch_plan import find_recordings
from tiptrace.errors import ConfigError, OutputError
from tiptrace.export.images import EncodedImages
from tiptrace.frames import FrameWatch, Stamps, read_frames
from tiptrace.geometry.transforms import quaternion_from_rotation
from tiptrace.outputs import CSV, METRICS, read_csv
from tiptrace.pipeline import Step, open_tracer, trace
from tiptrace.streams.sources import open_recording
from tiptrace.types import (
    SIDES,
    BoolArray,
    FloatArray,
    ImageSample,
    Phase,
    Side,
    Status,
    Stream,
    TipEstimate,
)

ABSOLUTE = (Status.ANCHORING, Status.OK, Status.DEGRADED)
"""States in which a position is one in the base frame; ``relative`` is a displacement."""

_SUMMARY = "summary.json"
_PLAIN_OPTIONS = {"reference_frames", "stamps"}


@dataclass(frozen=True, slots=True)
class Source:
    """Where an episode comes from: a results folder or a recording.

    Attributes:
        name: Unique in the dataset.
        path: The folder or file.
        results: Whether it is a results folder.
    """

    name: str
    path: Path
    results: bool


@dataclass(frozen=True, slots=True)
class Episode:
    """The tip over one recording; a row per image pair.

    Attributes:
        name: Of the recording.
        method: That made the estimates.
        stamps: (n, 3) capture of the pair (mean of both), the left and the right image, ns.
        position: (n, 3) tip in the base frame, m; NaN where none is claimed.
        covariance: (n, 3, 3) m²; NaN where the method gives none.
        valid: (n,) whether the position is known, in the base frame.
        status: What each estimate is worth.
        phase: Segment, empty where unknown.
        state: (n, 7) end effector in the base frame, x y z in m and qx qy qz qw; None from results alone.
        images: Compressed images of each finger, where they were asked for.
    """

    name: str
    method: str
    stamps: Stamps
    position: FloatArray
    covariance: FloatArray
    valid: BoolArray
    status: tuple[str, ...]
    phase: tuple[str, ...]
    state: FloatArray | None = None
    images: Mapping[Side, EncodedImages] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.status)

    @classmethod
    def of(cls, name: str, method: str, stamps: Stamps, estimates: Sequence[TipEstimate]) -> Episode:
        """From estimates and the stamps of their pairs."""
        none, no_covariance = np.full(3, np.nan), np.full((3, 3), np.nan)
        p_B = [none if e.p_B is None else e.p_B for e in estimates]
        covariance = [no_covariance if e.covariance is None else e.covariance for e in estimates]
        position = np.array(p_B, dtype=np.float64).reshape(-1, 3)
        absolute = np.array([e.status in ABSOLUTE for e in estimates], dtype=bool)
        return cls(
            name=name,
            method=method,
            stamps=stamps,
            position=position,
            covariance=np.array(covariance, dtype=np.float64).reshape(-1, 3, 3),
            valid=absolute & np.isfinite(position).all(axis=1),
            status=tuple(e.status.value for e in estimates),
            phase=tuple("" if e.phase is None else e.phase.value for e in estimates),
        )


def find_sources(
    paths: Sequence[Path], bags: bool = False
) -> tuple[list[Source], list[tuple[str, str]], list[str]]:
    """Episodes under results folders, recordings and folders of either.

    A folder that holds results at any depth stands for these; any other for the recordings in it.

    Returns:
        The sources sorted by name, what cannot be exported with its reason, and notes for the user.

    Raises:
        ConfigError: nothing at all was found, or two episodes have the same name.
    """
    sources: dict[Path, Source] = {}
    failures: list[tuple[str, str]] = []
    recordings, notes = [], list[str]()
    for path in paths:
        results = sorted(file.parent for file in path.rglob(CSV)) if path.is_dir() else []
        if not results:
            recordings.append(path)
            continue
        for folder in results:
            name = str(folder.relative_to(path)) if folder != path else path.resolve().name
            sources.setdefault(folder.resolve(), Source(name, folder, True))
        failures += [
            (str(file.parent.relative_to(path)), "its reconstruction failed")
            for file in sorted(path.rglob(_SUMMARY))
            if not (file.parent / CSV).exists()
        ]
        if unused := sum(1 for _ in path.rglob("*.mcap")):
            notes.append(
                f"{path}: holds results, and these are exported; {unused} recording(s) beside them are not: give them "
                "by name to trace them"
            )
    if recordings:
        found = find_recordings(recordings, bags)
        notes += found.notes
        failures = [*failures, *found.empty]
        sources |= {i.path.resolve(): Source(i.name, i.path, False) for i in found.recordings}
    ordered = sorted(sources.values(), key=lambda s: s.name)
    twice = {a.name for a, b in pairwise(ordered) if a.name == b.name}
    if twice:
        raise ConfigError(f"more than one episode of the name {', '.join(sorted(twice))}; export them apart")
    return ordered, failures, notes


class EpisodeWatch(FrameWatch):
    """Notes what a dataset keeps of the pairs beside the tip; a viewer of the loop."""

    def __init__(self, images: bool) -> None:
        """With ``images`` the tactile images are kept, compressed."""
        super().__init__()
        self._keep = images
        self._state: list[FloatArray] = []
        self.images: dict[Side, EncodedImages] = {}

    def show(self, step: Step) -> None:
        """Note one pair."""
        super().show(step)
        T_B_E = step.observation.left.T_B_E
        self._state.append(np.concatenate([T_B_E[:3, 3], quaternion_from_rotation(T_B_E[:3, :3])]))
        for side in SIDES if self._keep else ():
            sample = step.observation.finger(side).sample
            if isinstance(sample, ImageSample):
                self.images.setdefault(side, EncodedImages()).append(sample.image)

    @property
    def state(self) -> FloatArray:
        """(n, 7) end effector, m and xyzw."""
        return np.array(self._state, dtype=np.float64).reshape(-1, 7)


def load_episode(
    source: Source, method: str, options: Mapping[str, str] | None = None, images: bool = False
) -> Episode:
    """The episode of a source; a recording is traced for it, with ``method``.

    Raises:
        TipTraceError: it cannot be read, or gives no trajectory.
    """
    if source.results:
        return _of_results(source)
    given: dict[str, Any] = {k: v if k in _PLAIN_OPTIONS else Path(v) for k, v in (options or {}).items()}
    return traced_episode(source.name, open_recording(source.path, **given), method, images)


def traced_episode(name: str, stream: Stream, method: str, images: bool = False) -> Episode:
    """The episode of a stream, traced with ``method``.

    Raises:
        TipTraceError: it gives no trajectory.
    """
    watch = EpisodeWatch(images)
    with open_tracer(stream, method) as tracer:
        trajectory = trace(stream, tracer, watch)
    episode = Episode.of(name, method, watch.stamps, trajectory.estimates)
    return replace(episode, state=watch.state, images=watch.images)


def _of_results(source: Source) -> Episode:
    estimates = read_csv(source.path / CSV)
    metrics = source.path / METRICS
    try:
        record = json.loads(metrics.read_text(encoding="utf-8"))
        method, smoothed = str(record["method"]), record.get("estimates") == "smoothed"
    except (OSError, ValueError, KeyError, TypeError):
        raise OutputError(f"{metrics}: does not tell the method of the trajectory beside it") from None
    if smoothed:
        raise OutputError(
            f"{source.path}: its estimates are smoothed, not causal; reconstruct without --smooth"
        )
    return Episode.of(source.name, method, read_frames(source.path, len(estimates)), estimates)


def dataset_record(episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What a dataset says of itself, whatever its format."""
    return {
        "format": "tiptrace training data 1",
        "tiptrace": tiptrace.__version__,
        "estimates": "causal",
        "estimates_detail": (
            "each row uses images up to its own pair and robot poses up to the first one after its exposure; no "
            "smoothing, nothing learned later in the trial"
        ),
        "frames": "a row per pair of left and right images; images without a partner have no row",
        "position": "centre of the tip's sphere in the robot's base frame, m; NaN where none is claimed",
        "covariance": "3x3, row by row, m^2; NaN where the method gives none",
        "valid": f"position known in the base frame: status {', '.join(s.value for s in ABSOLUTE)}",
        "stamps": "capture times as in the recording, integer ns; frame.stamp_ns is the mean of left and right",
        "status_values": [s.value for s in Status],
        "phase_values": ["", *(p.value for p in Phase)],
        "episodes": list(episodes),
    }


def episode_record(episode: Episode) -> dict[str, Any]:
    """What a dataset says of one episode."""
    valid = int(episode.valid.sum())
    return {"name": episode.name, "method": episode.method, "frames": len(episode), "valid_frames": valid}
