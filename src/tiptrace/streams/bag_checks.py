"""What a rosbag2 folder must be before a library opens it: tables that are tables, packed data that stay in bounds."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import zstandard

from tiptrace.config import read_yaml
from tiptrace.errors import RecordingError
from tiptrace.streams.chunks import MAX_CHUNK_BYTES
from tiptrace.streams.mcap_source import McapSource

_SQLITE, _ZSTD = b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
_MAX_FILE_GROWTH, _SMALL_FILE = 100, 512 * 2**20


def check_bag(path: Path) -> None:
    """Look at every file of a bag before it is opened.

    Raises:
        RecordingError: a file that would run somebody's query, or unpack to an enormous size.
        ConfigError: a ``metadata.yaml`` that is no YAML.
    """
    if not path.is_dir():
        _check_file(path)
        return
    read_yaml((path / "metadata.yaml").read_bytes(), str(path / "metadata.yaml"))
    for file in sorted(path.iterdir()):
        if file.is_file() and file.name != "metadata.yaml":
            _check_file(file)


def _check_file(file: Path) -> None:
    with file.open("rb") as opened:
        head = opened.read(18)
    if head.startswith(_SQLITE):
        _check_sqlite(file)
    elif head.startswith(_ZSTD):
        _check_packed_file(file)
    elif file.suffix == ".mcap":
        _check_mcap(file)


def _check_sqlite(file: Path) -> None:
    """A view or trigger is a program; one in place of a table may never end."""
    try:
        with closing(sqlite3.connect(f"file:{file.resolve()}?mode=ro", uri=True)) as base:
            kinds = {str(row[0]) for row in base.execute("SELECT DISTINCT type FROM sqlite_master")}
            if kinds - {"table", "index"}:
                raise RecordingError(
                    f"{file}: holds a {', '.join(sorted(kinds - {'table', 'index'}))}, which no recorder writes; "
                    "record it again"
                )
            _check_blobs(file, base)
    except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{file}: is damaged ({error}); recover what there is with: sqlite3 {file.name} .recover"
        ) from None


def _check_blobs(file: Path, base: sqlite3.Connection) -> None:
    columns = {str(row[1]) for row in base.execute("PRAGMA table_info(messages)")}
    if "data" not in columns:
        return  # told by the reader
    for size, head in base.execute("SELECT length(data), CAST(substr(data, 1, 18) AS BLOB) FROM messages"):
        packed = isinstance(head, bytes) and head.startswith(_ZSTD)
        if (size or 0) > MAX_CHUNK_BYTES or (packed and _claimed(head) > MAX_CHUNK_BYTES):
            raise RecordingError(
                f"{file}: a message of more than {MAX_CHUNK_BYTES >> 20} MB is none that a sensor sends; "
                "record it again"
            )


def _check_packed_file(file: Path) -> None:
    """Unpack it to nowhere: the library does so to the disk, as far as it goes."""
    limit, size = max(_SMALL_FILE, _MAX_FILE_GROWTH * file.stat().st_size), 0
    try:
        with file.open("rb") as packed:
            for block in zstandard.ZstdDecompressor(max_window_size=2**27).read_to_iter(packed):
                size += len(block)
                if size > limit:
                    break
    except zstandard.ZstdError:
        return  # told by the reader
    if size > limit:
        raise RecordingError(
            f"{file}: would unpack to more than {limit >> 20} MB; unpack it yourself: unzstd {file.name}"
        )


def _claimed(head: bytes) -> int:
    """Size that a zstd frame says it has; 0 where it does not say."""
    try:
        return max(zstandard.frame_content_size(head), 0)
    except zstandard.ZstdError:
        return 0


def _check_mcap(file: Path) -> None:
    """Other libraries unpack chunks without bounds: try each within them first."""
    source = McapSource(file)
    for _ in source.messages():
        pass
    if source.damage and ("claims to hold" in source.damage or "records" in source.damage):
        raise RecordingError(f"{file}: is {source.damage}; record it again")
