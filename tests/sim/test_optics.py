"""The shading law, and presses made with it."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiptrace.sim.dots import DotLayout
from tiptrace.sim.gel import untouched
from tiptrace.sim.optics import gel_optics, irradiance, nominal_optics, press_optics, unseen_optics
from tiptrace.sim.presses import PressPlan, ball_penetration, render_press, write_press_folder
from tiptrace.sim.render import CameraNoise, TactileRenderer

QUIET = CameraNoise((0, 0, 0), fixed_pattern=0.0)
BLUE, GREEN, RED = range(3)


def relative_light(channel: int, slope_x: float, slope_y: float) -> float:
    optics, zero = nominal_optics(), np.zeros((1, 1))
    E = [irradiance(optics, channel, zero + a, zero + b, zero, zero) for a, b in ((slope_x, slope_y), (0, 0))]
    return float(E[0][0, 0] / E[1][0, 0])


def test_each_colour_comes_from_its_own_side() -> None:
    """As in the real presses: a pit is red at its top, blue at its bottom, green at its right."""
    s = 0.4  # the surface rises away from the pit's middle: upwards in the image is −y
    assert relative_light(RED, 0, -s) > 1.3 > 1 > relative_light(RED, 0, s)
    assert relative_light(BLUE, 0, s) > 1.1 > 1 > relative_light(BLUE, 0, -s)
    assert relative_light(GREEN, s, 0) > 1.1 > 1 > relative_light(GREEN, -s, 0)


@pytest.mark.parametrize(
    "make", [nominal_optics, press_optics, lambda: gel_optics(4), lambda: unseen_optics(4)]
)
def test_light_is_positive_and_bounded_at_any_slope(make: object) -> None:
    optics = make()  # type: ignore[operator]
    a, b = np.meshgrid(np.linspace(-4, 4, 33), np.linspace(-4, 4, 33))
    at = np.full_like(a, 5e-3)
    for channel in range(3):
        E = irradiance(optics, channel, a.astype(np.float32), b.astype(np.float32), at, at)
        assert E.min() > 0
        assert E.max() < 10


def test_gels_differ_and_a_seed_repeats() -> None:
    images = [
        TactileRenderer(gel_optics(s), noise=QUIET).render(untouched()).astype(float) for s in (1, 1, 2)
    ]
    np.testing.assert_array_equal(images[0], images[1])
    assert 2 < np.abs(images[0] - images[2]).mean() < 30


@pytest.mark.parametrize("seed", range(6))
def test_no_gel_is_black_or_overexposed(seed: int) -> None:
    for optics in (gel_optics(seed), unseen_optics(seed)):
        image = TactileRenderer(optics, noise=QUIET).render(untouched())
        assert 40 < image.mean() < 180
        assert (image > 250).mean() < 0.01


def test_background_is_that_of_the_real_marker_gel() -> None:
    """Means of an upper corner, the middle and a lower corner, dots included, of a real gel with this layout."""
    layout = DotLayout(offset_m=(9.2 * 0.0625e-3, -6.4 * 0.0625e-3))  # where its dots lie in the image
    image = TactileRenderer(layout=layout).reference().astype(float)
    regions = {(0, 0): (83, 72, 16), (100, 140): (156, 115, 122), (200, 0): (67, 75, 47)}
    for (v, u), mean_bgr in regions.items():
        np.testing.assert_allclose(image[v : v + 40, u : u + 40].mean(axis=(0, 1)), mean_bgr, atol=10)


def test_press_of_a_ball_is_the_ball_within_its_contact_radius() -> None:
    renderer = TactileRenderer(noise=QUIET)
    press = render_press(renderer, (150.3, 110.6), 6e-3, 1e-3)
    v, u = np.mgrid[:240, :320]
    dx, dy = (u - 150.3) * 0.0625e-3, (v - 110.6) * 0.0625e-3
    r = np.hypot(dx, dy)
    inside = r < 0.85 * press.contact_radius_px * 0.0625e-3
    assert press.contact_radius_px > 20
    ball = -1e-3 + 3e-3 - np.sqrt(9e-6 - r[inside] ** 2)
    np.testing.assert_allclose(press.height_m[inside], ball, atol=15e-6)
    assert press.height_m.min() == pytest.approx(-1e-3, abs=5e-6)


def test_press_at_a_shifted_place_is_the_shifted_press() -> None:
    """Not only by whole grid cells: the height at the ball's middle does not depend on the sub-pixel place."""
    renderer = TactileRenderer(noise=QUIET)
    depths = [
        render_press(renderer, (160 + d, 120 - d), 4e-3, 0.8e-3).height_m.min() for d in (0, 0.5, 1.25, 2.0)
    ]
    np.testing.assert_allclose(depths, depths[0], atol=3e-6)


def test_ball_penetration_is_continuous() -> None:
    p = ball_penetration((0.2e-3, 0.1e-3), 3e-3, 1e-3)
    steepest = np.hypot(*np.gradient(p, 0.25e-3)).max()
    assert p.max() == pytest.approx(1e-3, abs=5e-5)
    assert steepest < 3.0


def test_folder_is_what_calibration_reads(tmp_path: Path) -> None:
    plan = PressPlan(gel_seeds=(7,), layout=DotLayout(), columns=2, rows=2)
    presses = write_press_folder(tmp_path, plan)
    with (tmp_path / "presses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(presses) == 4
    assert cv2.imread(str(tmp_path / "reference.png")).shape == (240, 320, 3)
    for row, press in zip(rows, presses, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / row["image"])), press.image)
        assert float(row["ball_diameter_mm"]) == pytest.approx(press.ball_diameter_m * 1e3)
        assert float(row["center_u_px"]) == pytest.approx(press.center_px[0])


def test_presses_of_several_gels_share_one_reference(tmp_path: Path) -> None:
    """Away from the press every image shows the reference, whichever gel it came from."""
    plan = PressPlan(gel_seeds=(7, 8), columns=2, rows=1, depth_m=(0.5e-3, 0.6e-3))
    presses = write_press_folder(tmp_path, plan)
    reference = cv2.imread(str(tmp_path / "reference.png")).astype(float)
    for press, far in zip(presses, (np.s_[:, 240:], np.s_[:, :80]), strict=True):
        gap = (press.image.astype(float) - reference)[far].mean(axis=(0, 1))
        np.testing.assert_allclose(gap, 0, atol=0.8)
