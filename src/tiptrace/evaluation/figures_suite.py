"""Figures over the trials of a suite, as in the paper and beside it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from tiptrace.evaluation import published, style
from tiptrace.evaluation.conditions import CONDITION_SETS, VARIED, Condition, sets_of
from tiptrace.evaluation.records import TrialRecord
from tiptrace.evaluation.statistics import spearman, summarise
from tiptrace.evaluation.suite_values import (
    BASELINES,
    aligned,
    methods_of,
    metric_heading,
    set_values,
    values_by_trial,
)
from tiptrace.evaluation.traces import TrialTraces
from tiptrace.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MARKS = ("o", "s", "^", "D", "v", "P")


def error_against_anchoring(records: Sequence[TrialRecord]) -> Figure:
    """Trajectory and shape RMSE against the initial contact error (the paper's error decomposition)."""
    figure = style.new_figure(7.2, 4.2)
    panels = figure.subplots(1, 2)
    names = ("trajectory_rmse_mm", "shape_rmse_mm")
    titles = ("trajectory RMSE [mm]", "shape RMSE [mm]")
    for ax, name, title in zip(panels, names, titles, strict=True):
        rhos = []
        for k, method in enumerate(methods_of(records)):
            contact = values_by_trial(records, method, "initial_contact_error_mm")
            error = values_by_trial(records, method, name)
            x, y = np.array(list(contact.values())), np.array([error[t] for t in contact])
            if not np.any(x > 0):  # from the true anchor, or without any: nothing to hold against the other
                continue
            rho = spearman(x, y, samples=200).rho
            rhos += [] if np.isnan(rho) else [f"{method} {rho:.2f}"]
            colour, _ = style.method_style(method, k)
            mark = _MARKS[k % len(_MARKS)]
            ax.scatter(x, y, s=16, marker=mark, color=colour, alpha=0.75, lw=0, label=method)
        ax.set(xlabel="initial contact error [mm]", ylabel=title)
        _logarithmic(ax, "x", "y")
        ax.set_title(
            "\n".join(["Spearman's ρ:", *_in_lines(rhos), f"published {published.SPEARMAN[name]:.2f}"])
        )
    handles, labels = panels[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=6)
    return figure


def _in_lines(words: Sequence[str], width: int = 3) -> list[str]:
    return [", ".join(words[k : k + width]) for k in range(0, len(words), width)]


def _logarithmic(ax: Axes, *axes: str) -> None:
    """Logarithmic axes with plain numbers at 1, 2 and 5 of each decade, or at 1 alone over many."""
    from matplotlib.ticker import LogLocator, NullFormatter

    for name in axes:
        axis = ax.xaxis if name == "x" else ax.yaxis
        ax.set(**{f"{name}scale": "log"})
        low, high = ax.get_xlim() if name == "x" else ax.get_ylim()
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 200 * low else (1, 3)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())


def shape_by_set(records: Sequence[TrialRecord]) -> Figure:
    """Distribution of the shape RMSE in each condition set, beside the paper's range of set means."""
    methods = methods_of(records)
    figure = style.new_figure(7.2, 3.4)
    ax = figure.subplots()
    width = 0.8 / max(1, len(methods))
    for k, method in enumerate(methods):
        colour, _ = style.method_style(method, k)
        for place, name in enumerate(CONDITION_SETS):
            values = set_values(records, method, name, "shape_rmse_mm")
            values = values[np.isfinite(values)]
            if len(values) == 0:
                continue
            x = place + (k - (len(methods) - 1) / 2) * width
            box = ax.boxplot(
                values,
                positions=[x],
                widths=0.7 * width,
                showfliers=False,
                patch_artist=True,
                medianprops={"color": style.BLACK},
                boxprops={"facecolor": colour, "alpha": 0.45},
            )
            if place == 0:
                box["boxes"][0].set_label(method)
            jitter = (np.arange(len(values)) * 0.618 % 1 - 0.5) * 0.45 * width
            ax.plot(x + jitter, values, ".", ms=3.5, color=colour)
    low, high = published.SET_SHAPE_RANGE_MM
    ax.axhspan(low, high, color="#DDDDDD", zorder=0, lw=0, label=f"set means in the paper: {low} – {high} mm")
    labels = [f"{name}: {VARIED[name]}\n({len(CONDITION_SETS[name])} conditions)" for name in CONDITION_SETS]
    ax.set_xticks(range(len(labels)), labels)
    ax.set(ylabel="shape RMSE [mm]")
    _logarithmic(ax, "y")
    ax.grid(visible=False, axis="x")
    figure.legend(loc="outside lower center", ncols=4)
    return figure


def overlays(traces: Iterable[tuple[Condition, TrialTraces]], method: str) -> Figure:
    """Reconstructed traces over the true ones, a panel per condition, a row per set; lateral axis stretched."""
    by_condition: dict[Condition, list[TrialTraces]] = {}
    for condition, trace in traces:
        by_condition.setdefault(condition, []).append(trace)
    sets = _sets_with(by_condition)
    columns = max((len(c) for c in sets.values()), default=1)
    width_in = max(4.0, 1.92 * columns)
    figure = style.new_figure(width_in, 0.4 + 1.5 * max(1, len(sets)))
    axes = figure.subplots(max(1, len(sets)), columns, sharex=True, sharey="row", squeeze=False)
    colour, _ = style.method_style(method)
    for row, (name, conditions) in zip(axes, sets.items(), strict=False):
        for ax, condition in zip(row, conditions, strict=False):
            found = by_condition.get(condition, [])
            _overlay(ax, found, method, colour)
            ax.set_title(f"{name}: {condition} ({len(found)})", fontsize=8)
        for ax in row[len(conditions) :]:
            ax.set_axis_off()
        row[0].set_ylabel("y [mm]")
    for column in axes.T:
        lowest = [ax for ax in column if ax.axison][-1]
        lowest.set_xlabel("x [mm]")
        lowest.tick_params(labelbottom=True)
    title = f"{method} (colour) over the true tip (grey), top view from the start, y stretched"
    figure.suptitle(fill(title, int(14 * width_in)), fontsize=9)
    return figure


def against_baselines(
    records: Sequence[TrialRecord], method: str, metric: str = "trajectory_rmse_mm"
) -> Figure | None:
    """Each trial's error by a method against that by each baseline; None where there is no baseline."""
    present = methods_of(records)
    rivals = [m for m in present if m != method and (m in BASELINES or m == "paper")]
    if not rivals:
        return None
    columns = min(3, len(rivals))
    rows = -(-len(rivals) // columns)
    figure = style.new_figure(2.4 * columns, 2.6 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, rival in zip(panels, rivals, strict=False):
        ours, theirs = aligned(records, (method, rival), metric)
        both = np.isfinite(ours) & np.isfinite(theirs) & (ours > 0) & (theirs > 0)
        ours, theirs = ours[both], theirs[both]
        pooled = np.concatenate([ours, theirs]) if len(ours) else np.array([0.1, 1.0])
        limits = (0.8 * float(pooled.min()), 1.25 * float(pooled.max()))
        ax.plot(limits, limits, color=style.GREY, lw=1)
        ax.scatter(theirs, ours, s=14, color=style.method_style(method)[0], alpha=0.7, lw=0)
        ax.set(xlim=limits, ylim=limits, xlabel=f"{rival} [mm]", ylabel=f"{method} [mm]", aspect="equal")
        _logarithmic(ax, "x", "y")
        ax.set(xlim=limits, ylim=limits)
        ax.set_title(f"better in {int(np.sum(ours < theirs))} of {len(ours)}")
    for ax in panels[len(rivals) :]:
        ax.set_axis_off()
    return figure


def error_distribution(records: Sequence[TrialRecord], metric: str = "trajectory_rmse_mm") -> Figure:
    """Part of the trials within an error, for each method."""
    figure = style.new_figure(7.2, 3.2)
    ax = figure.subplots()
    for k, method in enumerate(methods_of(records)):
        values = np.array(list(values_by_trial(records, method, metric).values()))
        trials = len(values)
        values = np.sort(values[np.isfinite(values)])
        colour, dash = style.method_style(method, k)
        share = np.arange(1, len(values) + 1) / max(1, trials)  # failures never come within any error
        ax.step(
            np.concatenate([values[:1], values]),  # up from 0: a single trial is a line, too
            np.concatenate([np.zeros(len(values[:1])), share]),
            where="post",
            color=colour,
            linestyle=dash,
            label=f"{method} ({len(values)} of {trials})",
        )
    ax.set(xlabel="trajectory RMSE [mm]", ylabel="part of the trials", ylim=(0, 1.02))
    _logarithmic(ax, "x")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def error_budget(budget: Mapping[str, Sequence[TrialRecord]], metric: str = "trajectory_rmse_mm") -> Figure:
    """Error with one disturbance at a time, by method: mean over trials, whisker to the 95th percentile."""
    methods = methods_of([r for records in budget.values() for r in records])
    figure = style.new_figure(7.2, 1.4 + 0.36 * len(budget))
    ax = figure.subplots()
    for k, method in enumerate(methods):
        colour, _ = style.method_style(method, k)
        s = [
            summarise(list(values_by_trial(records, method, metric).values())) for records in budget.values()
        ]
        y = np.arange(len(budget)) + 0.7 * ((k + 0.5) / max(1, len(methods)) - 0.5)
        ax.hlines(y, [x.mean for x in s], [x.p95 for x in s], color=colour, lw=1.0)
        ax.scatter([x.mean for x in s], y, s=16, color=colour, marker=_MARKS[k % len(_MARKS)], label=method)
    ax.set_yticks(range(len(budget)), list(budget))
    ax.invert_yaxis()
    for edge in np.arange(len(budget) - 1) + 0.5:
        ax.axhline(edge, color=style.GREY, lw=0.4)
    ax.grid(visible=False, axis="y")
    ax.set(xlabel=metric_heading(metric))
    _logarithmic(ax, "x")
    ax.set_title("One disturbance at a time: mean over trials, whisker to the 95th percentile")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def _sets_with(found: Mapping[Condition, object]) -> dict[str, list[Condition]]:
    """The paper's sets with the conditions that have traces; others in a set of their own."""
    sets = {name: [c for c in conditions if c in found] for name, conditions in CONDITION_SETS.items()}
    sets["other"] = [c for c in found if not sets_of(c)]
    return {name: conditions for name, conditions in sets.items() if conditions}


def _overlay(ax: Axes, traces: Sequence[TrialTraces], method: str, colour: str) -> None:
    truth = _finite_truth(traces)
    if truth is not None:
        ax.plot(truth[:, 0], truth[:, 1], color=style.TRUTH, lw=2.2, alpha=0.3)
    for trace in traces:
        p = trace.methods_mm.get(method)
        if p is not None:
            ax.plot(p[:, 0], p[:, 1], color=colour, lw=0.7, alpha=0.8)


def _finite_truth(traces: Sequence[TrialTraces]) -> FloatArray | None:
    return next((t.truth_mm for t in traces if len(t.truth_mm)), None)
