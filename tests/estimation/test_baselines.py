"""Baselines do what their names say."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.config import Tool
from tiptrace.errors import GeometryError
from tiptrace.estimation.baselines import EeOracleEstimator, LocalAnchoringEstimator, NominalTipEstimator
from tiptrace.geometry.transforms import apply
from tiptrace.types import Phase

from .synthetic import Synthetic


def test_nominal_tip_follows_the_hand() -> None:
    pairs = Synthetic(seed=1).pairs()
    estimator = NominalTipEstimator(Tool(tip_E_m=(0.0, 0.0, 0.2), tip_sigma_m=(1e-3, 1e-3, 1e-3)))
    for pair in pairs[::10]:
        assert estimator.update(pair).p_B == pytest.approx(apply(pair.left.T_B_E, [0.0, 0.0, 0.2]))


def test_nominal_tip_needs_one() -> None:
    with pytest.raises(GeometryError, match="tip_E_m"):
        NominalTipEstimator(Tool())


def test_oracle_is_exact_in_stage_one_and_blind_to_the_grasp_afterwards() -> None:
    trial = Synthetic(seed=1)
    pairs = trial.pairs()
    estimator = EeOracleEstimator(
        lambda stamp: np.array([np.interp(stamp * 1e-9, trial.s, trial.truth[:, k]) for k in range(3)])
    )
    error = [np.linalg.norm(estimator.update(p).p_B - q) for p, q in zip(pairs, trial.truth, strict=True)]
    anchoring = sum(p.phase is Phase.ANCHORING for p in pairs)
    assert max(error[:anchoring]) < 1e-9
    assert max(error[anchoring:]) > 2e-3  # the groove's sideways motion


def test_local_anchoring_finds_a_resting_tip_and_misses_a_moving_one() -> None:
    trial = Synthetic(seed=1, in_plane_m=1e-6, depth_m=1e-6)
    estimator = LocalAnchoringEstimator()
    error = [
        np.linalg.norm(estimator.update(p).p_B - q) for p, q in zip(trial.pairs(), trial.truth, strict=True)
    ]
    assert error[95] < 2e-3
    assert max(error[100:]) > 5e-3  # the fixed point of a moving tip is not the tip
