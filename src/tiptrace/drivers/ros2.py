"""ROS 2 as a robot: poses, and perhaps openings and phase marks, from topics or TF. rclpy is imported here only."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qs

import numpy as np

from tiptrace.drivers.base import PoseFrames, RobotTap, Wake
from tiptrace.drivers.queued_robot import QueuedRobot
from tiptrace.drivers.tf_chain import TfChain, Transform
from tiptrace.drivers.timeline import NS, ClockMap, Timeline
from tiptrace.errors import ConfigError, DeviceError, GeometryError
from tiptrace.geometry.transforms import rotation_from_quaternion, transform
from tiptrace.types import FloatArray, OpeningSample, Phase, PhaseSample, PoseSample

_TF_QUEUE = 100
_OPENING_MAX_M = 0.3
_FORM = "ros2, ros2:/POSE_TOPIC, with ?phase=/TOPIC&opening=/TOPIC, or ros2:tf?base=base&end_effector=tool0"


def load(name: str) -> Any:
    """A module of ROS 2.

    Raises:
        DeviceError: it is not in this Python.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise DeviceError(
            f"{name} is not in this Python: run in a terminal after 'source /opt/ros/jazzy/setup.bash', or in a "
            "RoboStack environment (docs/ros2.md)"
        ) from None


def stamp_ns(stamp: Any) -> int:
    """``builtin_interfaces/Time`` → ns."""
    return int(stamp.sec) * NS + int(stamp.nanosec)


def pose_matrix(position: Any, orientation: Any) -> FloatArray | None:
    """Position (m) and quaternion (xyzw) fields → (4, 4); None where they are no pose."""
    t = np.array([position.x, position.y, position.z], dtype=np.float64)
    q = np.array([orientation.x, orientation.y, orientation.z, orientation.w], dtype=np.float64)
    if not (np.isfinite(t).all() and np.isfinite(q).all()):
        return None
    try:
        return transform(rotation_from_quaternion(q), t)
    except GeometryError:
        return None


def listen_to_tf(
    node: Any, base: str, end_effector: str, on_pose: Callable[[int, FloatArray | None], None]
) -> None:
    """Subscribe ``/tf`` and ``/tf_static``; stamp (ns) and T_B_E each time that the chain gives a newer one.

    The chain is composed here, so that of ROS 2 only the messages are needed. ``on_pose`` is given None for a
    transform that is none.

    Raises:
        DeviceError: tf2_msgs is not installed.
    """
    kind, qos = load("tf2_msgs.msg").TFMessage, load("rclpy.qos")
    chain = TfChain(base, end_effector)

    def take(message: Any, static: bool) -> None:
        found = []
        for item in message.transforms:
            T = pose_matrix(item.transform.translation, item.transform.rotation)
            if T is None:
                on_pose(0, None)
            else:
                found.append(
                    Transform(item.header.frame_id, item.child_frame_id, stamp_ns(item.header.stamp), T)
                )
        newest = chain.add(found, static=static)
        if newest is not None:
            on_pose(*newest)

    best = qos.QoSProfile(depth=_TF_QUEUE, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
    latched = qos.QoSProfile(depth=_TF_QUEUE, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(kind, "/tf", lambda message: take(message, False), best)
    node.create_subscription(kind, "/tf_static", lambda message: take(message, True), latched)


class Ros2Robot(QueuedRobot):
    """The end effector's pose as ROS 2 publishes it.

    Args:
        uri: ``ros2``, ``ros2:/ee_pose?phase=/trial/phase&opening=/gripper/opening``, or
            ``ros2:tf?base=base&end_effector=tool0``.
        timeline: The session's.

    Raises:
        ConfigError: an address that means nothing.
        DeviceError: ROS 2 is not installed.
    """

    def __init__(self, uri: str, timeline: Timeline) -> None:
        topic, _, query = uri.removeprefix("ros2").removeprefix(":").partition("?")
        options = {key: values[0] for key, values in parse_qs(query).items()}
        known = {"phase", "opening", "base", "end_effector"}
        if set(options) - known or (topic and topic != "tf" and not topic.startswith("/")):
            raise ConfigError(f"robot {uri!r}: expected {_FORM}")
        super().__init__(uri, timeline)
        self._topic, self._options = topic or "/ee_pose", options
        self._rclpy = load("rclpy")
        self._clock = ClockMap()
        self._base: str | None = options.get("base") if topic == "tf" else None

    @property
    def frames(self) -> PoseFrames:
        """The frame that the messages name; what moves in it only TF can tell."""
        return PoseFrames(self._base, self._options.get("end_effector") if self._topic == "tf" else None)

    def start(self, wake: Wake, tap: RobotTap | None = None) -> None:
        """Subscribe and wait for the first pose."""
        self._deliver_to(wake, tap)
        context = self._rclpy.Context()
        self._rclpy.init(context=context)
        try:
            node = self._rclpy.create_node("tiptrace_robot", context=context)
            self._subscribe(node)
        except DeviceError:
            self._rclpy.shutdown(context=context)
            raise
        self._begin(
            lambda: self._spin(context, node),
            f" on {self._topic}: is it published (ros2 topic hz), in the same ROS_DOMAIN_ID?",
        )

    # --- the thread ----------------------------------------------------------------------------------------

    def _subscribe(self, node: Any) -> None:
        qos = load("rclpy.qos").qos_profile_sensor_data
        if self._topic == "tf":
            base, end_effector = self._options.get("base", "base"), self._options.get("end_effector", "tool0")
            listen_to_tf(node, base, end_effector, self._put_pose)
        else:
            node.create_subscription(
                load("geometry_msgs.msg").PoseStamped, self._topic, self._guarded(self._on_pose), qos
            )
        std = load("std_msgs.msg")
        phase, opening = self._options.get("phase", "/trial/phase"), self._options.get("opening")
        node.create_subscription(std.String, phase, self._guarded(self._on_phase), 10)
        if opening is not None:
            node.create_subscription(std.Float64, opening, self._guarded(self._on_opening), qos)

    def _spin(self, context: Any, node: Any) -> None:
        executor = load("rclpy.executors").SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            while not self._stop.is_set() and context.ok():
                executor.spin_once(timeout_sec=0.1)
        except Exception as error:  # noqa: BLE001  a thread that dies must not do so silently
            self._queue.fail(DeviceError(f"{self.name}: {error}"))
        finally:
            executor.shutdown()
            node.destroy_node()
            self._rclpy.shutdown(context=context)

    def _guarded(self, take: Callable[[Any], None]) -> Callable[[Any], None]:
        def guarded(message: Any) -> None:
            try:
                take(message)
            except (ValueError, ArithmeticError):
                self._queue.meter.fault("garbled")

        return guarded

    def _on_pose(self, message: Any) -> None:
        self._base = message.header.frame_id or self._base
        T = pose_matrix(message.pose.position, message.pose.orientation)
        self._put_pose(stamp_ns(message.header.stamp), T)

    def _put_pose(self, stamp: int, T_B_E: FloatArray | None) -> None:
        if T_B_E is None:
            self._queue.meter.fault("garbled")
            return
        self._queue.put(PoseSample(self._clock.stamp_ns(stamp, self._timeline.now_ns()), T_B_E))

    def _on_phase(self, message: Any) -> None:
        self._queue.put(PhaseSample(self._timeline.now_ns(), Phase(message.data)))

    def _on_opening(self, message: Any) -> None:
        if not 0.0 <= message.data <= _OPENING_MAX_M:
            raise ValueError("opening")
        self._queue.put(OpeningSample(self._timeline.now_ns(), float(message.data)))
