"""What a reconstruction leaves on disk, and reading it back.

::

    DIR/
      trajectory.tum    t x y z qx qy qz qw, s and m; rows without a position left out
      trajectory.csv    a row for every image pair (COLUMNS)
      events.json       [{kind, start_ns, end_ns, detail}]
      metrics.json      method, frames, loop rate, anchor, quality; accuracy where there is a ground truth

Every file appears whole or not at all.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.errors import GeometryError, OutputError
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.evaluation.metrics import TrialMetrics
from tiptrace.evaluation.quality import Quality
from tiptrace.geometry.transforms import quaternion_from_rotation, rotation_from_quaternion
from tiptrace.types import Anchor, Event, FloatArray, Phase, Status, TipEstimate, TipTrajectory

TUM, CSV, EVENTS, METRICS = "trajectory.tum", "trajectory.csv", "events.json", "metrics.json"

COLUMNS = (
    *("stamp_ns", "phase", "status", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    *("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2"),
    *("residual_m", "markers", "loop_ms"),
)
_UPPER = np.triu_indices(3)  # order of the covariance columns


def write_results(
    folder: Path,
    trajectory: TipTrajectory,
    method: str,
    metrics: TrialMetrics,
    quality: Quality,
    using: Mapping[str, str] | None = None,
) -> None:
    """Write all files of a reconstruction into a folder, which is made where it is missing.

    Args:
        folder: Where.
        trajectory: What.
        method: That made it.
        metrics: Of it.
        quality: Of it.
        using: What stood in for the usual means, as text; smoothed estimates are no longer causal.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    write_atomic(folder / TUM, tum_text(trajectory.estimates))
    write_atomic(folder / CSV, csv_text(trajectory.estimates))
    write_atomic(folder / EVENTS, json.dumps([asdict(e) for e in trajectory.events], indent=1) + "\n")
    record = metrics_record(method, trajectory.anchor, metrics, quality)
    record |= {"estimates": "smoothed" if (using or {}).get("smooth") else "causal"}
    record |= {"using": dict(using)} if using else {}
    write_atomic(folder / METRICS, json.dumps(record, indent=1, allow_nan=False) + "\n")


def tum_text(estimates: Iterable[TipEstimate]) -> str:
    """TUM trajectory: orientation R_t R_B_E(0), identity where the motion is unknown."""
    lines = []
    for e in estimates:
        if e.p_B is None:
            continue
        q = quaternion_from_rotation(np.eye(3) if e.R_B_E is None else e.R_B_E)  # (4,) xyzw
        seconds = f"{e.stamp_ns // 1_000_000_000}.{e.stamp_ns % 1_000_000_000:09d}"
        lines.append(" ".join([seconds, *(_number(v) for v in (*e.p_B, *q))]))
    return "\n".join([*lines, ""])


def csv_text(estimates: Iterable[TipEstimate]) -> str:
    """One row per image pair; what is not known is empty, never stale."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(_row(e) for e in estimates)
    return buffer.getvalue()


def metrics_record(
    method: str, anchor: Anchor | None, metrics: TrialMetrics, quality: Quality
) -> dict[str, Any]:
    """Content of ``metrics.json``; what is not known is null, accuracy without a truth left out."""
    record: dict[str, Any] = {
        "method": method,
        "frames": metrics.frames,
        "anchoring_frames": metrics.anchoring_frames,
        "reconstruction_frames": metrics.reconstruction_frames,
        "usable_fraction": _finite(metrics.usable_fraction),
        "loop_rate_hz": {name: _finite(value) for name, value in asdict(metrics.loop_rate_hz).items()},
        "anchor": None if anchor is None else _anchor_record(anchor),
    }
    accuracy = metrics.accuracy()
    if accuracy:
        record |= {"evaluated_frames": metrics.evaluated_frames, **accuracy}
    return record | {"quality": {"verdict": quality.verdict, "reasons": list(quality.reasons)}}


def read_results(folder: Path) -> TipTrajectory:
    """Trajectory, events and anchor of a results folder.

    Raises:
        OutputError: a file is missing, or is not what :func:`write_results` writes.
    """
    record = _load_json(folder / METRICS)
    events = _load_json(folder / EVENTS)
    try:
        anchor = None if record["anchor"] is None else _read_anchor(record["anchor"])
        return TipTrajectory(read_csv(folder / CSV), [Event(**e) for e in events], anchor)
    except (KeyError, TypeError, ValueError) as error:
        raise OutputError(
            f"{folder}: {METRICS} or {EVENTS} is not as tiptrace writes it ({error!r})"
        ) from None


def read_csv(path: Path) -> list[TipEstimate]:
    """Estimates of a ``trajectory.csv``.

    Raises:
        OutputError: the file cannot be read, or a row cannot be understood.
    """
    rows = csv.DictReader(io.StringIO(_load_text(path)))
    missing = [c for c in COLUMNS if c not in (rows.fieldnames or ())]
    if missing:
        raise OutputError(f"{path}: lacks the column(s) {', '.join(missing)}; expected {', '.join(COLUMNS)}")
    return list(_estimates(path, rows))


def read_tum(path: Path) -> list[TipEstimate]:
    """Positions and orientations of a TUM file; phase and status are not in it: all rows count as usable.

    Raises:
        OutputError: the file cannot be read, or a line is not ``t x y z qx qy qz qw``.
    """
    estimates = []
    for number, line in enumerate(_load_text(path).splitlines(), start=1):
        cells = line.split("#")[0].replace(",", " ").split()
        if not cells:
            continue
        try:
            if len(cells) != 8:
                raise ValueError(f"{len(cells)} numbers instead of 8")
            numbers = np.array([float(c) for c in cells[1:]])  # x y z qx qy qz qw
            stamp = int(Decimal(cells[0]).scaleb(9).to_integral_value())
            R = rotation_from_quaternion(numbers[3:])
        except (ValueError, ArithmeticError, GeometryError) as error:
            raise OutputError(f"{path}, line {number}: not `t x y z qx qy qz qw` ({error})") from None
        estimates.append(TipEstimate(stamp, None, Status.OK, p_B=numbers[:3], R_B_E=R))
    return estimates


def read_any(path: Path) -> list[TipEstimate]:
    """Estimates of a results folder, a ``trajectory.csv`` or a TUM file.

    Raises:
        OutputError: see the reader of each.
    """
    if path.is_dir():
        return read_csv(path / CSV)
    return read_csv(path) if path.suffix == ".csv" else read_tum(path)


def _estimates(path: Path, rows: Iterable[dict[str, str]]) -> Iterator[TipEstimate]:
    for number, row in enumerate(rows, start=2):
        try:
            yield _estimate(row)
        except (ValueError, TypeError, GeometryError) as error:
            raise OutputError(f"{path}, line {number}: cannot be understood ({error})") from None


def _row(e: TipEstimate) -> list[str]:
    q = None if e.R_B_E is None else quaternion_from_rotation(e.R_B_E)
    covariance = None if e.covariance is None else e.covariance[_UPPER]
    return [
        str(e.stamp_ns),
        "" if e.phase is None else e.phase.value,
        e.status.value,
        *_numbers(e.p_B, 3),
        *_numbers(q, 4),
        *_numbers(covariance, 6),
        "" if e.residual_m is None else _number(e.residual_m),
        str(e.markers),
        "" if e.loop_ms is None else f"{e.loop_ms:.4f}",
    ]


def _estimate(row: dict[str, str]) -> TipEstimate:
    q = _vector(row, "qx", "qy", "qz", "qw")
    upper = _vector(row, *COLUMNS[10:16])
    covariance = None
    if upper is not None:
        covariance = np.zeros((3, 3))
        covariance[_UPPER] = upper
        covariance = covariance + np.triu(covariance, 1).T
    return TipEstimate(
        stamp_ns=int(row["stamp_ns"]),
        phase=Phase(row["phase"]) if row["phase"] else None,
        status=Status(row["status"]),
        p_B=_vector(row, "x_m", "y_m", "z_m"),
        R_B_E=None if q is None else rotation_from_quaternion(q),
        covariance=covariance,
        residual_m=float(row["residual_m"]) if row["residual_m"] else None,
        markers=int(row["markers"]),
        loop_ms=float(row["loop_ms"]) if row["loop_ms"] else None,
    )


def _vector(row: dict[str, str], *names: str) -> FloatArray | None:
    cells = [row[name] for name in names]
    if not any(cells):
        return None
    return np.array([float(cell) for cell in cells])


def _anchor_record(anchor: Anchor) -> dict[str, Any]:
    covariance = anchor.covariance
    return {
        "p_B_m": [float(v) for v in anchor.p_B],
        "std_mm": None if covariance is None else [float(v) * 1e3 for v in np.sqrt(np.diag(covariance))],
        "covariance_m2": None if covariance is None else covariance.tolist(),
        "residual_mm": _finite(anchor.residual_m * 1e3),
        "frames": anchor.frames,
        "weak_axes": [[float(v) for v in axis] for axis in anchor.weak_axes],
    }


def _read_anchor(record: dict[str, Any]) -> Anchor:
    covariance, residual_mm = record["covariance_m2"], record["residual_mm"]
    return Anchor(
        p_B=np.array(record["p_B_m"], dtype=np.float64),
        covariance=None if covariance is None else np.array(covariance, dtype=np.float64),
        residual_m=math.nan if residual_mm is None else residual_mm * 1e-3,
        frames=int(record["frames"]),
        weak_axes=tuple(np.array(axis, dtype=np.float64) for axis in record["weak_axes"]),
    )


def _load_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise OutputError(f"{path}: is not a text file") from None


def _load_json(path: Path) -> Any:
    try:
        return json.loads(_load_text(path))
    except json.JSONDecodeError as error:
        raise OutputError(f"{path}: not valid JSON ({error})") from None


def _number(value: float) -> str:
    return format(float(value), ".12g")  # 1e-12 m


def _numbers(values: FloatArray | None, count: int) -> list[str]:
    return [""] * count if values is None else [_number(v) for v in values]


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
