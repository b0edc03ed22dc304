"""One row per trial and method: what suite tables are made of, and the small file that keeps it."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from tiptrace.errors import MissingExtraError, OutputError
from tiptrace.evaluation.conditions import Condition
from tiptrace.evaluation.metrics import LoopRate, TrialMetrics

_ANALYTIC = ("trajectory_rmse_mm", "shape_rmse_mm", "initial_contact_error_mm", "cross_track_rmse_mm")
_COUNTS = {"frames", "anchoring_frames", "reconstruction_frames", "evaluated_frames"}

_TEXTS = (
    "trial",
    "method",
    "trajectory",
    "tool",
    "wrist",
    "grasp",
    "level",
    "verdict",
    "failure",
    "report",
    "events",
    "event_delays_s",
)


@dataclass(frozen=True, slots=True)
class TrialRecord:
    """Result of one method on one trial.

    Attributes:
        trial: Name of the trial, unique in a suite; the recording's path or the condition with its repeat.
        method: Method.
        metrics: Its numbers; None where it failed.
        condition: What was varied; None for recordings that do not say.
        level: Disturbance level of a simulated trial, else empty.
        seed: Seed of a simulated trial.
        verdict: Quality without ground truth.
        failure: Why there is no result; empty where there is one.
        analytic: Errors against the paper's analytic curve, by metric, where that was asked for.
        events: Hits, misses and false alarms by kind, where the true events are known.
        event_delays_s: How late each hit was told, by kind.
        report: Path of the trial's own report, relative to the suite's.
    """

    trial: str
    method: str
    metrics: TrialMetrics | None = None
    condition: Condition | None = None
    level: str = ""
    seed: int | None = None
    verdict: str = ""
    failure: str = ""
    analytic: Mapping[str, float] | None = None
    events: Mapping[str, tuple[int, int, int]] | None = None
    event_delays_s: Mapping[str, tuple[float, ...]] | None = None
    report: str = ""

    def value(self, metric: str) -> float:
        """A number by its name; ``loop_rate_hz`` is the trial's mean rate, ``analytic_…`` the analytic error."""
        if metric.startswith("analytic_"):
            return float((self.analytic or {}).get(metric.removeprefix("analytic_"), math.nan))
        if self.metrics is None:
            return math.nan
        if metric == "loop_rate_hz":
            return self.metrics.loop_rate_hz.mean
        return float(getattr(self.metrics, metric))


def analytic_errors(metrics: TrialMetrics) -> dict[str, float]:
    """The errors that are worth keeping of an evaluation against the analytic curve."""
    return {name: getattr(metrics, name) for name in _ANALYTIC if math.isfinite(getattr(metrics, name))}


def to_row(record: TrialRecord) -> dict[str, Any]:
    """Flat row of plain values; None where a number is not known."""
    condition = record.condition
    row: dict[str, Any] = {
        "trial": record.trial,
        "method": record.method,
        "trajectory": condition and condition.trajectory,
        "tool": condition and condition.tool,
        "wrist": condition and condition.wrist,
        "grasp": condition and condition.grasp,
        "level": record.level,
        "seed": record.seed,
        "verdict": record.verdict,
        "failure": record.failure,
        "report": record.report,
        "events": _as_json(record.events),
        "event_delays_s": _as_json(record.event_delays_s),
    }
    for field in fields(TrialMetrics):
        value = getattr(record.metrics, field.name) if record.metrics else None
        if field.name == "loop_rate_hz":
            rate = asdict(value) if value else dict.fromkeys(("mean", "std", "min", "max"))
            row |= {f"loop_rate_{name}_hz": _known(v) for name, v in rate.items()}
        else:
            row[field.name] = _known(value)
    analytic = record.analytic or {}
    return row | {f"analytic_{name}": _known(analytic.get(name)) for name in _ANALYTIC}


def from_row(row: Mapping[str, Any]) -> TrialRecord:
    """Record of a flat row.

    Raises:
        KeyError: a column is missing.
        ValueError: a value cannot be understood.
    """
    parts = [row[name] for name in ("trajectory", "tool", "wrist", "grasp")]
    analytic = {
        name: float(row[f"analytic_{name}"]) for name in _ANALYTIC if row[f"analytic_{name}"] is not None
    }
    return TrialRecord(
        trial=row["trial"],
        method=row["method"],
        metrics=None if row["frames"] is None else _metrics(row),
        condition=Condition(*parts) if all(parts) else None,
        level=row["level"] or "",
        seed=None if row["seed"] is None else int(row["seed"]),
        verdict=row["verdict"] or "",
        failure=row["failure"] or "",
        analytic=analytic or None,
        events=_from_json(row["events"]),
        event_delays_s=_from_json(row.get("event_delays_s")),  # older files have none
        report=row["report"] or "",
    )


def write_records(path: Path, records: Iterable[TrialRecord]) -> None:
    """Write records as ``.parquet`` or ``.csv``, by the path's suffix.

    Raises:
        OutputError: another suffix, or the file cannot be written.
        MissingExtraError: Parquet without pyarrow.
    """
    from tiptrace.evaluation.atomic import write_atomic

    rows = [to_row(r) for r in records]
    if path.suffix == ".parquet":
        content = _parquet_bytes(rows)
    elif path.suffix == ".csv":
        content = _csv_bytes(rows)
    else:
        raise OutputError(f"{path}: records are written as .parquet or .csv")
    write_atomic(path, content)


def read_records(path: Path) -> list[TrialRecord]:
    """Records of a file that :func:`write_records` wrote.

    Raises:
        OutputError: the file cannot be read or understood.
        MissingExtraError: Parquet without pyarrow.
    """
    try:
        rows = _read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
        return [from_row(row) for row in rows]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise OutputError(f"{path}: not a file of trial records ({error})") from None


def _metrics(row: Mapping[str, Any]) -> TrialMetrics:
    rate = LoopRate(*(_float(row[f"loop_rate_{name}_hz"]) for name in ("mean", "std", "min", "max")))
    numbers = {
        f.name: int(row[f.name]) if f.name in _COUNTS else _float(row[f.name])
        for f in fields(TrialMetrics)
        if f.name != "loop_rate_hz"
    }
    return TrialMetrics(loop_rate_hz=rate, **numbers)  # type: ignore[arg-type]


def _parquet_bytes(rows: list[dict[str, Any]]) -> bytes:
    pa, parquet = _pyarrow()
    names = list(to_row(TrialRecord("", "")))
    types = {
        n: pa.string() if n in _TEXTS else pa.int64() if n in _COUNTS | {"seed"} else pa.float64()
        for n in names
    }
    table = pa.Table.from_pylist(rows, schema=pa.schema(list(types.items())))
    buffer = io.BytesIO()
    parquet.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def _read_parquet(path: Path) -> list[dict[str, Any]]:
    _, parquet = _pyarrow()
    rows: list[dict[str, Any]] = parquet.read_table(path).to_pylist()
    return rows


def _csv_bytes(rows: list[dict[str, Any]]) -> bytes:
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(to_row(TrialRecord("", ""))), lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: "" if v is None else v for k, v in row.items()} for row in rows)
    return buffer.getvalue().encode()


def _read_csv(path: Path) -> list[dict[str, Any]]:
    with path.open(encoding="utf-8", newline="") as file:
        return [{k: v or None for k, v in row.items()} for row in csv.DictReader(file)]


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("pyarrow", "tables") from None
    return pyarrow, pyarrow.parquet


def _as_json(counts: Mapping[str, tuple[float, ...]] | None) -> str | None:
    return None if counts is None else json.dumps(dict(counts), sort_keys=True)


def _from_json(text: str | None) -> dict[str, Any] | None:
    return None if text is None else {kind: tuple(values) for kind, values in json.loads(text).items()}


def _known(value: float | None) -> float | None:
    return None if value is None or (isinstance(value, float) and not math.isfinite(value)) else value


def _float(value: Any) -> float:
    return math.nan if value is None else float(value)
