"""The grooves are the paper's, and distances to them are exact with their derivatives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import SimulationError
from tiptrace.sim.groove import TRAJECTORIES, Groove, Pit, centreline_from_csv, named_centreline


@pytest.mark.parametrize(
    ("name", "period_mm", "amplitude_mm"), [("T3", 50, 4), ("T4", 20, 2), ("T5", 100, 8)]
)
def test_sinusoids_of_the_paper(name: str, period_mm: float, amplitude_mm: float) -> None:
    x = np.linspace(0, 0.2, 400)
    y = named_centreline(name).points(x)[:, 1]
    np.testing.assert_allclose(y * 1e3, amplitude_mm * np.sin(2 * np.pi * x * 1e3 / period_mm), atol=1e-9)


def test_arc_of_the_paper_is_a_circle_with_8_mm_of_deviation() -> None:
    p = named_centreline("T2").points(np.linspace(0, 0.2, 101))[:, :2]
    assert p[0, 1] == pytest.approx(0, abs=1e-12)
    assert p[-1, 1] == pytest.approx(0, abs=1e-12)
    assert np.abs(p[:, 1]).max() == pytest.approx(8e-3)
    radius = (0.1**2 + 8e-3**2) / (2 * 8e-3)
    np.testing.assert_allclose(np.linalg.norm(p - [0.1, 8e-3 - radius], axis=1), radius, rtol=1e-12)


@pytest.mark.parametrize("name", sorted(TRAJECTORIES))
def test_curves_continue_along_their_tangents(name: str) -> None:
    line = named_centreline(name)
    for end, outside in ((0.0, -5e-3), (0.2, 0.205)):
        f, slope, _, _ = line.inside(end)
        assert line.at(outside) == pytest.approx((f + slope * (outside - end), slope, 0.0, 0.0))


@pytest.mark.parametrize("name", sorted(TRAJECTORIES))
def test_derivatives_of_the_curve(name: str) -> None:
    line, h = named_centreline(name), 1e-6
    for x in (0.013, 0.06, 0.151):
        for k in range(3):
            numeric = (line.at(x + h)[k] - line.at(x - h)[k]) / (2 * h)
            assert line.at(x)[k + 1] == pytest.approx(numeric, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("name", ["T1", "T2", "T4", "T5"])
def test_distance_is_the_nearest_point_of_the_solid(name: str) -> None:
    """Against a dense sample of the channel's wall and the plate, away from the pit."""
    groove = Groove(named_centreline(name), Pit(depth_m=0.0))
    x = np.arange(0.05, 0.07, 2e-5)
    line = groove.line.points(x)
    slope = np.array([groove.line.at(float(v))[1] for v in x])
    normal = np.stack([-slope, np.ones_like(x)], 1) / np.hypot(1, slope)[:, None]
    angle = np.linspace(-np.pi / 2, np.pi / 2, 181)
    wall = np.concatenate(
        [
            np.column_stack([line[:, :2] + 1.5e-3 * np.sin(a) * normal, np.full(len(x), -1.5e-3 * np.cos(a))])
            for a in angle
        ]
    )
    rng = np.random.default_rng(1)
    for _ in range(15):
        k = rng.integers(300, 700)
        p = line[k] + [0, 0, 0]
        p[:2] += rng.uniform(-0.9e-3, 0.9e-3) * normal[k]
        p[2] = rng.uniform(-0.8e-3, 0.5e-3)
        nearest = np.linalg.norm(wall - p, axis=1).min()
        assert groove.gap(p).distance_m == pytest.approx(nearest, abs=2e-5)


@pytest.mark.parametrize("name", sorted(TRAJECTORIES))
def test_gradient_and_hessian(name: str) -> None:
    groove, rng, h = Groove(named_centreline(name)), np.random.default_rng(2), 1e-8
    for _ in range(60):
        x = float(rng.uniform(-5e-4, 0.02))
        p = np.array([x, groove.line.at(x)[0], 0.0])
        p += [0, rng.choice([0.1, 1.0, 2.0]) * 1e-3, rng.choice([-0.4, -0.2, 0.0, 0.3]) * 1e-3 + 1e-6]
        gap = groove.gap(p)
        gradient = [
            (groove.gap(p + h * e).distance_m - groove.gap(p - h * e).distance_m) / (2 * h) for e in np.eye(3)
        ]
        hessian = [
            (groove.gap(p + h * e).gradient - groove.gap(p - h * e).gradient) / (2 * h) for e in np.eye(3)
        ]
        np.testing.assert_allclose(gap.gradient, gradient, atol=1e-5)
        np.testing.assert_allclose(gap.hessian, hessian, atol=1e-3 * max(1.0, np.abs(gap.hessian).max()))


def test_pit_has_continuous_slope_and_ends_level() -> None:
    pit = Pit()
    x = np.linspace(-1.5e-3, 7e-3, 20001)
    z, slope, _ = np.array([pit.at(float(v)) for v in x]).T
    np.testing.assert_allclose(np.gradient(z, x)[1:-1], slope[1:-1], atol=6e-3)
    assert z.min() == pytest.approx(-pit.depth_m, rel=0.15)
    assert z[0] == z[-1] == 0.0


def test_user_curve_runs_through_its_points(tmp_path: Path) -> None:
    x = np.arange(10, 120, 5.0)
    path = tmp_path / "mine.csv"
    np.savetxt(path, np.column_stack([x, 3 * np.cos(x / 15)]), delimiter=",")
    line = centreline_from_csv(path).check(1.5e-3)
    np.testing.assert_allclose(line.points((x - 10) * 1e-3)[:, 1], 3e-3 * np.cos(x / 15), atol=1e-9)
    assert line.name == "mine"
    assert line.span_m == pytest.approx(0.105)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,0\n1,0\n2,2\n3,0\n4,0\n", "too sharp"),
        ("0,0\n2,0\n1,0\n3,0\n", "must increase"),
        ("0,0\n1,0\n", "at least 4"),
        ("x,y\nfoo,bar\n", "rows 'x, y'"),
        ("0,0\n1,nan\n2,0\n3,0\n", "finite"),
    ],
)
def test_bad_curves_are_refused(tmp_path: Path, rows: str, message: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(rows)
    with pytest.raises(SimulationError, match=message):
        centreline_from_csv(path).check(1.5e-3)


def test_unknown_trajectory_lists_the_valid_ones() -> None:
    with pytest.raises(SimulationError, match="T1, T2, T3, T4, T5"):
        named_centreline("T9")
