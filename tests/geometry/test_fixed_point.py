"""Fixed points and pivots against analytic truth and real pointer poses."""

from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import GeometryError
from tiptrace.geometry.fixed_point import FixedPointAccumulator, relative_motions, solve_pivot
from tiptrace.geometry.transforms import apply, invert, rotation_exp, transform
from tiptrace.types import FloatArray

P = np.array([0.4, -0.1, 0.05])
C = np.array([0.001, -0.002, 0.2])


def poses_about(p: FloatArray, c: FloatArray, rotations: FloatArray) -> FloatArray:
    R = rotation_exp(rotations)
    return transform(R, p - R @ c)


def test_motions_about_a_fixed_point_give_it_back() -> None:
    accumulator = FixedPointAccumulator()
    for w in np.random.default_rng(0).normal(scale=0.1, size=(20, 3)):
        R = rotation_exp(w)
        accumulator.add(R, P - R @ P)
    solution = accumulator.solve()
    assert solution is not None
    np.testing.assert_allclose(solution.p, P, atol=1e-9)
    assert solution.residual_m < 1e-7
    assert solution.frames == 20


@pytest.mark.parametrize("rotations", [np.zeros((5, 3)), np.outer(np.linspace(0, 0.2, 5), [0, 0, 1])])
def test_no_rotation_or_a_single_axis_leaves_the_point_undetermined(rotations: FloatArray) -> None:
    accumulator = FixedPointAccumulator()
    for w in rotations:
        R = rotation_exp(w)
        accumulator.add(R, P - R @ P)
    assert accumulator.solve() is None


def test_residual_is_the_rms_of_the_rows() -> None:
    rng = np.random.default_rng(1)
    R = rotation_exp(rng.normal(scale=0.2, size=(30, 3)))
    d = P - R @ P + rng.normal(scale=1e-3, size=(30, 3))
    accumulator = FixedPointAccumulator()
    for R_t, d_t in zip(R, d, strict=True):
        accumulator.add(R_t, d_t)
    solution = accumulator.solve()
    assert solution is not None
    rows = (np.eye(3) - R) @ solution.p - d
    assert solution.residual_m == pytest.approx(np.sqrt(np.mean(np.sum(rows**2, axis=1))))


def test_pivot_recovers_tip_and_point_with_honest_covariance() -> None:
    rng = np.random.default_rng(2)
    scores = []
    for _ in range(200):
        T = poses_about(P, C, rng.normal(scale=0.3, size=(40, 3)))
        T[:, :3, 3] += rng.normal(scale=4e-4, size=(40, 3))
        pivot = solve_pivot(T)
        error = np.concatenate([pivot.tip - C, pivot.pivot - P])
        scores.append(error @ np.linalg.solve(pivot.covariance, error))
    assert np.mean(scores) == pytest.approx(6.0, rel=0.15)  # χ² with six degrees of freedom


def test_a_single_axis_is_named_as_weak() -> None:
    axis = np.array([0.0, 0.6, 0.8])
    pivot = solve_pivot(poses_about(P, C, np.outer(np.linspace(-0.3, 0.3, 15), axis)))
    assert len(pivot.weak_axes) == 1
    assert abs(pivot.weak_axes[0] @ axis) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("T", "message"),
    [(np.tile(np.eye(4), (2, 1, 1)), "at least 3"), (np.tile(np.eye(4), (9, 1, 1)), "do not rotate")],
)
def test_poses_that_cannot_tell_are_refused(T: FloatArray, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        solve_pivot(T)


def test_relative_motions_carry_a_tool_point_from_the_first_pose() -> None:
    T = poses_about(P, C, np.random.default_rng(4).normal(size=(5, 3)))
    R_t, d_t = relative_motions(T)
    x_T = np.array([0.1, 0.2, 0.3])
    for i in range(5):
        np.testing.assert_allclose(R_t[i] @ apply(T[0], x_T) + d_t[i], apply(T[i], x_T), atol=1e-12)
    np.testing.assert_allclose(T[2] @ invert(T[2]), np.eye(4), atol=1e-12)


def test_real_pointer_poses_give_the_published_tip_and_pivot(shared_data: Path) -> None:
    rows = np.loadtxt(shared_data / "pivot_ndi" / "poses_3x4_rowmajor_m.csv", delimiter=",").reshape(-1, 3, 4)
    published = np.loadtxt(shared_data / "pivot_ndi" / "published_answer_tip_then_pivot_m.csv", delimiter=",")
    pivot = solve_pivot(transform(rows[:, :, :3], rows[:, :, 3]))
    np.testing.assert_allclose(np.concatenate([pivot.tip, pivot.pivot]), published, atol=1e-5)
    assert pivot.weak_axes == ()
