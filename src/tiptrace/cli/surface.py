"""``tiptrace surface``: plane, groove centreline, period and amplitude from traces."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tiptrace.evaluation.surface import Trace


def surface(
    trajectories: Annotated[
        list[Path],
        typer.Argument(
            help="Results folders, trajectory.csv or TUM files; several are repeats on one surface."
        ),
    ],
    tip_radius_mm: Annotated[
        float,
        typer.Option(min=0.0, max=50.0, help="Radius of the tip: the surface lies so far below its centre."),
    ] = 0.0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for surface.json, centreline.csv and the figure.")
    ] = None,
) -> None:
    """Tell what traces say about the world: plane, centreline, period and amplitude, each with its uncertainty.

    Examples:

      tiptrace surface results/trial_001 --tip-radius-mm 1.4 --out surface

      tiptrace surface results/*/trajectory.csv
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from tiptrace.evaluation.surface import fit_surface, surface_table, write_surface

    fit = fit_surface([_trace(path) for path in trajectories], tip_radius_mm * 1e-3)
    shown = surface_table(fit)
    table = Table(*(c.heading for c in shown.columns), title=shown.title)
    for row in shown.text_rows():
        table.add_row(*(escape(cell) for cell in row))  # [mm] is no markup
    console = Console()
    console.print(table)
    for note in fit.notes:
        console.print(f"note: {escape(note)}", highlight=False)
    if out is not None:
        write_surface(out, fit)
        console.print(f"Written to {out}", highlight=False, markup=False, soft_wrap=True)


def _trace(path: Path) -> Trace:
    """Positions of the reconstruction segment; of all rows where a file has no phases."""
    import numpy as np

    from tiptrace.evaluation.surface import Trace
    from tiptrace.outputs import read_any
    from tiptrace.types import Phase

    rows = [e for e in read_any(path) if e.p_B is not None and e.phase in (None, Phase.RECONSTRUCTION)]
    known = [e.covariance for e in rows if e.covariance is not None]
    p_B = np.array([e.p_B for e in rows], dtype=np.float64).reshape(-1, 3)
    return Trace(str(path), p_B, np.array(known) if known and len(known) == len(rows) else None)
