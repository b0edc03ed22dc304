"""Cameras: what is delivered is new and whole, whatever the server does; everything else is told."""

from __future__ import annotations

import socket
import time
import zlib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.live.servers import FPS, Fault, Feed, MjpegServer, feed_from
from tests.streams.helpers import SIZE, make_rig, texture
from tiptrace.drivers.base import DeviceStatus, Frame
from tiptrace.drivers.camera import SourceLostError
from tiptrace.drivers.jpeg_scan import warm_up
from tiptrace.drivers.mjpeg import MjpegSource
from tiptrace.drivers.opening import camera_source, open_camera
from tiptrace.drivers.picture import Framing, Novelty, PictureError, decode_jpeg, encode_jpeg, inspect_jpeg
from tiptrace.drivers.timeline import NS, ClockMap, Timeline
from tiptrace.drivers.v4l2 import find_camera, list_cameras
from tiptrace.errors import ConfigError, DeviceError
from tiptrace.types import ImageSample, PoseSample

PICTURES = 60


@pytest.fixture(scope="module")
def feed() -> Feed:
    warm_up()
    rng = np.random.default_rng(1)
    base = texture(1).astype(np.float64)
    samples: list[ImageSample | PoseSample] = []
    for k in range(PICTURES):
        noisy = np.clip(base + 10 * np.sin(k / 9) + rng.normal(0, 2, base.shape), 0, 255).astype(np.uint8)
        stamp = round(k / FPS * NS)
        samples += [ImageSample("left", stamp, noisy), ImageSample("right", stamp, noisy)]
        samples.append(PoseSample(stamp, np.eye(4)))
    return feed_from(samples)


def watch(
    feed: Feed, faults: Sequence[Fault], seconds: float, **options: bool
) -> tuple[list[Frame], dict[str, int], set[DeviceStatus]]:
    """Frames, fault counts and states seen while a server plays."""
    start = time.monotonic()
    server = MjpegServer("left", feed, start, faults, **options)
    timeline, frames, states = Timeline(), [], set()
    camera = open_camera(server.url, make_rig().sensors.left, timeline, encode=True)
    try:
        camera.start(lambda: None)
        while time.monotonic() - start < seconds:
            frames += camera.take()
            states.add(camera.health().status)
            time.sleep(0.01)
        return frames, dict(camera.health().faults), states
    finally:
        camera.close()
        server.close()


def known(feed: Feed) -> set[int]:
    return {zlib.crc32(decode_jpeg(jpeg).tobytes()) for jpeg in feed.jpegs["left"]}


def assert_sound(frames: Sequence[Frame], feed: Feed) -> None:
    """Every frame is one of those sent, none follows itself, stamps increase, bytes and pixels agree."""
    marks = [zlib.crc32(frame.image.tobytes()) for frame in frames]
    assert set(marks) <= known(feed)
    assert all(a != b for a, b in pairwise(marks))
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(frames))
    for frame in frames:
        assert frame.stamp_ns <= frame.arrived_ns
        assert frame.jpeg is not None
        assert np.array_equal(decode_jpeg(frame.jpeg), frame.image)


@pytest.mark.parametrize("options", [{}, {"timestamps": False}, {"lengths": False}])
def test_every_frame_of_a_good_server_is_delivered_in_order(feed: Feed, options: dict[str, bool]) -> None:
    frames, _, _ = watch(feed, (), 1.5, **options)
    assert_sound(frames, feed)
    assert len(frames) >= 0.6 * 1.5 * FPS


@pytest.mark.parametrize(
    ("kind", "told", "status"),
    [
        ("freeze", "repeated", DeviceStatus.FROZEN),
        pytest.param("repeat", "repeated", None, marks=pytest.mark.slow),
        ("truncate", "garbled", DeviceStatus.GARBLED),
        ("garbage", "garbled", DeviceStatus.GARBLED),
        ("disconnect", "lost", DeviceStatus.LOST),
        pytest.param("stall", "lost", DeviceStatus.LOST, marks=pytest.mark.slow),
        pytest.param("drop", None, None, marks=pytest.mark.slow),
    ],
)
def test_faults_are_told_and_never_delivered(
    feed: Feed, kind: str, told: str | None, status: DeviceStatus | None
) -> None:
    long = kind in ("stall", "disconnect")
    end = 2.2 if long else 1.4
    frames, faults, states = watch(feed, [Fault(kind, "left", 0.6, end)], end + (2.5 if long else 1.3))
    assert_sound(frames, feed)
    if told is not None:
        assert faults[told] >= 1
    if status is not None:
        assert status in states
    last = (frames[-1].stamp_ns - frames[0].stamp_ns) / NS
    assert last > end - 0.6, "it comes back after the fault's end"


def test_a_clock_that_is_set_moves_no_stamp_away_from_its_arrival(feed: Feed) -> None:
    frames, _, _ = watch(feed, [Fault("clock", "left", 0.5, 1.0)], 2.0)
    assert all(frame.arrived_ns - frame.stamp_ns < 0.3 * NS for frame in frames)
    assert (frames[-1].stamp_ns - frames[0].stamp_ns) / NS > 1.2


def test_damage_in_a_jpeg_is_mostly_seen_by_its_bytes_and_a_cut_always() -> None:
    jpeg = encode_jpeg(texture(3, (320, 240)))
    rng = np.random.default_rng(0)
    for length in rng.integers(2, len(jpeg) - 1, 50):
        with pytest.raises(PictureError):
            inspect_jpeg(jpeg[:length])


def test_a_torn_picture_is_held_back_and_a_lasting_change_is_not() -> None:
    novelty, calm, dark = Novelty(), texture(3, (320, 240)), np.zeros((240, 320, 3), np.uint8)
    assert not novelty.torn(calm)
    torn = calm.copy()
    torn[120:] = 128
    assert novelty.torn(torn)
    assert not novelty.torn(calm)
    for _ in range(5):  # one damaged picture after the other, none like the one before
        torn = np.roll(torn, 30, axis=0)
        assert novelty.torn(torn)
    assert novelty.torn(dark)
    novelty.broken()
    assert novelty.torn(dark), "with a damaged one between them"
    assert not novelty.torn(dark)


def test_crop_flip_and_size_in_this_order() -> None:
    rig = make_rig()
    camera = {"crop_px": (10, 20, 128, 96), "flip": "horizontal"}
    sensor = rig.sensors.left.model_validate(rig.sensors.left.model_dump() | {"camera": camera})
    image = texture(2, (200, 150))
    expected = cv2.resize(image[20:116, 10:138][:, ::-1], SIZE, interpolation=cv2.INTER_AREA)
    assert np.array_equal(Framing(sensor).apply(image), expected)
    with pytest.raises(DeviceError, match="lies outside the image of 100x80"):
        Framing(sensor).check("camera", texture(2, (100, 80)))


def test_another_size_than_asked_for_is_refused(feed: Feed) -> None:
    rig = make_rig()
    sensor = rig.sensors.left.model_validate(
        rig.sensors.left.model_dump() | {"camera": {"size_px": (640, 480)}}
    )
    server = MjpegServer("left", feed, time.monotonic())
    with pytest.raises(DeviceError, match="sends 64x48 px, the rig file asks for 640x480"):
        open_camera(server.url, sensor, Timeline()).start(lambda: None)
    server.close()


def test_a_missing_server_is_named() -> None:
    camera = open_camera("http://127.0.0.1:9/", make_rig().sensors.left, Timeline())
    with pytest.raises(DeviceError, match="cannot be reached"):
        camera.start(lambda: None)


@pytest.mark.parametrize("uri", ["/dev/video0", "0", "gelsight", "ftp://host/x", "http://[::1", "http:///x"])
def test_addresses_that_mean_nothing_are_refused(uri: str) -> None:
    with pytest.raises((ConfigError, DeviceError)):
        camera_source(uri, make_rig().sensors.left, Timeline())


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A file system with three cameras, two of one serial number."""
    for number, (name, serial) in enumerate([("A", "S1"), ("B", "S2"), ("C", "S2")]):
        device = tmp_path / f"dev/video{number}"
        device.parent.mkdir(exist_ok=True)
        device.touch()
        link = tmp_path / f"dev/v4l/by-id/usb-{name}-video-index0"
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(device)
        usb = tmp_path / f"sys/devices/usb{number}"
        (usb / "interface").mkdir(parents=True)
        (usb / "serial").write_text(serial + "\n")
        folder = tmp_path / f"sys/class/video4linux/video{number}"
        folder.mkdir(parents=True)
        (folder / "name").write_text(f"GelSight {name}\n")
        (folder / "device").symlink_to(usb / "interface")
    return tmp_path


def test_cameras_are_found_by_serial_number_and_by_path(machine: Path) -> None:
    assert find_camera("v4l2:S1", machine).name == "GelSight A"
    assert find_camera("/dev/v4l/by-id/usb-B-video-index0", machine).name == "GelSight B"
    with pytest.raises(DeviceError, match="2 cameras have this serial number"):
        find_camera("v4l2:S2", machine)
    with pytest.raises(DeviceError, match="GelSight A, serial S1"):
        find_camera("v4l2:S9", machine)
    with pytest.raises(ConfigError, match="number changes"):
        find_camera("/dev/video0", machine)


def test_cameras_of_one_serial_number_are_named_by_their_ports(machine: Path) -> None:
    """udev makes one link of both in by-id, to whichever came last."""
    (machine / "dev/v4l/by-id/usb-C-video-index0").unlink()
    ports = machine / "dev/v4l/by-path"
    ports.mkdir()
    for number in range(3):
        for kind in ("usb", "usbv2"):
            link = ports / f"pci-0000:00:14.0-{kind}-0:{number}:1.0-video-index0"
            link.symlink_to(machine / f"dev/video{number}")
    (ports / "platform-codec-video-index0").symlink_to(machine / "dev/video9")  # no camera
    found = list_cameras(machine)
    assert [camera.path.parent.name for camera in found] == ["by-id", "by-path", "by-path"]
    assert len({camera.device for camera in found}) == 3
    for camera in found:
        again = find_camera("/" + str(camera.path.relative_to(machine)), machine)
        assert again.device == camera.device
    with pytest.raises(DeviceError, match=r"usb-0:1:1\.0.*usb-0:2:1\.0"):
        find_camera("v4l2:S2", machine)


@pytest.mark.parametrize(
    ("told", "sent"),
    [
        ('"frame"; charset=x', "--frame"),
        ("--frame", "--frame"),
        ("--frame", "----frame"),
        ("=_x", "--=_x"),
    ],
)
def test_servers_write_the_boundary_in_many_ways(feed: Feed, told: str, sent: str) -> None:
    jpegs = feed.jpegs["left"]

    class Server(MjpegServer):
        def handle(self, connection: socket.socket) -> None:
            connection.recv(4096)
            head = f"HTTP/1.0 200 OK\r\nContent-Type: Multipart/X-Mixed-Replace; boundary={told}\r\n\r\n"
            connection.sendall(head.encode())
            for jpeg in jpegs[:5]:
                connection.sendall(f"{sent}\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode() + jpeg + b"\r\n")
            connection.sendall(f"{sent}--\r\n".encode())

    server = Server("left", feed, time.monotonic())
    source = MjpegSource(server.url, Timeline())
    source.connect()
    assert [source.read().jpeg for _ in range(5)] == jpegs[:5]
    with pytest.raises(SourceLostError, match="ended the stream"):
        source.read()
    source.disconnect()
    server.close()


def test_the_least_delay_tells_the_clocks_apart() -> None:
    rng, clock = np.random.default_rng(0), ClockMap()
    device = np.arange(200) * 40_000_000
    arrived = device + 7 * NS + 3_000_000 + (rng.exponential(8e-3, 200) * NS).astype(int)
    stamps = [clock.stamp_ns(int(d), int(a)) for d, a in zip(device, arrived, strict=True)]
    error_ms = (np.array(stamps) - device - 7 * NS)[50:] / 1e6
    assert error_ms.min() >= 3.0
    assert error_ms.max() < 6.0, "jitter of 8 ms does not reach the stamps"
    assert clock.stamp_ns(5, int(arrived[-1]) + 40_000_000) == int(arrived[-1]) + 40_000_000
    assert clock.jumps == 1
