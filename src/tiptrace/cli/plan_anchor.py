"""``tiptrace plan-anchor``: the whole of Stage I as a plan, with what it will tell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tiptrace.estimation.planning import Prediction


def plan_anchor(
    rig: Annotated[Path, typer.Option(help="rig.yaml.")],
    tool: Annotated[Path, typer.Option(help="tool.yaml with the nominal tip.")],
    out: Annotated[
        Path, typer.Option(help="Folder for plan.csv, plan.script, poses.yaml and plan.png.")
    ] = Path("anchor-plan"),
    motion: Annotated[str, typer.Option(help="Which alternative to export; see the table.")] = "recommended",
    preload: Annotated[
        float, typer.Option(min=0.1, max=50.0, help="Contact force after pressing down, N.")
    ] = 3.0,
    picture: Annotated[bool, typer.Option(help="Draw plan.png.")] = True,
) -> None:
    """Propose the anchoring motion: approach, preload, settling, waypoints, loads, and the accuracy to expect.

    The table's columns: standard deviation of the tip along the hand's start axes, largest contact force, shear of
    the gel and speed of the hand; "unobservable": over 2 mm in some direction; "over strain": more shear than the
    gel bears (max_strain_mm in rig.yaml).

    Poses are relative to the hand at first touch (T_E0_E): start with the tip on the surface, then press.

    Examples:

      tiptrace plan-anchor --rig rig.yaml --tool tool.yaml

      tiptrace plan-anchor --rig rig.yaml --tool tool.yaml --motion gentle --out plan
    """
    import numpy as np
    from rich.console import Console

    from tiptrace.config import Rig, Tool, load_yaml
    from tiptrace.errors import ConfigError
    from tiptrace.estimation.planning import CANDIDATES, Task, predict
    from tiptrace.estimation.priors import require_tip
    from tiptrace.export.anchor_plan import ABORT_RATIO, APPROACH_MPS, SETTLE_S, write_plan

    names = [w.name for w in CANDIDATES]
    if motion not in names:
        raise ConfigError(f"unknown anchoring motion '{motion}'; valid: {', '.join(names)}")
    prior = require_tip(load_yaml(Tool, tool))
    sigma = float(np.sqrt(np.trace(prior.covariance) / 3.0))
    task = Task(load_yaml(Rig, rig), prior.c, sigma, preload)
    predictions = [predict(w, task) for w in CANDIDATES]
    chosen = predictions[names.index(motion)]
    write_plan(out, chosen, task, predictions, picture)
    console = Console()
    console.print(_table(predictions, motion))
    for line in (
        f"Approach along the tool at {APPROACH_MPS * 1e3:.0f} mm/s until {preload:.1f} N, settle {SETTLE_S:.0f} s,",
        f"then {chosen.wiggle.name} for {chosen.wiggle.duration_s:.0f} s.",
        f"Expected force up to {chosen.force_n:.1f} N, abort above {ABORT_RATIO * chosen.force_n:.1f} N. "
        f"Written to {out}",
    ):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _table(predictions: list[Prediction], motion: str) -> object:
    from rich.table import Table

    table = Table(title="Anchoring motions: standard deviation of the tip along the hand's start axes")
    for column in ("motion", "σx mm", "σy mm", "σz mm", "force N", "shear mm", "mm/s", "remark"):
        words = column in ("motion", "remark")
        table.add_column(column, justify="left" if words else "right", no_wrap=words)
    for p in predictions:
        sigma = [f"{v * 1e3:.2f}" if v < 0.05 else "open" for v in p.sigma_m]
        remark = "unobservable" if p.worst_sigma_m > 2e-3 else ("" if p.within_strain else "over strain")
        name = f"[bold]{p.wiggle.name}[/]" if p.wiggle.name == motion else p.wiggle.name
        loads = (f"{p.force_n:.1f}", f"{p.pad_shear_m * 1e3:.2f}", f"{p.speed_mps * 1e3:.0f}")
        table.add_row(name, *sigma, *loads, remark)
    return table
