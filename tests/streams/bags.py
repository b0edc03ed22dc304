"""Writes rosbag2 recordings with the rosbags library, for tests of the reader."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from tiptrace.types import FloatArray, Image

from .helpers import NS

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types


def header(stamp_ns: int, frame_id: str) -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](sec=stamp_ns // NS, nanosec=stamp_ns % NS)
    return TYPES["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def raw_image(image: Image, stamp_ns: int, encoding: str = "rgb8", padding: int = 0) -> Any:
    pixels = {"rgb8": image[..., ::-1], "bgr8": image, "mono8": image[..., :1]}[encoding]
    rows = pixels.reshape(image.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    return TYPES["sensor_msgs/msg/Image"](
        header=header(stamp_ns, "camera"),
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=np.ascontiguousarray(rows).reshape(-1),
    )


def pose_stamped(T: FloatArray, stamp_ns: int, frame_id: str = "base") -> Any:
    point = TYPES["geometry_msgs/msg/Point"](*map(float, T[:3, 3]))
    quaternion = TYPES["geometry_msgs/msg/Quaternion"](*map(float, Rotation.from_matrix(T[:3, :3]).as_quat()))
    pose = TYPES["geometry_msgs/msg/Pose"](position=point, orientation=quaternion)
    return TYPES["geometry_msgs/msg/PoseStamped"](header=header(stamp_ns, frame_id), pose=pose)


def tf_message(links: list[tuple[str, str, FloatArray]], stamp_ns: int) -> Any:
    transforms = []
    for parent, child, T in links:
        vector = TYPES["geometry_msgs/msg/Vector3"](*map(float, T[:3, 3]))
        quaternion = TYPES["geometry_msgs/msg/Quaternion"](
            *map(float, Rotation.from_matrix(T[:3, :3]).as_quat())
        )
        transform = TYPES["geometry_msgs/msg/Transform"](translation=vector, rotation=quaternion)
        transforms.append(
            TYPES["geometry_msgs/msg/TransformStamped"](
                header=header(stamp_ns, parent), child_frame_id=child, transform=transform
            )
        )
    return TYPES["tf2_msgs/msg/TFMessage"](transforms=transforms)


class Bag:
    """Adds messages by topic."""

    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer
        self._connections: dict[str, Any] = {}

    def add(self, topic: str, message: Any, log_time_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=STORE)
        self._writer.write(self._connections[topic], log_time_ns, STORE.serialize_cdr(message, kind))


@contextmanager
def bag(folder: Path, plugin: StoragePlugin = StoragePlugin.MCAP) -> Iterator[Bag]:
    with BagWriter(folder, version=9, storage_plugin=plugin) as writer:
        yield Bag(writer)
