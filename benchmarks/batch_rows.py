"""A row of means for each batch: what options of ``tiptrace reconstruct`` cost or gain on recordings with truth.

tiptrace reconstruct suite/nominal-10 --depth none --workers 2 --out none
tiptrace reconstruct suite/nominal-10 --smooth --workers 2 --out smooth
python benchmarks/batch_rows.py none smooth
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

COLUMNS = {
    "trajectory": "trajectory_rmse_mm",
    "shape": "shape_rmse_mm",
    "contact": "initial_contact_error_mm",
    "cross-track": "cross_track_rmse_mm",
}


def row(folder: Path) -> str:
    """Mean over the trials that have a position, and what else a table of results says."""
    found = pq.read_table(folder / "summary.parquet").to_pylist()
    value = np.array([[r[c] for c in COLUMNS.values()] for r in found], dtype=float)  # (n, 4) mm
    told = ~np.isnan(value[:, 0])
    cells = [f"{mean:.2f}" for mean in value[told].mean(axis=0)]
    coverage = np.nanmean([np.nan if r["coverage_95"] is None else r["coverage_95"] for r in found])
    usable = np.mean([r["usable_fraction"] or 0.0 for r in found])
    largest = f"{value[told, 0].max():.2f}"
    rest = [*cells, largest, f"{100 * coverage:.1f} %", f"{100 * usable:.1f} %"]
    return f"| {folder.name} | {len(found)} | {int((~told).sum())} | " + " | ".join(rest) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("batch", nargs="+", type=Path, help="--out of tiptrace reconstruct")
    heads = (
        "batch",
        "trials",
        "refused",
        *COLUMNS,
        "largest trajectory",
        "coverage",
        "frames with a position",
    )
    print("| " + " | ".join(heads) + " |")
    print("|---" * len(heads) + "|")
    for folder in parser.parse_args().batch:
        print(row(folder))


if __name__ == "__main__":
    main()
