"""Real marker gel against an independent tracker's csv and each dot's own centroid, since video frame 10."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from tiptrace.perception.markers import Markers, detect_markers
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.tracking import LucasKanadeTracker


@pytest.fixture(scope="module")
def bench():
    """Its truths and its loop come from the benchmark, which shares no code with the tracker's meter."""
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "real_video.py"
    spec = importlib.util.spec_from_file_location("real_video", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["real_video"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def video(bench, shared_data):
    """219 frames and the csv's tracks (209, 70, 2)."""
    frames, csv = bench.read(shared_data / "gelsight_mini_marker_video")
    assert len(frames) == 219
    return frames, csv


@pytest.fixture(scope="module")
def markers(bench, video):
    """The 70 markers of frame 10 in the csv's order."""
    frames, csv = video
    found = detect_markers(frames[bench.FIRST])
    order = np.linalg.norm(found.uv_px[:, None] - csv[0], axis=2).argmin(axis=0)
    assert sorted(order) == list(range(70))
    return Markers(found.uv_px[order], found.diameter_px[order])


def full(bench, video, markers, every=1, edit=None):
    tracker = RegisteredTracker(video[0][bench.FIRST], markers)
    return bench.run(tracker, tracker.start_px, video[0], every, edit)


def displacement_error(result, csv):
    return np.linalg.norm((result.uv - result.uv[0]) - (csv - csv[0])[result.at], axis=2)  # (f, 70)


def test_the_papers_tracker(bench, video, markers):
    frames, csv = video
    tracker = LucasKanadeTracker(frames[bench.FIRST], markers.uv_px)
    result = bench.run(tracker, markers.uv_px, frames)
    error = displacement_error(result, csv)
    assert result.tracked.all()
    assert error.mean() <= 0.25
    assert np.percentile(error, 95) <= 0.65
    assert bench.swaps(result, csv) == 0


def test_all_dots_found_before_the_contacts(video):
    assert all(len(detect_markers(frame)) == 70 for frame in video[0][:50])


def test_the_full_tracker(bench, video, markers):
    frames, csv = video
    result = full(bench, video, markers)
    assert result.tracked[-1].all()
    assert result.tracked.mean() > 0.99
    own = bench.own_centroids(frames, csv)
    own_moved = own - own[0]
    seen = np.isfinite(own_moved[..., 0]) & result.tracked
    assert seen.mean() > 0.95
    own_error = np.linalg.norm((result.uv - result.uv[0]) - own_moved, axis=2)[seen]
    assert np.sqrt(np.mean(own_error**2)) <= 0.1
    lags = np.linalg.norm((csv - csv[0]) - own_moved, axis=2) > bench.LAG_PX
    assert lags.sum() < 50  # few, so that leaving them out hides nothing
    error = displacement_error(result, csv)[result.tracked & ~lags]
    assert error.mean() <= 0.21
    assert np.percentile(error, 95) <= 0.55
    assert bench.swaps(result, csv) == 0


@pytest.mark.parametrize("every", [2, 3])
def test_dropped_frames_swap_nobody(bench, video, markers, every):
    result = full(bench, video, markers, every)
    assert bench.swaps(result, video[1]) == 0
    assert result.tracked[-1].all()


@pytest.mark.parametrize("case", [0, 1, *(pytest.param(k, marks=pytest.mark.slow) for k in range(2, 12))])
def test_an_occlusion_of_five_frames_swaps_nobody(bench, video, markers, case):
    first, paint = bench.occlusions()[case]
    result = full(bench, video, markers, edit=paint)
    hidden = ~result.tracked[first - bench.FIRST : first - bench.FIRST + 5]
    assert hidden.sum() > 5
    assert bench.swaps(result, video[1]) == 0
    assert result.tracked[-1].all()
