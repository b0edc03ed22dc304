"""``Ros2Robot`` hears an arm of another process, with the real rclpy (``TIPTRACE_ROS_PYTHON``)."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.ros.arm import PERIOD_NS, STEP_M
from tests.ros.environment import NEEDS_ROS, ROS_PYTHON, alone

HERE = Path(__file__).parent
pytestmark = NEEDS_ROS


def has(module: str) -> bool:
    return (
        subprocess.run([ROS_PYTHON, "-c", f"import {module}"], capture_output=True, timeout=60).returncode
        == 0
    )


def listen(uri: str, out: Path, arm: str | None) -> dict:
    environment = alone()
    talking = None
    if arm is not None:
        talking = subprocess.Popen([ROS_PYTHON, str(HERE / "arm.py"), arm, "60"], env=environment)
    try:
        listener = [ROS_PYTHON, str(HERE / "listener.py"), uri, str(out)]
        subprocess.run(listener, env=environment, check=True, timeout=120)
    finally:
        if talking is not None:
            talking.kill()
            talking.wait(timeout=10)
    return json.loads(out.read_text())


def check_poses(rows: list[list[float]]) -> None:
    """Each is one that was sent, in order; stamps keep the sender's spacing."""
    stamps, T = np.array([r[0] for r in rows]), np.array([r[1:] for r in rows]).reshape(-1, 4, 4)
    k = T[:, 0, 3] / STEP_M
    index = np.round(k).astype(int)
    np.testing.assert_allclose(k, index, atol=1e-6)
    assert (np.diff(index) > 0).all()
    assert len(index) > 0.6 * (index[-1] - index[0])
    assert (np.diff(stamps) > 0).all()
    spacing_error = np.diff(stamps) - np.diff(index) * PERIOD_NS
    assert np.median(np.abs(spacing_error)) < 1_000_000
    np.testing.assert_array_equal(T[:, :3, :3], np.broadcast_to(np.eye(3), (len(T), 3, 3)))


def test_poses_openings_and_marks_from_topics(tmp_path: Path) -> None:
    found = listen("ros2:/ee_pose?opening=/gripper/opening", tmp_path / "found.json", "topic")
    assert not found["error"]
    check_poses(found["poses"])
    assert set(found["openings"]) == {0.0062}
    assert set(found["phases"]) == {"anchoring"}
    assert found["frames"] == ["base", None]
    assert found["faults"].get("garbled", 0) > 0  # the mark that is none


def test_poses_from_tf(tmp_path: Path) -> None:
    if not has("tf2_msgs"):
        pytest.skip("tf2_msgs is not in the Python of TIPTRACE_ROS_PYTHON")
    found = listen("ros2:tf?base=base&end_effector=tool0", tmp_path / "found.json", "tf")
    assert not found["error"]
    check_poses(found["poses"])
    assert found["frames"] == ["base", "tool0"]


@pytest.mark.parametrize("uri", ["ros2", "ros2:tf"])
def test_silence_or_a_missing_part_is_one_sentence(uri: str, tmp_path: Path) -> None:
    found = listen(uri, tmp_path / "found.json", None)
    missing = uri == "ros2:tf" and not has("tf2_msgs")
    assert ("tf2_msgs.msg is not in this Python" if missing else "no pose within 5 s") in found["error"]
