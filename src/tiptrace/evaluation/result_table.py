"""The result table of one trial: a row per method, and the paper's published row beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tiptrace.evaluation import published
from tiptrace.evaluation.metrics import TrialMetrics, evaluate
from tiptrace.evaluation.quality import assess
from tiptrace.evaluation.report_data import MethodResult
from tiptrace.evaluation.truth import Truth

COLUMNS = (
    "method",
    "trajectory RMSE [mm]",
    "shape RMSE [mm]",
    "initial contact error [mm]",
    "cross-track RMSE [mm]",
    "along-track RMSE [mm]",
    "loop rate [Hz]",
    "slowest … fastest [Hz]",
    "usable [%]",
    "quality",
)
_ACCURACY = (
    "trajectory_rmse_mm",
    "shape_rmse_mm",
    "initial_contact_error_mm",
    "cross_track_rmse_mm",
    "along_track_rmse_mm",
)
MISSING = "–"


@dataclass(frozen=True, slots=True)
class ResultRow:
    """One row as text, in the order of :data:`COLUMNS`; ``published`` marks the paper's own numbers."""

    cells: tuple[str, ...]
    published: bool = False


def result_rows(methods: Sequence[MethodResult], truth: Truth | None) -> list[ResultRow]:
    """Rows for every method and the paper's published row."""
    rows = [_row(m.name, evaluate(m.trajectory, truth), assess(m.trajectory).verdict) for m in methods]
    return [*rows, _published_row()]


def _row(name: str, metrics: TrialMetrics, verdict: str) -> ResultRow:
    rate = metrics.loop_rate_hz
    return ResultRow(
        (
            name,
            *(_number(getattr(metrics, field)) for field in _ACCURACY),
            MISSING if math.isnan(rate.mean) else f"{rate.mean:.1f}",
            MISSING if math.isnan(rate.min) else f"{rate.min:.1f} … {rate.max:.1f}",
            MISSING if math.isnan(metrics.usable_fraction) else f"{metrics.usable_fraction:.0%}".rstrip("%"),
            verdict,
        )
    )


def _published_row() -> ResultRow:
    cells = [f"paper ({published.LABEL})"]
    for name in _ACCURACY:
        value = published.PUBLISHED.get(name)
        cells.append(MISSING if value is None else f"{value.mean:.2f} ± {value.std:.2f}")
    rate = published.PUBLISHED["loop_rate_hz"]
    low, high = published.LOOP_RATE_RANGE_HZ
    speed = (f"{rate.mean:.2f} ± {rate.std:.2f}", f"{low} … {high}")
    return ResultRow((*cells, *speed, MISSING, MISSING), published=True)


def _number(value: float) -> str:
    return MISSING if math.isnan(value) else f"{value:.2f}"
