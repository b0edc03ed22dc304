"""``tiptrace export``: training data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tiptrace.cli.options import MapFile, ReferenceFrames, RigFile

if TYPE_CHECKING:
    from tiptrace.export.dataset import Exported
    from tiptrace.types import Side


def export(
    paths: Annotated[
        list[Path],
        typer.Argument(
            help="Results of `tiptrace reconstruct`, recordings, folders of either, or a LeRobot dataset."
        ),
    ],
    to: Annotated[str, typer.Option(help="parquet, zarr or lerobot.")] = "parquet",
    out: Annotated[Path | None, typer.Option(help="File (parquet) or folder to write.")] = None,
    method: Annotated[str, typer.Option(help="For recordings; results have theirs.")] = "full",
    map_file: MapFile = None,
    rig: RigFile = None,
    reference_frames: ReferenceFrames = None,
    tool: Annotated[Path | None, typer.Option(help="tool.yaml, for a LeRobot dataset.")] = None,
    reference_left: Annotated[
        Path | None, typer.Option(help="Image of the untouched left gel, for a LeRobot dataset.")
    ] = None,
    reference_right: Annotated[Path | None, typer.Option(help="Of the right gel.")] = None,
    columns: Annotated[
        str | None,
        typer.Option(help="Of a LeRobot dataset, where names do not tell: left=NAME,right=NAME,pose=NAME."),
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

    A LeRobot dataset with tactile images is copied with the tip at each of its own frames (same version):

      tiptrace export dataset/ --to lerobot --rig rig.yaml --reference-left l.png --reference-right r.png --out with-tip
    """
    from tiptrace.cli.show import progress_bar
    from tiptrace.errors import ConfigError
    from tiptrace.export.dataset import FORMATS, LeRobotOptions, export_dataset
    from tiptrace.export.episodes import find_sources
    from tiptrace.export.lerobot_reader import is_lerobot
    from tiptrace.tracer import require_methods

    if to not in FORMATS:
        raise ConfigError(f"unknown format '{to}'; valid: {', '.join(FORMATS)}")
    require_methods(method)
    target = out or Path(f"tip.{to}")
    if any(is_lerobot(path) for path in paths):
        references: dict[Side, Path | None] = {"left": reference_left, "right": reference_right}
        _annotate(paths, to, target, method, rig, tool, references, reference_frames, columns)
        return
    given = {"map_file": map_file, "rig": rig, "reference_frames": reference_frames}
    options = {key: str(value) for key, value in given.items() if value is not None}
    sources, missing, notes = find_sources(paths, bags=map_file is not None)
    with progress_bar() as progress:
        bar = progress.add_task("episodes", total=len(sources))
        chosen = LeRobotOptions(lerobot_version, task or LeRobotOptions().task, images)
        done = export_dataset(sources, to, target, method, options, lambda _: progress.advance(bar), chosen)
    _say(target, done, missing, notes)


def _annotate(
    paths: list[Path],
    to: str,
    out: Path,
    method: str,
    rig: Path | None,
    tool: Path | None,
    references: dict[Side, Path | None],
    reference_frames: str | None,
    columns: str | None,
) -> None:
    """A LeRobot dataset with the tip at its own frames."""
    from tiptrace.cli.show import progress_bar
    from tiptrace.errors import ConfigError
    from tiptrace.export.lerobot_annotate import annotate
    from tiptrace.export.lerobot_reader import open_lerobot

    if len(paths) != 1 or to != "lerobot":
        raise ConfigError("a LeRobot dataset is annotated alone, with --to lerobot")
    if rig is None:
        raise ConfigError(f"{paths[0]}: a LeRobot dataset does not describe the rig: give --rig rig.yaml")
    pairs = [part.partition("=") for part in (columns or "").split(",") if part]
    odd = [name for name, _, value in pairs if name not in ("left", "right", "pose") or not value]
    if odd:
        raise ConfigError(f"--columns '{columns}': expected left=NAME,right=NAME,pose=NAME")
    source = open_lerobot(paths[0], {name: value for name, _, value in pairs})
    with progress_bar() as progress:
        bar = progress.add_task("episodes", total=len(source.episodes))
        done = annotate(
            source,
            out,
            rig,
            tool,
            {side: path for side, path in references.items() if path is not None},
            reference_frames,
            method,
            on_done=lambda _: progress.advance(bar),
        )
    _say(out, done, [], [])


def _say(target: Path, done: Exported, missing: list[tuple[str, str]], notes: list[str]) -> None:
    from rich.console import Console

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
