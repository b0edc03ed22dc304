"""``tiptrace demo``: the main job end to end, without hardware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the recording and the report.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Seed of the simulated trial.")] = 0,
) -> None:
    """Simulate a trial (T3, O1, W1, G1) as a recording, reconstruct it from the file and write a report.

    Example: tiptrace demo --out demo
    """
    from rich.console import Console

    from tiptrace.cli.reconstruct import reconstruct
    from tiptrace.cli.simulate import simulate

    console = Console()
    trial = out / "trial.mcap"
    console.print(f"[bold]1/2[/] the virtual rig traces a sinusoidal groove with a grasped tool → {trial}")
    out.mkdir(parents=True, exist_ok=True)
    simulate(out=trial, seed=seed)
    console.print("[bold]2/2[/] the tip's trajectory from the two tactile image streams and the robot's pose")
    reconstruct([trial], out=out, method="full", beside=["paper", "ee-only"])
    console.print(
        f"\nOpen [bold]{out / 'report.html'}[/] in a browser. What to try next:\n"
        f"  tiptrace inspect {trial}\n"
        f"  tiptrace simulate --trajectory T2 --seed 7 --out {out / 'arc.mcap'}\n"
        f"  tiptrace reconstruct {out / 'arc.mcap'} --out {out / 'arc'}",
        highlight=False,
    )
