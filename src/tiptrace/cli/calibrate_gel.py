"""``tiptrace calibrate gel``: a gel network from ball presses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from tiptrace.calibration.gel import GelTrainingReport
    from tiptrace.config import Sensor


def calibrate_gel(
    folder: Annotated[
        Path,
        typer.Argument(
            exists=True,
            file_okay=False,
            help="Holds reference.png, presses.csv (image, ball_diameter_mm) and the images.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="ONNX file to write; the reference is copied beside it.")] = Path(
        "gel.onnx"
    ),
    mm_per_px: Annotated[
        float | None,
        typer.Option(
            help="Scale of the images; else the rig's, else the csv's column, else 20 mm per width.",
            min=1e-4,
            max=1.0,
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            help="rig.yaml: gives the scale; a gel of another pitch or crop than it says is refused."
        ),
    ] = None,
    side: Annotated[Literal["left", "right"], typer.Option(help="Finger of the rig.")] = "left",
    seed: Annotated[int, typer.Option(help="Decides which presses are held out.")] = 0,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for a picture of each held-out press; default beside --out.")
    ] = None,
) -> None:
    """Train a gel's network on presses of balls of known size; contacts are found in the images.

    Press 20 to 40 times all over the gel, with balls of 3 to 8 mm, some deep. Gels with and without dots.
    Every fifth press is held out and tells how good the network is.

    Examples:

      tiptrace calibrate gel presses/ --out gel.onnx --mm-per-px 0.0625

      tiptrace calibrate gel presses/ --out gel_left.onnx --rig rig.yaml --side left
    """
    from tiptrace.calibration.gel import train_gel
    from tiptrace.cli.files import check_writable
    from tiptrace.cli.show import progress_bar

    check_writable(out)
    sensor = _sensor(rig, side)
    with progress_bar() as progress:
        task = progress.add_task("reading the presses", total=100)

        def tell(label: str, share: float) -> None:
            progress.update(task, description=label, completed=round(100 * share))

        scale = None if mm_per_px is None else (mm_per_px, mm_per_px)
        where = pictures or out.with_name(f"{out.stem}-held-out")
        report = train_gel(
            folder, out, seed=seed, mm_per_px=scale, sensor=sensor, pictures=where, progress=tell
        )
    reference = beside(out)
    reference.write_bytes((folder / "reference.png").read_bytes())
    for line in _lines(report):
        typer.echo(line)
    typer.echo(
        f"pictures of the held-out presses: {where}; reference kept for 'calibrate check': {reference}"
    )


def beside(gel: Path) -> Path:
    """Where the reference of a gel model is kept."""
    return gel.with_name(f"{gel.stem}-reference.png")


def _sensor(rig: Path | None, side: Literal["left", "right"]) -> Sensor | None:
    from tiptrace.config import Rig, load_yaml

    return None if rig is None else load_yaml(Rig, rig).sensor(side)


def _lines(report: GelTrainingReport) -> list[str]:
    """The report as a user reads it."""
    assumed = " (assumed: 20 mm over the image's width)" if report.scale_is_assumed else ""
    width, height = report.view_mm
    lines = [
        f"{report.model}: trained on {len(report.trained_on)} presses, {len(report.held_out)} held out, "
        f"{report.seconds:.0f} s",
        f"held-out presses: normal error {report.normal_error_deg:.2f}° (median), depth error inside the contact "
        f"{report.depth_rms_m * 1e6:.0f} µm rms, ball radius off by {100 * report.radius_error:.1f} %",
        f"untouched gel: slope {report.flatness_m * 1e6:.1f} µm per mm rms; steepest slope in the presses "
        f"{report.max_slope:.2f} (steeper is extrapolated)",
        f"scale: {report.mm_per_px[0]:.4g} × {report.mm_per_px[1]:.4g} mm/px{assumed}, so that the image shows "
        f"{width:.1f} × {height:.1f} mm of gel; every depth is proportional to it",
    ]
    if report.marker_pitch_mm is not None:
        lines.append(
            f"marker pitch at this scale: {report.marker_pitch_mm:.3f} mm; compare with the gel's data sheet (GelSight "
            "Mini: 2 mm), a wrong scale shows here"
        )
    if report.one_place:
        u0, v0, u1, v1 = report.valid_px
        lines.append(
            f"all presses lie in one place: valid there only (u {u0:.0f}–{u1:.0f}, v {v0:.0f}–{v1:.0f} px); "
            "press all over the gel to teach the rest"
        )
    return lines
