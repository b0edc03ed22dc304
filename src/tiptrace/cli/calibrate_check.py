"""``tiptrace calibrate check``: health of a gel."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

# score: label, format, what to do
_SCORES = {
    "flatness_um": (
        "flatness of untouched gel",
        "{:.0f} µm",
        "a lasting dent, or uneven lamps: replace, calibrate",
    ),
    "curl_per_mm": (
        "curl on untouched gel",
        "{:.2f} /mm",
        "a scratch, dirt or worn coating: clean or replace the gel",
    ),
    "curl_in_contact": (
        "curl in the contact",
        "{:.2f}",
        "the network no longer fits the gel: calibrate anew",
    ),
    "illumination_change": (
        "brightness since calibration",
        "{:.1%}",
        "check lamps, exposure and white balance; if it stays, calibrate anew",
    ),
    "dots_lost": ("dots dead", "{:.0f}", "markers are worn off: replace the gel"),
    "dots_merged": (
        "pairs of dots merged",
        "{:.0f}",
        "markers have run or dirt lies between them: clean or replace",
    ),
    "dots_moved_px": (
        "dots moved",
        "{:.2f} px",
        "the gel or the crop has shifted: seat it, calibrate",
    ),
}
_COLOURS = {"good": "green", "watch": "yellow", "worn": "red"}


def calibrate_check(
    images: Annotated[
        list[Path], typer.Argument(exists=True, dir_okay=False, help="Images of the gel, best untouched.")
    ],
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Image of the untouched gel from its calibration; default: kept beside the gel model."
        ),
    ] = None,
    gel: Annotated[str, typer.Option(help="Gel model: a packaged name or an ONNX file.")] = "gel.onnx",
    mm_per_px: Annotated[
        float | None, typer.Option(help="Scale of the images; default: the gel model's.", min=1e-4, max=1.0)
    ] = None,
) -> None:
    """Tell a gel's wear before it costs a trial: flatness, curl, lamps and dots against the calibration.

    Each score is good, watch or worn; the exit code is 1 if any is worn.

    Examples:

      tiptrace calibrate check today.png --gel gel.onnx

      tiptrace calibrate check *.png --gel gelsight-mini-virtual --reference reference.png
    """
    from rich.console import Console
    from rich.table import Table

    from tiptrace.calibration.gel_health import check_gel
    from tiptrace.cli.calibrate_gel import beside
    from tiptrace.errors import CalibrationError
    from tiptrace.perception.gel_model import load_gel_model
    from tiptrace.perception.still import read_image

    model = load_gel_model(gel)
    x, y = (mm_per_px, mm_per_px) if mm_per_px is not None else model.mm_per_px or (None, None)
    if x is None or y is None:
        raise CalibrationError(f"gel model '{gel}' does not say its scale; give --mm-per-px")
    known = reference or beside(Path(gel))
    if not known.is_file():
        raise CalibrationError(
            f"{known}: no image of the untouched gel; give --reference from the calibration"
        )
    pictures = [read_image(path) for path in images]
    scores = check_gel(pictures, read_image(known), model, (x * 1e-3, y * 1e-3))
    table = Table(title="Gel health")
    table.add_column("")
    for path in images:
        table.add_column(path.name, justify="right")
    advice: dict[str, str] = {}
    worn = False
    for name, (label, form, remedy) in _SCORES.items():
        cells = []
        for score in scores:
            verdict = score.verdicts().get(name)
            text = form.format(getattr(score, name))
            cells.append("–" if verdict is None else f"[{_COLOURS[verdict]}]{text} {verdict}[/]")
            if verdict not in (None, "good"):
                advice[label], worn = remedy, worn or verdict == "worn"
        table.add_row(label, *cells)
    table.add_row("contact in the image", *["yes" if s.touched else "no" for s in scores])
    Console().print(table)
    for label, remedy in advice.items():
        typer.echo(f"{label}: {remedy}")
    if advice and any(s.touched for s in scores):
        typer.echo(
            "something touches the gel, which hides dots and bends what lies around: check an image without contact "
            "before you replace anything"
        )
    if worn:
        raise typer.Exit(1)
