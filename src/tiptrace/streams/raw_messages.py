"""Messages as stored, before anything is made of them; one interface over MCAP files and rosbag2 folders."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from tiptrace.streams.topics import NS


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message, still serialised.

    Attributes:
        topic: Topic name.
        type: ROS 2 type, e.g. ``geometry_msgs/msg/PoseStamped``.
        log_time_ns: When the recorder received it.
        data: CDR bytes, with their encapsulation header.
        schema: Handle by which the source finds the decoder.
    """

    topic: str
    type: str
    log_time_ns: int
    data: bytes
    schema: Any


class MessageSource(Protocol):
    """A file or folder of ROS 2 messages that can be read several times."""

    @property
    def path(self) -> Path:
        """Where it lies."""
        ...

    @property
    def damage(self) -> str | None:
        """Why reading stopped early, once a pass has found out."""
        ...

    def messages(self) -> Iterator[RawMessage]:
        """All messages in log-time order; ends early at damage, never raises for it."""
        ...

    def decode(self, message: RawMessage) -> Any:
        """The message as an object with ROS field names.

        Raises:
            RecordingError: the bytes do not fit the type.
        """
        ...


_HEADED = {  # types that begin with std_msgs/Header
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/PointCloud2",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PointStamped",
    "geometry_msgs/msg/TransformStamped",
}


@dataclass(frozen=True, slots=True)
class HeaderPeek:
    """``std_msgs/Header`` read without decoding the rest of the message."""

    stamp_ns: int
    frame_id: str


def peek_header(message: RawMessage) -> HeaderPeek | None:
    """Header of a message whose type begins with one; None for other types and for bytes too short."""
    data = message.data
    if message.type not in _HEADED or len(data) < 16:
        return None
    order = "<" if data[1] & 1 else ">"
    sec, nanosec, length = struct.unpack_from(order + "iII", data, 4)
    frame_id = bytes(data[16 : 16 + max(length - 1, 0)]).decode("utf-8", errors="replace")
    return HeaderPeek(sec * NS + nanosec, frame_id)
