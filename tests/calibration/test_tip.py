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


def spoiled(T: np.ndarray, share: float, seed: int) -> np.ndarray:
    """A share of the poses off by 10 mm, each in a direction of its own."""
    rng, out = np.random.default_rng(seed), T.copy()
    bad = rng.choice(len(T), round(share * len(T)), replace=False)
    way = rng.normal(size=(len(bad), 3))
    out[bad, :3, 3] += 10e-3 * way / np.linalg.norm(way, axis=1, keepdims=True)
    return out


@pytest.mark.parametrize("seed", range(5))
def test_real_pointer_poses_with_outliers_stay_within_a_third_of_a_millimetre(
    shared_data: Path, seed: int
) -> None:
    folder = shared_data / "pivot_ndi"
    T = read_poses(folder / "poses_3x4_rowmajor_m.csv")
    answer = np.loadtxt(folder / "published_answer_tip_then_pivot_m.csv", delimiter=",").ravel()[:3]
    bad = spoiled(T, 0.3, seed)
    robust = calibrate_tip(bad, "maximum-likelihood")
    assert np.linalg.norm(robust.tip - answer) < 0.3e-3
    assert robust.outliers >= 25
    assert np.linalg.norm(calibrate_tip(bad, "least-squares").tip - answer) > np.linalg.norm(
        robust.tip - answer
    )


def test_both_methods_agree_on_clean_poses_and_know_their_error(poses: np.ndarray) -> None:
    errors, claims = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        R = rotation_exp(rng.normal(scale=0.3, size=(40, 3)))
        T = transform(R, np.array([0.4, 0, 0.1]) - R @ np.array([0, 0, 0.2]) + rng.normal(0, 2e-4, (40, 3)))
        result = calibrate_tip(T)
        errors.append(result.tip - [0, 0, 0.2])
        claims.append(result.sigma_m)
        assert np.linalg.norm(result.tip - calibrate_tip(T, "least-squares").tip) < 3e-4
    ratio = np.sqrt(np.mean(np.square(errors))) / np.sqrt(np.mean(np.square(claims)))
    assert 0.6 < ratio < 1.6


@pytest.mark.parametrize("method", ["least-squares", "maximum-likelihood"])
def test_a_single_axis_is_told_in_words(method: str) -> None:
    R = rotation_exp(np.outer(np.linspace(-0.3, 0.3, 20), [0, 0, 1.0]))
    T = transform(R, np.array([0.4, 0, 0.1]) - R @ np.array([0.02, 0, 0.2]))
    T[:, :3, 3] += np.random.default_rng(0).normal(0, 1e-4, (20, 3))
    result = calibrate_tip(T, method)
    assert len(result.weak) == 1
    assert "along z of the tool" in result.weak[0]
    assert "not determined" in result.weak[0]


def test_an_unknown_method_is_refused(poses: np.ndarray) -> None:
    with pytest.raises(CalibrationError, match="valid: least-squares, maximum-likelihood"):
        calibrate_tip(poses, "ml")
