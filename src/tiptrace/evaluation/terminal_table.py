"""The overall table for a terminal of 80 columns: a row per method, errors alone, loop rates in a line below."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tiptrace.evaluation import published
from tiptrace.evaluation.records import TrialRecord
from tiptrace.evaluation.statistics import summarise
from tiptrace.evaluation.suite_values import MAIN_METRICS, methods_of, values_by_trial
from tiptrace.evaluation.tables import MISSING, Table, columns, rows_of

TITLE = "Errors over trials [mm], mean ± std"
_METRICS = (*MAIN_METRICS, "cross_track_rmse_mm")
_HEADINGS = ("trajectory", "shape", "contact", "cross-track")


def terminal_table(records: Sequence[TrialRecord]) -> Table:
    """Errors by method beside the published ones; the note holds the loop rates."""
    rows = []
    rates = []
    for method in methods_of(records):
        trials = {r.trial: bool(r.failure) for r in records if r.method == method}
        done = len(trials) - sum(trials.values())
        count = f"{done}/{len(trials)}" if done < len(trials) else str(done)
        found = [summarise(list(values_by_trial(records, method, m).values())) for m in _METRICS]
        rows.append([method, count, *(_short(s.mean, s.std) for s in found)])
        rate = summarise(list(values_by_trial(records, method, "loop_rate_hz").values()))
        if rate.n:
            rates.append(f"{method} {_short(rate.mean, rate.std)}")
    paper = [published.PUBLISHED.get(m) for m in _METRICS]
    cells = [MISSING if p is None else _short(p.mean, p.std) for p in paper]
    rows.append(["published", str(published.TRIALS), *cells])
    hardware = published.PUBLISHED["loop_rate_hz"]
    rates.append(f"published {_short(hardware.mean, hardware.std)}")
    heads = (("method", "method"), ("trials", "trials"), *zip(_METRICS, _HEADINGS, strict=True))
    note = f"loop rate [Hz]: {', '.join(rates)}. Published: the paper's hardware, no result of these trials."
    return Table("terminal", TITLE, columns(*heads), rows_of(rows) if methods_of(records) else (), note)


def _short(mean: float, std: float) -> str:
    """Three figures at least: 0.23 ± 0.09, 47.5 ± 15.0, 152 ± 61."""
    if math.isnan(mean):
        return MISSING
    digits = 2 if mean < 10 else 1 if mean < 100 else 0
    return f"{mean:.{digits}f}" + ("" if math.isnan(std) else f" ± {std:.{digits}f}")
