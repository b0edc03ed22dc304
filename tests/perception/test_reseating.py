"""Matching markers to dots: laws on painted lattices, no images."""

import numpy as np
import pytest

from tiptrace.perception.reseating import Seating

from .gel_images import H, W, grid

PITCH = 31.0
SHAPE = (H, W)


def seats(before, now, dots=None, held=None):
    rest = grid()
    dots = now if dots is None else dots
    held = np.full_like(rest, np.nan) if held is None else held
    order = np.random.default_rng(0).permutation(len(dots))
    return Seating(rest, PITCH).seats(before, dots[order], held, SHAPE)


def disc(x):
    rest = grid()
    share = np.exp(-((np.linalg.norm(rest - [W / 2, H / 2], axis=1) / 75.0) ** 4))
    return rest + x * share[:, None] * [0.8, 0.6]


def test_what_did_not_move_stays():
    result = seats(grid(), grid())
    np.testing.assert_allclose(result.uv_px, grid())
    assert result.decided


@pytest.mark.parametrize(("before", "now"), [(-14, 14), (0, 22), (-25, 5), (16, -15)])
def test_a_patch_may_be_carried_further_than_to_the_next_dot(before, now):
    result = seats(disc(before), disc(now))
    known = np.isfinite(result.uv_px[:, 0])
    assert known.mean() > 0.9
    np.testing.assert_allclose(result.uv_px[known], disc(now)[known])
    assert result.decided


def test_no_two_markers_get_one_dot_and_a_hidden_one_gets_none():
    rest = grid()
    hidden = int(np.linalg.norm(rest - [W / 2, H / 2], axis=1).argmin())
    result = seats(rest, rest, np.delete(rest, hidden, axis=0))
    assert np.isnan(result.uv_px[hidden]).all()
    others = np.delete(np.arange(len(rest)), hidden)
    np.testing.assert_allclose(result.uv_px[others], rest[others])


def test_a_lattice_that_moved_by_half_a_pitch_as_a_whole_is_not_decided():
    """Dots half a pitch to both sides of every place: either lattice is as smooth."""
    rest = grid()
    moved = rest + [0.5 * PITCH, 0.0]
    both = np.unique(np.concatenate([moved, rest - [0.5 * PITCH, 0.0]]).round(0), axis=0)
    result = seats(rest, moved, both)
    assert not result.decided


def test_without_dots_nothing_is_known():
    result = seats(grid(), grid(), np.zeros((0, 2)))
    assert np.isnan(result.uv_px).all()
    assert not result.decided


def test_what_following_gave_is_not_given_up_where_it_is_right():
    now = disc(10)
    result = seats(disc(0), now, held=now)
    known = np.isfinite(result.uv_px[:, 0])
    np.testing.assert_allclose(result.uv_px[known], now[known])
