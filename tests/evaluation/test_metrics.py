"""Metrics against cases that can be computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.evaluation.metrics import CHI2_3_95, evaluate
from tiptrace.evaluation.truth import Truth
from tiptrace.types import Phase, Status, TipEstimate, TipTrajectory, TruthSample

from .builders import FRAME_NS, START_NS, straight_truth, trajectory_of, truth_of


def test_a_perfect_trace_has_no_error():
    p = straight_truth()
    m = evaluate(trajectory_of(p, 5, anchor=p[0]), truth_of(p))
    assert m.frames == 25
    assert m.anchoring_frames == 5
    assert m.evaluated_frames == m.reconstruction_frames == 20
    assert m.usable_fraction == 1.0
    for name, value in m.accuracy().items():
        assert value == pytest.approx(0.0, abs=1e-9), name


def test_a_constant_offset_is_all_anchoring_and_no_shape():
    p = straight_truth()
    offset = np.array([0.0, 3e-3, 4e-3])
    m = evaluate(trajectory_of(p + offset, 5, anchor=offset), truth_of(p))
    assert m.trajectory_rmse_mm == pytest.approx(5.0)
    assert m.initial_contact_error_mm == pytest.approx(5.0)
    assert m.shape_rmse_mm == pytest.approx(0.0, abs=1e-9)
    assert m.cross_track_rmse_mm == pytest.approx(5.0)
    assert m.along_track_rmse_mm == pytest.approx(0.0, abs=1e-9)
    assert m.frechet_mm == pytest.approx(5.0)
    assert m.trajectory_median_mm == pytest.approx(5.0)
    assert m.trajectory_max_mm == pytest.approx(5.0)


def test_trailing_along_the_path_is_not_cross_track_error():
    p = straight_truth()
    lag = np.array([-2e-3, 0.0, 0.0])
    m = evaluate(trajectory_of(p + lag, 5, anchor=p[0]), truth_of(p))
    assert m.cross_track_rmse_mm == pytest.approx(0.0, abs=1e-9)
    assert m.along_track_mean_mm == pytest.approx(-2.0)
    assert m.along_track_rmse_mm == pytest.approx(2.0)
    assert m.trajectory_rmse_mm == pytest.approx(2.0)
    assert m.shape_rmse_mm == pytest.approx(2.0)


def test_rms_percentile_and_median_of_two_levels():
    p = straight_truth(moving=20)
    estimate = p.copy()
    estimate[-5:, 1] = 2e-3  # 15 rows without error, 5 with 2 mm
    m = evaluate(trajectory_of(estimate, 5, anchor=p[0]), truth_of(p))
    assert m.trajectory_rmse_mm == pytest.approx(np.sqrt(5 * 4 / 20))
    assert m.trajectory_median_mm == 0.0
    assert m.trajectory_p95_mm == pytest.approx(2.0)


def test_on_a_sine_the_straight_line_errs_across_and_not_along():
    x = np.linspace(0.0, 0.2, 401)
    p = np.stack([x, 4e-3 * np.sin(2 * np.pi * x / 0.05), np.zeros_like(x)], axis=1)
    p = np.concatenate([np.zeros((1, 3)), p])
    line = p * [1.0, 0.0, 1.0]
    m = evaluate(trajectory_of(line, 1, anchor=p[0]), truth_of(p))
    assert m.trajectory_rmse_mm == pytest.approx(4.0 / np.sqrt(2), rel=0.01)  # rms of A sin
    assert m.cross_track_rmse_mm < m.trajectory_rmse_mm  # the closest point is not the one straight across


def test_a_path_that_comes_back_is_compared_with_its_right_pass():
    out = np.linspace(0.0, 0.1, 101)
    x = np.concatenate([[0.0], out, out[::-1]])
    y = np.concatenate([np.zeros(102), np.full(101, 6e-3)])  # the way back runs 6 mm beside
    p = np.stack([x, y, np.zeros_like(x)], axis=1)
    estimate = p.copy()
    estimate[1:60, 1] = 2e-3
    m = evaluate(trajectory_of(estimate, 1, anchor=p[0]), truth_of(p))
    assert m.along_track_rmse_mm == pytest.approx(0.0, abs=1e-6)
    assert m.cross_track_rmse_mm == pytest.approx(2.0 * np.sqrt(59 / 202), rel=1e-6)


def test_truth_is_interpolated_at_the_instant_of_the_estimate():
    truth = [TruthSample(START_NS, np.zeros(3)), TruthSample(START_NS + 100_000_000, np.array([1e-2, 0, 0]))]
    e = TipEstimate(START_NS + 25_000_000, Phase.RECONSTRUCTION, Status.OK, p_B=np.array([2.5e-3, 1e-3, 0]))
    m = evaluate(TipTrajectory([e]), truth)
    assert m.trajectory_rmse_mm == pytest.approx(1.0)


def test_truth_is_neither_extrapolated_nor_bridged_over_long_gaps():
    p = np.array([[0.0, 0, 0], [1e-2, 0, 0]])
    truth = Truth(np.array([0, 10**9]), p, max_gap_s=0.5)
    assert np.isnan(truth.at([-1, 5 * 10**8, 10**9 + 1])).all()
    assert np.array_equal(truth.at([0, 10**9]), p)


def test_truth_samples_may_be_unordered_repeated_or_nan():
    p = straight_truth()
    samples = truth_of(p)
    messy = [*reversed(samples), samples[3], TruthSample(START_NS + 7, np.full(3, np.nan))]
    trajectory = trajectory_of(p + 1e-3, 5, anchor=p[0] + 1e-3)
    assert evaluate(trajectory, messy) == evaluate(trajectory, samples)


def test_rows_without_position_are_counted_and_not_guessed():
    p = straight_truth(moving=20)
    estimate = p.copy()
    estimate[-5:] = np.nan
    m = evaluate(trajectory_of(estimate, 5, anchor=p[0]), truth_of(p))
    assert m.usable_fraction == pytest.approx(0.75)
    assert m.evaluated_frames == 15
    assert m.trajectory_rmse_mm == pytest.approx(0.0, abs=1e-9)


def test_nothing_to_evaluate_gives_nan_and_no_error():
    nothing = evaluate(TipTrajectory(), truth_of(straight_truth()))
    assert nothing.frames == 0
    assert np.isnan(nothing.usable_fraction)
    assert nothing.accuracy() == {}
    p = straight_truth()
    blind = evaluate(trajectory_of(np.full_like(p, np.nan), 5), truth_of(p))
    assert blind.usable_fraction == 0.0
    assert np.isnan(blind.trajectory_rmse_mm)
    untold = evaluate(trajectory_of(p, 5, anchor=p[0]))
    assert untold.accuracy() == {}
    assert untold.usable_fraction == 1.0


def test_displacements_are_judged_by_shape_alone():
    p = straight_truth()
    moved = p + np.array([0.1, 0.2, 0.3])
    m = evaluate(trajectory_of(moved, 5, status=Status.RELATIVE), truth_of(p))
    assert m.shape_rmse_mm == pytest.approx(0.0, abs=1e-9)
    assert m.cross_track_rmse_mm == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(m.trajectory_rmse_mm)
    assert np.isnan(m.initial_contact_error_mm)


def test_loop_rate_is_frames_over_time_spent():
    p = straight_truth()
    trajectory = trajectory_of(p, 5)
    rows = [
        TipEstimate(e.stamp_ns, e.phase, e.status, loop_ms=40.0 if k % 2 else 10.0)
        for k, e in enumerate(trajectory.estimates[:20])
    ]
    rate = evaluate(TipTrajectory(rows)).loop_rate_hz
    assert rate.mean == pytest.approx(40.0)  # 20 frames in 0.5 s
    assert (rate.min, rate.max) == (pytest.approx(25.0), pytest.approx(100.0))
    assert rate.std == pytest.approx(37.5)


def test_coverage_of_a_right_covariance_is_95_percent():
    rng = np.random.default_rng(0)
    A = np.array([[1.0, 0.2, 0.0], [0.0, 0.5, 0.1], [0.3, 0.0, 2.0]]) * 1e-3
    p = straight_truth(moving=1500, step_m=1e-4)
    errors = rng.standard_normal(p.shape) @ A.T
    m = evaluate(trajectory_of(p + errors, 5, anchor=p[0], covariance=A @ A.T), truth_of(p))
    assert m.coverage_95 == pytest.approx(0.95, abs=0.02)
    assert m.nees_median == pytest.approx(2.366, abs=0.25)  # median of χ²₃
    too_sure = evaluate(trajectory_of(p + errors, 5, anchor=p[0], covariance=A @ A.T / 9), truth_of(p))
    assert too_sure.coverage_95 < 0.7
    assert pytest.approx(7.8147, abs=1e-4) == CHI2_3_95


def test_motion_of_the_tip_during_anchoring_is_told():
    p = straight_truth()
    p[2, 1] = 0.4e-3
    m = evaluate(trajectory_of(p, 5, anchor=p[0]), truth_of(p))
    assert m.anchoring_truth_motion_mm == pytest.approx(0.4)


def test_a_truth_that_begins_within_the_latency_still_tells_the_start():
    p = straight_truth()
    late = truth_of(p)[1:]  # frame 0 lies one frame before the first sample
    m = evaluate(trajectory_of(p, 5, anchor=[3e-3, 0, 4e-3]), late)
    assert m.initial_contact_error_mm == pytest.approx(5.0)
    truth = Truth.from_samples(late)
    at, away_s = truth.nearest(START_NS)
    assert (at, away_s) == (pytest.approx(p[0]), pytest.approx(FRAME_NS * 1e-9))
    assert np.isnan(truth.nearest(START_NS - 10**9)[0]).all()
    assert np.isnan(truth.at([START_NS])).all()  # nothing but the start is extrapolated
