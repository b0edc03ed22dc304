"""The verdict that needs no ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tiptrace.evaluation.quality import assess
from tiptrace.types import Event, Phase, Status, TipEstimate, TipTrajectory

from .builders import straight_truth, trajectory_of


def test_a_sound_trace_passes():
    p = straight_truth()
    assert assess(trajectory_of(p, 5, anchor=p[0], covariance=np.eye(3) * 1e-6)).verdict == "pass"


def test_missing_positions_warn_then_fail():
    p = straight_truth(moving=20)
    p[-4:] = np.nan
    quality = assess(trajectory_of(p, 5, anchor=p[0]))
    assert quality.verdict == "warn"
    assert "20% of the reconstruction pairs have no position (4 lost)" in quality.reasons[0]
    p[10:] = np.nan
    assert assess(trajectory_of(p, 5, anchor=p[0])).verdict == "fail"


@pytest.mark.parametrize(
    ("trajectory", "words"),
    [
        (TipTrajectory(), "no usable image pair"),
        (TipTrajectory([TipEstimate(1, Phase.ANCHORING, Status.ANCHORING)]), "ends before"),
        (
            TipTrajectory(
                [TipEstimate(1, Phase.RECONSTRUCTION, Status.UNOBSERVABLE)],
                [Event("anchor-refused", 1, 1, "rotate 4° more about x")],
            ),
            "rotate 4° more about x",
        ),
    ],
)
def test_what_cannot_be_used_fails_with_its_reason(trajectory: TipTrajectory, words: str):
    quality = assess(trajectory)
    assert quality.verdict == "fail"
    assert words in quality.reasons[0]


def test_doubts_are_listed():
    p = straight_truth()
    trajectory = trajectory_of(p, 5, anchor=p[0], covariance=np.diag([1e-6, 1e-6, 25e-6]))
    assert trajectory.anchor is not None
    trajectory.anchor = replace(trajectory.anchor, weak_axes=(np.array([0.0, 0.0, 1.0]),))
    trajectory.events = [
        Event("grasp-slip", 1, 2, ""),
        Event("grasp-slip", 3, 4, ""),
        Event("marker-lost", 1, 2, ""),
    ]
    trajectory.estimates = [replace(e, residual_m=1e-3) for e in trajectory.estimates]
    quality = assess(trajectory)
    assert quality.verdict == "warn"
    assert "5.0 mm" in quality.reasons[0]
    assert "(+0.00, +0.00, +1.00)" in quality.reasons[1]
    assert "one rigid body" in quality.reasons[2]
    assert quality.reasons[3] == "the tool slipped in the grasp (2 events)"
    assert len(quality.reasons) == 4
