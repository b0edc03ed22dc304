"""Poses replayed from files, in real time."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tests.streams.helpers import make_rig
from tiptrace.drivers.base import DeviceStatus
from tiptrace.drivers.opening import open_robot
from tiptrace.drivers.timeline import NS, Timeline
from tiptrace.errors import DeviceError
from tiptrace.streams.writer import RecordingWriter
from tiptrace.types import PoseSample

HEADER = "stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw\n"


def play(uri: str, seconds: float) -> tuple[list[PoseSample], DeviceStatus]:
    robot = open_robot(uri, Timeline())
    robot.start(lambda: None)
    time.sleep(seconds)
    poses = [s for s in robot.take() if isinstance(s, PoseSample)]
    status = robot.health().status
    robot.close()
    return poses, status


def test_a_csv_is_played_at_its_own_pace_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    rows = [f"{k * 10_000_000},{0.001 * k},0,0.2,0,0,0,1\n" for k in range(30)]
    path.write_text(HEADER + "".join(rows))
    poses, status = play(f"replay:{path}", 0.6)
    assert status is DeviceStatus.ENDED
    assert np.array_equal(np.diff([p.stamp_ns for p in poses]), [10_000_000] * 29)
    assert poses[-1].T_B_E[0, 3] == pytest.approx(0.029)


def test_a_recordings_poses_and_frame_are_played(tmp_path: Path) -> None:
    path = tmp_path / "trial.mcap"
    with RecordingWriter(path, rig=make_rig()) as writer:
        for k in range(10):
            writer.write(PoseSample(NS + k * 10_000_000, np.eye(4)))
    assert open_robot(f"replay:{path}", Timeline()).frames.base == "base"
    assert len(play(f"replay:{path}", 0.3)[0]) == 10


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "expected a csv file with the columns"),
        (HEADER + "0,1,2\n", "line 2"),
        (HEADER + "0,0,0,0,0,0,0,2\n", "line 2"),
        (HEADER + "0,nan,0,0,0,0,0,1\n", "not finite"),
        (HEADER + "0,300,0,0,0,0,0,1\n", "millimetres"),
        (HEADER + "5,0,0,0,0,0,0,1\n5,0,0,0,0,0,0,1\n", "must increase"),
        (HEADER + "5,0,0,0,0,0,0,1\n", "holds no poses"),
    ],
)
def test_bad_files_are_refused_by_line(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(DeviceError, match=told):
        open_robot(f"replay:{path}", Timeline())
