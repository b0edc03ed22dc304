"""Rigid alignment: exact recovery, optimality, degenerate input."""

import numpy as np
import pytest

from tiptrace.errors import GeometryError
from tiptrace.geometry.kabsch import kabsch
from tiptrace.geometry.transforms import rotation_exp


def test_recovers_an_exact_motion() -> None:
    rng = np.random.default_rng(1)
    X_0 = rng.normal(size=(16, 3))
    R, d = rotation_exp([0.3, -0.2, 0.9]), np.array([0.1, 0.2, -0.3])
    motion = kabsch(X_0, X_0 @ R.T + d)
    np.testing.assert_allclose(motion.R, R, atol=1e-12)
    np.testing.assert_allclose(motion.d, d, atol=1e-12)
    assert motion.residual_m < 1e-12


def test_is_a_proper_rotation_even_for_planar_and_mirrored_points() -> None:
    rng = np.random.default_rng(2)
    X_0 = rng.normal(size=(8, 3)) * [1, 1, 0]
    motion = kabsch(X_0, X_0 * [1, -1, 1])
    assert np.linalg.det(motion.R) == pytest.approx(1.0)


def test_no_nearby_motion_fits_noisy_points_better() -> None:
    rng = np.random.default_rng(3)
    X_0 = rng.normal(size=(10, 3))
    X_t = X_0 @ rotation_exp([0.1, 0, 0.2]).T + 0.05 * rng.normal(size=(10, 3))
    motion = kabsch(X_0, X_t)
    for _ in range(100):
        R = rotation_exp(0.02 * rng.normal(size=3)) @ motion.R
        d = motion.d + 0.02 * rng.normal(size=3)
        assert np.sqrt(np.mean(np.sum((X_0 @ R.T + d - X_t) ** 2, axis=1))) >= motion.residual_m


@pytest.mark.parametrize(
    ("X", "message"),
    [
        (np.eye(3)[:2], "at least 3"),
        (np.outer(np.arange(5.0), [1, 2, 3]), "on a line"),
        (np.zeros((4, 3)), "on a line"),
        (np.zeros((4, 2)), r"\(N, 3\)"),
    ],
)
def test_degenerate_points_are_refused(X: np.ndarray, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        kabsch(X, X)
