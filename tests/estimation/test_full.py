"""The full estimator on a linear grasp with known truth: what it learns, refuses, admits and notices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tiptrace.config import Tool
from tiptrace.estimation import kernels, pattern_kernels
from tiptrace.estimation.anchor import TipPrior
from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.full_config import FullConfig
from tiptrace.estimation.pads import PadMarkers
from tiptrace.estimation.stage_one import StageOne
from tiptrace.types import FingerMarkers, FloatArray, Phase, SensedFinger, SensedPair, Status, TipEstimate

from .synthetic import Synthetic, rig

OFFSET = np.array([3e-3, -2e-3, 4e-3])


def errors(estimates: list[TipEstimate], trial: Synthetic) -> FloatArray:
    """Against the truth at the instants that the estimates claim, (m, 3) m."""
    stamps = trial.s - trial.latency_s  # s, of the truth
    at = [e.stamp_ns * 1e-9 for e in estimates if e.p_B is not None and e.phase is Phase.RECONSTRUCTION]
    truth = np.stack([np.interp(at, stamps, trial.truth[:, k]) for k in range(3)], axis=1)
    p = [e.p_B for e in estimates if e.p_B is not None and e.phase is Phase.RECONSTRUCTION]
    return np.array(p) - truth


def run(estimator: FullEstimator, pairs: list[SensedPair]) -> list[TipEstimate]:
    return [estimator.update(pair) for pair in pairs]


def test_tip_map_and_latency_are_learned_and_the_path_follows() -> None:
    trial = Synthetic(seed=1, shown=(0.9, 0.7), latency_s=0.04, tip_offset_m=OFFSET, pose_noise=(5e-5, 5e-4))
    estimator = FullEstimator()
    estimates = run(estimator, trial.pairs())
    tip_map = estimator.anchoring.tip_map
    assert tip_map.latency_s == pytest.approx(0.04, abs=3e-3)
    assert tip_map.G[1, 1] == pytest.approx(0.9, abs=0.02)
    assert np.linalg.norm(estimator.anchor.p_B - trial.tip_0) < 2e-4
    e = errors(estimates, trial)
    assert np.sqrt((e**2).sum(axis=1).mean()) < 3e-4
    C = [x.covariance for x in estimates if x.phase is Phase.RECONSTRUCTION]
    nees = [a @ np.linalg.solve(P, a) for a, P in zip(e, C, strict=True)]
    assert np.mean(np.array(nees) < 7.81) > 0.9


def test_the_map_costs_clean_data_nothing() -> None:
    rmse = []
    for learn in (True, False):
        trial = Synthetic(seed=2, tip_offset_m=OFFSET)
        config = FullConfig()
        config = config.model_copy(update={"tip_map": config.tip_map.model_copy(update={"learn_map": learn})})
        e = errors(run(FullEstimator(config, rig()), trial.pairs()), trial)
        rmse.append(np.sqrt((e**2).sum(axis=1).mean()))
    assert rmse[0] - rmse[1] < 2e-5


@pytest.mark.parametrize("motion", ["one-axis", "pads"])
def test_unobservable_anchoring_is_refused_with_advice(motion: str) -> None:
    estimator = FullEstimator()
    estimates = run(estimator, Synthetic(seed=3, anchor_motion=motion, shown=(0.9, 0.7)).pairs())
    assert estimator.anchor is None
    assert [e.kind for e in estimator.events] == ["anchor-refused"]
    assert "rotate" in estimator.events[0].detail
    assert all(
        e.status is Status.UNOBSERVABLE and e.p_B is None
        for e in estimates
        if e.phase is Phase.RECONSTRUCTION
    )


def test_a_prior_on_the_tip_lifts_the_refusal() -> None:
    trial = Synthetic(seed=3, anchor_motion="one-axis", tip_offset_m=np.array([5e-4, 0, 0]))
    tool = Tool(tip_E_m=(0.0, 0.0, 0.2), tip_sigma_m=(1e-3, 1e-3, 1e-3))
    estimator = FullEstimator(tool=tool)
    run(estimator, trial.pairs())
    assert estimator.anchor is not None
    assert np.linalg.norm(estimator.anchor.p_B - trial.tip_0) < 1e-3


def test_phases_are_found_where_there_are_no_marks() -> None:
    trial = Synthetic(seed=4, tip_offset_m=OFFSET)
    marked = trial.pairs()
    estimator = FullEstimator()
    estimates = run(
        estimator, [replace(p, phase=None) for p in Synthetic(seed=4, tip_offset_m=OFFSET).pairs()]
    )
    assert estimator.anchor is not None
    assert np.linalg.norm(estimator.anchor.p_B - trial.tip_0) < 2e-4
    found = next(k for k, e in enumerate(estimates) if e.phase is Phase.RECONSTRUCTION)
    true = next(k for k, p in enumerate(marked) if p.phase is Phase.RECONSTRUCTION)
    assert 0 <= found - true <= 25


def test_tip_from_the_tool_without_stage_one() -> None:
    trial = Synthetic(seed=5, tip_offset_m=np.array([5e-4, 5e-4, 0]))
    pairs = [p for p in trial.pairs() if p.phase is Phase.RECONSTRUCTION]
    tool = Tool(tip_E_m=(0.0, 0.0, 0.2), tip_sigma_m=(1e-3, 1e-3, 1e-3))
    estimates = run(FullEstimator(FullConfig(use_stage_one=False), rig(), tool), pairs)
    e = errors(estimates, trial)
    assert len(e) > 0.9 * len(pairs)
    assert np.sqrt((e**2).sum(axis=1).mean()) < 2e-3


def test_anchor_from_another_trial() -> None:
    first = Synthetic(seed=6, tip_offset_m=OFFSET)
    donor = FullEstimator(rig=rig())
    run(donor, first.pairs())
    second = Synthetic(seed=7, tip_offset_m=OFFSET)
    pairs = [p for p in second.pairs() if p.phase is Phase.RECONSTRUCTION]
    same_grasp = errors(run(FullEstimator(rig=rig(), anchor_from=donor.anchoring), pairs), second)
    assert np.sqrt((same_grasp**2).sum(axis=1).mean()) < 3e-4
    assert donor.tip_E is not None
    regrasp = TipPrior(donor.tip_E.c, donor.tip_E.covariance + 4e-6 * np.eye(3))
    estimates = run(FullEstimator(rig=rig(), anchor_from=regrasp), pairs)
    e = errors(estimates, second)
    C = [x.covariance for x in estimates if x.p_B is not None]
    assert np.mean([a @ np.linalg.solve(P, a) < 7.81 for a, P in zip(e, C, strict=True)]) > 0.9


def test_without_any_anchor_only_displacements_are_claimed() -> None:
    trial = Synthetic(seed=8)
    pairs = [p for p in trial.pairs() if p.phase is Phase.RECONSTRUCTION]
    estimator = FullEstimator(rig=rig())
    estimates = [e for e in run(estimator, pairs) if e.p_B is not None]
    assert estimator.anchor is None
    assert {e.status for e in estimates} == {Status.RELATIVE}
    assert estimates[0].p_B == pytest.approx(np.zeros(3))
    truth = np.stack(
        [np.interp([e.stamp_ns * 1e-9 for e in estimates], trial.s, trial.truth[:, k]) for k in range(3)],
        axis=1,
    )
    moved = np.stack([e.p_B for e in estimates])
    d = moved - (truth - truth[0])
    inside = [a @ np.linalg.solve(e.covariance, a) < 7.81 for a, e in zip(d, estimates, strict=True)]
    assert np.mean(inside) > 0.9


def corrupted(pairs: list[SensedPair], change) -> list[SensedPair]:
    out = []
    for k, pair in enumerate(pairs):
        x = change(k, pair.left.markers.x_S.copy(), pairs)
        out.append(
            replace(pair, left=replace(pair.left, markers=FingerMarkers(x, np.isfinite(x).all(axis=1))))
        )
    return out


def kinds(change) -> dict[str, tuple[int, int]]:
    trial = Synthetic(seed=9, tip_offset_m=OFFSET)
    estimator = FullEstimator(rig=rig())
    pairs = corrupted(trial.pairs(), change)
    run(estimator, pairs)
    return {e.kind: (e.start_ns, e.end_ns) for e in estimator.events}


def test_clean_trial_has_no_events() -> None:
    assert kinds(lambda k, x, pairs: x) == {}


def test_frozen_frames_are_told() -> None:
    found = kinds(lambda k, x, pairs: pairs[139].left.markers.x_S.copy() if 140 <= k < 150 else x)
    assert "frame-stale" in found or "frame-repeated" in found


def test_lost_markers_are_told_and_no_position_is_claimed() -> None:
    trial = Synthetic(seed=9, tip_offset_m=OFFSET)
    estimator = FullEstimator(rig=rig())
    estimates = run(estimator, corrupted(trial.pairs(), lambda k, x, p: x * np.nan if 140 <= k < 150 else x))
    assert all(estimates[k].status is Status.LOST and estimates[k].p_B is None for k in range(140, 150))
    assert estimates[155].status is Status.OK
    assert [e.kind for e in estimator.events] == ["too-few-markers"]


def test_a_jumped_marker_is_named_and_does_no_harm() -> None:
    def jump(k: int, x: FloatArray, pairs: list[SensedPair]) -> FloatArray:
        if k >= 140:
            x[31, 1] += 1.5e-3
        return x

    assert "marker-jump" in kinds(jump)
    trial = Synthetic(seed=9, tip_offset_m=OFFSET)
    e = errors(run(FullEstimator(rig=rig()), corrupted(trial.pairs(), jump)), trial)
    assert np.sqrt((e**2).sum(axis=1).mean()) < 4e-4


def test_a_kick_into_another_pattern_means_a_slip() -> None:
    def slip(k: int, x: FloatArray, pairs: list[SensedPair]) -> FloatArray:
        if k >= 140:
            x[:, 0] += 8e-4  # the gel relaxes at once
            x[::2, 1] += 2e-4  # and grips elsewhere
        return x

    assert "grasp-slip" in kinds(slip)


def test_what_moved_in_a_pause_is_no_kick() -> None:
    """The same jump, but no pairs came for half a second about it."""
    trial = Synthetic(seed=9, tip_offset_m=OFFSET)
    estimator = FullEstimator(rig=rig())
    pairs = trial.pairs()

    def slip(k: int, x: FloatArray, _: list[SensedPair]) -> FloatArray:
        return x + np.array([8e-4, 0.0, 0.0]) if k >= 140 else x

    slipped = corrupted(pairs, slip)
    run(estimator, slipped[:134] + slipped[147:])
    assert "grasp-slip" not in {e.kind for e in estimator.events}


def test_pads_that_turn_apart_disagree() -> None:
    def slide(k: int, x: FloatArray, pairs: list[SensedPair]) -> FloatArray:
        if k >= 140:
            x[:, 1] += 0.04 * x[:, 0]  # this pad's markers turn, the other's do not
        return x

    assert "left-right-disagreement" in kinds(slide)


def test_a_marker_that_stays_away_is_told() -> None:
    def lose(k: int, x: FloatArray, pairs: list[SensedPair]) -> FloatArray:
        if k >= 140:
            x[31] = np.nan
        return x

    found = kinds(lose)
    assert list(found) == ["marker-lost"]


def resting(seed: int) -> tuple[Synthetic, list[SensedPair]]:
    """A tip that goes on resting under a turning hand for eight seconds after Stage I."""
    trial = Synthetic(
        seed=seed,
        anchoring_s=12.0,
        latency_s=0.05,
        tip_offset_m=OFFSET,
        shown=(0.9, 0.7),
        pose_noise=(5e-5, 5e-4),
    )
    pairs = [
        replace(p, phase=Phase.ANCHORING if k < 100 else Phase.RECONSTRUCTION)
        for k, p in enumerate(trial.pairs())
    ]
    return trial, pairs


def test_a_change_of_the_time_offset_is_told_and_followed() -> None:
    _, pairs = resting(4)
    late = 30_000_000
    pairs = [p if k < 120 else replace(p, stamp_ns=p.stamp_ns - late) for k, p in enumerate(pairs)]
    estimator = FullEstimator()
    run(estimator, pairs)
    assert next(e.kind for e in estimator.events) == "latency-changed"
    assert estimator.anchoring is not None
    assert estimator.anchoring.tip_map.latency_s == pytest.approx(0.02, abs=8e-3)


def test_an_unchanged_time_offset_is_not() -> None:
    _, pairs = resting(5)
    estimator = FullEstimator()
    run(estimator, pairs)
    assert "latency-changed" not in [e.kind for e in estimator.events]


def crept() -> tuple[Synthetic, list[SensedPair]]:
    """A resting tip whose markers end up 3 mm along y_E, 0.1 mm per frame: too slowly for a slip."""
    trial, pairs = resting(6)

    def moved(k: int, finger: SensedFinger) -> SensedFinger:
        d_E = np.array([0.0, 1e-4 * min(max(k - 105, 0), 30), 0.0])
        return replace(
            finger, markers=replace(finger.markers, x_S=finger.markers.x_S + d_E @ finger.T_E_S[:3, :3])
        )

    return trial, [replace(p, left=moved(k, p.left), right=moved(k, p.right)) for k, p in enumerate(pairs)]


def test_a_tool_that_crept_away_is_anchored_anew() -> None:
    trial, pairs = crept()
    estimator = FullEstimator()
    estimates = run(estimator, pairs)
    told = [e.kind for e in estimator.events]
    assert "grasp-slip" not in told
    assert "latency-changed" not in told
    assert "re-anchored" in told
    at = next(e.end_ns for e in estimator.events if e.kind == "re-anchored")
    e = np.linalg.norm(errors(estimates, trial), axis=1)
    stamps = np.array([x.stamp_ns for x in estimates if x.phase is Phase.RECONSTRUCTION])
    assert np.median(e[(stamps > at - 10**9) & (stamps < at)]) > 2e-3
    assert np.median(e[stamps > at]) < 1e-3


def test_estimates_do_not_depend_on_what_is_worked_out_between_pairs() -> None:
    _, pairs = crept()
    at_once, between = FullEstimator(), FullEstimator()
    expected = run(at_once, pairs)
    assert "re-anchored" in [e.kind for e in at_once.events]
    for pair, estimate in zip(pairs, expected, strict=True):
        found = between.update(pair)
        between.use_pause()
        assert found.status is estimate.status
        if estimate.p_B is not None:
            assert np.array_equal(found.p_B, estimate.p_B)
    assert between.events == at_once.events


def test_a_gap_in_the_poses_is_told() -> None:
    trial = Synthetic(seed=9)
    pairs = trial.pairs()
    cut = (pairs[140].stamp_ns, pairs[150].stamp_ns)
    pairs = [
        replace(p, poses=tuple(s for s in p.poses if not cut[0] < s.stamp_ns < cut[1]) or p.poses[:1])
        for p in pairs
    ]
    pairs = [
        p for k, p in enumerate(pairs) if not 141 <= k < 150
    ]  # the synchroniser drops pairs inside a gap
    estimator = FullEstimator(rig=rig(latency_s=0.02))
    estimates = run(estimator, pairs)
    assert any(e.status is Status.LOST for e in estimates[139:145])
    assert "pose-gap" in [e.kind for e in estimator.events]


def test_cost_per_frame_does_not_grow() -> None:
    trial = Synthetic(seed=10, travel_s=12.0)
    estimator = FullEstimator(rig=rig())
    run(estimator, trial.pairs())
    assert len(estimator._track) < 1000
    assert len(estimator._reanchoring._rows) < 140  # five seconds
    assert len(estimator._reanchoring._segment) < 140


def test_markers_that_a_window_no_longer_holds_are_not_divided_by() -> None:
    config = FullConfig()
    stage = StageOne(config.stage_one, config.patch, config.motion, config.tip_map, 0.05)
    for k, pair in enumerate(Synthetic().pairs()[:8]):
        markers = PadMarkers.of(pair)
        gone = replace(markers, X=markers.X.copy(), x_S=markers.x_S.copy())
        if k >= 4:  # some are never seen again
            gone.X[:3] = gone.x_S[:3] = np.nan
        stage.add(k, gone)
    stage.keep_from(4)
    with np.errstate(all="raise"):
        weights = stage.trust()
    assert not weights[:3].any()
    assert weights.any()


def test_a_trial_compiles_nothing_on_the_way() -> None:
    estimator = FullEstimator(rig=rig())

    def kinds() -> int:
        found = [*vars(kernels).values(), *vars(pattern_kernels).values()]
        functions = [f for f in found if hasattr(f, "nopython_signatures")]
        return sum(len(f.nopython_signatures) for f in functions)

    before = kinds()
    assert before >= 5
    run(estimator, Synthetic().pairs())
    assert kinds() == before
