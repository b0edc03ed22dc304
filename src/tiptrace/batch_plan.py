"""Which recordings a batch works on, the name of each, and its share of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from glob import glob, has_magic
from pathlib import Path

from tiptrace.errors import ConfigError


@dataclass(frozen=True, slots=True)
class NamedPath:
    """A recording and the name of its results: a relative path, unique in its batch."""

    name: str
    path: Path


@dataclass(frozen=True, slots=True)
class Found:
    """What was found under the paths that a user gave.

    Attributes:
        recordings: Sorted by name, each file once.
        empty: Paths without any recording, with the reason.
        notes: Sentences that the user should read.
    """

    recordings: tuple[NamedPath, ...]
    empty: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()


def is_batch(paths: Sequence[Path]) -> bool:
    """Whether paths mean many recordings; a single file or bag does not."""
    return len(paths) != 1 or _is_pattern(paths[0]) or (paths[0].is_dir() and not is_bag(paths[0]))


def is_bag(path: Path) -> bool:
    """Whether a folder is a rosbag2 recording."""
    return path.is_dir() and (path / "metadata.yaml").exists()


def find_recordings(paths: Sequence[Path], bags: bool = False) -> Found:
    """Recordings under files, folders and glob patterns.

    In a folder these are ``*.mcap`` at any depth, with ``bags`` also rosbag2 folders and ``*.db3``. A recording is
    named by its path below the folder without suffix, a file by its stem; where names are equal, all that share one
    get the folders above in front. So the names, and what each shard works on, depend on the paths alone.

    Raises:
        ConfigError: nothing at all was found.
    """
    named: dict[Path, NamedPath] = {}
    empty, notes = [], []
    for given in paths:
        found = [item for path in _matches(given) for item in _inside(path, bags)]
        if not found:
            what = "matches nothing" if _is_pattern(given) else "holds no recording (*.mcap)"
            empty.append((str(given), what))
        for item in found:
            if item.path.resolve() in named:
                notes.append(f"{item.path}: given more than once, done once")
            named.setdefault(item.path.resolve(), item)
    if not named:
        raise ConfigError("; ".join(f"{path}: {reason}" for path, reason in empty) or "no recording given")
    recordings = _unique(list(named.values()))
    if len({i.name for i in named.values()}) < len(recordings):
        notes.append("recordings of the same name: their folders were put in front of it")
    return Found(tuple(sorted(recordings, key=lambda i: i.name)), tuple(empty), tuple(notes))


def parse_shard(text: str) -> tuple[int, int]:
    """``i/n``: the i-th of n shares, counted from 1.

    Raises:
        ConfigError: not of this form.
    """
    match = re.fullmatch(r"\s*(\d+)\s*/\s*(\d+)\s*", text)
    index, count = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= index <= count:
        raise ConfigError(f"--shard '{text}': expected i/n with 1 <= i <= n, e.g. 3/16")
    return index, count


def share(items: Sequence[NamedPath], shard: tuple[int, int]) -> list[NamedPath]:
    """Every n-th item from the i-th on: shares of equal size, whatever order of days or lengths the names have."""
    index, count = shard
    return list(items[index - 1 :: count])


def _is_pattern(path: Path) -> bool:
    return has_magic(str(path)) and not path.exists()


def _matches(path: Path) -> list[Path]:
    return sorted(Path(p) for p in glob(str(path), recursive=True)) if _is_pattern(path) else [path]


def _inside(path: Path, bags: bool) -> Iterator[NamedPath]:
    """The recording that a path is, or those in a folder."""
    if not path.is_dir() or is_bag(path):
        yield NamedPath(path.resolve().name if path.is_dir() else path.stem, path)
        return
    folders = {meta.parent for meta in path.rglob("metadata.yaml")} if bags else set()
    files = [f for pattern in (("*.mcap", "*.db3") if bags else ("*.mcap",)) for f in path.rglob(pattern)]
    alone = {f for f in files if f.is_file() and not folders.intersection(f.parents)}
    for found in sorted(folders | alone):
        relative = found.relative_to(path)
        yield NamedPath(str(relative if found in folders else relative.with_suffix("")), found)


def _unique(items: list[NamedPath]) -> list[NamedPath]:
    """Names made different by the folders above, for all that share one."""
    beside = Counter((item.path.resolve().parent, item.name) for item in items)
    items = [_with_suffix(i) if beside[i.path.resolve().parent, i.name] > 1 else i for i in items]
    while True:
        counts = Counter(item.name for item in items)
        longer = [_longer(item) if counts[item.name] > 1 else item for item in items]
        if longer == items:
            return items
        items = longer


def _with_suffix(item: NamedPath) -> NamedPath:
    return NamedPath(item.name + item.path.suffix.replace(".", "_"), item.path)


def _longer(item: NamedPath) -> NamedPath:
    """The name with one more of the folders above the recording."""
    above = item.path.resolve().parent.parts[1:]
    inside = len(Path(item.name).parts) - 1
    return NamedPath(str(Path(*above[len(above) - inside - 1 :][:1], item.name)), item.path)
