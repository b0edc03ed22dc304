"""What a report learns while a trial runs."""

import numpy as np
import pytest

from tests.live.simulated import short_trial
from tests.streams.helpers import ListStream
from tiptrace.pipeline import open_tracer, trace
from tiptrace.trial_watch import TrialWatch
from tiptrace.types import Phase, PhaseSample


@pytest.mark.parametrize("method", ["full", "paper"])
def test_markers_of_the_fit_are_those_that_the_tool_presses(method: str) -> None:
    rig, references, samples = short_trial()
    end = PhaseSample(samples[0].stamp_ns + int(1.5e9), Phase.RECONSTRUCTION)
    stream = ListStream(sorted([*samples, end], key=lambda s: s.stamp_ns), rig, references=references)
    watch = TrialWatch(on_pair=None, keep_pairs=False, keep_images=True)
    with open_tracer(stream, method) as tracer:
        watch.tracer = tracer
        trace(stream, tracer, watch)
        views = watch.tactile()
    assert {view.side for view in views} == {"left", "right"}
    for view in views:
        assert view.selected is not None
        assert view.uv_first_px is not None
        assert view.depth_first_mm is not None
        u, v = np.round(view.uv_first_px).astype(int).T
        pressed = view.depth_first_mm[v, u]
        assert 4 <= view.selected.sum() < len(view.selected)
        assert pressed[view.selected].min() > np.median(pressed[~view.selected])
