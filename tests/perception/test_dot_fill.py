import numpy as np
import pytest

from tiptrace.perception.dot_fill import DotFill
from tiptrace.perception.fill import nearest_fill, smooth_fill

SHAPE, RADIUS = (120, 160), 4.3
V, U = np.indices(SHAPE).astype(np.float64)
DOTS = np.array([[u, v] for v in np.arange(12.3, 115, 16) for u in np.arange(12.7, 155, 16)])


def discs():
    mask = np.zeros(SHAPE, bool)
    for u, v in DOTS:
        mask |= np.hypot(U - u, V - v) < RADIUS
    return mask


def edge(angle, centre=(80.0, 60.0), width=3.0):
    """A ridge of slope along a straight line, as at a tool's edge."""
    across = (U - centre[0]) * np.cos(angle) + (V - centre[1]) * np.sin(angle)
    height = np.exp(-0.5 * (across / width) ** 2)
    return np.stack([height * np.cos(angle), height * np.sin(angle)], axis=-1).astype(np.float32)


def apply(maps, dots):
    planes = np.ascontiguousarray(np.moveaxis(maps, -1, 0))
    DotFill(RADIUS).apply(planes, dots)
    return np.moveaxis(planes, 0, -1)


def rms_under(filled, truth):
    return float(np.sqrt(np.mean((filled - truth)[discs()] ** 2)))


@pytest.mark.parametrize("angle", [0.0, 0.07, 0.6, 1.2, -0.4])
def test_an_edge_is_continued_under_dots(angle):
    truth, mask = edge(angle), discs()
    spoiled = np.where(mask[..., None], np.float32(9), truth)
    filled = smooth_fill(spoiled, mask)
    smooth = filled.copy()
    filled = apply(filled, DOTS)
    assert rms_under(filled, truth) < 0.6 * rms_under(smooth, truth)
    assert rms_under(filled, truth) < 0.6 * rms_under(nearest_fill(spoiled, mask), truth)
    assert np.array_equal(filled[~mask], smooth[~mask])


def test_smooth_fill_continues_planes_better_than_the_nearest_value():
    truth = np.stack([0.002 * U - 0.001 * V, 0.0015 * V], axis=-1).astype(np.float32)
    mask = discs()
    spoiled = np.where(mask[..., None], np.float32(-5), truth)
    assert rms_under(smooth_fill(spoiled, mask), truth) < 0.5 * rms_under(nearest_fill(spoiled, mask), truth)


def test_smooth_fill_keeps_what_is_known_and_constants():
    mask = discs()
    rng = np.random.default_rng(0)
    maps = rng.normal(size=(*SHAPE, 2)).astype(np.float32)
    np.testing.assert_allclose(smooth_fill(maps, mask)[~mask], maps[~mask], atol=1e-6)
    flat = np.where(mask[..., None], np.float32(7), np.float32(0.25)) * np.ones((*SHAPE, 2), np.float32)
    np.testing.assert_allclose(smooth_fill(flat, mask), 0.25, atol=1e-5)


def test_dots_at_the_border_and_none():
    maps = edge(0.0, (4.0, 60.0))
    before = maps.copy()
    maps = apply(maps, np.zeros((0, 2)))
    assert np.array_equal(maps, before)
    maps = apply(maps, np.array([[4.0, 2.0], [0.0, 119.0], [4.0, 60.0]]))
    assert np.isfinite(maps).all()
    assert np.sqrt(np.mean((maps - before) ** 2)) < 0.02
