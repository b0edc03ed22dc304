import numpy as np
import pytest

from tiptrace.errors import PerceptionError
from tiptrace.perception.fill import nearest_fill


def test_takes_the_nearest_value():
    rng = np.random.default_rng(0)
    maps = rng.normal(size=(40, 50, 2)).astype(np.float32)
    masked = np.zeros((40, 50), bool)
    masked[10:20, 12:22] = masked[0:4, 0:3] = True
    spoiled = np.where(masked[..., None], np.float32(np.nan), maps)
    filled = nearest_fill(spoiled, masked)
    assert np.array_equal(filled[~masked], maps[~masked])
    open_v, open_u = np.nonzero(~masked)
    for v, u in zip(*np.nonzero(masked), strict=True):
        d = np.hypot(open_v - v, open_u - u)
        near = d <= d.min() + 0.6  # the distance transform is a chamfer one
        assert (filled[v, u] == maps[open_v[near], open_u[near]]).all(axis=1).any()


def test_nothing_masked_and_everything_masked():
    maps = np.ones((4, 5, 2), np.float32)
    assert np.array_equal(nearest_fill(maps, np.zeros((4, 5), bool)), maps)
    with pytest.raises(PerceptionError, match="marker_threshold"):
        nearest_fill(maps, np.ones((4, 5), bool))
