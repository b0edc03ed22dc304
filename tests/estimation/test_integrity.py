"""What a frame is worth when markers are taken for their neighbours, or may be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tiptrace.estimation.full import FullEstimator
from tiptrace.tracer import Sensing, TipTracer
from tiptrace.types import FloatArray, SensedPair, Status, TipEstimate

from .synthetic import Synthetic

LEAP, LONG = 140, 20  # frame of Stage II, frames


def taken_for_neighbours(x_S: FloatArray) -> FloatArray:
    """Half of the patch of markers (n, 3), each on the dot of the next one below, a pitch further."""
    moved = x_S.copy()
    patch = (np.abs(x_S[:, 1]) < 5e-3) & (x_S[:, 0] < 1e-3)
    moved[patch, 1] += 2e-3 + 2e-4 * np.sin(7e3 * x_S[patch, 1] + 2e3 * x_S[patch, 0])
    return moved


def changed(pair: SensedPair, x_S: FloatArray | None = None, doubtful: bool = False) -> SensedPair:
    markers = pair.left.markers
    x_S = markers.x_S if x_S is None else x_S
    return replace(pair, left=replace(pair.left, markers=replace(markers, x_S=x_S, doubtful=doubtful)))


def traced(pairs: list[SensedPair]) -> tuple[FullEstimator, list[TipEstimate]]:
    estimator = FullEstimator()
    return estimator, [estimator.update(pair) for pair in pairs]


class Counting(Sensing):
    """Counts how often markers are to be matched anew."""

    matched_anew = 0

    def __init__(self) -> None:
        pass

    def match_anew(self) -> None:
        self.matched_anew += 1


@pytest.fixture(scope="module")
def pairs() -> list[SensedPair]:
    return Synthetic(seed=3).pairs()


def test_a_clean_trial_is_ok_throughout(pairs: list[SensedPair]) -> None:
    estimator, estimates = traced(pairs)
    assert {e.status for e in estimates} == {Status.ANCHORING, Status.OK}
    assert not estimator.events


def test_markers_of_one_pad_taken_for_their_neighbours_leave_no_position_ok(pairs: list[SensedPair]) -> None:
    inside = range(LEAP, LEAP + LONG)
    pairs = [
        changed(p, taken_for_neighbours(p.left.markers.x_S)) if k in inside else p
        for k, p in enumerate(pairs)
    ]
    estimator, estimates = traced(pairs)
    assert estimates[LEAP - 1].status is Status.OK
    assert all(estimates[k].status is Status.DEGRADED for k in inside)
    assert all(np.trace(estimates[k].covariance) > 3 * 1.4e-3**2 for k in inside)
    (told,) = [e for e in estimator.events if e.kind == "marker-jump"]
    assert told.end_ns > told.start_ns
    assert estimates[-1].status in (Status.OK, Status.DEGRADED)


def test_what_the_tracker_cannot_tell_is_not_ok(pairs: list[SensedPair]) -> None:
    inside = range(LEAP, LEAP + LONG)
    _, estimates = traced([changed(p, doubtful=True) if k in inside else p for k, p in enumerate(pairs)])
    degraded = [k for k, e in enumerate(estimates) if e.status is Status.DEGRADED]
    assert degraded == list(inside)


def test_all_markers_of_one_pad_a_pitch_away_are_not_ok(pairs: list[SensedPair]) -> None:
    inside = range(LEAP, LEAP + LONG)

    def shifted(pair: SensedPair) -> SensedPair:
        return changed(pair, pair.left.markers.x_S + [0.0, 2e-3, 0.0])

    sensing = Counting()
    estimator = FullEstimator()
    tracer = TipTracer(sensing, estimator)
    estimates = [tracer.estimate(shifted(p) if k in inside else p) for k, p in enumerate(pairs)]
    assert all(estimates[k].status is Status.DEGRADED for k in inside)
    assert {"marker-jump"} <= {e.kind for e in estimator.events}
    assert sensing.matched_anew == LONG // 10, "after every ten frames"
