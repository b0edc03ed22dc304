"""Pose lists from files: what is read, what is refused."""

from pathlib import Path

import numpy as np
import pytest

from tiptrace.calibration.tip import calibrate_tip, read_poses
from tiptrace.errors import CalibrationError, GeometryError
from tiptrace.geometry.transforms import rotation_exp, transform


def write(path: Path, T: np.ndarray, separator: str = ",") -> Path:
    path.write_text("\n".join(separator.join(repr(float(v)) for v in pose[:3].reshape(-1)) for pose in T))
    return path


@pytest.fixture
def poses() -> np.ndarray:
    R = rotation_exp(np.random.default_rng(0).normal(scale=0.3, size=(12, 3)))
    return transform(R, np.array([0.4, 0, 0.1]) - R @ np.array([0, 0, 0.2]))


@pytest.mark.parametrize("separator", [",", " ", ", "])
def test_reads_rows_and_finds_the_tip(tmp_path: Path, poses: np.ndarray, separator: str) -> None:
    T = read_poses(write(tmp_path / "poses.csv", poses, separator))
    result = calibrate_tip(T)
    np.testing.assert_allclose(result.pivot.tip, [0, 0, 0.2], atol=1e-9)
    assert result.paper is not None
    np.testing.assert_allclose(result.paper.p, [0.4, 0, 0.1], atol=1e-9)


def test_bad_files_are_refused_with_line_and_remedy(tmp_path: Path, poses: np.ndarray) -> None:
    file = tmp_path / "poses.csv"
    file.write_text("1,2,3\n")
    with pytest.raises(CalibrationError, match="line 1: 3 numbers; a pose is 3×4"):
        read_poses(file)
    file.write_text("a,b\n")
    with pytest.raises(CalibrationError, match="line 1: not a number"):
        read_poses(file)
    file.write_text("")
    with pytest.raises(CalibrationError, match="holds no poses"):
        read_poses(file)
    millimetres = poses.copy()
    millimetres[:, :3, 3] *= 1000
    with pytest.raises(CalibrationError, match="give metres"):
        read_poses(write(file, millimetres))
    with pytest.raises(CalibrationError, match="holds no rotation"):
        read_poses(write(file, poses * 1.1))
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_poses(tmp_path / "none.csv")


def test_poses_without_rotation_are_refused(tmp_path: Path) -> None:
    still = np.tile(np.eye(4), (5, 1, 1))
    still[:, 0, 3] = np.linspace(0, 1, 5)
    with pytest.raises(GeometryError, match="do not rotate"):
        calibrate_tip(read_poses(write(tmp_path / "poses.csv", still)))
