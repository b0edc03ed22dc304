"""Plays a recording into ROS 2 and keeps what the node answers: python player.py TRIAL.mcap OUT.json."""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Float64, String

from tiptrace.streams.mcap_source import McapSource

TYPES = {
    "sensor_msgs/msg/CompressedImage": CompressedImage,
    "geometry_msgs/msg/PoseStamped": PoseStamped,
    "std_msgs/msg/String": String,
    "std_msgs/msg/Float64": Float64,
}
NS = 1_000_000_000
SPEED = 0.7


def stamp(message) -> int:
    return message.header.stamp.sec * NS + message.header.stamp.nanosec


def main(recording: Path, out: Path) -> None:
    rclpy.init()
    node = rclpy.create_node("player")
    qos = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
    rows = [
        m for m in McapSource(recording).messages() if m.type in TYPES and not m.topic.startswith("/ground")
    ]
    publishers = {m.topic: node.create_publisher(TYPES[m.type], m.topic, qos) for m in rows}
    clock = node.create_publisher(Clock, "/clock", 10)
    found = {"tip": [], "pose": [], "path": 0, "diagnostics": []}
    node.create_subscription(
        PointStamped,
        "tip",
        lambda m: found["tip"].append([stamp(m), m.header.frame_id, m.point.x, m.point.y, m.point.z]),
        qos,
    )
    node.create_subscription(
        PoseWithCovarianceStamped,
        "tip_pose",
        lambda m: found["pose"].append([stamp(m), *(float(v) for v in m.pose.covariance)]),
        qos,
    )
    node.create_subscription(PathMessage, "path", lambda m: found.update(path=len(m.poses)), 10)
    node.create_subscription(
        DiagnosticArray,
        "/diagnostics",
        lambda m: found["diagnostics"].append({v.key: v.value for s in m.status for v in s.values}),
        10,
    )
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinning = threading.Thread(target=executor.spin, daemon=True)
    spinning.start()
    deadline = time.monotonic() + 90
    while any(p.get_subscription_count() == 0 for p in publishers.values()) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(1.0)
    begun, first = time.monotonic(), rows[0].log_time_ns
    for row in rows:
        time.sleep(max(0.0, begun + (row.log_time_ns - first) / NS / SPEED - time.monotonic()))
        clock.publish(Clock(clock=Time(sec=row.log_time_ns // NS, nanosec=row.log_time_ns % NS)))
        if row.type == "std_msgs/msg/String":
            time.sleep(0.5)  # so that the node's clock says this when the mark comes
        publishers[row.topic].publish(deserialize_message(row.data, TYPES[row.type]))
        if row.type == "std_msgs/msg/String":
            time.sleep(0.5)
            begun += 1.0
    quiet, count = time.monotonic(), -1
    while time.monotonic() - quiet < 12.0:  # the node may be slower than the recording
        if len(found["tip"]) != count:
            quiet, count = time.monotonic(), len(found["tip"])
        time.sleep(0.2)
    out.write_text(json.dumps(found))
    executor.shutdown(timeout_sec=5.0)
    spinning.join(timeout=5.0)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
