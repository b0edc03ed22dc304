"""Writes a dataset whole or not at all; an episode that fails is left out and reported."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tiptrace.errors import ConfigError, OutputError, TipTraceError
from tiptrace.export.episodes import Episode, Source, load_episode
from tiptrace.export.lerobot_format import check_version
from tiptrace.export.lerobot_writer import DEFAULT_TASK, LikeTheFirst, write_lerobot
from tiptrace.export.parquet import write_parquet
from tiptrace.export.zarr_store import write_zarr

_WRITERS: dict[str, Callable[..., dict[str, Any]]] = {
    "parquet": write_parquet,
    "zarr": write_zarr,
    "lerobot": write_lerobot,
}
FORMATS = tuple(_WRITERS)


@dataclass(frozen=True, slots=True)
class LeRobotOptions:
    """What only LeRobot datasets know.

    Attributes:
        version: Layout, ``v3.0`` or ``v2.1``.
        task: What was done, in words, for all episodes.
        images: Whether the tactile images go along.
    """

    version: str = "v3.0"
    task: str = DEFAULT_TASK
    images: bool = True


@dataclass(frozen=True, slots=True)
class Exported:
    """What became of an export.

    Attributes:
        record: What the dataset says of itself.
        failures: Name and reason of each episode that is not in it.
    """

    record: dict[str, Any]
    failures: list[tuple[str, str]] = field(default_factory=list)


def export_dataset(
    sources: Sequence[Source],
    kind: str,
    out: Path,
    method: str = "full",
    options: Mapping[str, str] | None = None,
    on_done: Callable[[str], None] = lambda name: None,
    lerobot: LeRobotOptions | None = None,
) -> Exported:
    """Write the episodes of sources as a dataset; memory is that of one episode.

    Args:
        sources: Where the episodes come from.
        kind: One of :data:`FORMATS`.
        out: File (parquet) or folder (zarr); must not exist.
        method: For recordings; results have theirs.
        options: Of ``open_recording``, as text, for recordings.
        on_done: Called with the name of each episode.
        lerobot: For ``lerobot`` alone.

    Raises:
        ConfigError: an unknown format or version.
        OutputError: the target exists, cannot be written, or not a single episode could be exported.
        MissingExtraError: the format's library is not installed.
    """
    if kind not in _WRITERS:
        raise ConfigError(f"unknown format '{kind}'; valid: {', '.join(FORMATS)}")
    if out.exists():
        raise OutputError(f"{out}: exists already; choose another --out, or remove it")
    chosen = (lerobot or LeRobotOptions()) if kind == "lerobot" else None
    if chosen is not None:
        check_version(chosen.version)
    failures: list[tuple[str, str]] = []
    partial = out.with_name(f".{out.name}.part")
    try:
        _remove(partial)
        out.parent.mkdir(parents=True, exist_ok=True)
        episodes = _episodes(sources, method, options, failures, on_done, chosen)
        extra = {} if chosen is None else {"version": chosen.version, "task": chosen.task}
        record = _WRITERS[kind](partial, episodes, **extra)
        if not record["episodes"]:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in failures[:3])
            raise OutputError(f"{out}: not written, no episode could be exported ({reasons})")
        partial.rename(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error})") from None
    finally:
        _remove(partial)
    return Exported(record, failures)


def _episodes(
    sources: Sequence[Source],
    method: str,
    options: Mapping[str, str] | None,
    failures: list[tuple[str, str]],
    on_done: Callable[[str], None],
    lerobot: LeRobotOptions | None,
) -> Iterator[Episode]:
    check = LikeTheFirst() if lerobot is not None else lambda episode: None
    for source in sources:
        try:
            episode = load_episode(source, method, options, images=lerobot is not None and lerobot.images)
            check(episode)
        except TipTraceError as error:
            failures.append((source.name, str(error)))
        except Exception as error:  # noqa: BLE001 - one episode among thousands must not end the others
            failures.append((source.name, f"internal error, {type(error).__name__}: {error}"))
        else:
            yield episode
        on_done(source.name)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
