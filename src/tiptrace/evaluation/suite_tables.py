"""Tables over the trials of a suite, as in the paper and beyond it. Trials that failed are listed, not hidden."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from tiptrace.evaluation import published
from tiptrace.evaluation.conditions import CONDITION_SETS, VARIED
from tiptrace.evaluation.records import TrialRecord
from tiptrace.evaluation.statistics import Summary, compare, spearman, summarise
from tiptrace.evaluation.tables import Cell, Table, columns, mean_std, rows_of, show_interval, show_p
from tiptrace.types import FloatArray

BASELINES = ("ee-only", "ee-oracle", "nominal-tip", "local-anchoring")
MAIN_METRICS = ("trajectory_rmse_mm", "shape_rmse_mm", "initial_contact_error_mm")
_MORE = ("cross_track_rmse_mm", "along_track_rmse_mm", "frechet_mm")
_NAMES = {
    "trajectory_rmse_mm": "trajectory RMSE [mm]",
    "shape_rmse_mm": "shape RMSE [mm]",
    "initial_contact_error_mm": "initial contact error [mm]",
    "cross_track_rmse_mm": "cross-track RMSE [mm]",
    "along_track_rmse_mm": "along-track RMSE [mm]",
    "frechet_mm": "discrete Fréchet distance [mm]",
    "loop_rate_hz": "loop rate [Hz]",
}


def suite_tables(records: Sequence[TrialRecord]) -> list[Table]:
    """Every table that the records can fill, in the order of a report."""
    tables = [
        overall_table(records),
        distribution_table(records),
        sets_table(records),
        correlation_table(records),
        wins_table(records),
        coverage_table(records),
        analytic_table(records),
        events_table(records),
        failures_table(records),
    ]
    return [t for t in tables if t.rows]


def methods_of(records: Sequence[TrialRecord]) -> list[str]:
    """Methods in the order of their first record."""
    return list(dict.fromkeys(r.method for r in records))


def metric_heading(metric: str) -> str:
    """A metric's name with its unit, for headings and axes."""
    return _NAMES[metric]


def values_by_trial(records: Sequence[TrialRecord], method: str, metric: str) -> dict[str, float]:
    """A metric of one method by trial; the last record of a trial counts. NaN where it failed."""
    return {r.trial: r.value(metric) for r in records if r.method == method}


def aligned(records: Sequence[TrialRecord], methods: Sequence[str], metric: str) -> list[FloatArray]:
    """A metric of several methods over the trials that all of them were run on, in one order."""
    by_method = [values_by_trial(records, m, metric) for m in methods]
    trials = [t for t in by_method[0] if all(t in values for values in by_method)]
    return [np.array([values[t] for t in trials]) for values in by_method]


def overall_table(records: Sequence[TrialRecord]) -> Table:
    """Mean ± std over trials, as the paper's Table II, with its row beside ours."""
    names = (*MAIN_METRICS, "cross_track_rmse_mm", "along_track_rmse_mm", "loop_rate_hz")
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        trials = {r.trial: bool(r.failure) for r in records if r.method == method}
        lost = sum(trials.values())
        count = f"{len(trials) - lost} of {len(trials)}" if lost else len(trials)
        summaries = [summarise(list(values_by_trial(records, method, name).values())) for name in names]
        rate = summaries[-1]
        span = "–" if rate.n == 0 else f"{rate.min:.1f} … {rate.max:.1f}"
        rows.append([method, count, *(mean_std(s.mean, s.std) for s in summaries), span])
    paper = (published.PUBLISHED.get(name) for name in names)
    low, high = published.LOOP_RATE_RANGE_HZ
    cells = ["–" if p is None else mean_std(p.mean, p.std) for p in paper]
    rows.append([published.LABEL, published.TRIALS, *cells, f"{low} … {high}"])
    return Table(
        "overall",
        "Mean ± std over trials",
        columns(
            ("method", "method"),
            ("trials", "trials"),
            *((n, _NAMES[n]) for n in names),
            ("loop_rate_range_hz", "slowest … fastest trial [Hz]"),
        ),
        rows_of(rows) if methods_of(records) else (),
        "The last row is what the paper reports for its hardware; it is no result of these trials.",
    )


def distribution_table(records: Sequence[TrialRecord]) -> Table:
    """Median, 95th percentile and extremes of each metric."""
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        for name in (*MAIN_METRICS, *_MORE):
            s = summarise(list(values_by_trial(records, method, name).values()))
            if s.n:
                rows.append([method, _NAMES[name], s.n, s.mean, s.std, s.median, s.p95, s.min, s.max])
    heads = (("method", "method"), ("metric", "metric"), ("n", "n"), ("mean", "mean"), ("std", "std"))
    more = (("median", "median"), ("p95", "95 %"), ("min", "min"), ("max", "max"))
    return Table("distribution", "Distribution over trials", columns(*heads, *more), rows_of(rows))


def set_values(records: Sequence[TrialRecord], method: str, set_name: str, metric: str) -> FloatArray:
    """A metric over the trials of a condition set; a condition shared by sets counts in each."""
    conditions = set(CONDITION_SETS[set_name])
    last = {r.trial: r for r in records if r.method == method and r.condition in conditions}
    return np.array([r.value(metric) for r in last.values()], dtype=np.float64)


def sets_table(records: Sequence[TrialRecord]) -> Table:
    """Mean shape error of each condition set, beside the paper's range."""
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        per_set: list[Summary] = [
            summarise(set_values(records, method, s, "shape_rmse_mm")) for s in CONDITION_SETS
        ]
        if any(s.n for s in per_set):
            rows.append([method, *(_with_count(s) for s in per_set)])
    low, high = published.SET_SHAPE_RANGE_MM
    if rows:
        rows.append([published.LABEL, *[f"{low} … {high}"] * len(CONDITION_SETS)])
    return Table(
        "sets",
        "Shape RMSE by condition set [mm], mean ± std (trials)",
        columns(("method", "method"), *((f"set_{s}", f"set {s}: {VARIED[s]}") for s in CONDITION_SETS)),
        rows_of(rows),
        "A condition that sets share counts in each of them.",
    )


def correlation_table(records: Sequence[TrialRecord]) -> Table:
    """Spearman's ρ of initial contact error against each RMSE."""
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        contact = values_by_trial(records, method, "initial_contact_error_mm")
        for name in ("trajectory_rmse_mm", "shape_rmse_mm"):
            other = values_by_trial(records, method, name)
            c = spearman([contact[t] for t in contact], [other[t] for t in contact])
            if c.n >= 4:
                interval = show_interval(c.low, c.high)
                rows.append(
                    [method, _NAMES[name], c.n, c.rho, interval, show_p(c.p_value), published.SPEARMAN[name]]
                )
    return Table(
        "correlation",
        "Spearman's ρ of the initial contact error against each RMSE",
        columns(
            *(
                ("method", "method"),
                ("metric", "against"),
                ("n", "n"),
                ("rho", "ρ"),
                ("interval", "95 % interval"),
            ),
            *(("p_value", "p"), ("paper_rho", "ρ in the paper")),
        ),
        rows_of(rows),
        "Intervals: percentile bootstrap over trials.",
    )


def wins_table(records: Sequence[TrialRecord]) -> Table:
    """Every method against every baseline, trial by trial."""
    present = methods_of(records)
    rows: list[list[Cell]] = []
    for method in (m for m in present if m not in BASELINES):
        rivals = [m for m in present if m != method and (m in BASELINES or m == "paper")]
        for rival in rivals:
            for name in (*MAIN_METRICS[:2], "cross_track_rmse_mm"):
                ours, theirs = aligned(records, (method, rival), name)
                c = compare(ours, theirs)
                if c.n:
                    counts = [c.n, c.wins, c.losses, c.median_difference]
                    doubt = [show_interval(c.low, c.high), show_p(c.p_value)]
                    rows.append([method, rival, _NAMES[name], *counts, *doubt])
    return Table(
        "wins",
        "Trial by trial against each baseline",
        columns(
            *(
                ("method", "method"),
                ("baseline", "against"),
                ("metric", "metric"),
                ("n", "n"),
                ("wins", "wins"),
            ),
            *(("losses", "losses"), ("median_difference_mm", "median difference [mm]")),
            *(("interval", "95 % interval"), ("p_value", "p (Wilcoxon)")),
        ),
        rows_of(rows),
        "Difference: method − baseline, negative is better. Two-sided signed-rank test; intervals by bootstrap.",
    )


def coverage_table(records: Sequence[TrialRecord]) -> Table:
    """How often the 95 % region of the covariance holds the truth."""
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        coverage = summarise(list(values_by_trial(records, method, "coverage_95").values()))
        nees = summarise(list(values_by_trial(records, method, "nees_median").values()))
        if coverage.n:
            rows.append([method, coverage.n, 100 * coverage.mean, 100 * coverage.min, nees.median])
    return Table(
        "coverage",
        "Coverage of the 95 % covariance region",
        columns(
            *(("method", "method"), ("n", "trials"), ("coverage_percent", "coverage [%]", 1)),
            *(("worst_percent", "worst trial [%]", 1), ("nees_median", "median NEES")),
        ),
        rows_of(rows),
        "95 % and a median NEES of 2.37 are right; above is cautious, below is overconfident.",
    )


def analytic_table(records: Sequence[TrialRecord]) -> Table:
    """Errors against the paper's analytic curve, where they were computed."""
    names = (*MAIN_METRICS, "cross_track_rmse_mm")
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        found = [summarise(list(values_by_trial(records, method, f"analytic_{n}").values())) for n in names]
        if any(s.n for s in found):
            rows.append([method, max(s.n for s in found), *(mean_std(s.mean, s.std) for s in found)])
    return Table(
        "analytic",
        "Against the analytic centreline anchored at the measured start, mean ± std",
        columns(("method", "method"), ("n", "trials"), *((f"analytic_{n}", _NAMES[n]) for n in names)),
        rows_of(rows),
        "The paper's ground truth: the tip is taken to advance with the end effector, so friction drag is error.",
    )


def events_table(records: Sequence[TrialRecord]) -> Table:
    """Events hit, missed and raised without cause."""
    totals: dict[tuple[str, str], list[int]] = defaultdict(lambda: [0, 0, 0])
    for record in records:
        for kind, counts in (record.events or {}).items():
            for k, count in enumerate(counts):
                totals[record.method, kind][k] += count
    heads = (
        ("method", "method"),
        ("kind", "event"),
        ("hits", "hit"),
        ("misses", "missed"),
        ("false", "false alarms"),
    )
    return Table(
        "events",
        "Events",
        columns(*heads),
        rows_of([[*key, *counts] for key, counts in totals.items() if any(counts)]),
    )


def budget_table(budget: Mapping[str, Sequence[TrialRecord]]) -> Table:
    """Errors with one disturbance at a time: where they enter, at the anchor or on the way."""
    rows: list[list[Cell]] = []
    for name, records in budget.items():
        for method in methods_of(records):
            found = [summarise(list(values_by_trial(records, method, m).values())) for m in MAIN_METRICS]
            rows.append([name, method, found[0].n, *(mean_std(s.mean, s.std) for s in found)])
    return Table(
        "budget",
        "Error budget: one disturbance at a time, mean ± std",
        columns(
            *(("disturbance", "disturbance"), ("method", "method"), ("n", "trials")),
            *((m, _NAMES[m]) for m in MAIN_METRICS),
        ),
        rows_of(rows),
    )


def failures_table(records: Sequence[TrialRecord]) -> Table:
    """What gave no result, by name and reason; methods that failed alike in a row of their own."""
    alike: dict[tuple[str, str], list[str]] = defaultdict(list)
    run: dict[str, int] = defaultdict(int)
    for record in records:
        run[record.trial] += 1
        if record.failure:
            alike[record.trial, record.failure].append(record.method)
    rows = [
        [trial, "all" if 1 < len(methods) == run[trial] else ", ".join(methods), reason]
        for (trial, reason), methods in alike.items()
    ]
    heads = (("trial", "trial"), ("method", "method"), ("reason", "reason"))
    return Table("failures", "Failures", columns(*heads), rows_of(rows))


def without_truth(records: Sequence[TrialRecord]) -> list[str]:
    """Trials that have results and nothing to hold them against, in order."""
    measured = {r.trial: False for r in records if not r.failure}
    for record in records:
        if record.metrics is not None and record.metrics.evaluated_frames:
            measured[record.trial] = True
    return [trial for trial, known in measured.items() if not known]


def outliers(
    records: Sequence[TrialRecord], method: str, metric: str = "trajectory_rmse_mm"
) -> list[TrialRecord]:
    """Trials above the upper quartile by more than 1.5 interquartile ranges, worst first."""
    found = [r for r in records if r.method == method and math.isfinite(r.value(metric))]
    if len(found) < 4:
        return []
    low, high = np.percentile([r.value(metric) for r in found], [25, 75])
    worst = [r for r in found if r.value(metric) > high + 1.5 * (high - low)]
    return sorted(worst, key=lambda r: -r.value(metric))


def _with_count(s: Summary) -> str:
    return "–" if s.n == 0 else f"{mean_std(s.mean, s.std)} ({s.n})"
