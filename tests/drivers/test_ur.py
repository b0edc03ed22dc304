"""The real ur-rtde client against an RTDE server on loopback."""

from __future__ import annotations

import socket
import time
from dataclasses import replace

import numpy as np
import pytest

from tests.live.servers import Fault, Feed, in_child, play_arm
from tiptrace.drivers.base import DeviceStatus, PoseFrames
from tiptrace.drivers.opening import open_robot
from tiptrace.drivers.sample_queue import SampleQueue
from tiptrace.drivers.timeline import NS, Timeline
from tiptrace.drivers.ur import pose_matrix
from tiptrace.errors import ConfigError, DeviceError
from tiptrace.geometry.transforms import rotation_exp, transform
from tiptrace.types import FloatArray, OpeningSample, PoseSample


def swing(t_s: float) -> FloatArray:
    """A smooth hand motion."""
    w = np.array([0.1 * np.sin(t_s), 3.0, 0.2])
    return transform(rotation_exp(w), np.array([0.3, -0.2, 0.2 + 0.05 * np.sin(2 * t_s)]))


def make_feed() -> Feed:
    t_s = np.arange(0.0, 20.0, 0.008)
    return Feed({}, {}, t_s, np.stack([swing(t) for t in t_s]), 20.0)


def port_is_free() -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", 30004)) != 0


def test_a_pose_in_plain_numbers_is_that_of_the_exponential_map() -> None:
    rng = np.random.default_rng(0)
    for scale in (0.0, 1e-9, 1e-7, 1e-5, 0.1, 1.0, np.pi):
        for w in rng.normal(size=(20, 3)):
            x = np.concatenate([rng.normal(size=3), scale * w / np.linalg.norm(w)])
            T = pose_matrix(x.tolist())
            assert T is not None
            assert np.abs(T - transform(rotation_exp(x[3:]), x[:3])).max() < 1e-12
    assert pose_matrix([0.0] * 5) is None
    assert pose_matrix([0.0] * 5 + [float("nan")]) is None


@pytest.fixture
def client() -> None:
    pytest.importorskip("rtde_receive", reason="ur-rtde is not installed (extra `ur`)")
    if not port_is_free():
        pytest.skip("port 30004, the only one that the client knows, is in use")


@pytest.mark.usefixtures("client")
def test_poses_arrive_with_their_stamps_through_drop_outs() -> None:
    feed, start = make_feed(), time.monotonic() + 1.5
    faults = (Fault("disconnect", "robot", 1.0, 1.6), Fault("clock", "robot", 3.5, 9.0))
    with in_child(play_arm, feed, start, faults, None):
        time.sleep(max(start - time.monotonic(), 0.0))
        timeline = Timeline()
        robot = open_robot("ur://127.0.0.1?opening_register=36", timeline)
        assert robot.frames == PoseFrames("base", "tcp")
        samples, states = [], set()
        robot.start(lambda: None)
        while time.monotonic() < start + 5.0:
            samples += robot.take()
            states.add(robot.health().status)
            time.sleep(0.02)
        robot.close()
    poses = [s for s in samples if isinstance(s, PoseSample)]
    stamps_s = np.array([p.stamp_ns - timeline.offset_ns for p in poses]) / NS - start
    assert np.all(np.diff(stamps_s) > 0)
    assert DeviceStatus.LOST in states
    assert stamps_s[-1] > 4.5, "it has come back"
    errors = [np.linalg.norm(p.T_B_E[:3, 3] - swing(t)[:3, 3]) for p, t in zip(poses, stamps_s, strict=True)]
    assert np.median(errors) < 0.001, "100 mm/s: stamps are right within 10 ms"
    assert {s.opening_m for s in samples if isinstance(s, OpeningSample)} == {0.006}


@pytest.mark.usefixtures("client")
def test_another_tcp_in_mid_trial_is_refused() -> None:
    start = time.monotonic() + 1.5
    with in_child(play_arm, replace(make_feed()), start, (), 1.0):
        time.sleep(max(start - time.monotonic(), 0.0))
        robot = open_robot("ur://127.0.0.1", Timeline())
        robot.start(lambda: None)
        time.sleep(max(start + 1.8 - time.monotonic(), 0.0))
        robot.take()
        with pytest.raises(DeviceError, match="changed in mid-trial"):
            robot.take()
        robot.close()


def test_a_jump_is_told_from_fast_motion() -> None:
    timeline = Timeline()
    queue, now = SampleQueue("arm", timeline), timeline.now_ns()
    for k in range(10):  # 2 m/s
        queue.put(PoseSample(now + k * 8_000_000, transform(np.eye(3), np.array([0.016 * k, 0.0, 0.0]))))
    assert len(queue.take()) == 10
    queue.put(PoseSample(now + 100_000_000, transform(np.diag([-1.0, -1.0, 1.0]), np.array([0.16, 0, 0]))))
    queue.take()
    with pytest.raises(DeviceError, match="180°"):
        queue.take()


@pytest.mark.usefixtures("client")
@pytest.mark.parametrize("host", ["127.0.0.1", "no..name"])
def test_a_robot_that_is_not_there_is_named(host: str) -> None:
    with pytest.raises(DeviceError, match="robot cannot be reached"):
        open_robot(f"ur://{host}", Timeline()).start(lambda: None)


@pytest.mark.parametrize(
    "uri",
    [
        "ur://",
        "ur://[host",
        "ur://host?opening_register=7",
        "ur://host?speed=1",
        "kuka://host",
        "replay:none.csv",
    ],
)
def test_addresses_that_mean_nothing_are_refused(uri: str) -> None:
    if uri.startswith("ur://"):
        pytest.importorskip("rtde_receive", reason="ur-rtde is not installed (extra `ur`)")
    with pytest.raises((ConfigError, DeviceError)):
        open_robot(uri, Timeline())
