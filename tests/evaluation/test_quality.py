"""The verdict that needs no ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tiptrace.evaluation.quality import assess
from tiptrace.types import AnchorChecks, Event, Phase, Status, TipEstimate, TipTrajectory

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


def checked(**values: float) -> TipTrajectory:
    p = straight_truth()
    trajectory = trajectory_of(p, 5, anchor=p[0], covariance=np.eye(3) * 1e-8)
    checks = AnchorChecks(
        **({"residual_m": 1e-4, "held_out_m": 1e-4, "halves_m": 1e-3, "halves_sigma": 1.0} | values)
    )
    assert trajectory.anchor is not None
    trajectory.anchor = replace(trajectory.anchor, checks=checks)
    return trajectory


@pytest.mark.parametrize(
    ("values", "verdict", "words"),
    [
        ({}, "pass", ""),
        ({"held_out_m": 5e-4}, "warn", "predicted from the others"),
        ({"held_out_m": 1e-3}, "fail", "does not fit a resting tip"),
        ({"halves_sigma": 4.0}, "warn", "two halves"),
        ({"prior_sigma": 4.0}, "warn", "tip of the tool's file"),
        ({"in_grasp_m": 0.02}, "warn", "end effector alone"),
        ({"closure_m": 2e-3}, "warn", "anchored anew"),
    ],
)
def test_what_a_trial_says_of_its_own_anchor_counts(
    values: dict[str, float], verdict: str, words: str
) -> None:
    quality = assess(checked(**values))
    assert quality.verdict == verdict
    assert words in " ".join(quality.reasons)


@pytest.mark.parametrize(("off_m", "verdict"), [(2e-4, "pass"), (2e-3, "warn")])
def test_a_tip_that_returns_to_its_anchor_closes_the_loop(off_m: float, verdict: str) -> None:
    x = np.concatenate(
        [np.zeros(5), np.linspace(0, 0.05, 30), np.linspace(0.05, off_m, 30), np.full(12, off_m)]
    )
    p = np.stack([x, 0 * x, 0 * x], axis=1)
    assert assess(trajectory_of(p, 5, anchor=np.zeros(3), covariance=np.eye(3) * 1e-8)).verdict == verdict
