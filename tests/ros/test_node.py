"""The node against the offline estimate, with the real rclpy in a Python of its own (``TIPTRACE_ROS_PYTHON``)."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.ros.environment import NEEDS_ROS, ROS_PYTHON, alone
from tiptrace.config import dump_yaml
from tiptrace.pipeline import open_tracer, trace
from tiptrace.sim.spec import TrialSpec
from tiptrace.streams.recording import Recording
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.writer import RecordingWriter
from tiptrace.types import SIDES

FRAMES = 150
pytestmark = NEEDS_ROS


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first six seconds of a simulated trial, and the rig's folder beside it."""
    folder = tmp_path_factory.mktemp("trial")
    stream = SimulatedStream(TrialSpec(seed=3, level="nominal"))
    with RecordingWriter(
        folder / "trial.mcap", rig=stream.rig, tool=stream.tool, references=stream.references
    ) as writer:
        for frame in islice(stream.frames(), FRAMES):
            for sample in frame.samples:
                writer.write(sample)
    (folder / "rig.yaml").write_text(dump_yaml(stream.rig))
    if stream.tool is not None:
        (folder / "tool.yaml").write_text(dump_yaml(stream.tool))
    for side in SIDES:
        cv2.imwrite(str(folder / f"reference_{side}.png"), stream.references[side])
    return folder / "trial.mcap"


@pytest.fixture(scope="module")
def answers(trial: Path) -> dict:
    """What the node published while another process played the recording."""
    environment = alone()
    command = [
        ROS_PYTHON,
        "-m",
        "tiptrace",
        "ros2",
        "--rig",
        str(trial.parent / "rig.yaml"),
        "--",
        "--ros-args",
    ]
    options = ("use_sim_time:=true", "reliable:=true", "queue_depth:=1000", "wait_for_late_s:=0.25")
    command += [part for option in options for part in ("-p", option)]
    out = trial.with_name("answers.json")
    with trial.with_name("node.txt").open("wb") as said:
        node = subprocess.Popen(command, env=environment, stdout=said, stderr=said, start_new_session=True)
        try:
            player = [ROS_PYTHON, str(Path(__file__).with_name("player.py")), str(trial), str(out)]
            subprocess.run(player, env=environment, check=True, timeout=900)
            assert node.poll() is None, trial.with_name("node.txt").read_text()
        finally:
            os.killpg(node.pid, signal.SIGINT)
            node.wait(timeout=30)
    return json.loads(out.read_text())


def test_the_node_s_estimate_is_the_offline_one(trial: Path, answers: dict) -> None:
    recording = Recording(trial)
    with open_tracer(recording, "full") as tracer:
        offline = trace(recording, tracer)
    expected = {e.stamp_ns: e for e in offline.estimates if e.p_B is not None}
    found = {row[0]: np.array(row[2:]) for row in answers["tip"]}
    assert set(found) <= set(expected)
    # as offline, late samples are waited for: at the end of the stream the last quarter second still is
    assert len(found) >= 0.93 * len(expected)
    worst_m = max(float(np.abs(found[t] - expected[t].p_B).max()) for t in found)
    assert worst_m < 1e-6
    covariances = {row[0]: np.array(row[1:]).reshape(6, 6)[:3, :3] for row in answers["pose"]}
    for t, covariance in covariances.items():
        np.testing.assert_allclose(covariance, expected[t].covariance, rtol=1e-3, atol=1e-12)


def test_frames_path_and_diagnostics(answers: dict) -> None:
    assert {row[1] for row in answers["tip"]} == {"base"}
    assert answers["path"] > 10
    assert answers["diagnostics"][-1]["status"] in ("ok", "anchoring")
    assert float(answers["diagnostics"][-1]["rate_hz"]) > 0


def test_the_node_ends_quietly_on_an_interrupt(trial: Path, answers: dict) -> None:
    assert "Traceback" not in trial.with_name("node.txt").read_text()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "rig is not set"),
        (["-p", "rig:=none.yaml"], "none.yaml"),
        (["-p", "rig:=3"], "parameter rig"),
        (["-p", "queue_depth:=many"], "parameter queue_depth"),
        (["-p", "wait_for_late_s"], "ROS arguments"),
    ],
)
def test_wrong_parameters_are_one_sentence_and_exit_code_2(
    arguments: list[str], sentence: str, tmp_path: Path
) -> None:
    command = [ROS_PYTHON, "-m", "tiptrace", "ros2", "--", "--ros-args", *arguments]
    done = subprocess.run(command, cwd=tmp_path, env=alone(), capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert sentence in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


def test_whole_numbers_are_numbers(tmp_path: Path) -> None:
    command = [ROS_PYTHON, "-m", "tiptrace", "ros2", "--", "--ros-args", "-p", "wait_for_late_s:=1"]
    done = subprocess.run(command, cwd=tmp_path, env=alone(), capture_output=True, text=True, timeout=120)
    assert "rig is not set" in done.stderr
