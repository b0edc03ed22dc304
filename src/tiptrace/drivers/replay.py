"""A robot's poses from a file, in real time: for rehearsals without an arm."""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path

import numpy as np

from tiptrace.drivers.base import DeviceStatus, PoseFrames, RobotTap, Wake
from tiptrace.drivers.queued_robot import QueuedRobot
from tiptrace.drivers.timeline import NS, Timeline
from tiptrace.errors import DeviceError, GeometryError
from tiptrace.geometry.transforms import rotation_from_quaternion, transform
from tiptrace.types import PoseSample

_COLUMNS = ("stamp_ns", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_REACH_M = 3.0


class ReplayRobot(QueuedRobot):
    """Poses of a csv or MCAP file, each at its time after the start.

    Args:
        path: ``.mcap`` with ``/ee_pose``, or csv with the columns stamp_ns, x_m, y_m, z_m, qx, qy, qz, qw.
        timeline: The session's.

    Raises:
        DeviceError: cannot be read, or holds no poses.
    """

    def __init__(self, path: Path, timeline: Timeline) -> None:
        super().__init__(f"replay:{path}", timeline)
        if path.suffix == ".mcap":
            self._poses, base = _from_mcap(path)
        else:
            self._poses, base = _from_csv(path), None
        if len(self._poses) < 2:
            raise DeviceError(f"{path}: holds no poses to replay")
        self._frames = PoseFrames(base, None)

    @property
    def frames(self) -> PoseFrames:
        """As the file says; a csv does not."""
        return self._frames

    def start(self, wake: Wake, tap: RobotTap | None = None) -> None:
        """Begin to play."""
        self._deliver_to(wake, tap)
        self._begin(self._run, "")

    def _run(self) -> None:
        shift_ns = self._timeline.now_ns() - self._poses[0].stamp_ns
        for pose in self._poses:
            stamp_ns = pose.stamp_ns + shift_ns
            wait_s = (stamp_ns - self._timeline.now_ns()) / NS
            if wait_s > 0 and self._stop.wait(wait_s):
                return
            self._queue.put(PoseSample(stamp_ns, pose.T_B_E))
        self._queue.meter.bad(DeviceStatus.ENDED, f"{self.name}: the replay is over")


def _from_csv(path: Path) -> list[PoseSample]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DeviceError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if not rows or any(name not in rows[0] for name in _COLUMNS):
        raise DeviceError(f"{path}: expected a csv file with the columns {', '.join(_COLUMNS)}")
    poses = []
    for number, row in enumerate(rows, start=2):
        try:
            x, y, z, *q = (float(row[name]) for name in _COLUMNS[1:])
            poses.append(_pose(int(row["stamp_ns"]), (x, y, z), q))
        except (TypeError, ValueError, GeometryError) as error:
            raise DeviceError(f"{path}: line {number}: {error}") from None
    if any(b.stamp_ns <= a.stamp_ns for a, b in pairwise(poses)):
        raise DeviceError(f"{path}: stamps must increase from line to line")
    return poses


def _from_mcap(path: Path) -> tuple[list[PoseSample], str | None]:
    """Poses of ``/ee_pose`` and the frame that they are in."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    poses: list[PoseSample] = []
    base: str | None = None
    try:
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, _, _, m in reader.iter_decoded_messages(topics=["/ee_pose"]):
                p, o = m.pose.position, m.pose.orientation
                stamp_ns = m.header.stamp.sec * NS + m.header.stamp.nanosec
                base = m.header.frame_id or base
                poses.append(_pose(stamp_ns, (p.x, p.y, p.z), [o.x, o.y, o.z, o.w]))
    except (OSError, McapError, ValueError, AttributeError, GeometryError) as error:
        raise DeviceError(
            f"{path}: its poses cannot be read ({getattr(error, 'strerror', None) or str(error) or 'no MCAP file'})"
        ) from None
    if not poses:
        raise DeviceError(f"{path}: has no poses on /ee_pose")
    poses.sort(key=lambda pose: pose.stamp_ns)
    return poses, base


def _pose(stamp_ns: int, t: tuple[float, float, float], q: list[float]) -> PoseSample:
    if not all(map(math.isfinite, (*t, *q))):
        raise ValueError("a number of the pose is not finite")
    if max(abs(c) for c in t) > _REACH_M:
        raise ValueError(f"position {t} is beyond {_REACH_M:g} m: it looks like millimetres; give metres")
    return PoseSample(stamp_ns, transform(rotation_from_quaternion(np.asarray(q)), np.asarray(t)))
