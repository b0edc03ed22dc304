"""Fixed point by maximum likelihood: exact, unbiased, efficient, honest, robust."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import GeometryError
from tiptrace.estimation.anchor import TipPrior, fixed_point_ml
from tiptrace.estimation.observability import advice, weak_axes
from tiptrace.geometry.transforms import rotation_exp
from tiptrace.types import FloatArray

C = np.array([0.0, 0.01, 0.06])
P = np.array([0.4, -0.1, 0.02])


def poses(rng: np.random.Generator, sigma: tuple[float, float], deg: tuple[float, float], frames: int = 100):
    """Rotation about a fixed tip by sines of deg about x and y, with noise (rad, m) on every pose."""
    a = np.linspace(0, 2 * np.pi, frames)
    w = np.radians(np.stack([deg[0] * np.sin(a), deg[1] * np.sin(2 * a), 0 * a], axis=1))
    R = rotation_exp(w)
    t = P - R @ C
    R = rotation_exp(sigma[0] * rng.standard_normal((frames, 3))) @ R
    return (
        R,
        t + sigma[1] * rng.standard_normal((frames, 3)),
        np.diag([sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3),
    )


def least_squares(R: FloatArray, t: FloatArray) -> FloatArray:
    A = np.concatenate([R, np.broadcast_to(-np.eye(3), R.shape)], axis=2).reshape(-1, 6)
    return np.linalg.lstsq(A, -t.ravel(), rcond=None)[0]


def cramer_rao(sigma: tuple[float, float], deg: tuple[float, float], frames: int = 100) -> FloatArray:
    """Bound on the covariance of p from the noise-free poses: rotations and translations eliminated."""
    R, _, Sigma = poses(np.random.default_rng(0), (0.0, 0.0), deg, frames)
    Sigma = np.diag([sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3)
    N = np.zeros((6, 6))
    for R_k in R:
        y = R_k @ C
        B = np.hstack([-np.array([[0, -y[2], y[1]], [y[2], 0, -y[0]], [-y[1], y[0], 0]]), np.eye(3)])
        A = np.hstack([R_k, -np.eye(3)])
        N += A.T @ np.linalg.inv(B @ Sigma @ B.T) @ A
    return np.linalg.inv(N)[3:, 3:]


def test_exact_poses_give_the_fixed_point() -> None:
    R, t, _ = poses(np.random.default_rng(0), (0.0, 0.0), (5, 5))
    point = fixed_point_ml(R, t, np.eye(6) * 1e-8)
    assert point.p == pytest.approx(P, abs=1e-9)
    assert point.c == pytest.approx(C, abs=1e-9)


def _efficiency(draws: int) -> tuple[float, float, float, float]:
    sigma, deg = (2e-3, 1e-4), (2.0, 2.0)
    bound = cramer_rao(sigma, deg)
    ml, ls, nees = [], [], []
    for seed in range(draws):
        R, t, Sigma = poses(np.random.default_rng(seed), sigma, deg)
        point = fixed_point_ml(R, t, Sigma)
        ml.append(point.p - P)
        ls.append(least_squares(R, t)[3:] - P)
        nees.append(ml[-1] @ np.linalg.solve(point.covariance_p, ml[-1]))
    rmse = float(np.sqrt(np.mean(np.square(ml).sum(axis=1)) / np.trace(bound)))
    bias = float(np.max(np.abs(np.mean(ml, axis=0)) / np.sqrt(np.diag(bound))))
    bias_ls = float(np.max(np.abs(np.mean(ls, axis=0)) / np.sqrt(np.diag(bound))))
    return rmse, bias, bias_ls, float(np.mean(nees))


def test_efficient_and_unbiased_where_least_squares_is_pulled_to_the_markers() -> None:
    rmse, bias, bias_ls, nees = _efficiency(200)
    assert rmse < 1.15  # sampling error of 200 draws included
    assert bias < 0.25
    assert bias_ls > 0.6
    assert 2.4 < nees < 3.8


@pytest.mark.slow
def test_efficiency_on_2000_draws() -> None:
    rmse, bias, _, nees = _efficiency(2000)
    assert rmse <= 1.10
    assert bias <= 0.10
    assert 2.7 < nees < 3.5


@pytest.mark.parametrize("seed", range(20))
def test_one_axis_leaves_the_tip_open_along_it(seed: int) -> None:
    R, t, Sigma = poses(np.random.default_rng(seed), (2e-3, 1e-4), (5, 0), frames=400)
    point = fixed_point_ml(R, t, Sigma)
    weak = weak_axes(point.covariance_p, 2e-3)
    assert len(weak) == 1
    assert abs(weak[0][0]) > 0.95
    assert "along x of the base" in advice(weak, point.covariance_p, R, 2e-3)
    assert "rotate" in advice(weak, point.covariance_p, R, 2e-3)


def test_a_prior_closes_the_open_direction() -> None:
    R, t, Sigma = poses(np.random.default_rng(1), (2e-3, 1e-4), (5, 0))
    prior = TipPrior(C + [1e-3, 0, 0], np.eye(3) * 1e-6)
    point = fixed_point_ml(R, t, Sigma, prior=prior)
    assert not weak_axes(point.covariance_p, 2e-3)
    assert point.c[0] == pytest.approx(C[0] + 1e-3, abs=3e-4)  # along x only the prior speaks


def test_anisotropic_noise_is_weighed() -> None:
    R, t, _ = poses(np.random.default_rng(2), (0.0, 0.0), (8, 8))
    rng = np.random.default_rng(3)
    s = np.where(np.arange(len(t)) % 2, 1e-5, 2e-3)[:, None]
    t = t + s * rng.standard_normal(t.shape)
    Sigma = np.zeros((len(t), 6, 6))
    Sigma[:, range(3, 6), range(3, 6)] = s**2
    Sigma[:, range(3), range(3)] = 1e-12
    assert fixed_point_ml(R, t, Sigma).p == pytest.approx(P, abs=5e-5)


def test_pointer_poses_with_outliers_stay_at_the_published_tip(shared_data: Path) -> None:
    folder = shared_data / "pivot_ndi"
    T = np.loadtxt(folder / "poses_3x4_rowmajor_m.csv", delimiter=",").reshape(-1, 3, 4)
    answer = np.loadtxt(folder / "published_answer_tip_then_pivot_m.csv", delimiter=",")
    robust, plain = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        t = T[:, :, 3].copy()
        off = rng.permutation(len(t))[:30]
        away = rng.standard_normal((30, 3))
        t[off] += 0.010 * away / np.linalg.norm(away, axis=1, keepdims=True)
        point = fixed_point_ml(T[:, :, :3], t, outliers=True)
        assert (point.weights[off] == 0).all()
        robust.append(np.linalg.norm(point.c - answer[:3]))
        plain.append(np.linalg.norm(least_squares(T[:, :, :3], t)[:3] - answer[:3]))
    assert max(robust) < 0.3e-3
    assert np.mean(plain) > 1e-3


@pytest.mark.parametrize(
    ("R", "t", "sentence"),
    [
        (np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), "at least 3 poses"),
        (np.tile(np.eye(3), (5, 1, 1)), np.zeros((4, 3)), "poses must be"),
        (np.full((5, 3, 3), np.nan), np.zeros((5, 3)), "not finite"),
    ],
)
def test_bad_poses_are_refused(R: FloatArray, t: FloatArray, sentence: str) -> None:
    with pytest.raises(GeometryError, match=sentence):
        fixed_point_ml(R, t)


def test_poses_that_no_point_fits_are_refused_in_a_sentence(monkeypatch: pytest.MonkeyPatch):
    def runs_away(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("tiptrace.estimation.anchor._Problem.step", runs_away)
    with pytest.raises(GeometryError, match="no fixed point"):
        fixed_point_ml(np.broadcast_to(np.eye(3), (5, 3, 3)), np.zeros((5, 3)), outliers=True)
