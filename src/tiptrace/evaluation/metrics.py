"""Accuracy of one trial against its ground truth (paper, Sec. III-B), and how fast and how complete it was.

All errors are over the reconstruction segment, in rows that hold a position. ``docs/evaluation.md`` defines
each number.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np

from tiptrace.evaluation.error_series import ErrorSeries, error_series, initial_point, is_relative
from tiptrace.evaluation.polyline import discrete_frechet
from tiptrace.evaluation.truth import Truth
from tiptrace.types import FloatArray, Phase, TipEstimate, TipTrajectory, TruthSample

CHI2_3_95 = 7.814727903251179  # 95 % quantile of χ² with 3 degrees of freedom
_SIGMA_FLOOR_M = 1e-9  # a covariance claims no more than this, so that NEES stays finite
NAN = float("nan")


@dataclass(frozen=True, slots=True)
class LoopRate:
    """Loop rate of one trial, Hz: frames over the time spent; the others over single frames."""

    mean: float = NAN
    std: float = NAN
    min: float = NAN
    max: float = NAN


@dataclass(frozen=True, slots=True)
class TrialMetrics:
    """Numbers of one trial. Whatever needs a ground truth, or positions, that are not there is NaN.

    Attributes:
        frames: Image pairs in all.
        anchoring_frames: Pairs of the anchoring segment.
        reconstruction_frames: Pairs of the reconstruction segment.
        evaluated_frames: Reconstruction pairs with a position and a truth at their instant.
        usable_fraction: Part of the reconstruction pairs that have a position.
        loop_rate_hz: Loop rate, acquisition or decoding included.
        trajectory_rmse_mm: rms ‖p̂(t) − p^gt(t)‖.
        shape_rmse_mm: The same after moving p̂(0) onto p^gt(0).
        initial_contact_error_mm: ‖p̂(0) − p^gt(0)‖.
        cross_track_rmse_mm: rms distance to the true path.
        along_track_rmse_mm: rms lag or lead along the true path, by arc length.
        along_track_mean_mm: Its mean; negative where the estimate trails.
        trajectory_median_mm: Median error.
        trajectory_p95_mm: 95th percentile of the error.
        trajectory_max_mm: Largest error.
        frechet_mm: Discrete Fréchet distance between estimated and true positions.
        coverage_95: Part of the rows whose 95 % covariance region holds the truth.
        nees_median: Median of eᵀ Σ⁻¹ e; 2.37 where the covariance is right.
        anchoring_truth_motion_mm: How far the true tip strayed from p^gt(0) while it was assumed at rest.
    """

    frames: int
    anchoring_frames: int
    reconstruction_frames: int
    evaluated_frames: int
    usable_fraction: float
    loop_rate_hz: LoopRate
    trajectory_rmse_mm: float = NAN
    shape_rmse_mm: float = NAN
    initial_contact_error_mm: float = NAN
    cross_track_rmse_mm: float = NAN
    along_track_rmse_mm: float = NAN
    along_track_mean_mm: float = NAN
    trajectory_median_mm: float = NAN
    trajectory_p95_mm: float = NAN
    trajectory_max_mm: float = NAN
    frechet_mm: float = NAN
    coverage_95: float = NAN
    nees_median: float = NAN
    anchoring_truth_motion_mm: float = NAN

    def accuracy(self) -> dict[str, float]:
        """What was measured against a ground truth, by name, NaN left out."""
        named = {f.name: getattr(self, f.name) for f in fields(self)}
        names = list(named)[list(named).index("trajectory_rmse_mm") :]
        return {name: named[name] for name in names if np.isfinite(named[name])}


def evaluate(trajectory: TipTrajectory, truth: Truth | Iterable[TruthSample] | None = None) -> TrialMetrics:
    """Metrics of a trial; without ground truth only those that need none."""
    estimates = trajectory.estimates
    reconstruction = [e for e in estimates if e.phase is Phase.RECONSTRUCTION]
    base = TrialMetrics(
        frames=len(estimates),
        anchoring_frames=sum(e.phase is Phase.ANCHORING for e in estimates),
        reconstruction_frames=len(reconstruction),
        evaluated_frames=0,
        usable_fraction=_fraction([e.p_B is not None for e in reconstruction]),
        loop_rate_hz=loop_rate(estimates),
    )
    truth = as_truth(truth)
    if truth is None:
        return base
    return _with_truth(base, trajectory, truth)


def as_truth(truth: Truth | Iterable[TruthSample] | None) -> Truth | None:
    """Truth from whatever holds it; None where there is none."""
    if truth is None:
        return None
    truth = truth if isinstance(truth, Truth) else Truth.from_samples(truth)
    return truth if len(truth) else None


def loop_rate(estimates: Iterable[TipEstimate]) -> LoopRate:
    """Loop rate from the time that each pair took."""
    spent_s = np.array([e.loop_ms for e in estimates if e.loop_ms], dtype=np.float64) / 1e3
    if len(spent_s) == 0:
        return LoopRate()
    hz = 1.0 / spent_s
    return LoopRate(
        mean=float(len(spent_s) / spent_s.sum()),
        std=float(hz.std()),
        min=float(hz.min()),
        max=float(hz.max()),
    )


def _with_truth(base: TrialMetrics, trajectory: TipTrajectory, truth: Truth) -> TrialMetrics:
    e = error_series(trajectory, truth)
    p_hat_0, p_gt_0 = initial_point(trajectory, truth)
    relative = is_relative(trajectory)
    measured = replace(
        base,
        evaluated_frames=len(e.rows),
        shape_rmse_mm=_rms(np.linalg.norm(e.p_hat - p_hat_0 + p_gt_0 - e.p_gt, axis=1)) * 1e3
        if not relative
        else _rms(e.total_mm),
        cross_track_rmse_mm=_rms(e.cross_track_mm),
        along_track_rmse_mm=_rms(e.along_track_mm),
        along_track_mean_mm=float(np.mean(e.along_track_mm)) if len(e.rows) else NAN,
        anchoring_truth_motion_mm=_anchoring_motion_mm(trajectory, truth, p_gt_0),
    )
    if relative or len(e.rows) == 0:
        return replace(measured, initial_contact_error_mm=NAN if relative else _norm_mm(p_hat_0 - p_gt_0))
    nees = _nees(trajectory, e)
    return replace(
        measured,
        trajectory_rmse_mm=_rms(e.total_mm),
        initial_contact_error_mm=_norm_mm(p_hat_0 - p_gt_0),
        trajectory_median_mm=float(np.median(e.total_mm)),
        trajectory_p95_mm=float(np.percentile(e.total_mm, 95)),
        trajectory_max_mm=float(e.total_mm.max()),
        frechet_mm=discrete_frechet(e.p_hat, e.p_gt) * 1e3,
        coverage_95=_fraction(nees <= CHI2_3_95),
        nees_median=float(np.median(nees)) if len(nees) else NAN,
    )


def _nees(trajectory: TipTrajectory, e: ErrorSeries) -> FloatArray:
    """eᵀ Σ⁻¹ e of the rows that have a covariance."""
    values = []
    for row, error in zip(e.rows, e.p_hat - e.p_gt, strict=True):
        covariance = trajectory.estimates[int(row)].covariance
        if covariance is None or not np.isfinite(covariance).all():
            continue
        variance, axes = np.linalg.eigh(covariance)
        values.append(float(np.sum((axes.T @ error) ** 2 / np.maximum(variance, _SIGMA_FLOOR_M**2))))
    return np.array(values)


def _anchoring_motion_mm(trajectory: TipTrajectory, truth: Truth, p_gt_0: FloatArray) -> float:
    p = truth.at([e.stamp_ns for e in trajectory.estimates if e.phase is Phase.ANCHORING])
    p = p[np.isfinite(p).all(axis=1)]
    return float(np.linalg.norm(p - p_gt_0, axis=1).max()) * 1e3 if len(p) else NAN


def _rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(x**2))) if len(x) else NAN


def _norm_mm(v: FloatArray) -> float:
    return float(np.linalg.norm(v)) * 1e3


def _fraction(flags: object) -> float:
    flags = np.asarray(flags, dtype=bool)
    return float(flags.mean()) if flags.size else NAN
