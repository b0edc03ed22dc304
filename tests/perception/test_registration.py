import numpy as np
import pytest

from tiptrace.perception.markers import detect_markers
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.seeding import seed

from .gel_images import BASE, H, W, grid, paint_dots, shade, to_uint8


def start(uv, diameter=10.5):
    image = to_uint8(paint_dots(shade(), uv, diameter), 1.5)
    tracker = RegisteredTracker(image, detect_markers(image))
    order = np.linalg.norm(uv[:, None] - tracker.start_px[None], axis=2).argmin(axis=1)
    return tracker, order


def step(tracker, order, uv, seed=1, diameter=10.5, edit=lambda image: image):
    image = edit(paint_dots(shade(), uv, diameter))
    found, tracked = tracker.update(to_uint8(image, 1.5, seed))
    return found[order], tracked[order]


INTERIOR = (grid() > 40).all(axis=1) & (grid()[:, 0] < W - 40) & (grid()[:, 1] < H - 40)


def test_no_drift_over_hundreds_of_frames():
    """A circular walk of 150 frames ends where it began, to the noise of a single frame."""
    rest = grid()
    tracker, order = start(rest)
    errors = []
    for t in range(1, 151):
        uv = rest + 6 * np.array([np.cos(t / 9) - 1, np.sin(t / 9)])
        found, tracked = step(tracker, order, uv, seed=t)
        assert tracked[INTERIOR].all()
        errors.append((found - uv)[INTERIOR])
    errors = np.array(errors)
    assert np.sqrt(np.mean(errors**2)) < 0.05
    assert np.abs(errors[-20:].mean(axis=0)).max() < np.abs(errors[:20].mean(axis=0)).max() + 0.03


@pytest.mark.parametrize("direction", [(12, 0), (0, -12), (8.4, 8.4)])
def test_a_jump_of_twelve_pixels(direction):
    rest = grid()
    tracker, order = start(rest)
    found, tracked = step(tracker, order, rest + np.array(direction))
    assert tracked[INTERIOR].all()
    assert np.linalg.norm(found - rest - direction, axis=1)[INTERIOR].max() < 0.2


def test_hidden_markers_are_flagged_and_found_again_under_their_own_index():
    rest = grid()
    tracker, order = start(rest)

    def hide(image):
        image[80:170, 90:200] = BASE
        return image

    hidden = (rest[:, 0] > 95) & (rest[:, 0] < 195) & (rest[:, 1] > 85) & (rest[:, 1] < 165)
    for t in range(1, 6):  # hidden for five frames while everything moves
        found, tracked = step(tracker, order, rest + [1.5 * t, 0.5 * t], seed=t, edit=hide)
        assert not tracked[hidden].any()
        assert np.isnan(found[hidden]).all()
    for t in range(6, 8):
        found, tracked = step(tracker, order, rest + [1.5 * t, 0.5 * t], seed=t)
    assert tracked[INTERIOR].all()
    assert np.linalg.norm(found - rest - [10.5, 3.5], axis=1)[INTERIOR].max() < 0.2


def test_one_missing_dot_is_not_replaced_by_its_neighbour():
    rest = grid()
    tracker, order = start(rest)
    gone = int(np.flatnonzero(INTERIOR)[5])
    others = np.delete(np.arange(len(rest)), gone)
    for t in range(1, 10):
        image = paint_dots(shade(), rest[others] + [2.0 * t, 0], 10.5)
        found, tracked = tracker.update(to_uint8(image, 1.5, t))
        found, tracked = found[order], tracked[order]
    assert not tracked[gone]
    keep = INTERIOR & (np.arange(len(rest)) != gone)
    assert np.linalg.norm(found - rest - [18.0, 0], axis=1)[keep].max() < 0.2


def test_brightness_and_shading_do_not_move_dots():
    rest = grid()
    tracker, order = start(rest)
    v, u = np.indices((H, W))
    for gain in (0.8, 1.15):
        tilt = 1 + 0.3 * np.sin(u / 60.0) * np.cos(v / 50.0)
        found, tracked = step(
            tracker, order, rest, edit=lambda image, g=gain, s=tilt: image * g * s[..., None]
        )
        assert tracked[INTERIOR].all()
        assert np.linalg.norm(found - rest, axis=1)[INTERIOR].max() < 0.15


@pytest.mark.parametrize(("pitch", "diameter"), [(18, 6), (33, 18)])
def test_other_gels(pitch, diameter):
    rest = grid(pitch)
    tracker, order = start(rest, diameter)
    inside = (rest > 40).all(axis=1) & (rest[:, 0] < W - 40) & (rest[:, 1] < H - 40)
    for t in range(1, 6):
        found, tracked = step(tracker, order, rest + [1.7 * t, -0.9 * t], seed=t, diameter=diameter)
    assert tracked[inside].all()
    assert np.linalg.norm(found - rest - [8.5, -4.5], axis=1)[inside].max() < 0.3


def test_dots_that_detection_misses_are_taken_from_the_untouched_gel():
    rest = grid()
    moved = rest + [4.0, -2.0]
    image = paint_dots(shade(), moved, 10.5)
    faint = int(np.flatnonzero(INTERIOR)[8])
    u, v = moved[faint].round().astype(int)
    image[v - 12 : v + 13, u - 12 : u + 13] *= 0.55  # in deep shade
    image = to_uint8(image, 1.0)
    reference = to_uint8(paint_dots(shade(), rest, 10.5), 1.0)
    seeds = seed(image, reference)
    distance = np.linalg.norm(seeds.markers.uv_px - moved[faint], axis=1)
    assert distance.min() < 0.5
    np.testing.assert_allclose(seeds.rest_px[distance.argmin()], rest[faint], atol=0.5)
    assert np.linalg.norm(seeds.markers.uv_px - seeds.rest_px - [4.0, -2.0], axis=1).max() < 0.5


def test_a_patch_carried_by_more_than_half_a_pitch_keeps_its_dots():
    rest = grid()
    across = np.abs(rest[:, 1] - 120.0)
    moved = rest + np.column_stack(
        [-0.6 * 31.0 * np.clip(1.4 - across / 80.0, 0.0, 1.0), np.zeros(len(rest))]
    )
    moved = moved[moved[:, 0] > 8.0]
    plain = np.full((H, W, 3), 120.0)
    reference, image = (to_uint8(paint_dots(plain, uv, 10), 0.0, 0) for uv in (rest, moved))
    seeds = seed(image, reference)
    carried = seeds.markers.uv_px[:, 0] - seeds.rest_px[:, 0]
    across = np.abs(seeds.markers.uv_px[:, 1] - 120.0)
    assert np.abs(carried + 0.6 * 31.0 * np.clip(1.4 - across / 80.0, 0.0, 1.0)).max() < 0.6


def test_a_row_that_breaks_loose_leaves_the_image_and_comes_back_under_its_own_indices():
    """Gel shears between rows by almost a pitch; the dot that leaves must not take its neighbour's when it is back."""
    rest = grid()
    tracker, order = start(rest)
    row = np.abs(rest[:, 1] - H / 2) < 16
    way = 26.0 * np.sin(np.linspace(0, 2 * np.pi, 49))[1:]  # px, 3.4 a frame at most
    for t, x in enumerate(way):
        uv = rest + np.where(row, x, 0.15 * x)[:, None] * [1.0, 0.0]
        found, tracked = step(tracker, order, uv, seed=t)
        swapped = np.linalg.norm(found - uv, axis=1)[tracked] > 8.0
        assert not swapped.any(), t
        assert tracked[INTERIOR].mean() > 0.9, t
    assert tracked[INTERIOR].all()


def leap(size, start_px, end_px, frames=12):
    """A band that moves out, leaps within one frame, and stays: markers on others' dots after each frame; doubts."""
    rest = grid()
    tracker, order = start(rest)
    patch = np.exp(-((np.abs(rest[:, 1] - H / 2) / size) ** 4))[:, None] * [1.0, 0.0]
    swapped, doubtful = [], []
    stay = end_px + 0.5 * np.sin(np.arange(frames) / 5)
    for t, x in enumerate([*np.linspace(0, start_px, 6), *stay]):
        found, tracked = step(tracker, order, rest + x * patch, seed=t)
        swapped.append((np.linalg.norm(found - rest - x * patch, axis=1)[tracked] > 8.0).sum())
        doubtful.append(tracker.doubtful)
    return swapped, doubtful


@pytest.mark.parametrize("size", [45, 60, 90])
def test_a_patch_that_leapt_to_the_next_dots_in_a_pause_keeps_its_own(size):
    """Nobody saw the way between, and the next dots look nearer: the patch's rim tells."""
    swapped, doubtful = leap(size, -12, 13)
    assert max(swapped) == 0
    assert not any(doubtful)


def test_a_leap_of_a_whole_pitch_is_doubtful():
    """Dots end up where others were: nothing but the rim differs."""
    swapped, doubtful = leap(60, -16, 16, frames=40)
    assert not any(doubtful[:6])
    assert all(doubtful[t] for t in range(6, len(doubtful)) if swapped[t])
    assert any(doubtful[6:])


@pytest.mark.parametrize("size", [60, 90])
def test_markers_on_others_dots_find_back_when_they_are_matched_anew(size):
    rest = grid()
    share = np.exp(-((np.abs(rest[:, 1] - H / 2) / size) ** 4))[:, None] * [1.0, 0.0]
    tracker, order = start(rest)
    pitch = np.linalg.norm(rest[1:] - rest[0], axis=1).min()
    for t in range(5):
        uv = rest + 2.0 * t * share
        step(tracker, order, uv, seed=t)
    tracker.expected_px = tracker.expected_px + np.round(share[np.argsort(order)]) * pitch  # a pitch away
    for t in range(5, 40):
        if t == 15:
            tracker.match_anew()
        uv = rest + (8.0 + 0.5 * np.sin(t / 5)) * share
        found, tracked = step(tracker, order, uv, seed=t)
        off = np.linalg.norm(found - uv, axis=1)[tracked]
        if t == 14:
            assert (off > 0.5 * pitch).sum() > 10
    assert (off < 0.5).all()
    assert tracked[INTERIOR].all()
    assert not tracker.doubtful
