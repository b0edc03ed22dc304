"""Laws of the gel's surface: it follows the tool, relaxes beside it, and never moves in steps."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.sim.gel import (
    GEL_GRID,
    WALL_SLOPE,
    GelParameters,
    PadContact,
    deform,
    spline_basis,
    spline_coefficients,
    unseen_gel,
    untouched,
)
from tiptrace.sim.presses import ball_penetration
from tiptrace.types import FloatArray

NODES = np.stack(np.meshgrid(np.linspace(-9.5e-3, 9.5e-3, 20), np.linspace(-7e-3, 7e-3, 15)), -1).reshape(
    -1, 2
)
HALF_WIDTH = 4.3e-3
DEPTH = 1.2e-3


def box(center_m: float = 0.0) -> FloatArray:
    """A bar of 8.6 mm across the image, pressed 1.2 mm deep."""
    X, _ = GEL_GRID.mesh()
    return DEPTH - WALL_SLOPE * np.maximum(np.abs(X - center_m) - HALF_WIDTH, 0)


def bar_contact(
    center_m: float = 0.0, twist_rad: float = 0.0, shift: tuple[float, float] = (0, 0)
) -> PadContact:
    nodes = NODES[np.abs(NODES[:, 0] - center_m) < HALF_WIDTH]
    return PadContact(box(center_m), nodes, rigid(nodes, twist_rad, shift))


def rigid(points: FloatArray, twist_rad: float, shift: tuple[float, float]) -> FloatArray:
    c, s = np.cos(twist_rad), np.sin(twist_rad)
    return points @ np.array([[c, s], [-s, c]]) - points + np.asarray(shift)


def test_untouched_gel_is_flat_and_still() -> None:
    gel = untouched()
    assert not gel.height_m.any()
    assert not gel.displacement(NODES).any()


def test_surface_takes_the_tools_depth_and_relaxes_beside_it() -> None:
    gel = deform(bar_contact())
    row = gel.height_m[gel.grid.shape[0] // 2]
    x = gel.grid.x_m
    np.testing.assert_allclose(row[np.abs(x) < 3.5e-3], -DEPTH, atol=2e-6)
    outside = row[x > HALF_WIDTH]
    assert (np.diff(outside) > 0).all()  # rises monotonically
    assert (
        -0.35 * DEPTH < row[np.argmin(np.abs(x - HALF_WIDTH - 1.2e-3))] < -0.1 * DEPTH
    )  # a skirt of mm scale
    assert abs(row[-1]) < 0.01 * DEPTH


def test_gel_is_never_deeper_than_the_tool_and_never_above_it() -> None:
    for overlap in (box(), ball_penetration((1e-3, -2e-3), 6e-3, 1e-3)):
        height = deform(PadContact(overlap, np.zeros((0, 2)), np.zeros((0, 2)))).height_m
        assert height.min() >= -overlap.max() - 2e-6
        flat = (
            np.hypot(*np.gradient(overlap, GEL_GRID.pitch_m)) < 0.3
        )  # away from walls, where edges are bridged
        assert (height + np.maximum(overlap, 0))[flat].max() < 6e-6


def test_points_in_contact_follow_a_rigid_tool_exactly() -> None:
    shift = (0.3e-3, -0.2e-3)
    gel = deform(bar_contact(twist_rad=0.06, shift=shift))
    inside = NODES[np.abs(NODES[:, 0]) < 3.9e-3] + 0.13e-3
    moved = gel.displacement(inside)
    np.testing.assert_allclose(moved[:, :2], rigid(inside, 0.06, shift), atol=2e-6)


def test_motion_dies_out_beside_the_contact() -> None:
    gel = deform(bar_contact(shift=(0.0, 0.5e-3)))
    distances = np.array([0.2e-3, 1e-3, 2.5e-3, 5e-3])
    points = np.column_stack([HALF_WIDTH + distances, np.zeros(4)])
    shown = gel.displacement(points)[:, 1] / 0.5e-3
    assert (np.diff(shown) < 0).all()
    assert shown[0] > 0.85
    assert shown[2] == pytest.approx(np.exp(-1), abs=0.12)
    assert shown[3] < 0.25


def test_dots_show_a_fraction_of_the_motion() -> None:
    gel = deform(bar_contact(shift=(0.4e-3, 0.1e-3)))
    rest = NODES[np.abs(NODES[:, 0]) < 3e-3]
    full, part = (
        gel.dots(rest) - np.c_[rest, 0 * rest[:, :1]],
        gel.dots(rest, 0.85) - np.c_[rest, 0 * rest[:, :1]],
    )
    np.testing.assert_allclose(part[:, :2], 0.85 * full[:, :2], atol=1e-9)
    np.testing.assert_allclose(full[:, 2], -DEPTH, atol=2e-6)


def test_nothing_steps_when_the_tool_slides_less_than_a_cell() -> None:
    """A bar sliding by 5 µm: every point rides along, skirt and rim included."""
    step = 5e-6
    places = np.array([[0.0, 0.0], [3.5e-3, 1e-3], [4.3e-3, 0], [5.0e-3, 0], [6e-3, -2e-3]])
    centers = step * np.arange(60)
    heights, shears = [], []
    for c in centers:
        gel = deform(bar_contact(c, shift=(c, 0.0)))
        heights.append(gel.grid.at(gel.height_m, places + [c, 0]))
        shears.append(gel.displacement(places)[:, 0])
    drift = np.ptp(np.array(heights), axis=0)
    assert drift.max() < 45e-6  # at the steepest place (slope above 1): less than a fifth of a cell
    assert np.abs(np.diff(heights, axis=0)).max() < 1.5 * step
    moved = np.diff(shears, axis=0)
    np.testing.assert_allclose(moved[:, :3], step, atol=0.2 * step)
    assert np.abs(moved).max() < 3 * step


def test_a_node_that_comes_into_contact_does_not_jerk_its_neighbours() -> None:
    overlap = box()
    inner = NODES[np.abs(NODES[:, 0]) < 3.4e-3]
    edge = np.column_stack([np.full(15, HALF_WIDTH + DEPTH / WALL_SLOPE), np.linspace(-7e-3, 7e-3, 15)])
    shear = np.full((len(inner), 2), 0.2e-3)
    late = PadContact(overlap, np.vstack([inner, edge]), np.vstack([shear, np.zeros((15, 2))]))
    points = np.array([[0.0, 0.0], [3e-3, 1e-3], [4e-3, 0.0]])
    before = deform(PadContact(overlap, inner, shear)).displacement(points)
    after = deform(late).displacement(points)
    np.testing.assert_allclose(after[:, :2], before[:, :2], atol=4e-6)


def test_symmetry() -> None:
    gel = deform(PadContact(ball_penetration((0, 0), 8e-3, 1e-3), np.zeros((0, 2)), np.zeros((0, 2))))
    np.testing.assert_allclose(gel.height_m, gel.height_m[:, ::-1], atol=1e-8)
    np.testing.assert_allclose(gel.height_m, gel.height_m[::-1], atol=1e-8)


def test_a_softer_skirt_reaches_farther() -> None:
    contact = bar_contact()
    near, far = (
        deform(contact, parameters=GelParameters(skirt_m=s)).height_m.mean() for s in (0.5e-3, 1.2e-3)
    )
    assert far < near


def test_an_incompressible_gel_bulges_beside_the_contact_and_not_in_it() -> None:
    plain, bulging = deform(bar_contact()), deform(bar_contact(), parameters=unseen_gel(3))
    x = GEL_GRID.x_m
    row = bulging.height_m[38]
    assert row[(x > 6e-3) & (x < 9e-3)].max() > 5e-6
    inside = np.abs(x) < 3.4e-3
    np.testing.assert_allclose(row[inside], plain.height_m[38][inside], atol=2e-6)


def test_sampling_reproduces_cubics_and_their_slopes() -> None:
    X, Y = GEL_GRID.mesh()
    x, y = np.linspace(-8e-3, 8e-3, 37), np.linspace(-6e-3, 6e-3, 23)
    values = 1e3 * X**2 - 2e3 * X * Y + 1e4 * Y**3 + 3 * X  # order 0.1
    C = spline_coefficients(values.astype(np.float32))
    rows, columns = spline_basis(GEL_GRID.y_m, y), spline_basis(GEL_GRID.x_m, x)
    sampled = rows @ (columns @ C.T).T
    xx, yy = np.meshgrid(x, y)
    np.testing.assert_allclose(sampled, 1e3 * xx**2 - 2e3 * xx * yy + 1e4 * yy**3 + 3 * xx, atol=1e-6)
    slope = rows @ (spline_basis(GEL_GRID.x_m, x, 1) @ C.T).T
    np.testing.assert_allclose(slope, 2e3 * xx - 2e3 * yy + 3, atol=1e-2)
