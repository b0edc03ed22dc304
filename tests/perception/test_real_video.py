"""Real marker gel against an independent tracker's csv: displacements since video frame 10."""

import numpy as np
import pytest

from tiptrace.perception.markers import Markers, detect_markers
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.tracking import LucasKanadeTracker

FIRST = 10  # csv frame k is video frame k + 9


@pytest.fixture(scope="module")
def video(shared_data):
    import cv2

    capture = cv2.VideoCapture(str(shared_data / "gelsight_mini_marker_video" / "mini_example.avi"))
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1])
    assert len(frames) == 219
    return frames


@pytest.fixture(scope="module")
def reference(shared_data):
    """(209, 70, 2) px."""
    rows = np.loadtxt(
        shared_data / "gelsight_mini_marker_video" / "vendor_meanshift_tracks.csv", delimiter=","
    ).reshape(209, 70, 7)
    assert (rows[:, :, 1:3] == rows[0, :, 1:3]).all()
    return rows[:, :, 5:7]


def track(tracker, start, frames):
    uv, tracked = [start], [np.ones(len(start), bool)]
    for frame in frames:
        for store, value in zip((uv, tracked), tracker.update(frame), strict=True):
            store.append(value)
    return np.array(uv), np.array(tracked)


def in_csv_order(start, reference):
    distance = np.linalg.norm(start[:, None] - reference[0], axis=2)
    order = distance.argmin(axis=0)
    assert sorted(order) == list(range(70))
    return start[order]


def swaps(uv, reference):
    """Markers that end a frame nearer to another marker's reference track than to their own."""
    offset = uv[0] - reference[0]
    count = 0
    for now, then in zip(uv, reference + offset, strict=True):
        seen = np.flatnonzero(np.isfinite(now[:, 0]))
        distance = np.linalg.norm(now[seen][:, None] - then[None], axis=2)
        count += int((distance.argmin(axis=1) != seen).sum())
    return count


def test_the_papers_tracker(video, reference):
    start = in_csv_order(detect_markers(video[FIRST]).uv_px, reference)
    uv, tracked = track(LucasKanadeTracker(video[FIRST], start), start, video[FIRST + 1 :])
    error = np.linalg.norm((uv - uv[0]) - (reference - reference[0]), axis=2)  # (209, 70)
    assert tracked.all()
    assert error.mean() <= 0.25
    assert np.percentile(error, 95) <= 0.65
    assert swaps(uv, reference) == 0


def test_all_dots_found_before_the_contacts(video):
    assert all(len(detect_markers(frame)) == 70 for frame in video[:50])


LAG_PX = 1.5  # csv displacement this far off the dot's own: its tracker lags there


def dots_own(video, start):
    """Displacements (209, 70, 2) of the dots' own centroids in each frame alone, NaN where not found."""
    own = np.full((209, 70, 2), np.nan)
    last = start
    for k, frame in enumerate(video[FIRST:]):
        found = detect_markers(frame).uv_px
        distance = np.linalg.norm(last[:, None] - found, axis=2)
        near = distance.min(axis=1) < 9.0
        own[k, near] = found[distance.argmin(axis=1)[near]]
        last = np.where(near[:, None], own[k], last)
    return own


def registered(video, reference, frames, edit=lambda index, image: image):
    markers = detect_markers(video[FIRST])
    order = np.linalg.norm(markers.uv_px[:, None] - reference[0], axis=2).argmin(axis=0)
    tracker = RegisteredTracker(video[FIRST], Markers(markers.uv_px[order], markers.diameter_px[order]))
    return track(tracker, tracker.start_px, (edit(i, video[i]) for i in frames))


def test_the_full_tracker(video, reference):
    uv, tracked = registered(video, reference, range(FIRST + 1, 219))
    assert tracked[-1].all()
    assert tracked.mean() > 0.99
    own = dots_own(video, uv[0])
    moved = reference - reference[0]
    lags = np.linalg.norm(moved - (own - own[0]), axis=2) > LAG_PX
    error = np.linalg.norm((uv - uv[0]) - moved, axis=2)[tracked & ~lags]
    assert error.mean() <= 0.21
    assert np.percentile(error, 95) <= 0.55
    assert swaps(uv, reference) == 0


@pytest.mark.parametrize("every", [2, 3])
def test_dropped_frames_swap_nobody(video, reference, every):
    frames = list(range(FIRST + every, 219, every))
    uv, tracked = registered(video, reference, frames)
    kept = reference[[0, *(i - FIRST for i in frames)]]
    assert swaps(uv, kept) == 0
    assert tracked[-1].all()


@pytest.mark.parametrize(("first", "box"), [(100, (60, 160, 80, 200)), (170, (0, 240, 0, 160))])
def test_an_occlusion_of_five_frames_swaps_nobody(video, reference, first, box):
    def hide(index, image):
        image = image.copy()
        if first <= index < first + 5:
            image[box[0] : box[1], box[2] : box[3]] = 90
        return image

    uv, tracked = registered(video, reference, range(FIRST + 1, 219), hide)
    assert swaps(uv, reference) == 0
    assert tracked[-1].all()
    hidden = ~tracked[first - FIRST : first - FIRST + 5]
    assert hidden.sum() > 5 * 5
