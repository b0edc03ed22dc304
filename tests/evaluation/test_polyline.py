"""Distances to paths, and the discrete Fréchet distance."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.evaluation.polyline import Polyline, discrete_frechet


def test_projection_on_a_circle():
    angle = np.linspace(0, np.pi, 2000)
    path = Polyline.through(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
    assert path.length_m == pytest.approx(np.pi, rel=1e-5)
    distance, arc = path.project([[0.0, 2.0, 0.0], [0.0, 0.5, 1.0]])
    assert distance == pytest.approx([1.0, np.sqrt(1.25)], abs=1e-5)
    assert arc == pytest.approx([np.pi / 2, np.pi / 2], abs=1e-3)


def test_path_goes_straight_on_beyond_its_ends():
    path = Polyline.through([[0, 0, 0], [1, 0, 0]])
    distance, arc = path.project([[-2.0, 3.0, 0.0], [5.0, 0.0, 1.0]])
    assert distance == pytest.approx([3.0, 1.0])
    assert arc == pytest.approx([-2.0, 5.0])


def test_noise_at_rest_does_not_lengthen_the_path():
    rng = np.random.default_rng(0)
    rest = 1e-5 * rng.standard_normal((500, 3))
    moving = np.stack([np.linspace(0, 0.1, 200), np.zeros(200), np.zeros(200)], axis=1)
    assert Polyline.through(np.concatenate([rest, moving])).length_m == pytest.approx(0.1, rel=0.01)


def test_a_single_point_has_distance_but_no_progress():
    distance, arc = Polyline.through(np.zeros((9, 3))).project([[3.0, 4.0, 0.0]])
    assert distance == pytest.approx([5.0])
    assert np.isnan(arc).all()
    assert np.isnan(Polyline.through([]).project([[1.0, 0, 0]])[0]).all()


def frechet_by_definition(a: np.ndarray, b: np.ndarray) -> float:
    table = np.full((len(a), len(b)), np.inf)
    for i in range(len(a)):
        for j in range(len(b)):
            d = np.linalg.norm(a[i] - b[j])
            before = [table[i - 1, j] if i else np.inf, table[i, j - 1] if j else np.inf]
            before.append(table[i - 1, j - 1] if i and j else np.inf)
            table[i, j] = d if i == j == 0 else max(d, min(before))
    return float(table[-1, -1])


@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 7), (7, 1), (12, 12), (30, 17), (17, 30)])
def test_frechet_equals_its_definition(n: int, m: int):
    rng = np.random.default_rng(n * 100 + m)
    a, b = rng.standard_normal((n, 3)), rng.standard_normal((m, 3))
    assert discrete_frechet(a, b) == pytest.approx(frechet_by_definition(a, b))


def test_frechet_of_parallel_lines_is_their_distance():
    x = np.linspace(0, 1, 50)
    a = np.stack([x, 0 * x, 0 * x], axis=1)
    assert discrete_frechet(a, a + np.array([0, 0.3, 0])) == pytest.approx(0.3)
    assert np.isnan(discrete_frechet(a, np.zeros((0, 3))))
