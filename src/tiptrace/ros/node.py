"""The node: parameters, the loop of ``pipeline.steps`` in the main thread, rclpy's callbacks in another."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tiptrace.config import load_yaml
from tiptrace.drivers.ros2 import load
from tiptrace.errors import ConfigError, PerceptionError
from tiptrace.live.start import read_rig_folder
from tiptrace.pipeline import open_tracer, steps
from tiptrace.ros.publishers import Publishers
from tiptrace.ros.stream import RosStream
from tiptrace.ros.subscriptions import Subscriptions, Topics, standard_topics
from tiptrace.streams.mapping import MapFile
from tiptrace.streams.sync_report import SyncReport
from tiptrace.streams.synchronise import LIVE, SyncSettings

PARAMETERS: dict[str, Any] = {
    "rig": "",
    "tool": "",
    "map": "",
    "method": "full",
    "left_topic": "",
    "right_topic": "",
    "pose_topic": "",
    "phase_topic": "",
    "opening_topic": "",
    "end_effector_frame": "",
    "use_tf": False,
    "reliable": False,
    "queue_depth": 10,
    "wait_for_late_s": 0.0,
    "path_length": 5000,
}
_KINDS = {str: "text", bool: "true or false", int: "whole number", float: "number"}


def run(arguments: Sequence[str], rig: Path | None = None) -> None:
    """Run the node until it is interrupted.

    Args:
        arguments: ROS arguments (``--ros-args -p rig:=rig.yaml …``).
        rig: In place of the parameter.

    Raises:
        DeviceError: ROS 2 is not installed.
        ConfigError: a parameter or a settings file is wrong.
    """
    rclpy = load("rclpy")
    try:
        rclpy.init(args=["tiptrace", *arguments])
    except Exception as error:  # noqa: BLE001  a class of rclpy's private extension
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"ROS arguments {' '.join(arguments)!r} are not understood: {reason}") from None
    node = rclpy.create_node("tiptrace")
    try:
        values = _parameters(node)
        if rig is not None:
            values["rig"] = str(rig)
        _run(node, values)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        if rclpy.ok():
            rclpy.shutdown()


def _parameters(node: Any) -> dict[str, Any]:
    """Values of all parameters, of the types of their defaults; a whole number is a number too."""
    anything = load("rcl_interfaces.msg").ParameterDescriptor(dynamic_typing=True)
    values = {}
    for name, default in PARAMETERS.items():
        value, kind = node.declare_parameter(name, default, anything).value, type(default)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            raise ConfigError(f"parameter {name}: {value!r} is no {_KINDS[kind]}")
        values[name] = value
    return values


def _run(node: Any, values: dict[str, Any]) -> None:
    if not values["rig"]:
        raise ConfigError("parameter rig is not set: --ros-args -p rig:=rig.yaml")
    folder = read_rig_folder(Path(values["rig"]), Path(values["tool"]) if values["tool"] else None)
    map_file = load_yaml(MapFile, Path(values["map"])) if values["map"] else None
    stream = RosStream(folder.rig, folder.tool, dict(folder.references))
    stream.gel_models = dict(folder.gel_models)
    topics = _topics(values, standard_topics(folder.rig, map_file))
    publishers = Publishers(node, folder.rig.frames.base, values["path_length"])
    Subscriptions(node, topics, stream, map_file)
    executor = load("rclpy.executors").SingleThreadedExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=_spin, args=(executor, stream), name="ros2", daemon=True)
    thread.start()
    node.get_logger().info(f"listening to {', '.join(topics.images.values())} and {topics.pose or 'TF'}")
    try:
        while not stream.stopped:
            publishers.begin()
            _trial(node, stream, values, publishers)
    except Exception:
        if node.context.ok():
            raise
        # interrupted between two messages: nothing can be published any more
    finally:
        stream.stop()
        executor.shutdown(timeout_sec=1.0)
        thread.join(timeout=2.0)


def _trial(node: Any, stream: RosStream, values: dict[str, Any], publishers: Publishers) -> None:
    """One trial: until its stamps begin anew or the node is stopped."""
    late_s = float(values["wait_for_late_s"])
    settings = LIVE if late_s <= 0 else SyncSettings(max_delay_s=late_s)
    report = SyncReport()
    with open_tracer(stream, values["method"]) as tracer:
        try:
            for step in steps(stream, tracer, report, settings):
                now_ns = int(node.get_clock().now().nanoseconds)
                publishers.publish(step.estimate, tracer.events, dict(stream.faults), now_ns)
        except PerceptionError as error:
            node.get_logger().error(f"{error}; starting anew")
    if report.pairs:
        node.get_logger().info(f"trial ended: {report.pairs} pairs; {'; '.join(report.sentences())}")


def _spin(executor: Any, stream: RosStream) -> None:
    try:
        executor.spin()
    except load("rclpy.executors").ExternalShutdownException:
        pass  # SIGINT or SIGTERM: rclpy's own handler has shut the context down
    finally:
        stream.stop()


def _topics(values: dict[str, Any], standard: Topics) -> Topics:
    images = dict(standard.images)
    if values["left_topic"]:
        images["left"] = values["left_topic"]
    if values["right_topic"]:
        images["right"] = values["right_topic"]
    return replace(
        standard,
        images=images,
        pose="" if values["use_tf"] else values["pose_topic"] or standard.pose,
        phase=values["phase_topic"] or standard.phase,
        opening=values["opening_topic"] or standard.opening,
        end_effector=values["end_effector_frame"] or standard.end_effector,
        reliable=bool(values["reliable"]),
        depth=int(values["queue_depth"]),
    )
