"""What ``tiptrace doctor`` looks at: each finding says how it is, and where it is not well, what to do."""

from __future__ import annotations

import importlib.util
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, cast

from tiptrace.config import Frames, Sensor
from tiptrace.drivers.base import Camera, DeviceHealth, DeviceStatus, Robot
from tiptrace.drivers.opening import open_camera, open_robot
from tiptrace.drivers.timeline import Timeline
from tiptrace.drivers.v4l2 import list_cameras
from tiptrace.errors import ConfigError, TipTraceError
from tiptrace.streams.live import check_frames

Verdict = Literal["ok", "note", "fail"]

_EXTRAS = {  # extra → module that tells whether it is there
    "ur": "rtde_receive",
    "tables": "pyarrow",
    "calibrate": "sklearn",
    "export": "zarr",
    "viz": "rerun",
}
_LEAST_RATE_HZ = {"camera": 15.0, "robot": 20.0}
_FASTER = {"camera": "a smaller size_px helps", "robot": "end other programs, use a cable in place of Wi-Fi"}
_MOST_JITTER_MS = 15.0
_LEAST_FREE_GB = 2.0
_MOST_DRIFT_MS = 5.0


@dataclass(frozen=True, slots=True)
class Finding:
    """One line.

    Attributes:
        what: Looked at.
        verdict: ``ok``, ``note`` (not needed by everybody), or ``fail``.
        detail: How it is.
        remedy: What to do; empty where it is well.
    """

    what: str
    verdict: Verdict
    detail: str
    remedy: str = ""


def check_extras() -> Iterator[Finding]:
    """Optional libraries."""
    for extra, module in _EXTRAS.items():
        if importlib.util.find_spec(module) is not None:
            yield Finding(f"extra {extra}", "ok", f"{module} is installed")
        else:
            yield Finding(
                f"extra {extra}", "note", "not installed", f"pip install 'tiptrace[{extra}]', if you need it"
            )


def check_machine(folder: Path) -> Iterator[Finding]:
    """Cameras that the kernel shows, and the disk."""
    cameras = list_cameras()
    if not cameras:
        yield Finding(
            "USB cameras",
            "note",
            "none found",
            "plug them in; be in the group 'video'; or give http:// addresses",
        )
    serials = [camera.serial for camera in cameras]
    for camera in cameras:
        twice = camera.serial and serials.count(camera.serial) > 1
        yield Finding(
            camera.name,
            "fail" if twice else "ok",
            f"serial {camera.serial or 'none'}, {camera.path}",
            "two cameras have this serial number: name them by path" if twice else "",
        )
    free_gb = shutil.disk_usage(folder).free / 1e9
    enough = free_gb >= _LEAST_FREE_GB
    yield Finding(
        "disk",
        "ok" if enough else "fail",
        f"{free_gb:.1f} GB free in {folder}",
        "" if enough else "free some: a minute of recording takes about 60 MB",
    )


def check_devices(
    addresses: Mapping[str, str],
    sensors: Mapping[str, Sensor],
    robot: str | None,
    seconds: float = 5.0,
    frames: Frames | None = None,
) -> Iterator[Finding]:
    """Rates and jitter of cameras and robot, all running together for some seconds, and the clock meanwhile."""
    timeline = Timeline()
    running: dict[str, Camera | Robot] = {}
    try:
        for name, address in addresses.items():
            open_this = partial(open_camera, address, sensors[name], timeline)
            yield from _start(f"{name} camera", running, open_this)
        if robot is not None and robot != "none":
            yield from _start("robot", running, partial(open_robot, robot, timeline))
        if running:
            _watch(running, seconds)
        for name, device in running.items():
            yield _judge(name, device.health())
            if name == "robot" and frames is not None:
                yield from _check_frames(cast(Robot, device), frames)
        drift_ms = abs(timeline.wall_error_ns()) * 1e-6
        steady = drift_ms < _MOST_DRIFT_MS
        yield Finding(
            "clock",
            "ok" if steady else "fail",
            f"wall clock and monotonic clock differ by {drift_ms:.2f} ms after the test",
            "" if steady else "the wall clock is being set: let NTP settle (timedatectl), then try again",
        )
    finally:
        for device in running.values():
            device.close()


def _start(
    name: str, running: dict[str, Camera | Robot], open_it: Callable[[], Camera | Robot]
) -> Iterator[Finding]:
    """Start a device; a finding only where that fails."""
    try:
        device = open_it()
        device.start(lambda: None)
    except TipTraceError as error:
        sentence, _, remedy = str(error).rpartition(": ")
        yield Finding(name, "fail", sentence or remedy, remedy if sentence else "")
    else:
        running[name] = device


def _check_frames(robot: Robot, frames: Frames) -> Iterator[Finding]:
    """A finding only where the pose is not the one that the rig file means."""
    try:
        check_frames(robot.frames, frames)
    except ConfigError as error:
        sentence, _, remedy = str(error).partition(": ")
        yield Finding("robot's pose", "fail", sentence, remedy)


def _watch(running: Mapping[str, Camera | Robot], seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.05)
        for device in running.values():
            device.take()


def _judge(name: str, health: DeviceHealth) -> Finding:
    rate, jitter = health.rate_hz or 0.0, health.jitter_ms or 0.0
    kind = "robot" if name == "robot" else "camera"
    faults = ", ".join(f"{fault} {count}" for fault, count in health.faults if fault != "dropped")
    detail = f"{health.name}: {rate:.1f} Hz, jitter {jitter:.1f} ms" + (f", {faults}" if faults else "")
    if health.status is DeviceStatus.ENDED:
        return Finding(name, "note", f"{detail}; the file is over", "give a longer one, or fewer --seconds")
    if health.status is not DeviceStatus.OK:
        return Finding(name, "fail", f"{detail}; {health.status.value}", "check its cable and its server")
    if rate < _LEAST_RATE_HZ[kind]:
        return Finding(
            name, "fail", detail, f"at least {_LEAST_RATE_HZ[kind]:g} Hz are needed: {_FASTER[kind]}"
        )
    if jitter > _MOST_JITTER_MS:
        return Finding(
            name, "fail", detail, "use a cable in place of Wi-Fi, end other programs, give each camera a port"
        )
    return Finding(name, "ok", detail)
