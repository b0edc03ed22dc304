"""Real marker gel against an independent tracker's csv: displacements since video frame 10."""

import numpy as np
import pytest

from tiptrace.perception.markers import detect_markers
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
        count += int(
            (np.linalg.norm(now[:, None] - then[None], axis=2).argmin(axis=1) != np.arange(70)).sum()
        )
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
