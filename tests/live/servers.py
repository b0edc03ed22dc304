"""A tactile camera pair over HTTP and a UR controller over RTDE, on loopback, that play a trial and misbehave.

Everything is a function of the time since ``start`` (``time.monotonic``): picture k of a camera, the arm's pose, and
which faults are on. So servers in another process and a checker here agree on what was sent.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import cv2
import numpy as np

from tiptrace.geometry.screw import interpolate_screw
from tiptrace.geometry.transforms import rotation_log
from tiptrace.types import FloatArray, ImageSample, PoseSample, Side

FPS = 25.0
RTDE_HZ = 500.0


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that goes wrong for a while.

    Attributes:
        kind: stall, disconnect, freeze, repeat, drop, truncate, garbage, clock.
        target: ``left``, ``right`` or ``robot``.
        start_s: Since the start of the play.
        end_s: Likewise.
    """

    kind: str
    target: str
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Feed:
    """What is played, forwards and backwards for ever.

    Attributes:
        jpegs: Of each camera.
        stamps_s: (n,) capture of each picture since the first, per camera.
        pose_s: (m,) of the poses.
        T_B_E: (m, 4, 4).
        duration_s: One way.
    """

    jpegs: dict[Side, list[bytes]]
    stamps_s: dict[Side, FloatArray]
    pose_s: FloatArray
    T_B_E: FloatArray
    duration_s: float

    def fold(self, t_s: float) -> float:
        """Time in the trial that is played at a time since the start."""
        phase = t_s % (2.0 * self.duration_s)
        return phase if phase <= self.duration_s else 2.0 * self.duration_s - phase

    def pose(self, t_s: float) -> FloatArray:
        """T_B_E (4, 4) at a time since the start."""
        s = float(np.clip(self.fold(t_s), self.pose_s[0], self.pose_s[-1]))
        k = int(np.clip(np.searchsorted(self.pose_s, s) - 1, 0, len(self.pose_s) - 2))
        u = (s - self.pose_s[k]) / (self.pose_s[k + 1] - self.pose_s[k])
        return interpolate_screw(self.T_B_E[k : k + 1], self.T_B_E[k + 1 : k + 2], np.array([u]))[0]

    def poses_at(self, rate_hz: float) -> list[bytes]:
        """Position and rotation vector one way through the trial, as six big-endian doubles each."""
        s = np.clip(
            np.arange(round(self.duration_s * rate_hz) + 1) / rate_hz, self.pose_s[0], self.pose_s[-1]
        )
        k = np.clip(np.searchsorted(self.pose_s, s) - 1, 0, len(self.pose_s) - 2)
        u = (s - self.pose_s[k]) / (self.pose_s[k + 1] - self.pose_s[k])
        T = interpolate_screw(self.T_B_E[k], self.T_B_E[k + 1], u)
        values = np.concatenate([T[:, :3, 3], rotation_log(T[:, :3, :3])], axis=1)
        return [row.tobytes() for row in values.astype(">f8")]


def feed_from(
    samples: Sequence[object],
    scale: int = 1,
    quality: int = 95,
    offset_s: float = 0.0,
    latency_s: float = 0.0,
) -> Feed:
    """From a recording's samples; ``scale`` 2 plays 320×240 as 640×480; the right camera lags by ``offset_s``.

    Poses are played later by ``latency_s``, so that a recording with that latency plays without one, both ways.
    """
    images: dict[Side, list[ImageSample]] = {"left": [], "right": []}
    poses: list[PoseSample] = []
    for sample in samples:
        if isinstance(sample, ImageSample):
            images[sample.side].append(sample)
        elif isinstance(sample, PoseSample):
            poses.append(sample)
    first = min(images["left"][0].stamp_ns, images["right"][0].stamp_ns)
    last = max(images["left"][-1].stamp_ns, images["right"][-1].stamp_ns)
    shifts: dict[Side, float] = {"left": 0.0, "right": offset_s}
    return Feed(
        jpegs={side: [_jpeg(s.image, scale, quality) for s in images[side]] for side in shifts},
        stamps_s={
            side: np.array([(s.stamp_ns - first) * 1e-9 for s in images[side]]) + shift
            for side, shift in shifts.items()
        },
        pose_s=np.array([(p.stamp_ns - first) * 1e-9 + latency_s for p in poses]),
        T_B_E=np.stack([p.T_B_E for p in poses]),
        duration_s=round((last - first) * 1e-9 * FPS) / FPS,
    )


def _jpeg(image: np.ndarray, scale: int, quality: int) -> bytes:
    if scale != 1:
        size = (image.shape[1] * scale, image.shape[0] * scale)
        image = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    data: np.ndarray = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return data.tobytes()


class _Server:
    """Accepts connections on 127.0.0.1 and serves each in a thread."""

    def __init__(self, port: int = 0) -> None:
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._open: set[socket.socket] = set()
        self.stopping = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while not self.stopping.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._open.add(connection)
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError, ConnectionError):
            self.handle(connection)
        self._open.discard(connection)
        connection.close()

    def handle(self, connection: socket.socket) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self.stopping.set()
        self._listener.close()
        for connection in list(self._open):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


class _Playing(_Server):
    """Knows the time and the faults that are on."""

    def __init__(self, target: str, feed: Feed, start: float, faults: Sequence[Fault], port: int = 0) -> None:
        self._target, self._feed, self._start = target, feed, start
        self.faults = [f for f in faults if f.target == target]
        super().__init__(port)

    def now_s(self) -> float:
        return time.monotonic() - self._start

    def on(self, *kinds: str) -> Fault | None:
        t = self.now_s()
        return next((f for f in self.faults if f.kind in kinds and f.start_s <= t < f.end_s), None)

    def sleep_until(self, t_s: float) -> None:
        wait = t_s - self.now_s()
        if wait > 0:
            self.stopping.wait(wait)


class MjpegServer(_Playing):
    """One camera, ``http://127.0.0.1:PORT/``."""

    def __init__(
        self,
        side: Side,
        feed: Feed,
        start: float,
        faults: Sequence[Fault] = (),
        *,
        timestamps: bool = True,
        lengths: bool = True,
        port: int = 0,
    ) -> None:
        self._side, self._timestamps, self._lengths = side, timestamps, lengths
        self.sent = 0
        super().__init__(side, feed, start, faults, port)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/stream"

    def handle(self, connection: socket.socket) -> None:
        connection.recv(4096)
        if self.on("disconnect"):
            return
        head = "HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"
        connection.sendall(head.encode())
        jpegs, stamps = self._feed.jpegs[self._side], self._feed.stamps_s[self._side]
        n, period = len(jpegs), 1.0 / FPS
        lag = float(stamps[0])
        k = max(int((self.now_s() - lag) / period), 0)
        frozen: bytes | None = None
        while not self.stopping.is_set():
            k += 1
            at_s = k * period + lag
            self.sleep_until(at_s)
            if self.on("disconnect"):
                return
            while self.on("stall") and not self.stopping.is_set():
                self.stopping.wait(0.01)
                k = max(k, int((self.now_s() - lag) / period))
                at_s = k * period + lag
            if self.on("drop"):
                continue
            place = k % (2 * n - 2)  # the turning points are shown once
            jpeg = jpegs[place if place < n else 2 * n - 2 - place]
            if self.on("freeze"):
                frozen = frozen or jpeg
                jpeg = frozen
            else:
                frozen = None
            jpeg = self._damaged(jpeg, k)
            shown = at_s + (5.0 if self.on("clock") else 0.0)
            self._send(connection, jpeg, shown)
            if self.on("repeat"):
                self._send(connection, jpeg, shown + 0.005)
            self.sent += 1

    def _damaged(self, jpeg: bytes, k: int) -> bytes:
        if self.on("truncate"):
            return jpeg[: len(jpeg) // 2]
        if self.on("garbage"):
            rng = np.random.default_rng(k)
            at = int(rng.integers(700, len(jpeg) * 3 // 4))
            noise = rng.integers(0, 256, 60).astype(np.uint8).tobytes()
            return jpeg[:at] + noise + jpeg[at + 60 :]
        return jpeg

    def _send(self, connection: socket.socket, jpeg: bytes, at_s: float) -> None:
        head = "--frame\r\nContent-Type: image/jpeg\r\n"
        if self._lengths:
            head += f"Content-Length: {len(jpeg)}\r\n"
        if self._timestamps:
            head += f"X-Timestamp: {1000.0 + at_s:.6f}\r\n"
        connection.sendall(head.encode() + b"\r\n" + jpeg + b"\r\n")


_TYPES = {"timestamp": "DOUBLE", "actual_TCP_pose": "VECTOR6D"}


class RtdeServer(_Playing):
    """A UR controller's real-time data exchange, as the ``ur-rtde`` client speaks it: packets V v O I S P U.

    Args:
        feed: Poses.
        start: Of the play.
        faults: Drop-outs.
        opening_m: What every output double register holds.
        base_change_s: From then on the pose is that of another TCP.
        port: 30004 is the only one that the client knows.
    """

    def __init__(
        self,
        feed: Feed,
        start: float,
        faults: Sequence[Fault] = (),
        *,
        opening_m: float = 0.006,
        base_change_s: float | None = None,
        port: int = 30004,
    ) -> None:
        self._opening_m, self._base_change_s = opening_m, base_change_s
        self._poses = feed.poses_at(
            RTDE_HZ
        )  # worked out before, so that the server takes little of the machine
        super().__init__("robot", feed, start, faults, port)

    def handle(self, connection: socket.socket) -> None:
        if self.on("disconnect"):
            return
        names: list[str] = []
        while not self.stopping.is_set():
            kind, payload = _receive(connection)
            if kind == b"v":
                _reply(connection, b"v", struct.pack(">IIII", 5, 12, 0, 0))
            elif kind == b"O":
                names = payload[8:].decode().split(",")
                types = ",".join(_TYPES.get(n, "DOUBLE" if "double" in n else "UINT32") for n in names)
                _reply(connection, b"O", b"\x01" + types.encode())
            elif kind == b"I":
                _reply(connection, b"I", b"\x01" + b",".join(b"DOUBLE" for _ in payload.split(b",")))
            elif kind == b"S":
                _reply(connection, b"S", b"\x01")
                self._play(connection, names)
                return
            else:  # V, P
                _reply(connection, kind, b"\x01")

    def _play(self, connection: socket.socket, names: Sequence[str]) -> None:
        k = int(self.now_s() * RTDE_HZ)
        while not self.stopping.is_set():
            k = max(k + 1, int(self.now_s() * RTDE_HZ) - 1)
            self.sleep_until(k / RTDE_HZ)
            if self.on("disconnect"):
                return
            if self.on("stall"):
                continue
            t_s = k / RTDE_HZ
            data = b"".join(self._value(name, t_s) for name in names)
            _reply(connection, b"U", b"\x01" + data)

    def _value(self, name: str, t_s: float) -> bytes:
        if name == "timestamp":
            return struct.pack(">d", 100.0 + t_s - (50.0 if self.on("clock") else 0.0))
        if name == "actual_TCP_pose":
            if self._base_change_s is not None and t_s > self._base_change_s:
                T = self._feed.pose(t_s)
                T[:3, 3] += T[:3, 2] * 0.2
                return struct.pack(">6d", *T[:3, 3], *rotation_log(T[:3, :3]))
            return self._poses[round(self._feed.fold(t_s) * RTDE_HZ)]
        if "double" in name:
            return struct.pack(">d", self._opening_m)
        return struct.pack(">I", 0)


def _receive(connection: socket.socket) -> tuple[bytes, bytes]:
    head = _exactly(connection, 3)
    size, kind = struct.unpack(">Hc", head)
    return kind, _exactly(connection, size - 3)


def _exactly(connection: socket.socket, n: int) -> bytes:
    data = b""
    while len(data) < n:
        more = connection.recv(n - len(data))
        if not more:
            raise ConnectionError("closed")
        data += more
    return data


def _reply(connection: socket.socket, kind: bytes, payload: bytes) -> None:
    connection.sendall(struct.pack(">Hc", len(payload) + 3, kind) + payload)


@contextlib.contextmanager
def in_child(target: Callable[..., None], *arguments: object) -> Iterator[None]:
    """Run servers in a process of their own, until the block ends; ``target`` gets a ready event last.

    The ur-rtde client holds the interpreter while it connects, so its server cannot live in the same process.
    """
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    child = context.Process(target=target, args=(*arguments, ready), daemon=True)
    child.start()
    try:
        assert ready.wait(60), "the servers did not come up"
        yield
    finally:
        child.kill()
        child.join(5)


def play_arm(
    feed: Feed, start: float, faults: tuple[Fault, ...], base_change_s: float | None, ready: Event
) -> None:
    """An arm; for :func:`in_child`."""
    RtdeServer(feed, start, faults, base_change_s=base_change_s)
    ready.set()
    threading.Event().wait()


def play_trial(
    path: Path,
    start: float,
    faults: tuple[Fault, ...],
    ports: tuple[int, int],
    latency_s: float,
    ready: Event,
) -> None:
    """Both cameras at 640×480 and an arm, from a recording; for :func:`in_child`."""
    from tiptrace.streams.recording import Recording

    feed = feed_from(list(Recording(path)), 2, 90, 0.004, latency_s)
    MjpegServer("left", feed, start, faults, port=ports[0])
    MjpegServer("right", feed, start, faults, port=ports[1])
    RtdeServer(feed, start, faults)
    ready.set()
    threading.Event().wait()
