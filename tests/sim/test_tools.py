"""Tools: dimensions, smooth surfaces, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.errors import SimulationError
from tiptrace.geometry.transforms import invert, rotation_exp, transform
from tiptrace.sim.rig import true_rig
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.tools import TOOL_NAMES, Corner, make_tool

T_S_E = invert(true_rig(TrialSpec()).T_E_S("left"))  # left pad: at +x_T, side +1


@pytest.mark.parametrize("name", TOOL_NAMES)
def test_length_and_tip(name: str) -> None:
    tool = make_tool(name)
    assert tool.length_m == 0.086
    assert tool.tip_radius_m - tool.top_m == pytest.approx(0.086)


def test_only_the_bent_tool_has_its_tip_off_the_grasped_axis() -> None:
    assert all(np.all(make_tool(n).shank_T == 0) for n in ("O1", "O2", "O3"))
    assert abs(make_tool("O4").shank_T[0]) > 5e-3


@pytest.mark.parametrize("thickness_mm", [5.0, 8.6, 20.0])
def test_cylinder_is_round(thickness_mm: float) -> None:
    tool = make_tool("O3", thickness_mm * 1e-3)
    b = np.linspace(-0.6, 0.6, 41) * thickness_mm * 0.5e-3
    y = np.column_stack([np.zeros_like(b), b, np.full_like(b, -0.06)])
    half = tool.overlap(y, np.ones(len(b))).depth
    np.testing.assert_allclose(np.hypot(half, b), thickness_mm * 0.5e-3, rtol=1e-12)


def test_hexagon_has_flats_of_its_side_and_flanks_at_60_degrees() -> None:
    tool = make_tool("O2")
    b = np.array([0.0, 1.5e-3, 3.9e-3, 4.1e-3])
    half = tool.overlap(np.column_stack([np.zeros(4), b, np.full(4, -0.06)]), np.ones(4)).depth
    assert half[0] == half[1] == pytest.approx(4.3e-3)
    assert (half[2] - half[3]) / 0.2e-3 == pytest.approx(np.tan(np.radians(60)))
    side = 8.6e-3 / np.sqrt(3)  # the flank's line meets the flat where a hexagon's corner is
    assert half[2] == pytest.approx(4.3e-3 - (3.9e-3 - side / 2) * np.tan(np.radians(60)), abs=1e-9)


@pytest.mark.parametrize("name", TOOL_NAMES)
def test_overlap_derivatives(name: str) -> None:
    tool, rng, h = make_tool(name), np.random.default_rng(0), 1e-7
    y = np.column_stack(
        [rng.uniform(-4e-3, 4e-3, 200), rng.uniform(-6e-3, 6e-3, 200), rng.uniform(-0.088, -0.05, 200)]
    )
    side = np.sign(y[:, 0])
    o = tool.overlap(y, side)
    for axis, slope, bend in ((1, o.slope_b, o.bend_b), (2, o.slope_l, o.bend_l)):
        e = h * np.eye(3)[axis]
        plus, minus = tool.overlap(y + e, side), tool.overlap(y - e, side)
        np.testing.assert_allclose((plus.depth - minus.depth) / (2 * h), slope, atol=1e-4)
        slopes = (plus.slope_b, minus.slope_b) if axis == 1 else (plus.slope_l, minus.slope_l)
        assert np.mean(np.abs((slopes[0] - slopes[1]) / (2 * h) - bend) > 0.5) < 0.02  # but for kinks


@pytest.mark.parametrize("name", TOOL_NAMES)
def test_height_above_the_gel_lies_on_the_tool(name: str) -> None:
    rng, tool = np.random.default_rng(1), make_tool(name)
    x, y = np.meshgrid(np.linspace(-8e-3, 8e-3, 9), np.linspace(-3e-3, 3e-3, 7))
    for _ in range(5):
        T_E_T = transform(rotation_exp(0.04 * rng.normal(size=3)), [0, 0, 0.2])
        T_E_T[:3, 3] -= T_E_T[:3, :3] @ (tool.shank_T + [0, 0, -0.06]) - [0, 0, -0.06]
        T_S_T = T_S_E @ T_E_T
        z = tool.height_above_gel(T_S_T, x, y, 1.0)
        points = np.stack([x.ravel(), y.ravel(), z.ravel()], 1)
        inside = tool.overlap((points - T_S_T[:3, 3]) @ T_S_T[:3, :3], np.ones(x.size)).depth
        np.testing.assert_allclose(inside, 0.0, atol=2e-6)
        assert z.min() < -1e-3


def test_height_is_smooth_under_sub_grid_motion() -> None:
    """A shift by a hundredth of the grid's pitch changes no height by more than the steepest flank's slope allows."""
    tool, step = make_tool("O1"), 2.5e-6
    x, y = np.meshgrid(np.linspace(-9e-3, 9e-3, 73), np.linspace(-7e-3, 7e-3, 57))
    before = tool.height_above_gel(T_S_E @ transform(np.eye(3), [0, 0, 0.2]), x, y, 1.0)
    for axis in range(3):
        p = np.array([0, 0, 0.2])
        p[axis] += step
        after = tool.height_above_gel(T_S_E @ transform(np.eye(3), p), x, y, 1.0)
        assert np.abs(after - before).max() <= step * 1.8


def test_corner_drop_is_monotonic() -> None:
    g, slope, bend = Corner(1e-3).drop(np.linspace(-1e-3, 3e-3, 500))
    assert np.all(np.diff(g) >= 0)
    assert np.all(slope >= 0)
    assert np.all(bend >= -1e-9)


def test_refusals() -> None:
    with pytest.raises(SimulationError, match="O1, O2, O3, O4"):
        make_tool("O7")
    with pytest.raises(SimulationError, match="5 to 20 mm"):
        make_tool("O1", 0.03)
    with pytest.raises(SimulationError, match="length"):
        make_tool("O1", length_m=0.01)
