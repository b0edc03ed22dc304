"""The paper's analytic ground truth."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.errors import TipTraceError
from tiptrace.evaluation.analytic import CENTRELINES, analytic_truth
from tiptrace.types import PoseSample


def poses(x: np.ndarray) -> list[PoseSample]:
    out = []
    for k, value in enumerate(x):
        T = np.eye(4)
        T[0, 3] = value
        out.append(PoseSample(k * 10, T))
    return out


@pytest.mark.parametrize(
    ("name", "at_m", "peak_m"),
    [("T2", 0.1, 0.008), ("T3", 0.0125, 0.004), ("T4", 0.005, 0.002), ("T5", 0.025, 0.008)],
)
def test_centrelines_start_at_zero_and_peak_as_the_paper_says(name: str, at_m: float, peak_m: float):
    x = np.linspace(0, 0.2, 20001)
    y = CENTRELINES[name].offset(x)[:, 1]
    assert y[0] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(y).max() == pytest.approx(peak_m, rel=1e-6)
    assert CENTRELINES[name].offset(np.array([at_m]))[0, 1] == pytest.approx(peak_m, rel=1e-6)
    assert not CENTRELINES["T1"].offset(x)[:, 1].any()


def test_truth_rests_while_anchoring_then_follows_the_hand_along_the_groove():
    start = np.array([0.4, -0.1, 0.02])
    x_E = np.array([0.50, 0.53, 0.51, 0.51, 0.5225, 0.535])  # moves about during anchoring
    samples = analytic_truth(CENTRELINES["T3"], start, poses(x_E), anchoring_end_ns=20)
    p = np.array([s.p_B for s in samples])
    assert p[:4] == pytest.approx(np.tile(start, (4, 1)))
    assert p[4] - start == pytest.approx([0.0125, 0.004, 0.0])
    assert p[5] - start == pytest.approx([0.025, 0.0, 0.0], abs=1e-12)


def test_a_turned_plate_turns_the_curve():
    T = poses(np.zeros(2))
    T[1].T_B_E[:3, 3] = [0.0, 0.0125, 0.0]
    samples = analytic_truth(CENTRELINES["T3"], np.zeros(3), T, anchoring_end_ns=0, yaw_rad=np.pi / 2)
    assert samples[1].p_B == pytest.approx([-0.004, 0.0125, 0.0])


def test_without_poses_after_anchoring_it_says_so():
    with pytest.raises(TipTraceError, match="after the end of anchoring"):
        analytic_truth(CENTRELINES["T1"], np.zeros(3), poses(np.zeros(3)), anchoring_end_ns=1000)
