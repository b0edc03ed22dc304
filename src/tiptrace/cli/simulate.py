"""``tiptrace simulate``: trials of the virtual rig as recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def simulate(
    out: Annotated[Path, typer.Option(help="Recording to write (.mcap); with --suite a folder.")] = Path(
        "trial.mcap"
    ),
    trajectory: Annotated[str, typer.Option(help="T1 line, T2 arc, T3–T5 sinusoids.")] = "T3",
    tool: Annotated[str, typer.Option(help="O1 rectangular, O2 hexagonal, O3 cylindrical, O4 bent.")] = "O1",
    wrist: Annotated[str, typer.Option(help="W1–W3.")] = "W1",
    grasp: Annotated[str, typer.Option(help="G1–G3.")] = "G1",
    seed: Annotated[int, typer.Option(help="Everything random derives from it.")] = 0,
    level: Annotated[str, typer.Option(help="clean, nominal, hard or unseen.")] = "nominal",
    mode: Annotated[str, typer.Option(help="images, or markers: 3-D markers without images.")] = "images",
    truth: Annotated[
        Path | None, typer.Option(help="Also write the truth of every frame (.parquet).")
    ] = None,
) -> None:
    """Simulate a trial: settle the grasp, press down, Stage I, Stage II.

    Example: tiptrace simulate --trajectory T3 --tool O1 --wrist W1 --grasp G1 --seed 0 --out trial.mcap
    """
    from rich.console import Console
    from rich.progress import Progress

    from tiptrace.sim.spec import make_spec
    from tiptrace.streams.simulated import SimulatedStream
    from tiptrace.streams.writer import write_recording
    from tiptrace.types import TruthSample

    spec = make_spec(
        trajectory=trajectory, tool=tool, wrist=wrist, grasp=grasp, seed=seed, level=level, mode=mode
    )
    stream = SimulatedStream(spec)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(f"simulating {spec.name}", total=stream.frame_count)
        write_recording(
            out,
            stream,
            trial=stream.trial_metadata,
            progress=lambda sample: progress.advance(task) if isinstance(sample, TruthSample) else None,
        )
    Console().print(f"{out}: {spec.name}, {stream.frame_count} frames, level {level}, seed {seed}")
