import numpy as np
import pytest

from tiptrace.perception.tracking import LucasKanadeTracker, lucas_kanade

from .gel_images import grid, paint_dots, shade, to_uint8


def test_follows_a_smooth_motion():
    start = grid()
    tracker = LucasKanadeTracker(to_uint8(paint_dots(shade(), start), 1.5), start)
    for t in range(1, 15):
        truth = start + np.array([0.5 * t, 4 * np.sin(t / 3)])
        uv, tracked = tracker.update(to_uint8(paint_dots(shade(), truth), 1.5, seed=t))
    inside = (truth[:, 0] < 312) & (truth[:, 1] < 232) & (truth[:, 1] > 8)
    assert tracked[inside].all()
    assert np.linalg.norm(uv - truth, axis=1)[inside].max() < 0.5


def test_a_lost_marker_keeps_its_index():
    start = grid()
    tracker = LucasKanadeTracker(to_uint8(paint_dots(shade(), start)), start)
    for t in range(1, 8):
        truth = start + np.array([6.0 * t, 0])
        uv, tracked = tracker.update(to_uint8(paint_dots(shade(), truth)))
    gone = truth[:, 0] > 330
    assert gone.any()
    assert not tracked[gone].any()
    assert np.isnan(uv[~tracked]).all()
    assert uv.shape == start.shape
    kept = truth[:, 0] < 310
    np.testing.assert_allclose(uv[kept], truth[kept], atol=0.5)


@pytest.mark.parametrize("shift", [(0.25, 0.0), (1.4, -2.3), (5.0, 3.0)])
def test_subpixel(shift):
    start = grid()
    a, b = (to_uint8(paint_dots(shade(), start + s, 10.5)) for s in ((0, 0), shift))
    grey = [im.mean(axis=2).round().astype(np.uint8) for im in (a, b)]
    uv, found = lucas_kanade(*grey, start)
    interior = (start > 20).all(axis=1) & (start[:, 0] < 300) & (start[:, 1] < 220)
    assert found[interior].all()
    assert np.linalg.norm(uv - start - shift, axis=1)[interior].max() < 0.12
