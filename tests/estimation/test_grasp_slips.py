"""Slips of the tool during Stage I: markers stand elsewhere on it, while its tip rests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.full_config import FullConfig
from tiptrace.types import FingerMarkers, SensedFinger, SensedPair

from .synthetic import Synthetic

OFFSET = np.array([3e-3, -2e-3, 4e-3])


def slipped(trial: Synthetic, at_s: float, apart_m: float = 2e-4) -> list[SensedPair]:
    """The trial with all markers on the tool 1.5 mm aside and a little out of place from an instant on."""
    rng = np.random.default_rng(5)
    pairs = trial.pairs()
    scatter = apart_m * rng.standard_normal((2, 63, 3)) * [1.0, 1.0, 0.0]
    out = []
    for pair in pairs:
        if (pair.stamp_ns - pairs[0].stamp_ns) * 1e-9 < at_s:
            out.append(pair)
            continue
        fingers = [moved(f, trial, scatter[k]) for k, f in enumerate((pair.left, pair.right))]
        out.append(replace(pair, left=fingers[0], right=fingers[1]))
    return out


def moved(f: SensedFinger, trial: Synthetic, scatter: np.ndarray) -> SensedFinger:
    aside_S = f.T_E_S[:3, :3].T @ np.array([0.0, 1.5e-3, 0.0])
    on_tool = trial.flat_S[:, 2:] < 0
    x = f.markers.x_S + np.where(on_tool, scatter + aside_S, 0.0)
    return replace(f, markers=FingerMarkers(x, f.markers.tracked))


def solved(most: int, pairs: list[SensedPair]) -> FullEstimator:
    config = FullConfig()
    slips = config.stage_one.slips.model_copy(update={"most": most})
    stage_one = config.stage_one.model_copy(update={"slips": slips})
    estimator = FullEstimator(config.model_copy(update={"stage_one": stage_one}))
    for pair in pairs:
        estimator.update(pair)
    return estimator


@pytest.mark.parametrize(("at_s", "apart_m"), [(1.2, 2e-4), (2.6, 2e-4), (2.0, 0.0)])
def test_a_resting_tip_ties_the_parts_before_and_after_a_slip_together(at_s: float, apart_m: float) -> None:
    trial = Synthetic(seed=7, tip_offset_m=OFFSET, shown=(0.9, 0.7))
    pairs = slipped(trial, at_s, apart_m)
    whole, cut = solved(0, pairs), solved(3, pairs)
    found = [(s - pairs[0].stamp_ns) * 1e-9 for _, s in cut.anchoring.slips_ns]
    assert found == [pytest.approx(at_s, abs=0.1)]
    (told,) = [e for e in cut.events if e.kind == "grasp-slip"]
    slip_ns = pairs[0].stamp_ns + round(at_s * 1e9)
    assert told.start_ns - 100_000_000 < slip_ns < told.end_ns + 100_000_000
    assert told.end_ns > told.start_ns
    assert cut.anchor is not None
    off = cut.anchor.p_B - trial.tip_0
    assert np.linalg.norm(off) < 4e-4
    assert off @ np.linalg.solve(cut.anchor.covariance, off) < 16.3  # 99.9 %
    assert whole.anchor is None or np.linalg.norm(whole.anchor.p_B - trial.tip_0) > 2 * np.linalg.norm(off)


def test_nothing_is_cut_where_nothing_slips() -> None:
    trial = Synthetic(seed=8, tip_offset_m=OFFSET, shown=(0.9, 0.7))
    assert solved(3, trial.pairs()).anchoring.slips_ns == ()
