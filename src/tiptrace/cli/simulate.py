"""``tiptrace simulate``: trials of the virtual rig as recordings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from tiptrace.sim.spec import TrialSpec


def simulate(
    out: Annotated[Path, typer.Option(help="Recording to write (.mcap); with --suite a folder.")] = Path(
        "trial.mcap"
    ),
    trajectory: Annotated[str | None, typer.Option(help="T1 line, T2 arc, T3–T5 sinusoids.")] = None,
    tool: Annotated[
        str | None, typer.Option(help="O1 rectangular, O2 hexagonal, O3 cylindrical, O4 bent.")
    ] = None,
    wrist: Annotated[str | None, typer.Option(help="W1–W3.")] = None,
    grasp: Annotated[str | None, typer.Option(help="G1–G3.")] = None,
    seed: Annotated[int | None, typer.Option(help="Everything random derives from it.")] = None,
    level: Annotated[str | None, typer.Option(help="clean, nominal, hard or unseen.")] = None,
    mode: Annotated[str | None, typer.Option(help="images, or markers: 3-D markers without images.")] = None,
    anchor_motion: Annotated[
        str | None, typer.Option(help="recommended, two-axis, one-axis or pads.")
    ] = None,
    curve: Annotated[Path | None, typer.Option(help="csv of your own centreline: x, y in mm.")] = None,
    thickness_mm: Annotated[float | None, typer.Option(help="Tool thickness, 5 to 20 mm.")] = None,
    length_mm: Annotated[float | None, typer.Option(help="Tool length.")] = None,
    fps: Annotated[float | None, typer.Option(help="Image pairs per second.")] = None,
    settings: Annotated[
        Path | None, typer.Option(help="YAML with any of the trial's settings; options win over it.")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="Also write the truth of every frame (.parquet); with --suite any name."),
    ] = None,
    suite: Annotated[str | None, typer.Option(help="paper: the 51 trials; quick: the 12 conditions.")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes for a suite; default: all cores.")] = None,
) -> None:
    """Simulate trials: settle the grasp, press down, Stage I, Stage II.

    Examples: tiptrace simulate --trajectory T3 --tool O1 --wrist W1 --grasp G1 --seed 0 --out trial.mcap;
    tiptrace simulate --suite paper --level nominal --out trials --workers 2
    """
    values = _read_settings(settings)
    given = {
        "trajectory": trajectory,
        "tool": tool,
        "wrist": wrist,
        "grasp": grasp,
        "seed": seed,
        "level": level,
        "mode": mode,
        "anchor_motion": anchor_motion,
        "curve": curve,
        "thickness_m": None if thickness_mm is None else thickness_mm * 1e-3,
        "tool_length_m": None if length_mm is None else length_mm * 1e-3,
        "fps": fps,
    }
    values |= {key: value for key, value in given.items() if value is not None}
    if suite is None:
        _one(values, out, truth)
    else:
        _suite(suite, values, out, workers or os.cpu_count() or 1, truth is not None)


def _read_settings(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    from tiptrace.config import read_yaml
    from tiptrace.errors import ConfigError

    try:
        text = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    values = read_yaml(text, str(path))
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected settings of a trial, 'key: value', got {type(values).__name__}")
    return values


def _one(values: dict[str, Any], out: Path, truth: Path | None) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from tiptrace.errors import OutputError
    from tiptrace.sim.spec import make_spec
    from tiptrace.streams.simulated_files import write_trial

    if out.is_dir():
        raise OutputError(f"{out}: is a folder; give the recording a name, e.g. --out {out / 'trial.mcap'}")
    spec = make_spec(**values)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(f"simulating {spec.name}", total=_expected_frames(spec))
        frames = write_trial(spec, out, truth, lambda: progress.advance(task))
    console = Console(highlight=False, markup=False, soft_wrap=True)
    console.print(f"{out}: {spec.name}, {frames} frames, {spec.mode}, level {spec.level}, seed {spec.seed}")
    if truth is not None:
        console.print(f"{truth}: the truth of every frame")


def _expected_frames(spec: TrialSpec) -> int:
    from tiptrace.sim.protocol import plan

    segments = plan(spec)
    return int((segments[-1].end_s if segments else 0.0) * spec.fps + 1e-6) + 1


def _suite(suite: str, values: dict[str, Any], out: Path, workers: int, truth: bool) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from tiptrace.errors import SimulationError
    from tiptrace.sim.suite import suite_trials
    from tiptrace.streams.simulated_files import write_suite

    fixed = [key for key in ("trajectory", "tool", "wrist", "grasp", "curve") if key in values]
    if fixed:
        raise SimulationError(f"a suite sets {', '.join(fixed)} itself: leave out the option or --suite")
    trials = suite_trials(suite, **values)
    failed = []
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(f"suite {suite}", total=len(trials))
        for done in write_suite(trials, out, workers, truth):
            progress.advance(task)
            if done.error is not None:
                failed.append(done)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    console.print(f"{out}: {len(trials) - len(failed)} of {len(trials)} trials")
    if failed:
        raise SimulationError("; ".join(f"{f.name}: {f.error}" for f in failed))
