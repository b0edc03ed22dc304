"""Flat rows of plain values as a Parquet or csv file, with a type for each column whatever it holds."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

from tiptrace.errors import MissingExtraError, OutputError
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.evaluation.metrics import TrialMetrics

_NUMBERS = {field.name for field in fields(TrialMetrics)}


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of the same columns as ``.parquet`` or ``.csv``, by the path's suffix.

    Raises:
        OutputError: another suffix, or the file cannot be written.
        MissingExtraError: Parquet without pyarrow.
    """
    if path.suffix not in (".parquet", ".csv"):
        raise OutputError(f"{path}: tables are written as .parquet or .csv")
    write_atomic(path, _parquet_bytes(rows) if path.suffix == ".parquet" else _csv_bytes(rows))


def _parquet_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    try:
        pa: Any = import_module("pyarrow")
        parquet: Any = import_module("pyarrow.parquet")
    except ImportError:
        raise MissingExtraError("pyarrow", "tables") from None
    kinds = {name: _kind(name, [row[name] for row in rows]) for name in (rows[0] if rows else ())}
    schema = pa.schema([(name, getattr(pa, kind)()) for name, kind in kinds.items()])
    buffer = io.BytesIO()
    parquet.write_table(pa.Table.from_pylist(list(rows), schema=schema), buffer, compression="zstd")
    return buffer.getvalue()


def _kind(name: str, values: Sequence[Any]) -> str:
    known = [v for v in values if v is not None]
    if not known:
        return "float64" if name in _NUMBERS or name.endswith("_hz") else "string"
    if all(isinstance(v, int) for v in known):
        return "int64"
    return "float64" if all(isinstance(v, int | float) for v in known) else "string"


def _csv_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    buffer = io.StringIO()
    if rows:
        writer = csv.DictWriter(buffer, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: "" if v is None else v for k, v in row.items()} for row in rows)
    return buffer.getvalue().encode()
