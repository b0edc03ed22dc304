"""Subscriptions of the node: two image topics, a pose or TF, phases and openings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from tiptrace.config import Rig
from tiptrace.drivers.ros2 import listen_to_tf, load, stamp_ns
from tiptrace.errors import ConfigError
from tiptrace.ros.stream import RosStream
from tiptrace.streams.mapping import MapFile
from tiptrace.streams.messages import (
    MessageError,
    image_from_compressed,
    image_from_raw,
    opening_from,
    phase_from,
    pose_from,
)
from tiptrace.types import SIDES, FloatArray, ImageSample, OpeningSample, PhaseSample, PoseSample, Side

_SHOW_EVERY_S = 5.0


@dataclass(frozen=True, slots=True)
class Topics:
    """Where the node listens.

    Attributes:
        images: Per finger; a name that ends in ``compressed`` is a ``CompressedImage``, else an ``Image``.
        pose: ``PoseStamped``; empty for TF.
        phase: ``String``.
        opening: ``Float64``; empty for none.
        end_effector: Frame of the end effector, for TF.
        reliable: Ask for reliable delivery; else best effort, which every publisher grants.
        depth: Of the queues.
    """

    images: dict[Side, str]
    pose: str
    phase: str
    opening: str
    end_effector: str
    reliable: bool = False
    depth: int = 10


class Subscriptions:
    """Turns messages into samples.

    Args:
        node: The rclpy node.
        topics: Where to listen.
        stream: Takes the samples.
        map_file: Crop, flip and size of the images, where they are not at processing size.

    Raises:
        DeviceError: a part of ROS 2 is not installed.
    """

    def __init__(self, node: Any, topics: Topics, stream: RosStream, map_file: MapFile | None) -> None:
        self._node, self._stream, self._rig, self._map = node, stream, stream.rig, map_file
        qos = _sensor_qos(topics)
        messages = load("sensor_msgs.msg")
        for side in SIDES:
            topic = topics.images[side]
            packed = topic.endswith("compressed")
            read = image_from_compressed if packed else image_from_raw
            kind = messages.CompressedImage if packed else messages.Image
            self._subscribe(kind, topic, partial(self._image, side, read), qos)
        if topics.pose:
            self._subscribe(load("geometry_msgs.msg").PoseStamped, topics.pose, self._pose, qos)
        else:
            listen_to_tf(node, self._rig.frames.base, topics.end_effector, self._tf)
        std = load("std_msgs.msg")
        self._subscribe(std.String, topics.phase, self._phase, 10)
        if topics.opening:
            self._subscribe(std.Float64, topics.opening, self._opening, qos)

    def _subscribe(self, kind: Any, topic: str, take: Callable[[Any], None], qos: Any) -> None:
        def guarded(message: Any) -> None:
            try:
                take(message)
            except (MessageError, ConfigError, AttributeError) as error:
                self._stream.faults[topic] += 1
                self._node.get_logger().warning(
                    f"{topic}: {error}; left out", throttle_duration_sec=_SHOW_EVERY_S
                )

        self._node.create_subscription(kind, topic, guarded, qos)

    def _image(self, side: Side, read: Callable[[Any], Any], message: Any) -> None:
        image = read(message)
        if self._map is not None:
            image = self._map.image(side).prepare(image)
        width, height = self._rig.sensor(side).image_size_px
        if image.shape[:2] != (height, width):
            raise MessageError(
                f"the {side} image is {image.shape[1]}x{image.shape[0]} px, the rig file says {width}x{height}: crop "
                "and resize with the parameter map"
            )
        self._stream.put(ImageSample(side, self._dated(message), image))

    def _pose(self, message: Any) -> None:
        frame, base = message.header.frame_id.strip("/"), self._rig.frames.base.strip("/")
        if frame not in ("", base):
            raise MessageError(f"frame_id is {frame!r}, but frames.base of the rig file is {base!r}")
        T_B_E = pose_from(message.pose.position, message.pose.orientation)
        self._stream.put(PoseSample(self._dated(message), T_B_E))

    def _tf(self, stamp_ns: int, T_B_E: FloatArray | None) -> None:
        if T_B_E is None:
            self._stream.faults["/tf"] += 1
        else:
            self._stream.put(PoseSample(stamp_ns, T_B_E))

    def _phase(self, message: Any) -> None:
        self._stream.put(PhaseSample(self._now_ns(), phase_from(message)))

    def _opening(self, message: Any) -> None:
        self._stream.put(OpeningSample(self._now_ns(), opening_from(message)))

    def _dated(self, message: Any) -> int:
        stamp = stamp_ns(message.header.stamp)
        if stamp == 0:
            raise MessageError("header.stamp is not set")
        return stamp

    def _now_ns(self) -> int:
        """The node's clock: wall time, or a bag's with ``use_sim_time``."""
        return int(self._node.get_clock().now().nanoseconds)


def standard_topics(rig: Rig, map_file: MapFile | None) -> Topics:
    """Names of the recording format, or of a map file."""
    from tiptrace.streams.topics import IMAGE_TOPIC, OPENING_TOPIC, PHASE_TOPIC, POSE_TOPIC

    end_effector = rig.frames.end_effector
    if map_file is None:
        return Topics(dict(IMAGE_TOPIC), POSE_TOPIC, PHASE_TOPIC, OPENING_TOPIC, end_effector)
    tf = map_file.tf
    return Topics(
        {side: map_file.image(side).topic for side in SIDES},
        map_file.pose or "",
        map_file.phase or PHASE_TOPIC,
        map_file.opening or "",
        end_effector if tf is None else tf.end_effector,
    )


def _sensor_qos(topics: Topics) -> Any:
    qos = load("rclpy.qos")
    reliability = qos.ReliabilityPolicy.RELIABLE if topics.reliable else qos.ReliabilityPolicy.BEST_EFFORT
    return qos.QoSProfile(
        depth=topics.depth, reliability=reliability, durability=qos.DurabilityPolicy.VOLATILE
    )
