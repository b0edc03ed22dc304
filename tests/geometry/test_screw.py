from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm

from tiptrace.geometry.screw import interpolate_screw, left_jacobian
from tiptrace.geometry.transforms import apply, invert, rotation_exp, skew, transform

vectors = arrays(np.float64, 3, elements=st.floats(-1.0, 1.0))
fractions = st.floats(0.0, 1.0)


def pose(w: np.ndarray, t: np.ndarray) -> np.ndarray:
    return transform(rotation_exp(w), t)


@settings(deadline=None)
@given(w=vectors, t=vectors, dw=vectors, dt=vectors)
def test_ends_are_met(w: np.ndarray, t: np.ndarray, dw: np.ndarray, dt: np.ndarray) -> None:
    T_0, T_1 = pose(w, t), pose(w, t) @ pose(dw, dt)
    np.testing.assert_array_equal(interpolate_screw(T_0, T_1, 0.0), T_0)
    np.testing.assert_allclose(interpolate_screw(T_0, T_1, 1.0), T_1, atol=1e-12)


@settings(deadline=None)
@given(w=vectors, v=vectors, s=fractions)
def test_equals_the_matrix_exponential(w: np.ndarray, v: np.ndarray, s: float) -> None:
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = skew(1.5 * w), v  # turns by less than π
    np.testing.assert_allclose(interpolate_screw(np.eye(4), expm(twist), s), expm(s * twist), atol=1e-9)


@settings(deadline=None)
@given(w=vectors, p=vectors, s=fractions)
def test_a_fixed_point_stays(w: np.ndarray, p: np.ndarray, s: float) -> None:
    R = rotation_exp(w)
    T = transform(R, p - R @ p)  # turns about p
    np.testing.assert_allclose(apply(interpolate_screw(np.eye(4), T, s), p), p, atol=1e-12)


@settings(deadline=None)
@given(w=vectors, t=vectors, v=vectors, dt=vectors, s=fractions)
def test_moves_with_the_frame(w: np.ndarray, t: np.ndarray, v: np.ndarray, dt: np.ndarray, s: float) -> None:
    T, T_1 = pose(w, t), pose(v, dt)
    np.testing.assert_allclose(
        interpolate_screw(T, T @ T_1, s), T @ interpolate_screw(np.eye(4), T_1, s), atol=1e-12
    )


@settings(deadline=None)
@given(v=vectors, dt=vectors)
def test_speed_is_constant(v: np.ndarray, dt: np.ndarray) -> None:
    T = interpolate_screw(np.eye(4), pose(v, dt), np.linspace(0, 1, 6))  # (6, 4, 4)
    steps = invert(T[:-1]) @ T[1:]
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-12)


@settings(deadline=None)
@given(w=vectors)
def test_left_jacobian_integrates_the_rotation(w: np.ndarray) -> None:
    """R(w) − I = [w] V(w), and V is even-handed near zero."""
    np.testing.assert_allclose(rotation_exp(w) - np.eye(3), skew(w) @ left_jacobian(w), atol=1e-12)
    for scale in (1e-9, 1e-4, 9e-4, 1.1e-3):
        small = scale * w
        np.testing.assert_allclose(
            rotation_exp(small) - np.eye(3), skew(small) @ left_jacobian(small), atol=1e-15
        )
