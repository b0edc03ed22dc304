"""Swapped and mirrored fingers in simulated trials are refused; right ones are not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tiptrace.errors import GeometryError
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.paper import PaperEstimator
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.synchronise import synchronise
from tiptrace.tracer import Sensing
from tiptrace.types import FloatArray, SensedFinger, SensedPair, Status

Distort = Callable[[SensedPair], SensedPair]


@pytest.fixture(scope="module")
def pairs() -> list[SensedPair]:
    stream = SimulatedStream(make_spec(mode="markers", level="nominal", seed=5, wrist="W2", travel_m=0.002))
    sensing = Sensing(stream)
    return [sensing(observation) for observation in synchronise(stream)]


def mirrored(finger: SensedFinger, signs: FloatArray) -> SensedFinger:
    return replace(finger, markers=replace(finger.markers, x_S=finger.markers.x_S * signs))


def exchanged(pair: SensedPair) -> SensedPair:
    left = replace(pair.left, markers=pair.right.markers)
    return replace(pair, left=left, right=replace(pair.right, markers=pair.left.markers))


U, V = np.array([-1.0, 1, 1]), np.array([1.0, -1, 1])
WRONG: dict[str, Distort] = {
    "left and right image were exchanged": exchanged,
    "left image were mirrored left to right": lambda p: replace(p, left=mirrored(p.left, U)),
    "right image were mirrored left to right": lambda p: replace(p, right=mirrored(p.right, U)),
    "left image were mirrored top to bottom": lambda p: replace(p, left=mirrored(p.left, V)),
    "right image were mirrored top to bottom": lambda p: replace(p, right=mirrored(p.right, V)),
    "both images were mirrored left": lambda p: replace(
        p, left=mirrored(p.left, U), right=mirrored(p.right, U)
    ),
}


def run(pairs: list[SensedPair], distort: Distort) -> None:
    estimator = PaperEstimator()
    for pair in pairs:
        estimator.update(distort(pair))


def test_the_right_arrangement_passes(pairs: list[SensedPair]) -> None:
    run(pairs, lambda pair: pair)


@pytest.mark.parametrize("sentence", WRONG)
def test_a_wrong_arrangement_is_named(pairs: list[SensedPair], sentence: str) -> None:
    with pytest.raises(GeometryError, match=sentence):
        run(pairs, WRONG[sentence])


@pytest.mark.parametrize("sentence", WRONG)
def test_full_refuses_the_anchor_and_names_the_arrangement(pairs: list[SensedPair], sentence: str) -> None:
    estimator = FullEstimator()
    estimates = [estimator.update(WRONG[sentence](pair)) for pair in pairs]
    assert estimator.anchor is None
    assert estimates[-1].status is Status.UNOBSERVABLE
    assert estimates[-1].p_B is None
    (refused,) = [e for e in estimator.events if e.kind == "anchor-refused"]
    assert sentence in refused.detail


def test_nobody_is_blamed_where_the_tip_rests_under_no_arrangement(pairs: list[SensedPair]) -> None:
    def adrift(pair: SensedPair) -> SensedPair:
        """The tool sways in the grasp by 2 mm, each pad its way."""
        t_s = (pair.stamp_ns - pairs[0].stamp_ns) * 1e-9
        sway = 2e-3 * np.array([np.sin(2.3 * t_s), np.sin(3.1 * t_s), 0.0])
        x_S = [f.markers.x_S + sign * sway for f, sign in ((pair.left, 1), (pair.right, -1))]
        left, right = (
            replace(f, markers=replace(f.markers, x_S=x))
            for f, x in zip((pair.left, pair.right), x_S, strict=True)
        )
        return replace(pair, left=left, right=right)

    run(pairs, lambda pair: exchanged(adrift(pair)))


def test_full_takes_the_right_arrangement(pairs: list[SensedPair]) -> None:
    estimator = FullEstimator()
    for pair in pairs:
        estimator.update(pair)
    assert estimator.anchor is not None
