"""Latency from a motion with the tip at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.estimation.synthetic import Synthetic, rig
from tiptrace.calibration.latency import calibrate_latency, rig_with_latency
from tiptrace.errors import CalibrationError


@pytest.mark.parametrize("latency_s", [0.0, 0.04, 0.11])
def test_the_latency_is_found_within_its_uncertainty(latency_s: float) -> None:
    trial = Synthetic(seed=3, latency_s=latency_s, shown=(0.8, 0.85), pose_noise=(5e-5, 5e-4), travel_s=1.0)
    found = calibrate_latency(trial.pairs())
    assert abs(found.latency_s - latency_s) < max(3.0 * found.std_s, 1e-3)
    assert found.std_s < 5e-3


def test_phases_are_not_needed() -> None:
    trial = Synthetic(seed=4, latency_s=0.05)
    pairs = [replace(pair, phase=None) for pair in trial.pairs()]
    assert calibrate_latency(pairs).latency_s == pytest.approx(0.05, abs=3e-3)


def test_too_few_pairs_are_refused() -> None:
    with pytest.raises(CalibrationError, match="at least 50"):
        calibrate_latency(Synthetic(seed=1).pairs()[:20])


def test_it_goes_into_both_sensors_of_the_rig() -> None:
    found = calibrate_latency(Synthetic(seed=5, latency_s=0.03, travel_s=1.0).pairs())
    new = rig_with_latency(rig(), found)
    assert new.sensors.left.latency_s == new.sensors.right.latency_s == found.latency_s
    assert new.sensors.left.T_E_S == rig().sensors.left.T_E_S
    assert np.isclose(new.sensors.right.latency_std_s or 0.0, found.std_s)
