"""The plane on which one or several traces lie, with the uncertainty of its tilt and height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiptrace.evaluation.serial_noise import lag_one, mad_sigma, sandwich
from tiptrace.types import FloatArray

_OUTLIER = 4.5  # robust standard deviations
_ROUNDS = 4
SAME_GROOVE_M = 0.010  # traces farther apart across the travel are no repeats of one groove
_LEAST_WIDTH = 3.0  # width of the trace over its scatter, below which the tilt across it is not determined

Inliers = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class PlaneFit:
    """A plane through traces of the tip's centre.

    Attributes:
        origin_B: (3,) centroid, m.
        axes_B: (3, 3) rows: direction of travel, across it, and the normal (upwards).
        height_std_m: Standard deviation of the plane's position along its normal, anchors included.
        tilt_along_std_rad: Of its slope in the direction of travel.
        tilt_across_std_rad: Of its slope across it; NaN where the traces are too narrow to tell.
        across_determined: Whether the traces are wide enough; if not, the plane is taken to be level across.
        rms_m: Scatter of the traces about the plane, without their common offsets if they are repeats.
        apart_m: Greatest distance between traces across the travel.
        inliers: (n,) rows that were used.
    """

    origin_B: FloatArray
    axes_B: FloatArray
    height_std_m: float
    tilt_along_std_rad: float
    tilt_across_std_rad: float
    across_determined: bool
    rms_m: float
    apart_m: float
    inliers: Inliers

    @property
    def normal_B(self) -> FloatArray:
        """(3,) unit normal, upwards."""
        return np.asarray(self.axes_B[2])

    def to_plane(self, p_B: FloatArray) -> FloatArray:
        """Base to plane coordinates (along, across, height): (n, 3) → (n, 3) m."""
        return np.asarray((p_B - self.origin_B) @ self.axes_B.T)

    def to_base(self, uvw: FloatArray) -> FloatArray:
        """Plane to base coordinates: (n, 3) → (n, 3) m."""
        return np.asarray(uvw @ self.axes_B + self.origin_B)


def fit_plane(traces: Sequence[FloatArray], offset_std_m: float | None = None) -> PlaneFit:
    """Plane through traces, (n_k, 3) m each, robust against single outliers.

    Repeats of one groove differ mostly by their anchors, which say nothing of the tilt: each then has its own
    height. Traces that lie side by side are taken as they are.

    Args:
        traces: Positions of the tip's centre.
        offset_std_m: Standard deviation of each trace's height offset (its anchor). None: from the spread
            between traces, 0 with a single one.
    """
    points = np.concatenate(traces)
    owner = np.concatenate([np.full(len(t), k) for k, t in enumerate(traces)])
    means = np.array([t.mean(axis=0) for t in traces])  # (k, 3)
    origin = means.mean(axis=0)
    axes, determined, keep = _robust_axes(points - means[owner])
    apart = float(np.ptp((means - origin) @ axes[1]))
    repeats = apart <= SAME_GROOVE_M
    if not repeats:
        axes, determined, keep = _robust_axes(points - origin)
    uvw = (points - (means[owner] if repeats else origin)) @ axes.T
    groups = [uvw[keep & (owner == k)] for k in range(len(traces))]
    heights = (means - origin) @ axes[2]
    along, across = _slope_std(groups, determined)
    return PlaneFit(
        origin_B=origin,
        axes_B=axes,
        height_std_m=_height_std(groups, heights, offset_std_m),
        tilt_along_std_rad=along,
        tilt_across_std_rad=across,
        across_determined=determined,
        rms_m=float(np.sqrt(np.mean(uvw[keep, 2] ** 2))),
        apart_m=apart,
        inliers=keep,
    )


def _robust_axes(centred: FloatArray) -> tuple[FloatArray, bool, Inliers]:
    """Axes of centred points, (n, 3), whether they have a width, and which points were used."""
    keep = np.ones(len(centred), dtype=bool)
    axes, determined = _axes(centred)
    for _ in range(_ROUNDS):
        w = centred @ axes[2]
        limit = max(_OUTLIER * mad_sigma(w[keep]), 1e-9)
        inside = np.abs(w - np.median(w[keep])) <= limit
        if np.array_equal(inside, keep):
            break
        keep = inside
        axes, determined = _axes(centred[keep])
    return axes, determined, keep


def _axes(points: FloatArray) -> tuple[FloatArray, bool]:
    """Principal axes of centred points (rows: travel, across, normal), and whether they have a width."""
    _, s, Vt = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    determined = bool(s[1] > _LEAST_WIDTH * s[2] and s[1] > 1e-6 * s[0])
    travel = Vt[0] * np.sign(Vt[0] @ (points[-1] - points[0]) or 1.0)
    if determined:
        normal = Vt[2]
    else:  # level across the travel
        across = np.cross([0.0, 0.0, 1.0], travel)
        norm = float(np.linalg.norm(across))
        normal = np.cross(travel, across / norm) if norm > 1e-6 else Vt[2]
    normal = normal * np.sign(normal[2] or 1.0)
    return np.stack([travel, np.cross(normal, travel), normal]), determined


def _slope_std(groups: Sequence[FloatArray], determined: bool) -> tuple[float, float]:
    """Standard deviations of the slopes along and across, rad: w = α_k + β u + γ v with an α for each trace."""
    centred = [g - g.mean(axis=0) for g in groups if len(g)]
    residuals = [g[:, 2] for g in centred]
    sigma = float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))
    designs = [g[:, : 2 if determined else 1] for g in centred]
    std = np.sqrt(np.diag(sandwich(designs, sigma, lag_one(residuals))))
    return float(std[0]), float(std[1]) if determined else float("nan")


def _height_std(groups: Sequence[FloatArray], heights: FloatArray, offset_std_m: float | None) -> float:
    """Standard deviation of the plane's height, m: noise of each trace and the anchors' own errors."""
    residuals = [g[:, 2] - g[:, 2].mean() for g in groups if len(g)]
    sigma, phi = float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))), lag_one(residuals)
    between = float(heights.std(ddof=1)) if len(heights) > 1 else 0.0
    offset_std = between if offset_std_m is None else max(between, offset_std_m)
    return float(np.sqrt(sandwich([np.ones((len(r), 1)) for r in residuals], sigma, phi, offset_std)[0, 0]))
