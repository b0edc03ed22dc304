"""Rendered images: dots where the truth says, noise as asked, the same bytes from the same seed."""

from __future__ import annotations

import numpy as np
import pytest

from tests.sim.test_gel import bar_contact
from tiptrace.sim.dots import DotLayout
from tiptrace.sim.gel import Float32Array, deform, untouched
from tiptrace.sim.render import CameraNoise, TactileRenderer
from tiptrace.types import FloatArray

QUIET = CameraNoise((0, 0, 0), fixed_pattern=0.0)


def clean_pair(layout: DotLayout, **kwargs: float) -> tuple[TactileRenderer, TactileRenderer]:
    """The same gel with and without dots, no noise."""
    return TactileRenderer(layout=layout, noise=QUIET, seed=3, **kwargs), TactileRenderer(noise=QUIET, seed=3)  # type: ignore[arg-type]


def centroids(darkening: Float32Array, near: FloatArray, half: int) -> FloatArray:
    """Intensity-weighted centroid of what the dots took, around each true centre."""
    found = []
    for u, v in np.round(near).astype(int):
        window = darkening[v - half : v + half + 1, u - half : u + half + 1]
        vv, uu = np.mgrid[v - half : v + half + 1, u - half : u + half + 1]
        found.append([(uu * window).sum() / window.sum(), (vv * window).sum() / window.sum()])
    return np.array(found)


@pytest.mark.parametrize("diameter_px", [5.0, 10.5, 18.0])
@pytest.mark.parametrize("pressed", [False, True])
def test_dots_are_centred_on_the_truth(diameter_px: float, pressed: bool) -> None:
    layout = DotLayout(columns=9, rows=7, diameter_m=diameter_px * 0.0625e-3, glint=0.0)
    with_dots, without = clean_pair(layout, shown_fraction=0.9)
    gel = deform(bar_contact(twist_rad=0.05, shift=(0.31e-3, 0.17e-3))) if pressed else untouched()
    darkening = 1 - with_dots.render_clean(gel).mean(axis=2) / without.render_clean(gel).mean(axis=2)
    truth = with_dots.dot_truth(gel).uv_px
    half = int(np.ceil(diameter_px / 2 * 1.1)) + 4  # wide enough for the dot, clear of its neighbours
    inside = np.all((truth > half) & (truth < np.array([319, 239]) - half), axis=1)
    error = centroids(darkening, truth[inside], half) - truth[inside]
    assert inside.sum() > 40
    assert np.abs(error).max() < 0.02


def test_dots_truth_is_the_projection_of_their_positions() -> None:
    renderer = TactileRenderer(layout=DotLayout(), metres_per_px=(0.06e-3, 0.065e-3), shown_fraction=0.85)
    truth = renderer.dot_truth(deform(bar_contact(shift=(0.2e-3, 0.0))))
    uv = truth.x_S[:, :2] / [0.06e-3, 0.065e-3] + [159.5, 119.5]
    np.testing.assert_allclose(truth.uv_px, uv, atol=1e-9)


def test_layout_has_the_pitch_and_size_asked_for() -> None:
    layout = DotLayout(columns=9, rows=7, pitch_m=(2e-3, 2.1e-3), diameter_m=0.7e-3, angle_deg=0.0)
    renderer = TactileRenderer(layout=layout, seed=1)
    assert renderer.dots is not None
    rest = renderer.dots.rest_xy.reshape(7, 9, 2)
    assert np.diff(rest[:, :, 0], axis=1).mean() == pytest.approx(2e-3, rel=0.01)
    assert np.diff(rest[:, :, 1], axis=0).mean() == pytest.approx(2.1e-3, rel=0.01)
    assert 2 * renderer.dots.radius_m.mean() == pytest.approx(0.7e-3, rel=0.02)


def test_noise_has_the_deviation_asked_for() -> None:
    renderer = TactileRenderer(noise=CameraNoise((2.2, 1.3, 1.8)))
    gel = untouched()
    a, b = (renderer.render(gel, frame).astype(float)[60:180, 60:260] for frame in (1, 2))
    np.testing.assert_allclose((a - b).std(axis=(0, 1)) / np.sqrt(2), [2.2, 1.3, 1.8], rtol=0.06)


def test_same_seed_same_bytes_whatever_the_order() -> None:
    gel = deform(bar_contact())
    first = TactileRenderer(layout=DotLayout(), seed=5)
    second = TactileRenderer(layout=DotLayout(), seed=5)
    a = [first.render(gel, frame) for frame in (0, 1, 2)]
    b = [second.render(gel, frame) for frame in (2, 1, 0)][::-1]
    for left, right in zip(a, b, strict=True):
        np.testing.assert_array_equal(left, right)
    assert (a[0] != a[1]).any()
    np.testing.assert_array_equal(first.reference(), second.reference())


def test_lamps_drift_slowly_and_settle() -> None:
    noise = CameraNoise((0, 0, 0), fixed_pattern=0.0, drift_per_minute=0.05, drift_limit=0.08)
    renderer = TactileRenderer(noise=noise)
    gel = untouched()
    level = [renderer.render(gel, 0, t).mean() for t in (0.0, 60.0, 1e5)]
    assert level[1] / level[0] == pytest.approx(1.045, abs=0.006)
    assert level[2] / level[0] == pytest.approx(1.08, abs=0.003)


def test_flicker_scales_each_channel_from_frame_to_frame() -> None:
    renderer = TactileRenderer(noise=CameraNoise((0, 0, 0), fixed_pattern=0.0, flicker=0.02))
    gel = untouched()
    levels = np.array([renderer.render(gel, frame).mean(axis=(0, 1)) for frame in range(40)])
    np.testing.assert_allclose(levels.std(axis=0) / levels.mean(axis=0), 0.02, rtol=0.45)


def test_heights_and_slopes_agree_with_each_other() -> None:
    renderer = TactileRenderer()
    gel = deform(bar_contact())
    z = renderer.heights(gel).astype(float)
    slope_x, slope_y = renderer.slopes(gel)
    by_difference = (z[:, 2:] - z[:, :-2]) / (2 * renderer.metres_per_px[0])
    np.testing.assert_allclose(slope_x[:, 1:-1], by_difference, atol=0.03)
    assert np.abs(slope_y[:, 100:200]).max() < 1e-4
    np.testing.assert_allclose(z[:, 130:190], -1.2e-3, atol=3e-6)


def test_untouched_gel_shows_its_background_everywhere() -> None:
    with_dots, without = clean_pair(DotLayout())
    flat = without.render_clean(untouched())
    dotted = with_dots.render_clean(untouched())
    assert (dotted <= flat + 8.1).all()  # dots only take light, but for glints of at most 8 grey levels
    assert np.median(np.abs(dotted - flat)) < 1e-3


def test_a_gel_without_dots_has_no_dot_truth() -> None:
    with pytest.raises(ValueError, match="DotLayout"):
        TactileRenderer().dot_truth(untouched())
