"""``tiptrace calibrate tip``: pivot calibration from tool poses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tiptrace.calibration.tip import TipCalibration
    from tiptrace.types import FloatArray

_LEAST_SIGMA_M = 5e-5


def calibrate_tip(
    poses: Annotated[Path, typer.Argument(help="Text file: one 3×4 pose per line, row-major, metres.")],
    method: Annotated[
        str, typer.Option(help="maximum-likelihood, which leaves outliers out, or least-squares.")
    ] = "maximum-likelihood",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write the tip into this tool.yaml; what else is in it stays. Poses must be those of F_E."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Where the tip sits in the tool, from poses of the tool turned about its resting tip.

    Solves R_i c + t_i = p jointly for the tip c (tool frame) and the point p (base frame), says which axes are weak,
    and shows the other method and the paper's form (I − R_t) p = d_t beside it.

    Examples:

      tiptrace calibrate tip poses.csv

      tiptrace calibrate tip poses.csv --method least-squares --json

      tiptrace calibrate tip hand_poses.csv --out tool.yaml
    """
    from tiptrace.calibration.tip import calibrate_tip as solve
    from tiptrace.calibration.tip import read_poses
    from tiptrace.errors import CalibrationError

    result = solve(read_poses(poses), method)
    if out is not None and result.weak:
        raise CalibrationError(f"{out} was not written: {'; '.join(result.weak)}")
    if as_json:
        typer.echo(json.dumps(_as_dict(result), indent=2))
    else:
        _print(result)
    if out is not None:
        _write(out, result)
        typer.echo(f"written: {out}", err=as_json)


def _write(out: Path, result: TipCalibration) -> None:
    """The tip into a tool file."""
    from tiptrace.config import Tool, dump_yaml, load_yaml
    from tiptrace.evaluation.atomic import write_atomic

    old = load_yaml(Tool, out) if out.exists() else Tool()
    sigma = [max(float(v), _LEAST_SIGMA_M) for v in result.sigma_m]
    new = old.model_copy(update={"tip_E_m": tuple(map(float, result.tip)), "tip_sigma_m": tuple(sigma)})
    write_atomic(out, dump_yaml(Tool.model_validate(new.model_dump())))


def _as_dict(result: TipCalibration) -> dict[str, object]:
    pivot, paper = result.pivot, result.paper
    return {
        "method": result.method,
        "poses": len(result.weights),
        "outliers": result.outliers,
        "rotation_deg": result.rotation_deg,
        "tip_T_m": result.tip.tolist(),
        "tip_std_m": result.sigma_m.tolist(),
        "pivot_B_m": result.point.tolist(),
        "residual_m": result.residual_m,
        "covariance_m2": result.covariance.tolist(),
        "weak": list(result.weak),
        "unobservable_axes_T": [axis.tolist() for axis in pivot.weak_axes],
        "least_squares": {"tip_T_m": pivot.tip.tolist(), "residual_m": pivot.residual_m},
        "paper": None if paper is None else {"pivot_B_m": paper.p.tolist(), "residual_m": paper.residual_m},
    }


def _print(result: TipCalibration) -> None:
    import numpy as np
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    pivot, paper = result.pivot, result.paper
    std_mm = np.sqrt(np.diag(result.covariance)) * 1e3
    left_out = f", {result.outliers} left out" if result.outliers else ""
    table = Table(
        title=f"Pivot calibration by {result.method}, {len(result.weights)} poses{left_out}, "
        f"rotation up to {result.rotation_deg:.1f}°"
    )
    for column in ("", "x [mm]", "y [mm]", "z [mm]", "residual rms [mm]"):
        table.add_column(escape(column), justify="right" if column else "left")
    rms = f"{result.residual_m * 1e3:.3f}"
    table.add_row("tip c ± σ, tool frame", *_pm(result.tip, std_mm[:3]), rms)
    table.add_row("fixed point p ± σ, base frame", *_pm(result.point, std_mm[3:]), rms)
    if result.method != "least-squares":
        cells = [f"{v * 1e3:.3f}" for v in pivot.tip]
        table.add_row("c by least squares", *cells, f"{pivot.residual_m * 1e3:.3f}", style="dim")
    if paper is not None:
        cells = [f"{v * 1e3:.3f}" for v in paper.p]
        table.add_row(
            "p by the paper's (I − R_t) p = d_t", *cells, f"{paper.residual_m * 1e3:.3f}", style="dim"
        )
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    for sentence in result.weak:
        console.print(f"[yellow]weak:[/] {sentence}")
    if not result.weak:
        console.print("no weak axis: every direction is known to better than 2 mm")


def _pm(value: FloatArray, std_mm: FloatArray) -> list[str]:
    return [
        f"{v * 1e3:.3f} ± {s:.3f}" if s < 500 else f"{v * 1e3:.3f} (open)"
        for v, s in zip(value, std_mm, strict=True)
    ]
