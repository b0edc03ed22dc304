"""Outputs are tried before the work, so that a wrong path costs no minutes."""

from __future__ import annotations

from pathlib import Path

from tiptrace.errors import OutputError


def check_writable(path: Path) -> None:
    """Make a file's folder and try whether the file can be written; what it holds stays.

    Raises:
        OutputError: it cannot.
    """
    existed = path.exists()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab"):
            pass
        if not existed:
            path.unlink()
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
