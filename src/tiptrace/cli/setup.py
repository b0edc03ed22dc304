"""``tiptrace setup``: from cables to a rig file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def setup(
    start_from: Annotated[
        Path,
        typer.Option(
            "--from", help="Rig file with the extrinsics T_E_S, gel models and scales to start from."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for rig.yaml and the references.")] = Path("rig"),
    camera: Annotated[
        list[str] | None,
        typer.Option(help="Camera to try, v4l2:SERIAL or http://…; default: all of this machine."),
    ] = None,
    robot: Annotated[str | None, typer.Option(help="Robot to reach: ur://HOST, ros2.")] = None,
    crop: Annotated[bool, typer.Option(help="Cut off the gel's border (a seventh on each side).")] = True,
    timeout: Annotated[float, typer.Option(help="Seconds to wait for a touch.", min=1)] = 60.0,
) -> None:
    """Find cameras and robot, learn by touch which is left and right, take the references and write the rig.

    Keep the gripper open: nothing may touch the gels but your finger, when asked.

    Example: tiptrace setup --from nominal-rig.yaml --robot ur://192.168.1.10 --out rig
    """
    from rich.console import Console

    from tiptrace.config import Rig, load_yaml
    from tiptrace.drivers.opening import open_robot
    from tiptrace.drivers.timeline import Timeline
    from tiptrace.live.setup import Setup, candidates, refuse_an_old_rig, with_gel_models
    from tiptrace.streams.live import check_frames
    from tiptrace.types import SIDES

    console = Console()
    rig = with_gel_models(load_yaml(Rig, start_from), start_from.parent)
    refuse_an_old_rig(out)
    if robot is not None and robot != "none":
        device = open_robot(robot, Timeline())
        check_frames(device.frames, rig.frames)
        try:
            device.start(lambda: None)
            check_frames(device.frames, rig.frames)
        finally:
            device.close()
        console.print(f"robot: {robot} sends poses", highlight=False, markup=False)
    helper = Setup(
        rig,
        candidates(camera or []),
        lambda text: console.print(text, highlight=False, markup=False),
        crop=crop,
    )
    found = helper.identify(timeout)
    sensors = {side: helper.sensor(side, found[side]) for side in SIDES}
    console.print("taking the references: do not touch the gels")
    references = {side: helper.reference(side, sensors[side], found[side]) for side in SIDES}
    path = helper.write(out, sensors, references)
    console.print(
        f"written: {path}, with the references beside it", highlight=False, markup=False, soft_wrap=True
    )
    if crop:
        console.print(
            "mm_per_px belongs to the crop: calibrate the rig again if it was another (tiptrace calibrate rig)",
            style="yellow",
        )
