"""``tiptrace calibrate rig``: sensor poses, scales, gains and latency from a wiggle about a clamped rod."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tiptrace.cli.options import Depth, MapFile, ReferenceFrames, ReferenceLeft, ReferenceRight, RigFile

if TYPE_CHECKING:
    from tiptrace.calibration.rig import RigCalibration
    from tiptrace.calibration.rig_data import Segment
    from tiptrace.config import Rig
    from tiptrace.types import FloatArray, Side, Stream


def calibrate_rig(
    wiggles: Annotated[
        list[Path], typer.Argument(help="Recordings of the hand wiggling about a rod that is clamped.")
    ],
    out: Annotated[Path | None, typer.Option(help="Write the calibrated rig here, e.g. rig.yaml.")] = None,
    rig: RigFile = None,
    map_file: MapFile = None,
    reference_left: ReferenceLeft = None,
    reference_right: ReferenceRight = None,
    reference_frames: ReferenceFrames = None,
    depth: Depth = "network",
    pitch: Annotated[
        bool, typer.Option("--pitch/--no-pitch", help="Use marker_pitch_mm where the rig states it.")
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Solve where both sensors sit, their scale, what their gels show, and the cameras' latency.

    Grip a rod that is clamped to the table and move the hand by about 0.5 mm and 2° in all six axes about the pads, for
    half a minute. Swapped, mirrored and inverted sensors are told; what the wiggle leaves open is said in words.

    Examples:

      tiptrace calibrate rig wiggle.mcap --out rig.yaml

      tiptrace calibrate rig wiggle1.mcap wiggle2.mcap --rig old.yaml --reference-frames 0:20 --out rig.yaml
    """
    from tiptrace.calibration.rig import calibrate_rig as solve
    from tiptrace.cli.files import check_writable
    from tiptrace.cli.show import progress_bar
    from tiptrace.config import dump_yaml
    from tiptrace.evaluation.atomic import write_atomic
    from tiptrace.streams.sources import open_recording

    options: dict[str, Any] = {
        "map_file": map_file,
        "rig": rig,
        "reference_left": reference_left,
        "reference_right": reference_right,
        "reference_frames": reference_frames,
    }
    if out is not None:
        check_writable(out)
    segments, believed = [], None
    with progress_bar() as progress:
        for path in wiggles:
            stream = open_recording(path, **options)
            believed = believed or stream.rig
            task = progress.add_task(path.name, total=None)
            segments.append(
                collect_wiggle(
                    stream, path.name, depth, believed, lambda n, t=task: progress.update(t, completed=n)
                )
            )
        assert believed is not None
        progress.add_task("solving", total=None)
        result = solve(segments, believed, use_pitch=pitch)
    if out is not None:
        write_atomic(out, dump_yaml(result.rig))
    if as_json:
        typer.echo(json.dumps(_as_dict(result), indent=2))
        return
    _print(result, believed)
    typer.echo(f"written: {out}" if out else "not written: give --out rig.yaml")


def collect_wiggle(stream: Stream, name: str, depth: str, rig: Rig, on_pair: Any = None) -> Segment:
    """Sense a recording of a wiggle."""
    from tiptrace.calibration.rig_data import WiggleCollector
    from tiptrace.perception.settings import SensingConfig
    from tiptrace.streams.synchronise import synchronise
    from tiptrace.tracer import Sensing
    from tiptrace.types import SIDES

    sensing = Sensing(stream, SensingConfig(depth=depth))
    collector = WiggleCollector(name)
    for count, observation in enumerate(synchronise(stream), start=1):
        collector.add(observation, sensing(observation))
        if on_pair is not None:
            on_pair(count)
    places: dict[Side, FloatArray] = {s: rig.T_E_S(s)[:3, 3] for s in SIDES}
    return collector.segment(places, _untouched(stream))


def _untouched(stream: Stream) -> dict[Side, FloatArray]:
    """Dots of the reference images in F_S, m."""
    from tiptrace.errors import PerceptionError
    from tiptrace.perception.lifting import lift
    from tiptrace.perception.markers import detect_markers

    found: dict[Side, FloatArray] = {}
    for side, image in stream.references.items():
        sensor = stream.rig.sensor(side)
        try:
            uv = detect_markers(image).uv_px
        except PerceptionError:
            continue
        found[side] = lift(uv, uv[:, 0] * 0.0, sensor.image_size_px, sensor.metres_per_px)[:, :2]
    return found


def _print(result: RigCalibration, old: Rig) -> None:
    import numpy as np
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title="Rig calibration: new value ± σ (change)")
    for column in ("", "left", "right"):
        table.add_column(column, justify="right" if column else "left")
    rows: dict[str, list[str]] = {}
    for side, s in result.sensors.items():
        t_mm, before = s.T_E_S[:3, 3] * 1e3, old.sensor(side)
        spread = np.abs(s.T_E_S[:3, :3]) @ s.translation_std_m * 1e3  # along F_E
        change = t_mm - np.array(before.T_E_S.translation_m) * 1e3
        for k, axis in enumerate("xyz"):
            value = f"{t_mm[k]:.2f} ± {spread[k]:.2f} ({change[k]:+.2f})"
            rows.setdefault(f"T_E_S, {axis}_E [mm]", []).append(value)
        for k, axis in enumerate("xyz"):
            value = f"{np.degrees(s.turned_rad[k]):+.2f} ± {np.degrees(s.rotation_std_rad[k]):.2f}"
            rows.setdefault(f"turned about {axis}_S [°]", []).append(value)
        for k, axis in enumerate("xy"):
            value = f"{s.mm_per_px[k]:.5f} ± {s.mm_per_px_std[k]:.5f} ({s.scaled[k] - 1:+.2%})"
            rows.setdefault(f"mm per px, {axis}", []).append(value)
        for k, axis in enumerate(("shear x", "shear y", "depth")):
            value = f"{s.gain[k]:.3f} ± {s.gain_std[k]:.3f}" if np.isfinite(s.gain[k]) else "not measured"
            rows.setdefault(f"gel shows of {axis}", []).append(value)
        was = "unknown" if before.latency_s is None else f"{before.latency_s * 1e3:.1f}"
        value = f"{s.latency_s * 1e3:.1f} ± {s.latency_std_s * 1e3:.1f} (was {was})"
        rows.setdefault("latency [ms]", []).append(value)
    for name, cells in rows.items():
        table.add_row(escape(name), *cells)
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    console.print(f"markers follow the rod to {result.residual_m * 1e3:.3f} mm")
    for sentence in result.weak:
        console.print(f"[yellow]note:[/] {sentence}")


def _as_dict(result: RigCalibration) -> dict[str, object]:
    import numpy as np

    return {
        "residual_mm": result.residual_m * 1e3,
        "weak": list(result.weak),
        "covariance": result.covariance.tolist(),
        "covariance_order": "per sensor, left first: rotation (3, rad) and translation (3, m) in F_S, "
        "ln of the scale's correction (2), ln of the gains (3), latency (s)",
        "sensors": {
            side: {
                "T_E_S": s.T_E_S.tolist(),
                "rotation_std_deg": np.degrees(s.rotation_std_rad).tolist(),
                "translation_std_mm": (s.translation_std_m * 1e3).tolist(),
                "turned_deg": np.degrees(s.turned_rad).tolist(),
                "shifted_mm": (s.shifted_m * 1e3).tolist(),
                "mm_per_px": s.mm_per_px.tolist(),
                "mm_per_px_std": s.mm_per_px_std.tolist(),
                "gain": [None if g != g else float(g) for g in s.gain],
                "gain_std": [None if g != g else float(g) for g in s.gain_std],
                "latency_s": s.latency_s,
                "latency_std_s": s.latency_std_s,
            }
            for side, s in result.sensors.items()
        },
    }
