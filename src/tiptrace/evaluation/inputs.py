"""What the files held that results were made from, so that a run that is continued does not keep results of others."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

_MOST_BYTES = 100_000_000  # more is known by size and time alone


def file_state(path: Path) -> list[int]:
    """Size and time of change, of a folder over all its files; tells whether a recording is still the same."""
    files = sorted(f for f in path.rglob("*") if f.is_file()) if path.is_dir() else [path]
    try:
        stats = [f.stat() for f in files]
    except OSError:
        return []
    return [sum(s.st_size for s in stats), max((s.st_mtime_ns for s in stats), default=0)]


def file_states(paths: Iterable[Path]) -> dict[str, list[int]]:
    """The state of several files by their paths; a missing one has none."""
    return {str(path): file_state(path) for path in paths}


def with_content(path: Path | str, file: Path | None = None) -> str:
    """A path as a setting, with what its file holds: edited settings are others.

    Args:
        path: What the user gave.
        file: The file that counts, where that is not ``path`` itself.
    """
    file = Path(path) if file is None else file
    try:
        if not file.is_file():
            return str(path)
        if file.stat().st_size > _MOST_BYTES:
            return f"{path} (size and time {file_state(file)})"
        return f"{path} (content {hashlib.sha256(file.read_bytes()).hexdigest()[:12]})"
    except OSError:  # whoever needs it will say so
        return str(path)
