"""Weighted template fit: exact, right about its noise, blind to depth tilt."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.estimation.motion import MotionConfig, TemplateFit
from tiptrace.estimation.patch import PatchConfig, in_contact, trust
from tiptrace.geometry.transforms import rotation_exp, rotation_log
from tiptrace.types import FloatArray

AXES = np.array(  # columns u, v, normal of the left and the right pad
    [[[0, 0, -1], [0, 1, 0], [1, 0, 0]], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]], dtype=float
)


def template() -> tuple[FloatArray, FloatArray]:
    v, u = np.meshgrid(np.linspace(-4e-3, 4e-3, 4), np.linspace(-8e-3, 8e-3, 7))
    n = v.size
    left = np.stack([np.full(n, 4e-3), v.ravel(), 0.14 + u.ravel()], axis=1)
    return np.concatenate([left, left * [-1, 1, 1]]), np.repeat([0, 1], n)


def moved(M: FloatArray, w: FloatArray, d: FloatArray) -> FloatArray:
    g = M.mean(axis=0)
    return (M - g) @ rotation_exp(w).T + g + d


def test_exact_motion_comes_back() -> None:
    M, pad = template()
    fit = TemplateFit(M, pad, AXES, np.ones(len(M)), MotionConfig(iterations=8, tilt_sigma_rad=1e-6))
    w, d = np.array([0.08, -0.05, 0.06]), np.array([4e-4, -5e-4, 8e-4])
    motions = fit.fit(moved(M, w, d)[None])
    assert rotation_log(motions.R[0]) == pytest.approx(w, abs=1e-6)
    assert motions.t[0] + motions.R[0] @ M.mean(axis=0) - M.mean(axis=0) == pytest.approx(d, abs=1e-8)


def test_covariance_tells_the_scatter() -> None:
    M, pad = template()
    config = MotionConfig(depth_sigma_m=1e-4, depth_bias_sigma_m=0.0)
    fit = TemplateFit(M, pad, AXES, np.ones(len(M)), config)
    rng = np.random.default_rng(0)
    T = 3000
    noise = rng.standard_normal((T, len(M), 3)) * [4e-5, 4e-5, 1e-4]  # u, v, normal
    tilt = 0.02 * rng.standard_normal((T, 2, 2))
    middle = np.stack([M[pad == k].mean(axis=0) for k in (0, 1)])
    uv = np.einsum("nij,ni->nj", AXES[pad], M - middle[pad])[:, :2]
    noise[..., 2] += np.einsum("tnj,nj->tn", tilt[:, pad], uv)
    motions = fit.fit(M + np.einsum("nij,tnj->tni", AXES[pad], noise))
    x = np.concatenate([rotation_log(motions.R), motions.centre - M.mean(axis=0)], axis=1)
    nees = np.einsum("ti,tij,tj->t", x, np.linalg.inv(motions.covariance), x)
    assert nees.mean() == pytest.approx(6.0, rel=0.08)


def test_depth_tilt_of_a_pad_is_not_taken_for_rotation() -> None:
    M, pad = template()
    tilted = M.copy()
    tilted[pad == 0, 0] += 0.03 * (M[pad == 0, 2] - 0.14)  # left pad's depth tilts along the tool
    w = rotation_log(TemplateFit(M, pad, AXES, np.ones(len(M)), MotionConfig()).fit(tilted[None]).R[0])
    flat = MotionConfig(tilt_sigma_rad=1e-6)
    naive = rotation_log(TemplateFit(M, pad, AXES, np.ones(len(M)), flat).fit(tilted[None]).R[0])
    assert np.abs(w).max() < 0.1 * np.abs(naive).max()


def test_slipping_markers_are_weighed_down() -> None:
    M, pad = template()
    X = M.copy()
    X[:4, 1] += 1e-3  # four markers at the edge slid by 1 mm
    motions = TemplateFit(M, pad, AXES, np.ones(len(M)), MotionConfig(iterations=10)).fit(X[None])
    assert np.linalg.norm(motions.centre[0] - M.mean(axis=0)) < 3e-5
    assert motions.weights[0, :4].max() < 0.2


def test_lost_markers_drop_out() -> None:
    M, pad = template()
    X = moved(M, np.array([0.0, 0.03, 0.02]), np.array([1e-4, 0, 2e-4]))
    X[::3] = np.nan
    fit = TemplateFit(M, pad, AXES, np.ones(len(M)), MotionConfig(iterations=8, tilt_sigma_rad=1e-6))
    motions = fit.fit(X[None])
    assert (motions.weights[0, ::3] == 0).all()
    assert rotation_log(motions.R[0]) == pytest.approx([0, 0.03, 0.02], abs=1e-6)


def test_template_from_many_frames_is_better_than_one() -> None:
    M, pad = template()
    rng = np.random.default_rng(1)
    w = 0.03 * rng.standard_normal((80, 3))
    X = np.stack([moved(M, a, np.zeros(3)) for a in w]) + 3e-5 * rng.standard_normal((80, len(M), 3))
    fit = TemplateFit(X[0], pad, AXES, np.ones(len(M)), MotionConfig())
    refined = fit.refined_template(X, fit.fit(X))

    def shape_error(A: FloatArray) -> float:
        B = TemplateFit(M, pad, AXES, np.ones(len(M)), MotionConfig(iterations=8)).fit(A[None])
        return float(np.sqrt(np.mean(np.square(A - (M @ B.R[0].T + B.t[0])))))

    assert shape_error(refined) < 0.4 * shape_error(X[0])


def test_patch_keeps_the_interior_and_falls_back_to_the_edge() -> None:
    v, u = np.meshgrid(np.arange(-3, 4) * 2e-3, np.arange(-4, 5) * 2e-3)
    x = np.stack([u.ravel(), v.ravel(), np.zeros(63)], axis=1)
    x[:, 2] = np.where(np.abs(x[:, 1]) < 5e-3, -1e-3, 0.0)  # five rows in contact
    weight = trust(x, PatchConfig())
    assert set(np.abs(x[weight == 1.0, 1]).round(4)) == {0.0, 0.002}
    assert (weight[np.abs(x[:, 1]) > 3e-3] == 0).all()
    narrow = x.copy()
    narrow[:, 2] = np.where(np.abs(x[:, 1]) < 3e-3, -1e-3, 0.0)[:] * (np.abs(x[:, 1]) > 1e-3)  # no interior
    weight = trust(narrow, PatchConfig())
    assert (weight[in_contact(narrow, PatchConfig())] > 0).all()
