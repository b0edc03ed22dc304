"""Figures of one trial: what the gels saw, the anchoring fit, and how long each step took."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tiptrace.evaluation import style
from tiptrace.evaluation.error_series import initial_point
from tiptrace.evaluation.report_data import AnchoringFit, ReportData, TactileView
from tiptrace.types import BoolArray, FloatArray, Phase

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ARROW_PX = 22.0  # length that a typical arrow should about reach
_HAIR = "#FFFFFF"


def tactile_markers(data: ReportData) -> Figure:
    """Both gels at the first and the last pair, markers with their displacement since frame 0."""
    figure = style.new_figure(7.2, 2.75 * len(data.tactile))
    axes = figure.subplots(len(data.tactile), 2, squeeze=False)
    factor = _arrow_factor(data.tactile)
    for (first, last), view in zip(axes, data.tactile, strict=True):
        _show_image(first, view.first_image, f"{view.side}, first pair")
        _show_image(last, view.last_image, f"{view.side}, last pair, arrows × {factor}")
        if view.uv_first_px is not None:
            _draw_markers(first, view.uv_first_px, _selected(view))
            if view.uv_last_px is not None:
                _draw_arrows(last, view, factor)
    _legend(figure, list(axes.flat))
    return figure


def depth_maps(data: ReportData) -> Figure:
    """Indentation of both gels at the first and the last pair, one scale for all."""
    maps = [(v.side, when, h) for v in data.tactile for when, h in _depths(v)]
    columns = 2 if len(maps) > 1 else 1
    rows = -(-len(maps) // columns)
    figure = style.new_figure(7.2, 2.6 * rows)
    axes = figure.subplots(rows, columns, squeeze=False)
    top = max(float(np.nanpercentile(h, 99.8)) for _, _, h in maps)
    low = min(0.0, *(float(np.nanpercentile(h, 0.2)) for _, _, h in maps))
    picture = None
    for ax, (side, when, h) in zip(axes.flat, maps, strict=False):
        picture = ax.imshow(h, cmap="cividis", vmin=low, vmax=max(top, 1e-3), interpolation="nearest")
        _bare(ax, f"{side}, {when} pair: deepest {np.nanmax(h):.2f} mm")
    for ax in axes.flat[len(maps) :]:
        ax.set_axis_off()
    if picture is not None:
        figure.colorbar(picture, ax=axes, label="indentation [mm]", shrink=0.85)
    return figure


def has_depth(data: ReportData) -> bool:
    """Whether any depth map was given."""
    return any(True for view in data.tactile for _ in _depths(view))


def anchoring_fit(data: ReportData) -> Figure:
    """Fixed-point residual frame by frame, and the running estimate as it converges."""
    t, p = _running_estimate(data)
    has_residual = data.anchoring is not None and len(data.anchoring.residual_mm) > 0
    panels = int(has_residual) + 2 * int(len(p) > 0)
    figure = style.new_figure(7.2, 1.7 * max(panels, 1))
    axes = list(figure.subplots(max(panels, 1), 1, sharex=True, squeeze=False).flat)
    if data.anchoring is not None and has_residual:
        _draw_residual(axes.pop(0), data, data.anchoring)
    if len(p):
        _draw_convergence(axes[0], axes[1], data, t, p)
    figure.axes[-1].set_xlabel("time [s]")
    return figure


def has_anchoring(data: ReportData) -> bool:
    """Whether there is anything to show of Stage I."""
    return data.anchoring is not None or len(_running_estimate(data)[1]) > 0


def step_times(data: ReportData) -> Figure:
    """Time of the whole loop over the trial, and of each step."""
    from matplotlib.ticker import LogLocator, NullFormatter

    loop = [(e.stamp_ns, e.loop_ms) for e in data.main.trajectory.estimates if e.loop_ms]
    panels = int(bool(loop)) + int(bool(data.step_ms))
    figure = style.new_figure(7.2, 2.4 if not data.step_ms else 1.4 + 1.0 * panels + 0.16 * len(data.step_ms))
    axes = list(figure.subplots(panels, 1, squeeze=False).flat)
    if loop:
        ax = axes.pop(0)
        t = (np.array([s for s, _ in loop]) - data.start_ns) * 1e-9
        ms = np.array([v for _, v in loop], dtype=np.float64)
        ax.plot(t, ms, ".", ms=3, color=style.BLUE, label="one pair")
        ax.axhline(1e3 / 14.0, color=style.GREY, ls="--", lw=1, label="paper: 14 Hz")
        ax.axhline(1e3 / 25.0, color=style.ORANGE, ls=":", lw=1.4, label="camera: 25 Hz")
        ax.set(xlabel="time [s]", ylabel="loop [ms]", yscale="log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.set_title(f"Whole loop: {1e3 * len(ms) / ms.sum():.1f} Hz, median {np.median(ms):.1f} ms")
        ax.legend(ncols=3, loc="upper right")
    if data.step_ms:
        _draw_steps(axes.pop(0), data)
    return figure


def has_times(data: ReportData) -> bool:
    """Whether any time was measured."""
    return bool(data.step_ms) or any(e.loop_ms for e in data.main.trajectory.estimates)


def _show_image(ax: Axes, image: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], title: str) -> None:
    ax.imshow(image[..., ::-1])  # BGR → RGB
    _bare(ax, title)


def _bare(ax: Axes, title: str) -> None:
    ax.set_title(title)
    ax.set_xticks([])
    ax.set_yticks([])
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)


def _legend(figure: Figure, axes: list[Axes]) -> None:
    """One legend for all panels, on grey because most markers are drawn white."""
    known: dict[str, Artist] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            known.setdefault(label, handle)
    if known:
        figure.legend(
            list(known.values()),
            list(known),
            loc="outside lower center",
            ncols=len(known),
            frameon=True,
            facecolor="#555555",
            labelcolor="white",
        )


def _selected(view: TactileView) -> BoolArray:
    if view.selected is not None:
        return view.selected
    assert view.uv_first_px is not None
    return np.zeros(len(view.uv_first_px), dtype=bool)


def _draw_markers(ax: Axes, uv: FloatArray, selected: BoolArray) -> None:
    for group, size, colour, width, label in (
        (~selected, 26, _HAIR, 0.9, "tracked"),
        (selected, 46, style.ORANGE, 1.8, "in the fit"),
    ):
        if group.any():
            u, v = uv[group].T
            ax.scatter(u, v, s=size, facecolors="none", edgecolors=colour, linewidths=width, label=label)


def _draw_arrows(ax: Axes, view: TactileView, factor: int) -> None:
    assert view.uv_first_px is not None
    assert view.uv_last_px is not None
    lost = ~np.isfinite(view.uv_last_px).all(axis=1)
    selected = _selected(view)
    for group, colour, width in ((~selected & ~lost, _HAIR, 0.004), (selected & ~lost, style.ORANGE, 0.006)):
        start, move = view.uv_first_px[group], (view.uv_last_px - view.uv_first_px)[group] * factor
        if len(start):
            ax.quiver(*start.T, *move.T, angles="xy", scale_units="xy", scale=1, color=colour, width=width,
                      edgecolor="black", linewidth=0.3)  # fmt: skip
    if lost.any():
        u, v = view.uv_first_px[lost].T
        ax.scatter(u, v, s=30, marker="x", color=style.VERMILLION, label="lost")


def _arrow_factor(views: tuple[TactileView, ...]) -> int:
    """Enlargement at which most arrows can be seen; single long ones may reach further."""
    moves = [
        np.linalg.norm(v.uv_last_px - v.uv_first_px, axis=1)
        for v in views
        if v.uv_first_px is not None and v.uv_last_px is not None and np.isfinite(v.uv_last_px).any()
    ]
    typical = float(np.nanpercentile(np.concatenate(moves), 75)) if moves else 0.0
    return max((f for f in (1, 2, 3, 5, 10, 20) if f * typical <= _ARROW_PX), default=1) if typical > 0 else 1


def _depths(view: TactileView) -> list[tuple[str, FloatArray]]:
    pairs = (("first", view.depth_first_mm), ("last", view.depth_last_mm))
    return [(when, h) for when, h in pairs if h is not None and np.isfinite(h).any()]


def _running_estimate(data: ReportData) -> tuple[FloatArray, FloatArray]:
    rows = [e for e in data.main.trajectory.estimates if e.phase is Phase.ANCHORING and e.p_B is not None]
    t = np.array([(e.stamp_ns - data.start_ns) * 1e-9 for e in rows])
    return t, np.array([e.p_B for e in rows], dtype=np.float64).reshape(-1, 3)


def _draw_residual(ax: Axes, data: ReportData, fit: AnchoringFit) -> None:
    t = (fit.stamps_ns - data.start_ns) * 1e-9
    rms = float(np.sqrt(np.nanmean(fit.residual_mm**2)))
    ax.plot(t, fit.residual_mm, ".", ms=3, color=style.BLUE)
    ax.axhline(rms, color=style.GREY, ls="--", lw=1, label=f"rms {rms:.2f} mm")
    ax.set(ylabel="residual [mm]", title="Fixed-point residual ‖(I − R) p − d‖ of each anchoring pair")
    ax.set_ylim(bottom=0)
    ax.legend(loc="upper right")


def _draw_convergence(distance: Axes, parts: Axes, data: ReportData, t: FloatArray, p: FloatArray) -> None:
    target, name = _target(data, p)
    offset = (p - target) * 1e3  # (n, 3) mm
    distance.semilogy(t, np.maximum(np.linalg.norm(offset, axis=1), 1e-4), color=style.BLUE)
    distance.set(ylabel="distance [mm]", title=f"Running estimate of the tip: distance to {name}")
    for k, (axis, colour, dash) in enumerate(
        (("x", style.VERMILLION, "-"), ("y", style.GREEN, "--"), ("z", style.BLUE, "-."))
    ):
        parts.plot(t, offset[:, k], color=colour, linestyle=dash, label=axis)
    reach = max(2.0, 2.5 * float(np.abs(offset[len(offset) // 2 :]).max()))
    parts.set(ylim=(-reach, reach), ylabel="offset [mm]", title=f"… and its components, from {name}")
    parts.legend(loc="upper right", ncols=3)


def _target(data: ReportData, p: FloatArray) -> tuple[FloatArray, str]:
    if data.truth is not None:
        p_gt_0 = initial_point(data.main.trajectory, data.truth)[1]
        if np.isfinite(p_gt_0).all():
            return p_gt_0, "the true tip"
    anchor = data.main.trajectory.anchor
    return (p[-1], "its last value") if anchor is None else (anchor.p_B, "the final anchor")


def _draw_steps(ax: Axes, data: ReportData) -> None:
    names = list(data.step_ms)
    values = [np.asarray(data.step_ms[name], dtype=np.float64) for name in names]
    middle = np.array([np.nanmedian(v) for v in values])
    high = np.array([np.nanpercentile(v, 95) for v in values])
    y = np.arange(len(names))
    ax.barh(y, middle, color=style.SKY, height=0.62)
    ax.hlines(y, middle, high, color=style.BLACK, lw=1)
    ax.plot(high, y, "|", color=style.BLACK, ms=7)
    for row, (m, h) in enumerate(zip(middle, high, strict=True)):
        ax.annotate(f" {m:.2f} / {h:.2f} ms", (h, row), va="center", fontsize=7.5)
    ax.set_yticks(y, names)
    ax.invert_yaxis()
    ax.margins(x=0.15)
    ax.grid(visible=False, axis="y")
    ax.set(xlabel="time per pair [ms]", title="Steps: median (bar) / 95th percentile (whisker)")
