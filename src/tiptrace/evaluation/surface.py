"""What traces say about the world: the plane they lie on, the groove's centreline, its period and amplitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.errors import GeometryError
from tiptrace.evaluation.surface_centreline import CentrelineFit, fit_centreline
from tiptrace.evaluation.surface_periodic import PeriodicFit, fit_periodic
from tiptrace.evaluation.surface_plane import SAME_GROOVE_M, PlaneFit, fit_plane
from tiptrace.evaluation.tables import Table, columns, rows_of, show
from tiptrace.types import FloatArray

_LEAST_POINTS = 12
_LEAST_TRAVEL_M = 2e-3


@dataclass(frozen=True, slots=True)
class Trace:
    """Positions of the tip's centre along one trace.

    Attributes:
        name: Where it came from.
        p_B: (n, 3) m.
        covariance: (n, 3, 3) m², where the method gave it.
    """

    name: str
    p_B: FloatArray
    covariance: FloatArray | None = None

    def offset_std_m(self, axis: FloatArray) -> float:
        """Standard deviation along a unit axis that all positions share, at most: the least of their own; or NaN."""
        if self.covariance is None or len(self.covariance) == 0:
            return float("nan")
        variance = np.einsum("i,nij,j->n", axis, self.covariance, axis)
        return float(np.sqrt(max(0.0, float(variance.min()))))


@dataclass(frozen=True, slots=True)
class SurfaceFit:
    """Plane, centreline and period of one or several traces.

    Attributes:
        traces: What was fitted.
        plane: Plane of the tip's centre.
        centreline: Smoothed deviation across the travel; None where the traces do not share one.
        periodic: Sinusoid, None where nothing repeats.
        tip_radius_m: Radius of the tip; the surface lies so far below the tip's centre, along the normal.
        notes: What the data do not tell.
    """

    traces: tuple[Trace, ...]
    plane: PlaneFit
    centreline: CentrelineFit | None
    periodic: PeriodicFit | None
    tip_radius_m: float
    notes: tuple[str, ...] = ()

    def surface_points(self, p_B: FloatArray) -> FloatArray:
        """Points of the surface below positions of the tip's centre: (n, 3) → (n, 3) m."""
        return np.asarray(p_B - self.tip_radius_m * self.plane.normal_B)

    def centreline_B(self) -> FloatArray:
        """Centreline of the tip's centre in the base frame, (g, 3) m."""
        assert self.centreline is not None
        along, across = self.centreline.along_m, self.centreline.across_m
        return self.plane.to_base(np.stack([along, across, np.zeros_like(along)], axis=1))


def fit_surface(traces: Sequence[Trace], tip_radius_m: float = 0.0) -> SurfaceFit:
    """Fit plane, centreline and period.

    Raises:
        GeometryError: a trace with too few positions, or one that does not move.
    """
    for trace in traces:
        _check(trace)
    prior = np.array([t.offset_std_m(np.array([0.0, 0.0, 1.0])) for t in traces])
    plane = fit_plane([t.p_B for t in traces], float(np.max(prior)) if np.isfinite(prior).all() else None)
    ends = np.cumsum([len(t.p_B) for t in traces])
    used = np.split(plane.inliers, ends[:-1])
    uvw = [plane.to_plane(t.p_B[k]) for t, k in zip(traces, used, strict=True)]
    uv = [_ordered(x[:, :2]) for x in uvw if len(x) >= _LEAST_POINTS]
    notes = _notes(plane, traces)
    if plane.apart_m > SAME_GROOVE_M:
        notes.append(
            f"the traces lie {plane.apart_m * 1e3:.0f} mm apart across the travel: no common centreline is fitted"
        )
        return SurfaceFit(tuple(traces), plane, None, None, tip_radius_m, tuple(notes))
    offset = traces[0].offset_std_m(plane.axes_B[1]) if len(traces) == 1 else float("nan")
    periodic = fit_periodic(uv)
    if len(traces) == 1 and periodic is None:
        notes.append(
            "a single trace cannot tell its own slow errors from the groove: the band of the centreline counts only "
            "what changes from pair to pair; trace it again for an honest one"
        )
    centreline = fit_centreline(uv, offset, periodic)
    return SurfaceFit(tuple(traces), plane, centreline, periodic, tip_radius_m, tuple(notes))


def surface_table(fit: SurfaceFit) -> Table:
    """The fitted quantities with their uncertainty."""
    plane, rows = fit.plane, []
    n = plane.normal_B
    rows.append(["surface normal (x, y, z)", f"{n[0]:+.4f}, {n[1]:+.4f}, {n[2]:+.4f}", ""])
    rows.append(
        ["slope along the travel [deg]", *_with_std(_slope(plane, 0), np.degrees(plane.tilt_along_std_rad))]
    )
    across = _with_std(_slope(plane, 1), np.degrees(plane.tilt_across_std_rad))
    rows.append(
        ["slope across the travel [deg]", *(across if plane.across_determined else ("not determined", ""))]
    )
    height = float(fit.surface_points(plane.origin_B[None])[0] @ n) * 1e3
    rows.append(
        ["distance of the surface from the base's origin [mm]", *_with_std(height, plane.height_std_m * 1e3)]
    )
    rows.append(["scatter about the plane [mm]", show(plane.rms_m * 1e3, 3), ""])
    if fit.centreline is not None:
        c = fit.centreline
        rows.append(["centreline, shape [mm]", "centreline.csv", f"± {float(np.median(c.std_m)) * 1e3:.3f}"])
        if np.isfinite(c.offset_std_m):
            rows.append(["centreline, offset across [mm]", "", f"± {c.offset_std_m * 1e3:.2f}"])
        rows.append(["scatter about the centreline [mm]", show(c.noise_m * 1e3, 3), ""])
    if fit.periodic is not None:
        p = fit.periodic
        rows.append(["period [mm]", *_with_std(p.period_m * 1e3, p.period_std_m * 1e3)])
        rows.append(["amplitude, peak [mm]", *_with_std(p.amplitude_m * 1e3, p.amplitude_std_m * 1e3)])
    heads = (("quantity", "quantity"), ("value", "value"), ("std", "1σ"))
    return Table("surface", f"Surface from {len(fit.traces)} trace(s)", columns(*heads), rows_of(rows))


def surface_record(fit: SurfaceFit) -> dict[str, Any]:
    """The fit as plain values for JSON."""
    plane, c, p = fit.plane, fit.centreline, fit.periodic
    return {
        "traces": [t.name for t in fit.traces],
        "tip_radius_mm": fit.tip_radius_m * 1e3,
        "plane": {
            "point_B_m": fit.surface_points(plane.origin_B[None])[0].tolist(),
            "normal_B": plane.normal_B.tolist(),
            "travel_B": plane.axes_B[0].tolist(),
            "height_std_mm": _finite(plane.height_std_m * 1e3),
            "slope_along_std_deg": _finite(float(np.degrees(plane.tilt_along_std_rad))),
            "slope_across_std_deg": _finite(float(np.degrees(plane.tilt_across_std_rad))),
            "slope_across_determined": plane.across_determined,
            "scatter_mm": plane.rms_m * 1e3,
        },
        "centreline": None
        if c is None
        else {
            "shape_std_mm": float(np.median(c.std_m)) * 1e3,
            "offset_std_mm": _finite(c.offset_std_m * 1e3),
            "scatter_mm": c.noise_m * 1e3,
        },
        "periodic": None
        if p is None
        else {
            "period_mm": p.period_m * 1e3,
            "period_std_mm": p.period_std_m * 1e3,
            "amplitude_mm": p.amplitude_m * 1e3,
            "amplitude_std_mm": p.amplitude_std_m * 1e3,
            "r2": p.r2,
        },
        "notes": list(fit.notes),
    }


def write_surface(folder: Path, fit: SurfaceFit) -> None:
    """Write ``surface.json``, ``surface.md``, ``centreline.csv`` and the figure ``surface``.

    Raises:
        OutputError: a file cannot be written.
    """
    import json

    from tiptrace.evaluation.atomic import write_atomic
    from tiptrace.evaluation.figures_surface import surface_figure
    from tiptrace.evaluation.style import figure_style, save_figure

    write_atomic(folder / "surface.json", json.dumps(surface_record(fit), indent=1, allow_nan=False) + "\n")
    write_atomic(folder / "surface.md", surface_table(fit).markdown())
    if fit.centreline is not None:
        write_atomic(folder / "centreline.csv", centreline_table(fit).csv())
    with figure_style():
        save_figure(surface_figure(fit), folder / "surface")


def centreline_table(fit: SurfaceFit) -> Table:
    """The centreline point by point: plane coordinates, band, and the surface below it in the base frame."""
    assert fit.centreline is not None
    c = fit.centreline
    low, high = c.band()
    below = fit.surface_points(fit.centreline_B())
    data = np.column_stack([np.stack([c.along_m, c.across_m, low, high], axis=1) * 1e3, below])
    names = ("along_mm", "across_mm", "across_low95_mm", "across_high95_mm", "x_m", "y_m", "z_m")
    cells = [[round(float(v), 7) for v in row] for row in data]
    return Table("centreline", "Centreline", columns(*((n, n) for n in names)), rows_of(cells))


def _check(trace: Trace) -> None:
    if len(trace.p_B) < _LEAST_POINTS:
        raise GeometryError(
            f"{trace.name}: {len(trace.p_B)} positions are too few; a surface needs {_LEAST_POINTS}"
        )
    if float(np.linalg.norm(np.ptp(trace.p_B, axis=0))) < _LEAST_TRAVEL_M:
        raise GeometryError(f"{trace.name}: the tip does not move; a surface needs a trace that travels")


def _ordered(uv: FloatArray) -> FloatArray:
    return np.asarray(uv[np.argsort(uv[:, 0], kind="stable")])


def _notes(plane: PlaneFit, traces: Sequence[Trace]) -> list[str]:
    notes = []
    if not plane.across_determined:
        notes.append(
            "the traces are too straight to tell the slope across them: the plane is taken as level there"
        )
    dropped = int(np.sum(~plane.inliers))
    if dropped:
        notes.append(f"{dropped} of {len(plane.inliers)} positions lie far off the plane and were left out")
    if len(traces) == 1:
        notes.append("from a single trace: the error of its anchor moves the surface as a whole")
    return notes


def _slope(plane: PlaneFit, axis: int) -> float:
    """Inclination of a plane axis against the horizontal, degrees."""
    return float(np.degrees(np.arcsin(np.clip(plane.axes_B[axis][2], -1.0, 1.0))))


def _with_std(value: float, std: float) -> tuple[str, str]:
    digits = 3 if std < 0.1 else 2
    return f"{value:.{digits}f}", f"± {std:.{digits}f}"


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
