"""``tiptrace reconstruct``: tip trajectory of a recording, or of any number of them."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer


def reconstruct(
    paths: Annotated[
        list[Path],
        typer.Argument(help="Recording (.mcap), or any ROS 2 bag with --map; folders and globs of them."),
    ],
    out: Annotated[Path, typer.Option(help="Results folder; of many recordings with a folder each.")] = Path(
        "out"
    ),
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
    report: Annotated[
        bool | None,
        typer.Option("--report/--no-report", help="Draw report.html; default: of a single recording only."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Of many recordings: processes; default: one per core.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(help="i/n: only the i-th of n shares of the recordings, from 1.")
    ] = None,
) -> None:
    """Reconstruct the tip's trajectory and write trajectory.tum, trajectory.csv, events, metrics and a report.

    Examples:

      tiptrace reconstruct trial.mcap --out results

      tiptrace reconstruct bag_folder --map map.yaml --rig rig.yaml --reference-frames 0:20 --out results

      tiptrace reconstruct recordings/ 'more/**/*.mcap' --workers 2 --shard 3/16 --out results

    Many recordings: the results of each go to OUT/NAME, a row of each to OUT/summary.parquet; what is done is not done
    again, what fails is listed and the rest goes on (exit code 1).
    """
    from tiptrace.batch_plan import is_batch

    options: dict[str, Any] = {
        "map_file": map_file,
        "rig": rig,
        "tool": tool,
        "reference_left": reference_left,
        "reference_right": reference_right,
        "reference_frames": reference_frames,
        "stamps": stamps,
    }
    if workers is None and shard is None and not is_batch(paths):
        _single(paths[0], out, method, beside or [], report is not False, options)
        return
    from tiptrace.batch import BatchSettings
    from tiptrace.cli.reconstruct_batch import reconstruct_batch

    given = {key: str(value) for key, value in options.items() if value is not None}
    settings = BatchSettings(method, tuple(beside or ()), bool(report), given)
    reconstruct_batch(paths, settings, out, workers, shard)


def _single(
    recording: Path,
    out: Path,
    method: str,
    beside: list[str],
    report: bool,
    options: dict[str, Any],
) -> None:
    from tiptrace.cli.show import print_results, progress_bar
    from tiptrace.reconstruction import reconstruct as run
    from tiptrace.streams.sources import open_recording

    stream = open_recording(recording, **options)
    with progress_bar() as progress:
        task = progress.add_task(f"reconstructing {recording.name}", total=None)
        result = run(
            stream,
            out,
            method,
            beside=beside,
            report=report,
            title=recording.stem,
            command=shlex.join(["tiptrace", *sys.argv[1:]]),
            source=recording.name,
            on_pair=lambda done: progress.update(task, completed=done),
        )
    print_results(result, f"{recording.name}, method {method}")
    typer.echo(f"results: {out}" + (f"   report: {result.report}" if result.report else ""))
