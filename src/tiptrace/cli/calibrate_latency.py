"""``tiptrace calibrate latency``: camera-to-robot latency from a motion with the tip at rest."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from tiptrace.cli.options import Depth, MapFile, ReferenceFrames, ReferenceLeft, ReferenceRight, RigFile


def calibrate_latency(
    recording: Annotated[
        Path, typer.Argument(help="Recording with a Stage I: the tip rests, the hand turns.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Write the rig with the latency here, e.g. rig.yaml.")
    ] = None,
    rig: RigFile = None,
    map_file: MapFile = None,
    reference_left: ReferenceLeft = None,
    reference_right: ReferenceRight = None,
    reference_frames: ReferenceFrames = None,
    depth: Depth = "network",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a sentence.")] = False,
) -> None:
    """How much later than its exposure an image is stamped, against the robot's clock.

    `tiptrace calibrate rig` finds it too, for each camera, from a wiggle about a clamped rod.

    Examples:

      tiptrace calibrate latency trial.mcap

      tiptrace calibrate latency trial.mcap --rig rig.yaml --out rig.yaml
    """
    from tiptrace.calibration.latency import calibrate_latency as solve
    from tiptrace.calibration.latency import rig_with_latency
    from tiptrace.cli.files import check_writable
    from tiptrace.cli.show import progress_bar
    from tiptrace.config import dump_yaml
    from tiptrace.evaluation.atomic import write_atomic
    from tiptrace.perception.settings import SensingConfig
    from tiptrace.streams.sources import open_recording
    from tiptrace.streams.synchronise import synchronise
    from tiptrace.tracer import Sensing

    stream = open_recording(
        recording,
        map_file=map_file,
        rig=rig,
        reference_left=reference_left,
        reference_right=reference_right,
        reference_frames=reference_frames,
    )
    if out is not None:
        check_writable(out)
    sensing = Sensing(stream, SensingConfig(depth=depth))
    with progress_bar() as progress:
        task = progress.add_task(f"sensing {recording.name}", total=None)
        pairs = []
        for observation in synchronise(stream):
            pairs.append(sensing(observation))
            progress.update(task, completed=len(pairs))
        result = solve(pairs)
    if out is not None:
        write_atomic(out, dump_yaml(rig_with_latency(stream.rig, result)))
    if as_json:
        typer.echo(json.dumps(asdict(result), indent=2))
        return
    first, second = (v * 1e3 for v in result.halves_s)
    typer.echo(
        f"latency {result.latency_s * 1e3:.1f} ± {result.std_s * 1e3:.1f} ms, from {result.frames} pairs with the tip "
        f"at rest (halves: {first:.1f} and {second:.1f} ms; residual {result.residual_m * 1e3:.2f} mm)"
    )
    typer.echo(f"written: {out}" if out else "not written: give --out rig.yaml")
