"""``tiptrace calibrate check``: health of a gel."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

_LABELS = {
    "flatness_um": ("flatness of untouched gel", "{:.0f} µm"),
    "curl": ("curl of the slope field", "{:.2f}"),
    "illumination_change": ("brightness since calibration", "{:.1%}"),
    "dots_lost": ("dots dead or merged", "{:.0f}"),
    "dots_moved_px": ("dots moved", "{:.2f} px"),
}
_COLOURS = {"good": "green", "watch": "yellow", "worn": "red"}


def calibrate_check(
    images: Annotated[list[Path], typer.Argument(help="Images of the gel, best untouched.")],
    reference: Annotated[Path, typer.Option(help="Image of the untouched gel from its calibration.")],
    gel: Annotated[
        str, typer.Option(help="Gel model: a packaged name or an ONNX file.")
    ] = "gelsight-mini-virtual",
    mm_per_px: Annotated[float, typer.Option(help="Scale of the images.", min=1e-4, max=1.0)] = 0.0625,
) -> None:
    """Tell a gel's wear before it costs a trial: flatness, curl, lamps and dots against the calibration.

    Example: tiptrace calibrate check today.png --reference reference.png --gel gel.onnx
    """
    from rich.console import Console
    from rich.table import Table

    from tiptrace.calibration.gel_health import check_gel
    from tiptrace.perception.gel_model import load_gel_model
    from tiptrace.perception.still import read_image

    pictures = [read_image(path) for path in images]
    scale = (mm_per_px * 1e-3, mm_per_px * 1e-3)
    scores = check_gel(pictures, read_image(reference), load_gel_model(gel), scale)
    table = Table(title="Gel health")
    table.add_column("")
    for path in images:
        table.add_column(path.name, justify="right")
    for name, (label, form) in _LABELS.items():
        cells = []
        for score in scores:
            verdict = score.verdicts().get(name)
            text = form.format(getattr(score, name))
            cells.append("–" if verdict is None else f"[{_COLOURS[verdict]}]{text} {verdict}[/]")
        table.add_row(label, *cells)
    table.add_row("contact in the image", *["yes" if s.touched else "no" for s in scores])
    Console().print(table)
