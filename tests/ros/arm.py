"""An arm as ROS 2 shows it: python arm.py topic|tf SECONDS. Sample k: x = k · 10 µm, stamped 8 ms after the last."""

from __future__ import annotations

import sys
import time
from typing import Any

NS = 1_000_000_000
PERIOD_NS, STEP_M = 8_000_000, 1e-5


def main(kind: str, seconds: float) -> None:
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from std_msgs.msg import Float64, String

    rclpy.init()
    node = rclpy.create_node("arm")
    if kind == "tf":
        from tf2_msgs.msg import TFMessage

        publisher = node.create_publisher(TFMessage, "/tf", 50)

        def send(transform: Any) -> None:
            publisher.publish(TFMessage(transforms=[transform]))

    else:
        send = node.create_publisher(PoseStamped, "/ee_pose", 50).publish
    opening = node.create_publisher(Float64, "/gripper/opening", 10)
    phase = node.create_publisher(String, "/trial/phase", 10)
    begun = time.time_ns()
    for k in range(int(seconds * NS / PERIOD_NS)):
        stamp = begun + k * PERIOD_NS
        time.sleep(max(0.0, (stamp - time.time_ns()) / NS))
        send(message(kind, stamp, k * STEP_M))
        if k % 25 == 0:
            opening.publish(Float64(data=0.0062))
            phase.publish(String(data="anchoring" if k % 50 else "nonsense"))
    node.destroy_node()
    rclpy.shutdown()


def message(kind: str, stamp_ns: int, x: float) -> Any:
    from builtin_interfaces.msg import Time
    from geometry_msgs.msg import PoseStamped, TransformStamped

    found = TransformStamped(child_frame_id="tool0") if kind == "tf" else PoseStamped()
    found.header.frame_id = "base"
    found.header.stamp = Time(sec=stamp_ns // NS, nanosec=stamp_ns % NS)
    if kind == "tf":
        found.transform.translation.x, found.transform.rotation.w = x, 1.0
    else:
        found.pose.position.x, found.pose.orientation.w = x, 1.0
    return found


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
