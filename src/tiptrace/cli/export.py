"""``tiptrace export``: training data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def export(
    paths: Annotated[
        list[Path],
        typer.Argument(help="Results of `tiptrace reconstruct`, recordings, or folders of either."),
    ],
    to: Annotated[str, typer.Option(help="parquet, zarr or lerobot.")] = "parquet",
    out: Annotated[Path | None, typer.Option(help="File (parquet) or folder to write.")] = None,
    method: Annotated[str, typer.Option(help="For recordings; results have theirs.")] = "full",
    map_file: Annotated[
        Path | None, typer.Option("--map", help="map.yaml for other people's recordings.")
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="rig.yaml, in place of the attached ones.")] = None,
    reference_frames: Annotated[
        str | None, typer.Option(help="Frames that show the untouched gel, e.g. 0:20.")
    ] = None,
    lerobot_version: Annotated[str, typer.Option(help="Layout: v3.0 or v2.1.")] = "v3.0",
    task: Annotated[str | None, typer.Option(help="LeRobot: what was done, in words.")] = None,
    images: Annotated[
        bool, typer.Option("--images/--no-images", help="LeRobot: the tactile images too, from recordings.")
    ] = True,
) -> None:
    """Write the tip at every image pair, with covariance and validity, as a dataset for learning.

    The estimates are causal: none uses an image later than its own. Many recordings are exported fastest from their
    results, made with several workers.

    Examples:

      tiptrace export trial.mcap --to parquet --out tip.parquet

      tiptrace reconstruct recordings/ --workers 8 --out results

      tiptrace export results --to zarr --out tip.zarr

      tiptrace export recordings/ --to lerobot --lerobot-version v2.1 --task "write" --out tip-lerobot
    """
    from rich.console import Console

    from tiptrace.cli.show import progress_bar
    from tiptrace.errors import ConfigError
    from tiptrace.export.dataset import FORMATS, LeRobotOptions, export_dataset
    from tiptrace.export.episodes import find_sources
    from tiptrace.tracer import METHODS

    if to not in FORMATS:
        raise ConfigError(f"unknown format '{to}'; valid: {', '.join(FORMATS)}")
    if method not in METHODS:
        raise ConfigError(f"unknown method '{method}'; valid: {', '.join(METHODS)}")
    given = {"map_file": map_file, "rig": rig, "reference_frames": reference_frames}
    options = {key: str(value) for key, value in given.items() if value is not None}
    target = out or Path(f"tip.{to}")
    sources, missing, notes = find_sources(paths, bags=map_file is not None)
    with progress_bar() as progress:
        bar = progress.add_task("episodes", total=len(sources))
        chosen = LeRobotOptions(lerobot_version, task or LeRobotOptions().task, images)
        done = export_dataset(sources, to, target, method, options, lambda _: progress.advance(bar), chosen)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    for note in notes:
        console.print(f"note: {note}")
    failures = [*missing, *done.failures]
    for name, reason in failures:
        console.print(f"failed: {name}: {reason}")
    episodes = done.record["episodes"]
    frames, valid = (sum(e[key] for e in episodes) for key in ("frames", "valid_frames"))
    console.print(f"{target}: {len(episodes)} episodes, {frames} frames, {valid} valid, causal estimates")
    if failures:
        raise typer.Exit(1)
