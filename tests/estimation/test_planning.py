"""Predictions of the planner rank the motions as they are known to rank."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.estimation.planning import CANDIDATES, Prediction, Task, predict

from .synthetic import rig

TIP = np.array([0.0, 0.0, 0.2])


@pytest.fixture(scope="module")
def predictions() -> dict[str, Prediction]:
    return {w.name: predict(w, Task(rig(None, None), TIP)) for w in CANDIDATES}


def test_more_rotation_tells_more(predictions: dict[str, Prediction]) -> None:
    worst = [predictions[n].worst_sigma_m for n in ("recommended", "gentle", "two-axis")]
    assert worst == sorted(worst)
    assert worst[-1] < 1e-3


@pytest.mark.parametrize("name", ["one-axis", "pads"])
def test_unobservable_motions_are_told(predictions: dict[str, Prediction], name: str) -> None:
    assert predictions[name].worst_sigma_m > 2e-3


def test_turning_about_the_pads_loads_the_contact_most(predictions: dict[str, Prediction]) -> None:
    assert max(predictions, key=lambda n: predictions[n].displacement_m) == "pads"


@pytest.mark.parametrize("wiggle", CANDIDATES, ids=lambda w: w.name)
def test_motions_start_and_end_where_the_hand_was(wiggle) -> None:
    T = wiggle.poses(np.array([0.0, wiggle.duration_s]), TIP, TIP - [0, 0, 0.06])
    assert np.allclose(T, np.eye(4), atol=1e-9)
