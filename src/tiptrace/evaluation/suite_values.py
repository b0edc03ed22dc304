"""Values of a suite's records by method, trial and condition set, and how they are counted."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tiptrace.evaluation.conditions import CONDITION_SETS
from tiptrace.evaluation.records import TrialRecord
from tiptrace.evaluation.statistics import Summary
from tiptrace.evaluation.tables import mean_std
from tiptrace.types import FloatArray

BASELINES = ("ee-only", "ee-oracle", "nominal-tip", "local-anchoring")
MAIN_METRICS = ("trajectory_rmse_mm", "shape_rmse_mm", "initial_contact_error_mm")
MORE_METRICS = ("cross_track_rmse_mm", "along_track_rmse_mm", "frechet_mm")
NAMES = {
    "trajectory_rmse_mm": "trajectory RMSE [mm]",
    "shape_rmse_mm": "shape RMSE [mm]",
    "initial_contact_error_mm": "initial contact error [mm]",
    "cross_track_rmse_mm": "cross-track RMSE [mm]",
    "along_track_rmse_mm": "along-track RMSE [mm]",
    "frechet_mm": "discrete Fréchet distance [mm]",
    "loop_rate_hz": "loop rate [Hz]",
}
LOST = "Where some trials were refused or failed, numbers are over the others; failures are listed by name."


def methods_of(records: Sequence[TrialRecord]) -> list[str]:
    """Methods in the order of their first record."""
    return list(dict.fromkeys(r.method for r in records))


def metric_heading(metric: str) -> str:
    """A metric's name with its unit, for headings and axes."""
    return NAMES[metric]


def values_by_trial(records: Sequence[TrialRecord], method: str, metric: str) -> dict[str, float]:
    """A metric of one method by trial; the last record of a trial counts. NaN where it failed."""
    return {r.trial: r.value(metric) for r in records if r.method == method}


def aligned(records: Sequence[TrialRecord], methods: Sequence[str], metric: str) -> list[FloatArray]:
    """A metric of several methods over the trials that all of them were run on, in one order."""
    by_method = [values_by_trial(records, m, metric) for m in methods]
    trials = [t for t in by_method[0] if all(t in values for values in by_method)]
    return [np.array([values[t] for t in trials]) for values in by_method]


def trials_of(records: Sequence[TrialRecord], method: str) -> int:
    """How many trials a method was run on, those that it refused included."""
    return len({r.trial for r in records if r.method == method})


def counted(n: int, of: int) -> int | str:
    """A count of trials for a cell: ``51``, or ``50 of 51`` where one gave no value."""
    return n if n == of else f"{n} of {of}"


def over_the_others(records: Sequence[TrialRecord]) -> str:
    """A sentence for a table's note, where a trial gave no result; else empty."""
    return LOST if any(r.failure for r in records) else ""


def set_values(records: Sequence[TrialRecord], method: str, set_name: str, metric: str) -> FloatArray:
    """A metric over the trials of a condition set; a condition shared by sets counts in each."""
    conditions = set(CONDITION_SETS[set_name])
    last = {r.trial: r for r in records if r.method == method and r.condition in conditions}
    return np.array([r.value(metric) for r in last.values()], dtype=np.float64)


def set_trials(records: Sequence[TrialRecord], method: str, set_name: str) -> int:
    """How many trials of a condition set a method was run on."""
    conditions = set(CONDITION_SETS[set_name])
    return len({r.trial for r in records if r.method == method and r.condition in conditions})


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


def with_count(s: Summary, of: int) -> str:
    """Mean ± std with the number of trials behind it."""
    return "–" if s.n == 0 else f"{mean_std(s.mean, s.std)} ({counted(s.n, of)})"
