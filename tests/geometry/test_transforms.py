"""Group laws and round trips of rigid transforms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tiptrace.errors import GeometryError
from tiptrace.geometry import transforms as tf

coordinates = st.floats(-2.0, 2.0, allow_subnormal=False)
vectors = arrays(np.float64, (3,), elements=coordinates)


@given(vectors)
def test_exp_and_log_are_inverse_within_half_a_turn(w: np.ndarray) -> None:
    angle = np.linalg.norm(w)
    w = w if angle < 3.0 else w * (3.0 / angle)
    np.testing.assert_allclose(tf.rotation_log(tf.rotation_exp(w)), w, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_log_recovers_angles_near_identity_and_half_turn(angle: float) -> None:
    axis = np.array([0.6, -0.64, 0.48])
    w = tf.rotation_log(tf.rotation_exp(angle * axis))
    assert np.linalg.norm(w) == pytest.approx(angle, abs=1e-9)


@given(vectors, vectors)
def test_rotations_are_orthonormal_and_compose(a: np.ndarray, b: np.ndarray) -> None:
    R = tf.rotation_exp(a) @ tf.rotation_exp(b)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


@given(vectors)
def test_quaternions_round_trip(w: np.ndarray) -> None:
    R = tf.rotation_exp(w)
    np.testing.assert_allclose(tf.rotation_from_quaternion(tf.quaternion_from_rotation(R)), R, atol=1e-12)


def test_quaternion_of_a_quarter_turn_about_z_is_xyzw() -> None:
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(tf.quaternion_from_rotation(R), [0, 0, np.sqrt(0.5), np.sqrt(0.5)])


def test_non_unit_quaternion_is_refused() -> None:
    with pytest.raises(GeometryError, match="norm 2"):
        tf.rotation_from_quaternion([0, 0, 0, 2])


@given(vectors, vectors, vectors)
def test_inverse_and_apply(w: np.ndarray, t: np.ndarray, x: np.ndarray) -> None:
    T = tf.transform(tf.rotation_exp(w), t)
    np.testing.assert_allclose(T @ tf.invert(T), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(tf.apply(tf.invert(T), tf.apply(T, x)), x, atol=1e-12)


@pytest.mark.parametrize("shape", [(), (1,), (4, 2)])
def test_batches_agree_with_single_calls(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    w = rng.normal(size=(*shape, 3))
    R = tf.rotation_exp(w)
    for index in np.ndindex(shape):
        np.testing.assert_allclose(R[index], tf.rotation_exp(w[index]))
        np.testing.assert_allclose(tf.rotation_log(R)[index], tf.rotation_log(R[index]))


@given(vectors, vectors, st.floats(0, 1))
def test_interpolation_is_a_constant_velocity_motion(w: np.ndarray, t: np.ndarray, s: float) -> None:
    T_0, T_1 = tf.transform(tf.rotation_exp([0.2, 0.1, -0.3]), [1, 2, 3]), np.eye(4)
    angle = np.linalg.norm(w)
    w = w if angle < 3.0 else w * (3.0 / angle)
    T_1 = tf.transform(T_0[:3, :3] @ tf.rotation_exp(w), T_0[:3, 3] + t)
    T = tf.interpolate(T_0, T_1, s)
    np.testing.assert_allclose(T[:3, :3], T_0[:3, :3] @ tf.rotation_exp(s * w), atol=1e-9)
    np.testing.assert_allclose(T[:3, 3], T_0[:3, 3] + s * t, atol=1e-12)
