"""``tiptrace reconstruct``: tip trajectory of a recording, or of any number of them."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tiptrace.cli.options import Depth, MapFile, ReferenceFrames, ReferenceLeft, ReferenceRight

if TYPE_CHECKING:
    from tiptrace.using import Using


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
    smooth: Annotated[
        bool,
        typer.Option("--smooth", help="Use the whole trial for every position, not only what came before."),
    ] = False,
    tip: Annotated[
        Path | None, typer.Option(help="No Stage I: the tip (with its σ) of this tool.yaml.")
    ] = None,
    anchor_from: Annotated[
        Path | None,
        typer.Option(
            help="No Stage I: results, or recording with its own rig, of another trial with the same grasp."
        ),
    ] = None,
    regrasp: Annotated[
        bool, typer.Option("--regrasp", help="The tool was gripped anew since --anchor-from: less certain.")
    ] = False,
    regrasp_sigma_mm: Annotated[float, typer.Option(help="By how much less, per axis.")] = 2.0,
    relative: Annotated[
        bool, typer.Option("--relative", help="No anchor at all: displacements from the first contact.")
    ] = False,
    depth: Depth = "network",
    map_file: MapFile = None,
    reference_left: ReferenceLeft = None,
    reference_right: ReferenceRight = None,
    reference_frames: ReferenceFrames = None,
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

      tiptrace reconstruct trial.mcap --smooth --out smoothed

      tiptrace reconstruct next.mcap --anchor-from results --out next

      tiptrace reconstruct trial.mcap --tip tool.yaml --depth none --out results

    Without marks of the phases the end of Stage I is found from the data.

    Many recordings: the results of each go to OUT/NAME, a row of each to OUT/summary.parquet; what is done is not done
    again, what fails is listed and the rest goes on (exit code 1).
    """
    from tiptrace.batch_plan import is_batch
    from tiptrace.tracer import require_methods
    from tiptrace.using import Using

    require_methods(method, *(beside or ()))
    using = Using(tip, anchor_from, regrasp, regrasp_sigma_mm * 1e-3, relative, depth, smooth)
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
        _single(paths[0], out, method, beside or [], report is not False, options, using)
        return
    from tiptrace.batch import BatchSettings
    from tiptrace.cli.reconstruct_batch import reconstruct_batch

    given = {key: str(value) for key, value in options.items() if value is not None}
    settings = BatchSettings(method, tuple(beside or ()), bool(report), given, using)
    reconstruct_batch(paths, settings, out, workers, shard)


def _single(
    recording: Path,
    out: Path,
    method: str,
    beside: list[str],
    report: bool,
    options: dict[str, Any],
    using: Using,
) -> None:
    from tiptrace.cli.files import check_writable
    from tiptrace.cli.show import print_results, progress_bar
    from tiptrace.outputs import CSV
    from tiptrace.reconstruction import reconstruct as run
    from tiptrace.streams.sources import open_recording

    stream = open_recording(recording, **options)
    check_writable(out / CSV)
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
            using=using,
        )
    print_results(result, f"{recording.name}, method {method}")
    typer.echo(f"results: {out}" + (f"   report: {result.report}" if result.report else ""))
