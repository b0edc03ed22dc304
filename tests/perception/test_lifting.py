import numpy as np
import pytest

from tiptrace.errors import PerceptionError
from tiptrace.perception.lifting import lift, sample_map, select_markers


def test_the_image_centre_is_the_origin_and_depth_points_into_the_gel():
    x = lift(
        np.array([[159.5, 119.5], [160.5, 119.5], [159.5, 121.5]]),
        np.array([0.0, 1e-3, 2e-3]),
        (320, 240),
        [1e-4, 2e-4],
    )
    np.testing.assert_allclose(x, [[0, 0, 0], [1e-4, 0, -1e-3], [0, 4e-4, -2e-3]], atol=1e-12)


def test_sampling_is_exact_on_a_plane_at_any_step():
    for step in (1, 2, 4):
        v, u = (
            np.indices((240 // step, 320 // step)) * step + (step - 1) / 2
        )  # image px of each block's centre
        plane = (0.3 * u - 0.2 * v + 1).astype(np.float32)
        uv = np.array([[10.3, 20.7], [200.0, 199.9], [np.nan, np.nan], [50.5, 60.0]])
        found = sample_map(plane, uv, step)
        assert np.isnan(found[2])
        ok = [0, 1, 3]
        np.testing.assert_allclose(found[ok], 0.3 * uv[ok, 0] - 0.2 * uv[ok, 1] + 1, rtol=1e-5)


def test_selection_drops_the_deepest():
    depth = np.arange(20.0)
    depth[4] = np.nan
    assert list(select_markers(depth)) == [16, 15, 14, 13, 12, 11, 10, 9]
    assert list(select_markers(depth, keep=2, discard=0)) == [19, 18]
    with pytest.raises(PerceptionError, match="10 markers have a depth"):
        select_markers(np.arange(10.0))
