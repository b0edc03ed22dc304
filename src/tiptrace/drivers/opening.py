"""Devices by name: an explicit table, imported where used."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

from tiptrace.config import Sensor
from tiptrace.drivers.base import Camera, Robot
from tiptrace.drivers.camera import FrameSource, ThreadedCamera
from tiptrace.drivers.picture import Framing
from tiptrace.drivers.timeline import Timeline
from tiptrace.errors import ConfigError, DeviceError

CAMERA_FORMS = (
    "v4l2:SERIAL, /dev/v4l/by-id/NAME, /dev/v4l/by-path/NAME, http://HOST:PORT/PATH, or a video file"
)
ROBOT_FORMS = "ur://HOST, ros2, replay:FILE.csv, replay:FILE.mcap, or none"


def camera_source(uri: str, sensor: Sensor, timeline: Timeline) -> FrameSource:
    """The source that an address means.

    Raises:
        ConfigError: no such form, or an unsorted index such as /dev/video0.
        DeviceError: it cannot be there.
    """
    if uri.startswith(("http://", "https://")):
        from tiptrace.drivers.mjpeg import MjpegSource

        return MjpegSource(uri, timeline)
    if uri.startswith(("v4l2:", "/dev/")):
        from tiptrace.drivers.v4l2 import V4l2Source

        return V4l2Source(uri, sensor.camera, timeline)
    if Path(uri).is_file():
        from tiptrace.drivers.video_file import VideoFileSource

        return VideoFileSource(Path(uri), timeline)
    if urlsplit(uri).scheme or uri.isdigit() or not Path(uri).suffix:
        raise ConfigError(f"camera {uri!r} is none that tiptrace knows; give {CAMERA_FORMS}")
    raise DeviceError(f"camera {uri!r}: no such file; give {CAMERA_FORMS}")


def open_camera(uri: str, sensor: Sensor, timeline: Timeline, *, encode: bool = False) -> Camera:
    """A camera, not yet started.

    Args:
        uri: One of :data:`CAMERA_FORMS`.
        sensor: Crop, flip, size, fourcc.
        timeline: The session's.
        encode: Whether frames carry jpeg bytes for a recorder.

    Raises:
        ConfigError: an address that means nothing.
        DeviceError: a camera that is not there; lists those found.
    """
    return ThreadedCamera(camera_source(uri, sensor, timeline), Framing(sensor), timeline, encode=encode)


def open_robot(uri: str, timeline: Timeline) -> Robot:
    """A robot, not yet started.

    Args:
        uri: One of :data:`ROBOT_FORMS`.
        timeline: The session's.

    Raises:
        ConfigError: an address that means nothing.
        DeviceError: a replay that cannot be read.
        MissingExtraError: its library is not installed.
    """
    if uri == "none":
        from tiptrace.drivers.no_robot import NoRobot

        return NoRobot()
    if uri.startswith("replay:"):
        from tiptrace.drivers.replay import ReplayRobot

        return ReplayRobot(Path(uri.removeprefix("replay:")), timeline)
    if uri.startswith("ur://"):
        from tiptrace.drivers.ur import UrRobot

        return UrRobot(uri, timeline)
    if uri == "ros2" or uri.startswith("ros2:"):
        return _ros2(uri, timeline)
    raise ConfigError(f"robot {uri!r} is none that tiptrace knows; give {ROBOT_FORMS}")


def _ros2(uri: str, timeline: Timeline) -> Robot:
    import importlib

    try:
        module = importlib.import_module("tiptrace.drivers.ros2")
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("tiptrace"):
            raise ConfigError(f"robot {uri!r}: this installation has no ROS 2 driver") from None
        raise
    robot: Robot = module.Ros2Robot(uri, timeline)
    return robot
