"""``tiptrace doctor``: is everything there, and does it keep time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

_COLOURS = {"ok": "green", "note": "yellow", "fail": "red"}


def doctor(
    rig: Annotated[Path | None, typer.Option(help="rig.yaml: its cameras are measured.")] = None,
    robot: Annotated[str | None, typer.Option(help="ur://HOST, ros2, replay:FILE: is measured.")] = None,
    left: Annotated[str | None, typer.Option(help="Left camera, in place of the rig file's.")] = None,
    right: Annotated[str | None, typer.Option(help="Right camera, in place of the rig file's.")] = None,
    seconds: Annotated[float, typer.Option(help="How long to measure.", min=0.5, max=600)] = 5.0,
) -> None:
    """Check what is installed, cameras, robot, rates and jitter, disk and clock; each failing line has its remedy.

    Exit code 2 if a line fails.

    Example: tiptrace doctor --rig rig.yaml --robot ur://192.168.1.10
    """
    from rich.console import Console
    from rich.markup import escape

    from tiptrace.errors import ConfigError
    from tiptrace.live.checkup import Finding, check_devices, check_extras, check_machine
    from tiptrace.live.start import camera_addresses, read_rig_folder
    from tiptrace.types import SIDES

    if rig is None and (left is not None or right is not None):
        raise ConfigError("--left and --right are measured as the rig file says: give --rig too")
    console, failed = Console(), 0

    def show(finding: Finding) -> None:
        nonlocal failed
        failed += finding.verdict == "fail"
        remedy = f"\n{'':17s}→ {escape(finding.remedy)}" if finding.remedy else ""
        mark = f"[{_COLOURS[finding.verdict]}]{finding.verdict:4s}[/]"
        console.print(
            f"{mark} {escape(finding.what)}: {escape(finding.detail)}{remedy}",
            highlight=False,
            soft_wrap=True,
        )

    for finding in [*check_extras(), *check_machine(Path.cwd())]:
        show(finding)
    addresses, sensors, frames = {}, {}, None
    if rig is not None:
        folder = read_rig_folder(rig)
        addresses = {
            str(k): v for k, v in camera_addresses(folder.rig, {"left": left, "right": right}).items()
        }
        frames = folder.rig.frames
        sensors = {str(side): folder.rig.sensor(side) for side in SIDES}
        for side in SIDES:
            has = side in folder.references
            remedy = "" if has else "tiptrace setup takes it"
            show(Finding(f"{side} reference", "ok" if has else "fail", "there" if has else "missing", remedy))
    for finding in check_devices(addresses, sensors, robot, seconds, frames):
        show(finding)
    if failed:
        console.print(f"{failed} of these need attention", style="red")
        raise typer.Exit(2)
