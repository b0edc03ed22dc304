"""Tables of a suite beside its errors: events, error budget, failures."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from tiptrace.evaluation.records import TrialRecord
from tiptrace.evaluation.statistics import summarise
from tiptrace.evaluation.suite_values import (
    MAIN_METRICS,
    counted,
    methods_of,
    metric_heading,
    trials_of,
    values_by_trial,
)
from tiptrace.evaluation.tables import Cell, Table, columns, mean_std, rows_of


def events_table(records: Sequence[TrialRecord]) -> Table:
    """Events hit, missed and raised without cause, and how late the hits were."""
    totals: dict[tuple[str, str], list[int]] = defaultdict(lambda: [0, 0, 0])
    delays: dict[tuple[str, str], list[float]] = defaultdict(list)
    for record in records:
        for kind, counts in (record.events or {}).items():
            for k, count in enumerate(counts):
                totals[record.method, kind][k] += count
        for kind, late in (record.event_delays_s or {}).items():
            delays[record.method, kind] += late
    rows: list[list[Cell]] = []
    for key, (hits, misses, false) in totals.items():
        if hits or misses or false:
            delay = f"{np.median(delays[key]):.2f}" if delays[key] else "–"
            rows.append([*key, hits, misses, false, delay])
    heads = (("method", "method"), ("kind", "event"), ("hits", "hit"), ("misses", "missed"))
    more = (("false", "false alarms"), ("delay_s", "median delay [s]"))
    return Table(
        "events",
        "Events",
        columns(*heads, *more),
        rows_of(rows),
        "Told within 0.5 s of a true event: losses of contact from 0.2 s on, slips of 1.5° or 0.5 mm within half a "
        "second. Slighter ones count in nothing. Delay: from the start of the true event.",
    )


def budget_table(budget: Mapping[str, Sequence[TrialRecord]]) -> Table:
    """Errors with one disturbance at a time: where they enter, at the anchor or on the way."""
    rows: list[list[Cell]] = []
    for name, records in budget.items():
        for method in methods_of(records):
            found = [summarise(list(values_by_trial(records, method, m).values())) for m in MAIN_METRICS]
            rows.append(
                [
                    name,
                    method,
                    counted(found[0].n, trials_of(records, method)),
                    *(mean_std(s.mean, s.std) for s in found),
                ]
            )
    return Table(
        "budget",
        "Error budget: one disturbance at a time, mean ± std",
        columns(
            *(("disturbance", "disturbance"), ("method", "method"), ("n", "trials")),
            *((m, metric_heading(m)) for m in MAIN_METRICS),
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
