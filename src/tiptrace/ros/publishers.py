"""What the node publishes: tip, pose with covariance, path, diagnostics. Nothing where no position can be claimed."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np

from tiptrace.drivers.ros2 import load
from tiptrace.geometry.transforms import quaternion_from_rotation
from tiptrace.types import Event, FloatArray, Status, TipEstimate

_UNKNOWN_RAD2 = 10.0  # no covariance of the orientation is estimated: as good as unknown
_PATH_PERIOD_S, _DIAGNOSTICS_PERIOD_S = 0.2, 1.0
_RATE_MEMORY_S = 3.0


class Publishers:
    """Publishes estimates.

    Args:
        node: The rclpy node.
        base: Frame of the positions.
        path_length: Poses that the path keeps.
    """

    def __init__(self, node: Any, base: str, path_length: int) -> None:
        self._node, self._base = node, base
        self._geometry, self._nav = load("geometry_msgs.msg"), load("nav_msgs.msg")
        self._diagnostic = load("diagnostic_msgs.msg")
        self._time = load("builtin_interfaces.msg").Time
        make = node.create_publisher
        self._tip = make(self._geometry.PointStamped, "tip", 10)
        self._pose = make(self._geometry.PoseWithCovarianceStamped, "tip_pose", 10)
        self._path = make(self._nav.Path, "path", 1)
        self._diagnostics = make(self._diagnostic.DiagnosticArray, "/diagnostics", 10)
        self._trail: deque[Any] = deque(maxlen=path_length)
        self._last_path = self._last_diagnostics = 0.0
        self._times: deque[float] = deque()

    def begin(self) -> None:
        """A new trial."""
        self._trail.clear()

    def publish(
        self, estimate: TipEstimate, events: list[Event], faults: dict[str, int], arrived_ns: int
    ) -> None:
        """Publish one estimate; its stamp is the instant that the position belongs to."""
        now = time.monotonic()
        self._times.append(now)
        while now - self._times[0] > _RATE_MEMORY_S:
            self._times.popleft()
        if estimate.p_B is not None:
            self._publish_tip(estimate, estimate.p_B)
            if now - self._last_path > _PATH_PERIOD_S:
                self._last_path = now
                header = self._header(estimate.stamp_ns)
                self._path.publish(self._nav.Path(header=header, poses=list(self._trail)))
        if now - self._last_diagnostics > _DIAGNOSTICS_PERIOD_S:
            self._last_diagnostics = now
            self._publish_diagnostics(estimate, events, faults, arrived_ns)

    def _publish_tip(self, estimate: TipEstimate, p_B: FloatArray) -> None:
        g, header = self._geometry, self._header(estimate.stamp_ns)
        x, y, z = (float(c) for c in p_B)
        self._tip.publish(g.PointStamped(header=header, point=g.Point(x=x, y=y, z=z)))
        R = np.eye(3) if estimate.R_B_E is None else estimate.R_B_E
        qx, qy, qz, qw = (float(c) for c in quaternion_from_rotation(R))
        pose = g.Pose(position=g.Point(x=x, y=y, z=z), orientation=g.Quaternion(x=qx, y=qy, z=qz, w=qw))
        message = g.PoseWithCovarianceStamped(header=header)
        message.pose.pose = pose
        message.pose.covariance = covariance_6x6(estimate.covariance)
        self._pose.publish(message)
        if estimate.status is not Status.ANCHORING:
            self._trail.append(g.PoseStamped(header=header, pose=pose))

    def _publish_diagnostics(
        self, estimate: TipEstimate, events: list[Event], faults: dict[str, int], arrived_ns: int
    ) -> None:
        d = self._diagnostic
        span = self._times[-1] - self._times[0]
        values = {
            "status": estimate.status.value,
            "phase": estimate.phase.value if estimate.phase else "",
            "rate_hz": f"{(len(self._times) - 1) / span:.2f}" if span > 0 else "",
            "loop_ms": "" if estimate.loop_ms is None else f"{estimate.loop_ms:.1f}",
            "age_ms": f"{(arrived_ns - estimate.stamp_ns) * 1e-6:.1f}",
            "markers": str(estimate.markers),
            "residual_mm": "" if estimate.residual_m is None else f"{estimate.residual_m * 1e3:.4f}",
            "sigma_mm": _sigma_mm(estimate.covariance),
            **{f"left out: {name}": str(count) for name, count in faults.items()},
        }
        for event in events[-5:]:
            values[f"event {event.kind} {event.start_ns}"] = event.detail
        good = estimate.status in (Status.OK, Status.ANCHORING)
        status = d.DiagnosticStatus(
            level=d.DiagnosticStatus.OK if good else d.DiagnosticStatus.WARN,
            name="tiptrace",
            message=estimate.status.value,
            values=[d.KeyValue(key=key, value=value) for key, value in values.items()],
        )
        self._diagnostics.publish(d.DiagnosticArray(header=self._header(estimate.stamp_ns), status=[status]))

    def _header(self, stamp_ns: int) -> Any:
        header = load("std_msgs.msg").Header(frame_id=self._base)
        header.stamp = self._time(sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000)
        return header


def covariance_6x6(covariance: FloatArray | None) -> list[float]:
    """Row-major covariance of (x, y, z, rotation); what is not estimated is as good as unknown."""
    full = np.diag([_UNKNOWN_RAD2] * 6)
    if covariance is not None:
        full[:3, :3] = covariance
    return [float(value) for value in full.ravel()]


def _sigma_mm(covariance: FloatArray | None) -> str:
    if covariance is None:
        return ""
    return " ".join(f"{1e3 * s:.3f}" for s in np.sqrt(np.maximum(np.diag(covariance), 0.0)))
