"""``tiptrace calibrate tip``: pivot calibration from tool poses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tiptrace.calibration.tip import TipCalibration
    from tiptrace.types import FloatArray


def calibrate_tip(
    poses: Annotated[Path, typer.Argument(help="Text file: one 3×4 pose per line, row-major, metres.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Where the tip sits in the tool, from poses of the tool turned about its resting tip.

    Solves R_i c + t_i = p jointly for the tip c (tool frame) and the point p (base frame), and shows the
    paper's form (I − R_t) p = d_t beside it.

    Example: tiptrace calibrate tip poses.csv --json
    """
    from tiptrace.calibration.tip import calibrate_tip as solve
    from tiptrace.calibration.tip import read_poses

    result = solve(read_poses(poses))
    if as_json:
        typer.echo(json.dumps(_as_dict(result), indent=2))
    else:
        _print(result)


def _as_dict(result: TipCalibration) -> dict[str, object]:
    pivot, paper = result.pivot, result.paper
    return {
        "poses": len(pivot.residuals),
        "rotation_deg": result.rotation_deg,
        "tip_T_m": pivot.tip.tolist(),
        "pivot_B_m": pivot.pivot.tolist(),
        "residual_m": pivot.residual_m,
        "covariance_m2": pivot.covariance.tolist(),
        "unobservable_axes_T": [axis.tolist() for axis in pivot.weak_axes],
        "paper": None if paper is None else {"pivot_B_m": paper.p.tolist(), "residual_m": paper.residual_m},
    }


def _print(result: TipCalibration) -> None:
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    pivot, paper = result.pivot, result.paper
    std_mm = np.sqrt(np.diag(pivot.covariance)) * 1e3
    table = Table(
        title=f"Pivot calibration, {len(pivot.residuals)} poses, rotation up to {result.rotation_deg:.1f}°"
    )
    for column in ("", "x [mm]", "y [mm]", "z [mm]", "residual rms [mm]"):
        table.add_column(column, justify="right" if column else "left")
    rms = f"{pivot.residual_m * 1e3:.3f}"
    table.add_row("tip c, tool frame", *_pm(pivot.tip, std_mm[:3]), rms)
    table.add_row("fixed point p, base frame", *_pm(pivot.pivot, std_mm[3:]), rms)
    if paper is not None:
        cells = [f"{v * 1e3:.3f}" for v in paper.p]
        table.add_row("p by the paper's (I − R_t) p = d_t", *cells, f"{paper.residual_m * 1e3:.3f}")
    console = Console()
    console.print(table)
    for axis in pivot.weak_axes:
        direction = ", ".join(f"{v:+.2f}" for v in axis)
        console.print(
            f"[yellow]not determined:[/] the tip along ({direction}) of the tool frame; rotate about another axis too"
        )


def _pm(value: FloatArray, std_mm: FloatArray) -> list[str]:
    return [f"{v * 1e3:.3f} ± {s:.3f}" for v, s in zip(value, std_mm, strict=True)]
