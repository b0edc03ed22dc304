"""Figures of one trial: the trace in space, its error, its events."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tiptrace.evaluation import style
from tiptrace.evaluation.error_series import error_series, initial_point
from tiptrace.evaluation.report_data import MethodResult, ReportData
from tiptrace.types import FloatArray, Phase, Status

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STATUS_COLOUR = {
    Status.ANCHORING: style.GREY,
    Status.OK: style.GREEN,
    Status.DEGRADED: style.YELLOW,
    Status.RELATIVE: style.SKY,
    Status.NO_CONTACT: style.BLUE,
    Status.LOST: style.VERMILLION,
    Status.UNOBSERVABLE: style.BLACK,
}
_SNAP_RAD = np.deg2rad(3.0)
_STRAY, _STRAY_M = (
    0.1,
    10e-3,
)  # share of the trace's extent, and least distance, beyond which others are cut off
_ERROR_SHOWN = 10.0  # times the main method's largest error, and
_ERROR_SHOWN_MM = 15.0  # at least this much, are drawn of any method's


def overlay_top(data: ReportData) -> Figure:
    """Top view with equal axes; below, deviation to the side and in height with stretched axes."""
    origin, to_travel, names = _view(data)
    figure = style.new_figure(7.2, 5.6)
    top, side, height = figure.subplots(3, 1, height_ratios=[1.0, 1.7, 1.3], sharex=True)
    for line in _lines(data):
        along, across, up = ((line.p_B - origin) @ to_travel.T * 1e3).T
        for ax, values in ((top, across), (side, across), (height, up)):
            ax.plot(along, values, color=line.colour, linestyle=line.dash, label=line.label, lw=line.width)
        if line.covariance is not None:
            _band(side, along, across, line.std_along_mm(to_travel[1]), line.colour)
            _band(height, along, up, line.std_along_mm(to_travel[2]), line.colour)
    top.set_aspect("equal", adjustable="datalim")
    top.set(title="Top view, equal axes", ylabel=f"{names[1]} [mm]")
    side.set(ylabel=f"{names[1]} [mm]")
    height.set(ylabel="z [mm]", xlabel=f"{names[0]} [mm], from the start")
    for ax in (side, height):
        _include_at_least(ax, 2.0)
    handles, labels = top.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
    figure.draw_without_rendering()
    side.set_title(f"Deviation to the side, axis stretched × {_stretch(side):.0f}")
    height.set_title(f"Height, axis stretched × {_stretch(height):.0f}")
    return figure


def overlay_3d(data: ReportData) -> Figure:
    """The trace in space, equal axes."""
    figure = style.new_figure(7.2, 3.3)
    figure.set_layout_engine("none")  # the layout engine leaves a wide margin about a long thin box
    ax: Any = figure.add_axes((-0.19, -0.91, 1.3, 2.84), projection="3d")
    origin, _, _ = _view(data)
    spans = []
    for line in _lines(data):
        p = (line.p_B - origin) * 1e3
        ax.plot(*p.T, color=line.colour, linestyle=line.dash, label=line.label, lw=line.width)
        spans.append(p[np.isfinite(p).all(axis=1)])
    points = np.concatenate([*spans, np.zeros((1, 3))])
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.maximum(high - low, 0.15 * float((high - low).max()) + 1.0)
    middle = (low + high) / 2
    ax.set(xlim=_limits(middle, span, 0), ylim=_limits(middle, span, 1), zlim=_limits(middle, span, 2))
    ax.set_box_aspect(span, zoom=0.66)
    ax.view_init(elev=26, azim=-62)
    for axis, size in zip("xyz", span, strict=True):
        ax.locator_params(axis=axis, nbins=max(2, round(6 * size / span.max())))
    ax.set_xlabel("x [mm]", labelpad=40)
    ax.set_ylabel("y [mm]", labelpad=2)
    ax.set_zlabel("z [mm]", labelpad=-4)
    ax.tick_params(pad=0, labelsize=8)
    figure.text(0.01, 0.95, "Base frame, from the start, equal axes")
    figure.legend(*ax.get_legend_handles_labels(), loc="upper right", ncols=4)
    return figure


def error_over_time(data: ReportData) -> Figure:
    """Error at the same instant, across the true path, and along it."""
    assert data.truth is not None
    figure = style.new_figure(7.2, 5.0)
    total, cross, along = figure.subplots(3, 1, sharex=True)
    ceiling = 1.0
    main_mm = error_series(data.main.trajectory, data.truth).total_mm
    most_mm = max(_ERROR_SHOWN_MM, _ERROR_SHOWN * float(main_mm.max())) if len(main_mm) else np.inf
    for k, method in enumerate(data.methods):
        colour, dash = style.method_style(method.name, k)
        look = {"color": colour, "linestyle": dash, "label": method.name}
        every = error_series(method.trajectory, data.truth, phase=None)
        late = error_series(method.trajectory, data.truth)
        if len(late.total_mm):
            ceiling = max(ceiling, min(1.15 * float(late.total_mm.max()), most_mm))
        total.plot(*_gapped(data, method, every.rows, every.total_mm), **look)
        cross.plot(*_gapped(data, method, late.rows, late.cross_track_mm), **look)
        along.plot(*_gapped(data, method, late.rows, late.along_track_mm), **look)
    total.set(ylim=(0, ceiling), ylabel="error [mm]", title="Distance to the true tip at the same instant")
    cross.set(ylabel="across [mm]", title="Distance to the true path")
    cross.set_ylim(0, min(cross.get_ylim()[1], most_mm))
    along.set_ylim(max(along.get_ylim()[0], -most_mm), min(along.get_ylim()[1], most_mm))
    along.set(ylabel="along [mm]", title="Lead (+) or lag (−) along the true path", xlabel="time [s]")
    for ax in (total, cross, along):
        _shade_phases(ax, data)
    handles, labels = total.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
    return figure


def events_timeline(data: ReportData) -> Figure:
    """Status of every pair, and the events of the main method."""
    events = data.main.trajectory.events
    kinds = list(dict.fromkeys(e.kind for e in events))
    figure = style.new_figure(7.2, 1.5 + 0.28 * len(kinds))
    ax = figure.subplots()
    estimates = data.main.trajectory.estimates
    t = np.array([_seconds(data, e.stamp_ns) for e in estimates])  # (n,) s
    step = float(np.median(np.diff(t))) if len(t) > 1 else 0.04
    for status, colour in _STATUS_COLOUR.items():
        spans = _runs([e.status is status for e in estimates], t, step)
        if spans:
            ax.broken_barh(spans, (-0.4, 0.8), color=colour, lw=0, label=status.value)
    for row, kind in enumerate(kinds, start=1):
        of_kind = [e for e in events if e.kind == kind]
        starts = [(_seconds(data, e.start_ns), (e.end_ns - e.start_ns) * 1e-9) for e in of_kind]
        spans = [(start, max(step, length)) for start, length in starts]
        ax.broken_barh(spans, (row - 0.3, 0.6), color=style.PURPLE, lw=0)
    ax.set_yticks(range(len(kinds) + 1), ["status", *kinds])
    ax.set(xlabel="time [s]", ylim=(len(kinds) + 0.6, -0.6))
    ax.grid(visible=False, axis="y")
    figure.legend(loc="outside upper right", ncols=4)
    return figure


@dataclass(frozen=True, slots=True)
class _Line:
    """One curve of the overlay: (n, 3) positions, m; (n, 3, 3) covariances, m², where there are any."""

    label: str
    p_B: FloatArray
    colour: str
    dash: str
    covariance: FloatArray | None = None
    width: float = 1.3

    def std_along_mm(self, axis: FloatArray) -> FloatArray:
        """(n,) standard deviation along a unit axis."""
        assert self.covariance is not None
        variance = np.einsum("i,nij,j->n", axis, self.covariance, axis)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)) * 1e3)


def _lines(data: ReportData) -> list[_Line]:
    """Truth and methods; a method that strays far from the truth and the main one is cut off there."""
    lines = list(_whole_lines(data))
    near = np.concatenate([line.p_B for line in lines[:2]])
    near = near[np.isfinite(near).all(axis=1)]
    if len(near) == 0:
        return lines
    low, high = near.min(axis=0), near.max(axis=0)
    margin = max(_STRAY * float((high - low).max()), _STRAY_M)
    for line in lines[2:]:
        outside = ((line.p_B < low - margin) | (line.p_B > high + margin)).any(axis=1)
        line.p_B[outside] = np.nan
    return lines


def _whole_lines(data: ReportData) -> Iterable[_Line]:
    if data.truth is not None:
        stamps = [e.stamp_ns for e in data.main.trajectory.estimates if e.phase is Phase.RECONSTRUCTION]
        p_gt = data.truth.at(stamps)
        yield _Line("true tip", p_gt, style.TRUTH, "-", width=2.4)
    for k, method in enumerate(data.methods):
        rows = [e for e in method.trajectory.estimates if e.phase is Phase.RECONSTRUCTION]
        p = np.array([np.full(3, np.nan) if e.p_B is None else e.p_B for e in rows]).reshape(-1, 3)
        covariance = None
        if k == 0 and any(e.covariance is not None for e in rows):
            unknown = np.full((3, 3), np.nan)
            covariance = np.array([unknown if e.covariance is None else e.covariance for e in rows])
        colour, dash = style.method_style(method.name, k)
        yield _Line(method.name, p, colour, dash, covariance)


def _view(data: ReportData) -> tuple[FloatArray, FloatArray, tuple[str, str]]:
    """Origin (3,), rotation from base to travel axes (3, 3), and the names of the two horizontal axes.

    The first axis is the direction of travel in the plane; within 3° of x it is x itself.
    """
    reference = next(iter(_whole_lines(data))).p_B
    reference = reference[np.isfinite(reference).all(axis=1)]
    origin = reference[0] if len(reference) else np.zeros(3)
    if data.truth is not None:
        start = initial_point(data.main.trajectory, data.truth)[1]
        origin = start if np.isfinite(start).all() else origin
    if len(reference) < 2:
        return origin, np.eye(3), ("x", "y")
    _, _, Vt = np.linalg.svd(reference[:, :2] - reference[:, :2].mean(axis=0), full_matrices=False)
    direction = Vt[0] * np.sign(Vt[0] @ (reference[-1, :2] - reference[0, :2]) or 1.0)
    yaw = float(np.arctan2(direction[1], direction[0]))
    if abs(yaw) < _SNAP_RAD:
        return origin, np.eye(3), ("x", "y")
    c, s = np.cos(yaw), np.sin(yaw)
    return origin, np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]), ("along travel", "across travel")


def _runs(flags: list[bool], t: FloatArray, step: float) -> list[tuple[float, float]]:
    """Start and length of each unbroken run of true flags, s."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(flags, dtype=np.int8), [0]])))
    return [(float(t[a]), float(t[b - 1] - t[a] + step)) for a, b in edges.reshape(-1, 2)]


def _band(ax: Axes, x: FloatArray, y: FloatArray, std: FloatArray, colour: str) -> None:
    ax.fill_between(x, y - 2 * std, y + 2 * std, color=colour, alpha=0.18, lw=0)


def _include_at_least(ax: Axes, span_mm: float) -> None:
    """A flat line should look flat, not like noise blown up to the frame."""
    low, high = ax.get_ylim()
    if high - low < span_mm:
        middle = (low + high) / 2
        ax.set_ylim(middle - span_mm / 2, middle + span_mm / 2)


def _stretch(ax: Axes) -> float:
    """How many times longer a millimetre is on the vertical axis than on the horizontal one."""
    box = ax.get_window_extent()
    x, y = ax.get_xlim(), ax.get_ylim()
    return float((box.height / (y[1] - y[0])) / (box.width / (x[1] - x[0])))


def _limits(middle: FloatArray, span: FloatArray, axis: int) -> tuple[float, float]:
    return float(middle[axis] - span[axis] / 2), float(middle[axis] + span[axis] / 2)


def _gapped(
    data: ReportData, method: MethodResult, rows: np.ndarray[Any, Any], values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Times and values with NaN in rows that have none, so that lines break there."""
    estimates = method.trajectory.estimates
    y = np.full(len(estimates), np.nan)
    y[rows] = values
    return np.array([_seconds(data, e.stamp_ns) for e in estimates]), y


def _shade_phases(ax: Axes, data: ReportData) -> None:
    t = [_seconds(data, e.stamp_ns) for e in data.main.trajectory.estimates if e.phase is Phase.ANCHORING]
    if t:
        ax.axvspan(min(t), max(t), color="#EFEFEF", zorder=0, lw=0)
        ax.annotate("anchoring", (min(t), 1), xycoords=("data", "axes fraction"), xytext=(3, -3),
                    textcoords="offset points", va="top", fontsize=7, color=style.GREY)  # fmt: skip


def _seconds(data: ReportData, stamp_ns: int) -> float:
    return (stamp_ns - data.start_ns) * 1e-9
