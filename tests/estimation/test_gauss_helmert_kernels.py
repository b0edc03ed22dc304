"""The compiled equations of Stage I equal the same equations written with whole arrays."""

from __future__ import annotations

import numpy as np

from tiptrace.estimation.gauss_helmert_kernels import (
    corrections,
    fixed_point_rows,
    linearise,
    normal_equations,
    spurious,
)
from tiptrace.geometry.transforms import rotation_exp, skew, transform
from tiptrace.types import FloatArray

T, STEPS = 7, 2
SIZE = 19 + 3 * STEPS


def some(rng: np.random.Generator, *shape: int, scale: float = 1.0) -> FloatArray:
    return np.asarray(scale * rng.standard_normal(shape))


def covariances(rng: np.random.Generator) -> FloatArray:
    root = some(rng, T, 6, 6, scale=1e-3)
    return root @ np.swapaxes(root, 1, 2)


def test_the_frames_of_stage_one() -> None:
    rng = np.random.default_rng(1)
    theta, delta = some(rng, SIZE, scale=0.1), some(rng, T, 6, scale=0.02)
    T_B_E = transform(rotation_exp(some(rng, T, 3)), some(rng, T, 3))
    velocity_B, rate_E = some(rng, T, 3), some(rng, T, 3)
    R, t, centre = rotation_exp(some(rng, T, 3, scale=0.1)), some(rng, T, 3), some(rng, T, 3)
    Sigma, shares, variance = covariances(rng), some(rng, T, 1 + STEPS), 1e-8
    A, S_inv, w, lever = linearise(
        theta, delta, T_B_E, velocity_B, rate_E, R, t, centre, Sigma, shares, variance
    )
    p, G, c_t = theta[3:6], theta[6:15].reshape(3, 3), theta[:3] + shares @ theta[16:].reshape(-1, 3)
    R_BE, t_BE = T_B_E[:, :3, :3], T_B_E[:, :3, 3]
    q = np.einsum("tji,tj->ti", R_BE, p - t_BE)
    du_ds = -np.cross(rate_E, q) - np.einsum("tji,tj->ti", R_BE, velocity_B)
    E = rotation_exp(delta[:, :3])
    arm = np.einsum("tij,tj->ti", E, np.einsum("tij,tj->ti", R, c_t) + t - centre)
    B = np.concatenate([-skew(arm), np.broadcast_to(np.eye(3), (T, 3, 3))], axis=2)
    expected = np.zeros((T, 3, SIZE))
    expected[:, :, :3] = E @ R - np.eye(3) + G
    expected[:, :, 3:6] = -G @ np.swapaxes(R_BE, 1, 2)
    for j in range(3):
        expected[:, j, 6 + 3 * j : 9 + 3 * j] = -(q - c_t)
    expected[:, :, 15] = du_ds @ G.T
    for k in range(1 + STEPS):
        expected[:, :, 16 + 3 * k : 19 + 3 * k] = shares[:, k, None, None] * expected[:, :, :3]
    r = arm + centre + delta[:, 3:] - c_t - (q - c_t) @ G.T
    np.testing.assert_allclose(lever, arm, rtol=0, atol=1e-12)
    np.testing.assert_allclose(A, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(w, r - np.einsum("tij,tj->ti", B, delta), rtol=0, atol=1e-12)
    S = B @ Sigma @ np.swapaxes(B, 1, 2) + variance * np.eye(3)
    np.testing.assert_allclose(S_inv, np.linalg.inv(S), rtol=1e-9)


def test_a_fixed_point_of_poses() -> None:
    rng = np.random.default_rng(2)
    theta, delta = some(rng, 6, scale=0.1), some(rng, T, 6, scale=0.02)
    R, t, centre = rotation_exp(some(rng, T, 3)), some(rng, T, 3), some(rng, T, 3)
    Sigma = covariances(rng)
    A, S_inv, w, lever = fixed_point_rows(theta, delta, R, t, Sigma, centre)
    c, p = theta[:3], theta[3:]
    E, arm = rotation_exp(delta[:, :3]), R @ c + t - centre
    y = np.einsum("tij,tj->ti", E, arm) + centre + delta[:, 3:]
    B = np.concatenate([-skew(y - centre), np.broadcast_to(np.eye(3), (T, 3, 3))], axis=2)
    np.testing.assert_allclose(
        A, np.concatenate([E @ R, np.broadcast_to(-np.eye(3), R.shape)], axis=2), atol=1e-12
    )
    np.testing.assert_allclose(lever, arm, atol=1e-12)
    np.testing.assert_allclose(w, y - p - np.einsum("tij,tj->ti", B, delta), atol=1e-12)
    np.testing.assert_allclose(S_inv, np.linalg.inv(B @ Sigma @ np.swapaxes(B, 1, 2)), rtol=1e-9)


def test_normal_equations_and_corrections() -> None:
    rng = np.random.default_rng(3)
    A, w, lever, step = some(rng, T, 3, SIZE), some(rng, T, 3), some(rng, T, 3), some(rng, SIZE)
    root = some(rng, T, 3, 3)
    S_inv, weights, Sigma = root @ np.swapaxes(root, 1, 2), rng.uniform(0, 1, T), covariances(rng)
    weights[2] = 0.0
    N, b = normal_equations(A, S_inv, w, weights)
    WA = weights[:, None, None] * (S_inv @ A)
    np.testing.assert_allclose(N, np.einsum("tij,tik->jk", A, WA), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(b, -np.einsum("tij,ti->j", WA, w), rtol=1e-9, atol=1e-9)
    length, delta = corrections(A, S_inv, w, lever, Sigma, step)
    left = w + A @ step
    k = np.einsum("tij,tj->ti", S_inv, left)
    np.testing.assert_allclose(length, np.sqrt(np.einsum("ti,ti->t", left, k)), rtol=1e-9)
    moved = np.concatenate([np.cross(lever, k), k], axis=1)
    np.testing.assert_allclose(delta, -np.einsum("tij,tj->ti", Sigma, moved), rtol=1e-9, atol=1e-15)


def test_what_rotation_noise_seems_to_say() -> None:
    """E[[δω]ᵀ S⁻¹ [δω]] by its definition, from draws along the principal axes of the noise."""
    rng = np.random.default_rng(4)
    R, weights = rotation_exp(some(rng, T, 3)), rng.uniform(0, 1, T)
    root, noise = some(rng, T, 3, 3), some(rng, T, 3, 3)
    S_inv, Sigma = root @ np.swapaxes(root, 1, 2), noise @ np.swapaxes(noise, 1, 2)
    K = skew(np.swapaxes(noise, 1, 2))  # (T, 3, 3, 3): one cross product per column of the root
    E = np.einsum("tmki,tkl,tmlj->tij", K, S_inv, K)
    expected = np.einsum("t,tki,tkl,tlj->ij", weights, R, E, R)
    np.testing.assert_allclose(spurious(Sigma, S_inv, R, weights), expected, rtol=1e-9, atol=1e-9)
