"""Ground truth that a user brings: a TUM file or a csv."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from tiptrace.errors import OutputError
from tiptrace.types import TruthSample

_COLUMNS = ("stamp_ns", "x_m", "y_m", "z_m")
_REACH_M = 5.0


def read_truth(path: Path) -> list[TruthSample]:
    """True tip from ``.csv`` (columns ``stamp_ns, x_m, y_m, z_m``; others are ignored) or TUM (any other suffix).

    Stamps are on the recording's clock; rows without a position are left out.

    Raises:
        OutputError: the file cannot be read or understood, holds no position, or is in millimetres.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise OutputError(f"{path}: ground truth cannot be read ({error})") from None
    samples = _from_csv(path, text) if path.suffix == ".csv" else _from_tum(path, text)
    if not samples:
        raise OutputError(f"{path}: holds no true position")
    reach = max(float(np.abs(s.p_B).max()) for s in samples)
    if reach > _REACH_M:
        raise OutputError(f"{path}: a position {reach:g} m from the base looks like millimetres; give metres")
    return samples


def _from_csv(path: Path, text: str) -> list[TruthSample]:
    rows = csv.DictReader(io.StringIO(text))
    missing = [c for c in _COLUMNS if c not in (rows.fieldnames or ())]
    if missing:
        raise OutputError(f"{path}: lacks the column(s) {', '.join(missing)}; expected {', '.join(_COLUMNS)}")
    samples = []
    for number, row in enumerate(rows, start=2):
        if not (row["x_m"] and row["y_m"] and row["z_m"]):
            continue
        try:
            samples.append(_sample(int(row["stamp_ns"]), [float(row[c]) for c in _COLUMNS[1:]]))
        except ValueError as error:
            raise OutputError(f"{path}, line {number}: cannot be understood ({error})") from None
    return samples


def _from_tum(path: Path, text: str) -> list[TruthSample]:
    from decimal import Decimal

    samples = []
    for number, line in enumerate(text.splitlines(), start=1):
        cells = line.split("#")[0].split()
        if not cells:
            continue
        try:
            if len(cells) < 4:
                raise ValueError(f"{len(cells)} numbers, expected t x y z qx qy qz qw")
            stamp = int(Decimal(cells[0]).scaleb(9).to_integral_value())
            samples.append(_sample(stamp, [float(c) for c in cells[1:4]]))
        except (ValueError, ArithmeticError) as error:
            raise OutputError(f"{path}, line {number}: cannot be understood ({error})") from None
    return samples


def _sample(stamp_ns: int, xyz: list[float]) -> TruthSample:
    return TruthSample(stamp_ns, np.array(xyz, dtype=np.float64))
