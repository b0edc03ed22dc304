"""Cameras of this machine, by serial number or stable path; never by an index, which changes with the plugging."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tiptrace.config import Camera
from tiptrace.drivers.camera import RawFrame, SourceLostError
from tiptrace.drivers.timeline import NS, Timeline
from tiptrace.errors import ConfigError, DeviceError

_MAX_STAMP_AGE_NS = NS
_BY_ID, _BY_PATH = "dev/v4l/by-id", "dev/v4l/by-path"


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera as the kernel names it.

    Attributes:
        path: Stable path: ``/dev/v4l/by-id/…``, or ``/dev/v4l/by-path/…``, the USB port, where another camera has the
            same serial number: those share one name in by-id, which is that of either.
        device: What it points to now, ``/dev/videoN``.
        name: Product name.
        serial: USB serial number; empty where the device has none.
    """

    path: Path
    device: Path
    name: str
    serial: str


def list_cameras(root: Path = Path("/")) -> list[FoundCamera]:
    """Capture devices with a stable path, sorted by it; ``root`` is another file system in tests."""
    by_id, by_port = _links(root / _BY_ID), _links(root / _BY_PATH, "-usb")
    facts = {
        device: (_read(sys / "name"), _read(sys / "device" / ".." / "serial"))
        for device in {**by_id, **by_port}
        for sys in [root / "sys/class/video4linux" / device.name]
    }
    serials = [serial for _, serial in facts.values()]
    found = []
    for device, (name, serial) in facts.items():
        alone = device in by_id and serials.count(serial) == 1
        path = by_id[device] if alone else by_port.get(device) or by_id[device]
        found.append(FoundCamera(path, device, name or path.name, serial))
    return sorted(found, key=lambda camera: camera.path)


def _links(folder: Path, part: str = "") -> dict[Path, Path]:
    """Device → link to it, of those that carry pictures: the others, not index 0, carry metadata."""
    if not folder.is_dir():
        return {}
    links = sorted(folder.iterdir(), reverse=True)  # of several links to a device the first one stays
    return {link.resolve(): link for link in links if link.name.endswith("-index0") and part in link.name}


def find_camera(uri: str, root: Path = Path("/")) -> FoundCamera:
    """The camera that an address means.

    Args:
        uri: ``v4l2:SERIAL``, ``/dev/v4l/by-id/NAME`` or ``/dev/v4l/by-path/NAME``.
        root: Of the file system.

    Raises:
        ConfigError: an index such as ``/dev/video0``.
        DeviceError: no such camera, or two with this serial number; lists those found.
    """
    if uri.startswith("/dev/video"):
        raise ConfigError(
            f"camera {uri!r}: the number changes with the order of plugging, so left and right may be exchanged; give "
            "v4l2:SERIAL, or a path in /dev/v4l/by-id or by-path (tiptrace doctor lists them)"
        )
    cameras = list_cameras(root)
    serial = uri.removeprefix("v4l2:") if uri.startswith("v4l2:") else None
    if serial is None:
        link = root / uri.lstrip("/")
        matches = [
            c for c in cameras if link.parent.parent == root / "dev/v4l" and c.device == link.resolve()
        ]
    else:
        matches = [c for c in cameras if serial and c.serial == serial]
    if len(matches) > 1:
        paths = ", ".join(str(c.path) for c in matches)
        raise DeviceError(
            f"camera {uri!r}: {len(matches)} cameras have this serial number; name each by its path, which holds the "
            f"USB port: {paths}"
        )
    if not matches:
        raise DeviceError(f"camera {uri!r} is not there; {describe(cameras)}")
    return matches[0]


def describe(cameras: list[FoundCamera]) -> str:
    """Cameras found, in words."""
    if not cameras:
        return "no camera found: check the USB cable, and that you may read /dev/video* (group video)"
    named = "; ".join(f"{c.name}, serial {c.serial or 'none'}, {c.path}" for c in cameras)
    return f"found: {named}"


class V4l2Source:
    """Frames of a camera of this machine, as jpeg where the camera sends it.

    Stamped by the kernel when the transfer of the frame began or ended, as the camera's driver does it.

    Args:
        uri: See :func:`find_camera`.
        camera: Size and fourcc to ask for.
        timeline: The session's.
        root: Of the file system.
    """

    def __init__(self, uri: str, camera: Camera | None, timeline: Timeline, root: Path = Path("/")) -> None:
        self._uri, self._root, self._timeline = uri, root, timeline
        self._fourcc = (camera.fourcc if camera else None) or "MJPG"
        self._size_px = camera.size_px if camera else None
        self.name = find_camera(uri, root).name
        self._capture: Any = None

    def connect(self) -> None:
        """Open, ask for format and size, and check that they were granted.

        Raises:
            DeviceError: missing, busy, or another format.
        """
        camera = find_camera(self._uri, self._root)
        _check_free(camera)
        capture = cv2.VideoCapture(str(camera.device), cv2.CAP_V4L2)
        if not capture.isOpened():
            raise DeviceError(
                f"{self.name}: cannot be opened; another program may be using it ({camera.device})"
            )
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*self._fourcc))
        if self._size_px is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size_px[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size_px[1])
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if self._fourcc == "MJPG":
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # the jpeg itself
        self._check_granted(capture)
        self._capture = capture

    def _check_granted(self, capture: Any) -> None:
        code = int(capture.get(cv2.CAP_PROP_FOURCC))
        fourcc = "".join(chr((code >> 8 * k) & 0xFF) for k in range(4))
        size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if fourcc != self._fourcc or (self._size_px is not None and size != tuple(self._size_px)):
            capture.release()
            asked = f"{self._fourcc} {self._size_px[0]}x{self._size_px[1]}" if self._size_px else self._fourcc
            raise DeviceError(
                f"{self.name}: asked for {asked}, granted {fourcc} {size[0]}x{size[1]}: set camera.fourcc and "
                "camera.size_px in the rig file to what `v4l2-ctl --list-formats-ext` shows"
            )

    def read(self) -> RawFrame:
        """The next frame.

        Raises:
            SourceLostError: unplugged or silent.
        """
        ok, data = self._capture.read() if self._capture is not None else (False, None)
        arrived_ns = self._timeline.now_ns()
        if not ok or data is None:
            raise SourceLostError(f"{self.name}: disconnected or silent")
        stamp_ns = self._timeline.from_monotonic(round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6))
        if not 0 <= arrived_ns - stamp_ns <= _MAX_STAMP_AGE_NS:
            stamp_ns = arrived_ns  # a kernel that stamps by another clock
        if data.ndim == 3 and data.shape[2] == 3:
            return RawFrame(stamp_ns, arrived_ns, image=np.asarray(data, dtype=np.uint8))
        return RawFrame(stamp_ns, arrived_ns, jpeg=data.tobytes())

    def abort(self) -> None:
        """A read ends by itself: OpenCV waits ten seconds at most."""

    def disconnect(self) -> None:
        """Release the device."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None


def _check_free(camera: FoundCamera) -> None:
    """The device must be there and readable, and say so in words.

    Raises:
        DeviceError: it is not.
    """
    try:
        os.close(os.open(camera.device, os.O_RDWR | os.O_NONBLOCK))
    except OSError as error:
        if error.errno == errno.EBUSY:
            raise DeviceError(
                f"{camera.name}: is in use by another program ({camera.device}): close it"
            ) from None
        remedy = "add yourself to the group 'video'" if error.errno == errno.EACCES else "plug it in again"
        raise DeviceError(
            f"{camera.name}: {camera.device} cannot be opened ({error.strerror}): {remedy}"
        ) from None


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
