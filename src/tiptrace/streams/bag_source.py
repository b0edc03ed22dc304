"""rosbag2 folders and SQLite files, through the rosbags library."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from tiptrace.errors import RecordingError
from tiptrace.streams.bag_checks import check_bag
from tiptrace.streams.raw_messages import RawMessage
from tiptrace.streams.topics import NS

_DAMAGE: tuple[type[Exception], ...] = (  # what rosbags and below raise on files that are wrong
    OSError,
    EOFError,
    RuntimeError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    AssertionError,
    MemoryError,
    struct.error,
    sqlite3.Error,
)


class BagSource:
    """Messages of a rosbag2 folder (MCAP or SQLite, split or compressed) or of one ``.db3`` file.

    Args:
        path: Folder with ``metadata.yaml``, or the file.

    Raises:
        RecordingError: not such a folder or file, or it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._damage: str | None = None
        if not path.exists():
            raise RecordingError(f"{path}: cannot be read (No such file or directory)")
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            raise RecordingError(
                f"{path}: folder has no metadata.yaml: run 'ros2 bag reindex' on it, or give one of its files"
            )
        if path.suffix == ".bag":
            raise RecordingError(
                f"{path}: is a ROS 1 bag; convert it with: rosbags-convert --src {path} --dst FOLDER"
            )
        try:
            check_bag(path)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
        self._reader = self._open()

    def _open(self) -> Any:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        try:
            reader = AnyReader([self._path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
            reader.open()
        except _errors() as error:
            raise RecordingError(
                f"{self._path}: is not a rosbag2 recording that can be read ({_line(error)}); repair it "
                "with 'ros2 bag reindex', or record it again"
            ) from None
        return reader

    @property
    def path(self) -> Path:
        """Folder or file."""
        return self._path

    @property
    def damage(self) -> str | None:
        """Why reading stopped early; known after a pass over :meth:`messages`."""
        return self._damage

    def messages(self) -> Iterator[RawMessage]:
        """All messages, in log-time order within each file of the bag."""
        stored = self._reader.messages()
        while True:
            try:
                connection, log_time_ns, data = next(stored)
            except StopIteration:
                return
            except _errors() as error:
                self._damage = f"damaged ({_line(error)})"
                return
            yield RawMessage(connection.topic, connection.msgtype, log_time_ns, bytes(data), None)

    def decode(self, message: RawMessage) -> Any:
        """The message as an object with ROS field names.

        Raises:
            RecordingError: the bytes do not fit the type.
        """
        try:
            return self._reader.deserialize(message.data, message.type)
        except _errors() as error:
            raise RecordingError(
                f"{self._path}: {message.topic}: the message logged at {message.log_time_ns / NS:.3f} s cannot be "
                f"decoded as {message.type} ({_line(error)})"
            ) from None


def _errors() -> tuple[type[Exception], ...]:
    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag2 import ReaderError
    from rosbags.serde import SerdeError

    sqlite: tuple[type[Exception], ...] = ()
    with suppress(ImportError):  # newer rosbags read SQLite through it
        from apsw import Error

        sqlite = (Error,)
    return (AnyReaderError, ReaderError, SerdeError, *sqlite, *_DAMAGE)


def _line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0] or type(error).__name__
