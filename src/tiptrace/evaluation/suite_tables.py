"""Tables over the trials of a suite, as in the paper and beyond it. Trials that failed are listed, not hidden."""

from __future__ import annotations

from collections.abc import Sequence

from tiptrace.evaluation import published
from tiptrace.evaluation.conditions import CONDITION_SETS, VARIED
from tiptrace.evaluation.records import TrialRecord
from tiptrace.evaluation.statistics import Summary, compare, spearman, summarise
from tiptrace.evaluation.suite_side_tables import events_table, failures_table
from tiptrace.evaluation.suite_values import (
    BASELINES,
    MAIN_METRICS,
    MORE_METRICS,
    NAMES,
    aligned,
    counted,
    methods_of,
    over_the_others,
    set_trials,
    set_values,
    trials_of,
    values_by_trial,
    with_count,
)
from tiptrace.evaluation.tables import Cell, Table, columns, mean_std, rows_of, show_interval, show_p


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
    paper_cells = ["–" if p is None else mean_std(p.mean, p.std) for p in paper]
    rows.append([published.LABEL, published.TRIALS, *paper_cells, f"{low} … {high}"])
    return Table(
        "overall",
        "Mean ± std over trials",
        columns(
            ("method", "method"),
            ("trials", "trials"),
            *((n, NAMES[n]) for n in names),
            ("loop_rate_range_hz", "slowest … fastest trial [Hz]"),
        ),
        rows_of(rows) if methods_of(records) else (),
        _sentences(
            "The last row is what the paper reports for its hardware; it is no result of these trials.",
            over_the_others(records),
        ),
    )


def distribution_table(records: Sequence[TrialRecord]) -> Table:
    """Median, 95th percentile and extremes of each metric."""
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        trials = trials_of(records, method)
        for name in (*MAIN_METRICS, *MORE_METRICS):
            s = summarise(list(values_by_trial(records, method, name).values()))
            if s.n:
                rows.append(
                    [method, NAMES[name], counted(s.n, trials), s.mean, s.std, s.median, s.p95, s.min, s.max]
                )
    heads = (("method", "method"), ("metric", "metric"), ("n", "n"), ("mean", "mean"), ("std", "std"))
    more = (("median", "median"), ("p95", "95 %"), ("min", "min"), ("max", "max"))
    return Table(
        "distribution",
        "Distribution over trials",
        columns(*heads, *more),
        rows_of(rows),
        over_the_others(records),
    )


def sets_table(records: Sequence[TrialRecord]) -> Table:
    """Mean shape error of each condition set, beside the paper's range."""
    rows: list[list[Cell]] = []
    for method in methods_of(records):
        per_set: list[Summary] = [
            summarise(set_values(records, method, s, "shape_rmse_mm")) for s in CONDITION_SETS
        ]
        cells = [
            with_count(s, set_trials(records, method, n))
            for s, n in zip(per_set, CONDITION_SETS, strict=True)
        ]
        if any(s.n for s in per_set):
            rows.append([method, *cells])
    low, high = published.SET_SHAPE_RANGE_MM
    if rows:
        rows.append([published.LABEL, *[f"{low} … {high}"] * len(CONDITION_SETS)])
    return Table(
        "sets",
        "Shape RMSE by condition set [mm], mean ± std (trials)",
        columns(("method", "method"), *((f"set_{s}", f"set {s}: {VARIED[s]}") for s in CONDITION_SETS)),
        rows_of(rows),
        _sentences("A condition that sets share counts in each of them.", over_the_others(records)),
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
                n = counted(c.n, trials_of(records, method))
                rows.append(
                    [method, NAMES[name], n, c.rho, interval, show_p(c.p_value), published.SPEARMAN[name]]
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
                    of = min(trials_of(records, method), trials_of(records, rival))
                    counts: list[Cell] = [counted(c.n, of), c.wins, c.losses, c.median_difference]
                    doubt = [show_interval(c.low, c.high), show_p(c.p_value)]
                    rows.append([method, rival, NAMES[name], *counts, *doubt])
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
            n = counted(coverage.n, trials_of(records, method))
            rows.append([method, n, 100 * coverage.mean, 100 * coverage.min, nees.median])
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
            n = counted(max(s.n for s in found), trials_of(records, method))
            rows.append([method, n, *(mean_std(s.mean, s.std) for s in found)])
    return Table(
        "analytic",
        "Against the analytic centreline anchored at the measured start, mean ± std",
        columns(("method", "method"), ("n", "trials"), *((f"analytic_{n}", NAMES[n]) for n in names)),
        rows_of(rows),
        "The paper's ground truth: the tip is taken to advance with the end effector, so friction drag is error.",
    )


def _sentences(*parts: str) -> str:
    return " ".join(part for part in parts if part)
