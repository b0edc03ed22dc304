"""Universal Robots through RTDE, receive only (extra ``ur``)."""

from __future__ import annotations

import contextlib
import importlib
import math
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from tiptrace.drivers.base import DeviceStatus, PoseFrames, RobotTap, Wake
from tiptrace.drivers.queued_robot import QueuedRobot
from tiptrace.drivers.timeline import NS, ClockMap, Timeline
from tiptrace.errors import ConfigError, DeviceError, MissingExtraError
from tiptrace.types import FloatArray, OpeningSample, PoseSample

_PORT = 30004
_REACH_S = 1.5
_POLL_S = 0.0015
_SILENCE_S = 0.5
_BACK_OFF_S = (0.1, 1.0)
_REGISTERS = (*range(12, 20), *range(36, 44))  # that the client can read


class UrRobot(QueuedRobot):
    """Poses of the active TCP in the controller's ``base`` frame, as RTDE sends them.

    What the receive interface cannot tell is whether the active TCP is the flange: the rig file has to say
    ``end_effector: tcp``. Stamps are the controller's own, brought to the session's timeline by the least delay.

    Args:
        uri: ``ur://HOST``, with ``?opening_register=N`` where an output double register holds the gripper's opening, m.
        timeline: The session's.

    Raises:
        MissingExtraError: ur-rtde is not installed.
    """

    def __init__(self, uri: str, timeline: Timeline) -> None:
        try:
            parts = urlsplit(uri)
        except ValueError:  # brackets that enclose no address
            parts = urlsplit("")
        if not parts.hostname:
            raise ConfigError(f"{uri}: names no robot; expected ur://HOST")
        self._host = parts.hostname
        self._register = _register(uri, parts.query)
        super().__init__(f"ur://{self._host}", timeline)
        try:
            self._library: Any = importlib.import_module("rtde_receive")
        except ImportError:
            raise MissingExtraError("ur-rtde", "ur") from None
        self._clock = ClockMap()

    @property
    def frames(self) -> PoseFrames:
        """The controller's base, the active TCP."""
        return PoseFrames("base", "tcp")

    def start(self, wake: Wake, tap: RobotTap | None = None) -> None:
        """Connect and wait for the first pose."""
        self._deliver_to(wake, tap)
        receiver = self._connect()
        self._begin(lambda: self._run(receiver), ", though connected: is the arm powered on?")

    # --- the thread ----------------------------------------------------------------------------------------

    def _run(self, receiver: Any) -> None:
        try:
            self._follow(receiver)
        except Exception as error:  # noqa: BLE001  a thread that dies must not do so silently
            self._queue.fail(DeviceError(f"{self.name}: {error}"))

    def _follow(self, receiver: Any) -> None:
        while not self._stop.is_set():
            reason = self._receive(receiver)
            if self._stop.is_set():
                break
            self._queue.meter.bad(DeviceStatus.LOST, f"{self.name}: {reason}")
            _drop(receiver)
            receiver = self._reconnect()
        if receiver is not None:
            _drop(receiver)

    def _receive(self, receiver: Any) -> str:
        """Deliver poses until the connection is gone; why it is."""
        last_s, last_ns = -1.0, self._timeline.now_ns()
        while not self._stop.is_set():
            stamp_s = float(receiver.getTimestamp())
            now_ns = self._timeline.now_ns()
            if stamp_s == last_s:
                if now_ns - last_ns > _SILENCE_S * NS:
                    return f"silent for {_SILENCE_S:g} s" if receiver.isConnected() else "disconnected"
                time.sleep(_POLL_S)
                continue
            pose = receiver.getActualTCPPose()
            if float(receiver.getTimestamp()) == stamp_s and stamp_s > 0.0:  # else they are of two instants
                if stamp_s < last_s:
                    self._queue.meter.fault("clock-jump")
                self._deliver(self._clock.stamp_ns(round(stamp_s * NS), now_ns), pose, receiver)
                last_s, last_ns = stamp_s, now_ns
            time.sleep(_POLL_S)
        return "stopped"

    def _deliver(self, stamp_ns: int, pose: list[float], receiver: Any) -> None:
        T_B_E = pose_matrix(pose)
        if T_B_E is None:
            self._queue.meter.fault("garbled")
            return
        self._queue.put(PoseSample(stamp_ns, T_B_E))
        if self._register is not None:
            opening_m = float(receiver.getOutputDoubleRegister(self._register))
            if 0.0 <= opening_m <= 0.3:
                self._queue.put(OpeningSample(stamp_ns, opening_m))
            else:
                self._queue.meter.fault("garbled")

    def _connect(self) -> Any:
        """A receiver.

        Raises:
            DeviceError: unreachable, or no RTDE there.
        """
        remedy = "check the address, that the arm is on, and that the network cable is plugged in"
        try:
            _shake_hands(self._host)
        except (OSError, UnicodeError) as error:  # a name that can be none is a UnicodeError
            why = getattr(error, "strerror", None) or str(error)
            raise DeviceError(
                f"{self.name}: robot cannot be reached on port {_PORT} ({why}): {remedy}"
            ) from None
        variables = ["timestamp", "actual_TCP_pose"]
        upper = self._register is not None and self._register > 23
        if self._register is not None:
            variables.append(f"output_double_register_{self._register}")
        try:
            return self._library.RTDEReceiveInterface(self._host, -1.0, variables, False, upper)
        except Exception as error:  # noqa: BLE001  the binding raises what C++ throws
            raise DeviceError(f"{self.name}: answers, but not as RTDE ({error}): {remedy}") from None

    def _reconnect(self) -> Any:
        wait_s, most_s = _BACK_OFF_S
        while not self._stop.is_set():
            try:
                receiver = self._connect()
            except DeviceError as error:
                self._queue.meter.bad(DeviceStatus.LOST, str(error), "reconnect-failed")
            else:
                self._clock = ClockMap()
                return receiver
            self._stop.wait(wait_s)
            wait_s = min(2.0 * wait_s, most_s)
        return None


def pose_matrix(pose: Sequence[float]) -> FloatArray | None:
    """Position, m, and rotation vector, rad → (4, 4); None where they are no pose.

    Rodrigues' formula in plain numbers: 500 times a second, arrays of three would cost a twentieth of a core.
    """
    if len(pose) != 6 or not all(map(math.isfinite, pose)):
        return None
    x, y, z, rx, ry, rz = pose
    theta = math.sqrt(rx * rx + ry * ry + rz * rz)
    near = theta < 1e-6
    s = 1.0 - theta * theta / 6.0 if near else math.sin(theta) / theta
    c = 0.5 if near else (1.0 - math.cos(theta)) / (theta * theta)
    return np.array(
        [
            [1.0 - c * (ry * ry + rz * rz), c * rx * ry - s * rz, c * rx * rz + s * ry, x],
            [c * rx * ry + s * rz, 1.0 - c * (rx * rx + rz * rz), c * ry * rz - s * rx, y],
            [c * rx * rz - s * ry, c * ry * rz + s * rx, 1.0 - c * (rx * rx + ry * ry), z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _shake_hands(host: str) -> None:
    """Make sure that an RTDE server answers: the client holds the interpreter while it connects, without a limit.

    Raises:
        OSError: unreachable, or silent.
    """
    request = struct.pack(">HBH", 5, ord("V"), 2)  # protocol version 2
    with socket.create_connection((host, _PORT), timeout=_REACH_S) as connection:
        connection.sendall(request)
        if not connection.recv(16):
            raise ConnectionError("the connection was closed at once")


def _register(uri: str, query: str) -> int | None:
    values = parse_qs(query)
    unknown = set(values) - {"opening_register"}
    if unknown:
        raise ConfigError(f"{uri}: unknown option {sorted(unknown)[0]!r}; valid: opening_register")
    if not values:
        return None
    try:
        register = int(values["opening_register"][0])
    except ValueError:
        register = -1
    if register not in _REGISTERS:
        raise ConfigError(
            f"{uri}: opening_register is the number of an output double register, 12 to 19 or 36 to 43"
        )
    return register


def _drop(receiver: Any) -> None:
    with contextlib.suppress(Exception):
        receiver.disconnect()
