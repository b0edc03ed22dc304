"""``tiptrace reconstruct``: tip trajectory of a recording."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer


def reconstruct(
    recording: Annotated[Path, typer.Argument(help="Recording (.mcap), or any ROS 2 bag with --map.")],
    out: Annotated[Path, typer.Option(help="Results folder.")] = Path("out"),
    method: Annotated[str, typer.Option(help="full, paper, or a baseline: ee-only, nominal-tip, …")] = "full",
    beside: Annotated[
        list[str] | None, typer.Option(help="Further method for the table and pictures; may be repeated.")
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="rig.yaml, in place of the attached one.")] = None,
    tool: Annotated[Path | None, typer.Option(help="tool.yaml, in place of the attached one.")] = None,
    map_file: Annotated[
        Path | None, typer.Option("--map", help="map.yaml of another bag; `tiptrace inspect` proposes one.")
    ] = None,
    reference_left: Annotated[Path | None, typer.Option(help="Image of the untouched left gel.")] = None,
    reference_right: Annotated[Path | None, typer.Option(help="Image of the untouched right gel.")] = None,
    reference_frames: Annotated[
        str | None, typer.Option(help="Frames of the bag whose mean is the untouched gel, e.g. 0:20.")
    ] = None,
    stamps: Annotated[
        Literal["auto", "header", "log"], typer.Option(help="Clock that dates the messages.")
    ] = "auto",
    report: Annotated[bool, typer.Option(help="Draw report.html.")] = True,
) -> None:
    """Reconstruct the tip's trajectory and write trajectory.tum, trajectory.csv, events, metrics and a report.

    Examples:

      tiptrace reconstruct trial.mcap --out results

      tiptrace reconstruct bag_folder --map map.yaml --rig rig.yaml --reference-frames 0:20 --out results
    """
    from tiptrace.cli.show import print_results, progress_bar
    from tiptrace.reconstruction import reconstruct as run
    from tiptrace.streams.sources import open_recording

    stream = open_recording(
        recording,
        map_file=map_file,
        rig=rig,
        tool=tool,
        reference_left=reference_left,
        reference_right=reference_right,
        reference_frames=reference_frames,
        stamps=stamps,
    )
    with progress_bar() as progress:
        task = progress.add_task(f"reconstructing {recording.name}", total=None)
        result = run(
            stream,
            out,
            method,
            beside=beside or (),
            report=report,
            title=recording.stem,
            command=shlex.join(["tiptrace", *sys.argv[1:]]),
            source=recording.name,
            on_pair=lambda done: progress.update(task, completed=done),
        )
    print_results(result, f"{recording.name}, method {method}")
    typer.echo(f"results: {out}" + (f"   report: {result.report}" if result.report else ""))
