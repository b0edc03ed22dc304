"""Errors of a trajectory row by row: in all, across the true path and along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiptrace.evaluation.polyline import Polyline, thin
from tiptrace.evaluation.truth import StampArray, Truth
from tiptrace.types import FloatArray, Phase, Status, TipTrajectory

_PROGRESS_WINDOW_M = 2e-3  # the true position is on the true path up to thinning and its own noise
_SEARCH_FACTOR = 3.0  # arc searched for the closest point, in units of the error
_SEARCH_MARGIN_M = 1e-3


@dataclass(frozen=True, slots=True)
class ErrorSeries:
    """Errors in the rows that could be evaluated, in order.

    Attributes:
        rows: (m,) index of the estimate.
        p_hat: (m, 3) estimated positions, m; moved onto p^gt(0) where the method gives displacements only.
        p_gt: (m, 3) true positions at the same instants, m.
        total_mm: (m,) ‖p̂ − p^gt‖.
        cross_track_mm: (m,) distance to the true path.
        along_track_mm: (m,) lead (positive) or lag along it, NaN where the truth does not move.
    """

    rows: NDArray[np.int64]
    p_hat: FloatArray
    p_gt: FloatArray
    total_mm: FloatArray
    cross_track_mm: FloatArray
    along_track_mm: FloatArray


@dataclass(frozen=True, slots=True)
class TruePath:
    """The path that the true tip took, and when it was where.

    Attributes:
        line: Path by arc length.
        stamps_ns: (n,) when the tip was at each vertex.
    """

    line: Polyline
    stamps_ns: StampArray

    def progress(self, stamps_ns: StampArray, p_gt: FloatArray) -> FloatArray:
        """Arc length of true positions at given instants: (m,) ns, (m, 3) m → (m,) m."""
        if len(self.stamps_ns) == 0:
            return np.full(len(stamps_ns), np.nan)
        t_0 = self.stamps_ns[0]
        rough = np.interp((stamps_ns - t_0) * 1e-9, (self.stamps_ns - t_0) * 1e-9, self.line.arc_m)
        _, arc = self.line.project(p_gt, rough, np.full(len(rough), _PROGRESS_WINDOW_M))
        return arc

    def track_errors(
        self, p_hat: FloatArray, p_gt: FloatArray, stamps_ns: StampArray
    ) -> tuple[FloatArray, FloatArray]:
        """Distance to the path, and lead (positive) or lag along it by arc length: (m,) m each.

        The closest point is sought within an arc about the true position at the same instant, three times as
        long as the error, so that a path that crosses or repeats itself is compared with its right pass.
        """
        s_gt = self.progress(stamps_ns, p_gt)
        window = _SEARCH_FACTOR * np.linalg.norm(p_hat - p_gt, axis=1) + _SEARCH_MARGIN_M
        cross, s_hat = self.line.project(p_hat, s_gt, window)
        return cross, s_hat - s_gt


def true_path(trajectory: TipTrajectory, truth: Truth) -> TruePath:
    """The path that the true tip took in the reconstruction segment."""
    rows = [e.stamp_ns for e in trajectory.estimates if e.phase is Phase.RECONSTRUCTION]
    if not rows:
        return TruePath(Polyline.through([]), np.zeros(0, dtype=np.int64))
    stamps, points = truth.between(min(rows), max(rows))
    keep = thin(points)
    return TruePath(Polyline.through(points[keep], spacing_m=0.0), stamps[keep])


def error_series(
    trajectory: TipTrajectory, truth: Truth, phase: Phase | None = Phase.RECONSTRUCTION
) -> ErrorSeries:
    """Errors row by row; ``phase`` None takes every row with a position."""
    estimates = trajectory.estimates
    rows = [k for k, e in enumerate(estimates) if e.p_B is not None and (phase is None or e.phase is phase)]
    p_hat = np.array([estimates[k].p_B for k in rows], dtype=np.float64).reshape(-1, 3)  # (m, 3)
    stamps = np.array([estimates[k].stamp_ns for k in rows], dtype=np.int64)  # (m,)
    p_gt = truth.at(stamps)  # (m, 3)
    if is_relative(trajectory):
        p_hat_0, p_gt_0 = initial_point(trajectory, truth)
        p_hat = p_hat - p_hat_0 + p_gt_0
    valid = np.isfinite(p_gt).all(axis=1) & np.isfinite(p_hat).all(axis=1)
    p_hat, p_gt = p_hat[valid], p_gt[valid]
    cross, along = true_path(trajectory, truth).track_errors(p_hat, p_gt, stamps[valid])
    return ErrorSeries(
        rows=np.asarray(rows, dtype=np.int64)[valid],
        p_hat=p_hat,
        p_gt=p_gt,
        total_mm=np.linalg.norm(p_hat - p_gt, axis=1) * 1e3,
        cross_track_mm=cross * 1e3,
        along_track_mm=along * 1e3,
    )


def initial_point(trajectory: TipTrajectory, truth: Truth) -> tuple[FloatArray, FloatArray]:
    """p̂(0) and p^gt(0), (3,) m each.

    p̂(0) is the anchor, which belongs to frame 0, the first one in which the tool's motion is known; p^gt(0)
    is the truth at that instant, or its first sample where that begins up to 0.25 s later. Without an anchor
    (displacements only) both are taken at the first position of the reconstruction segment. NaN where there is no
    such frame or no truth.
    """
    frame_0 = next((e for e in trajectory.estimates if e.R_B_E is not None), None)
    if trajectory.anchor is not None and frame_0 is not None:
        return trajectory.anchor.p_B, truth.nearest(frame_0.stamp_ns)[0]
    for e in trajectory.estimates:
        if e.phase is Phase.RECONSTRUCTION and e.p_B is not None:
            return e.p_B, truth.nearest(e.stamp_ns)[0]
    return np.full(3, np.nan), np.full(3, np.nan)


def is_relative(trajectory: TipTrajectory) -> bool:
    """Whether positions are displacements without an absolute anchor."""
    return any(e.status is Status.RELATIVE for e in trajectory.estimates)
