"""``tiptrace ros2``: the tracer as a ROS 2 node."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def ros2(
    ros_arguments: Annotated[
        list[str] | None, typer.Argument(help="ROS arguments, after --: --ros-args -p method:=full …")
    ] = None,
    rig: Annotated[
        Path | None, typer.Option(help="rig.yaml with references beside it; or -p rig:=rig.yaml.")
    ] = None,
) -> None:
    """Trace the tip from ROS 2 topics and publish it: tip, tip_pose, path, /diagnostics.

    Examples:

      tiptrace ros2 --rig rig.yaml

      tiptrace ros2 -- --ros-args -p rig:=rig.yaml -p use_sim_time:=true -p pose_topic:=/tcp_pose
    """
    from tiptrace.ros.node import run

    run(ros_arguments or [], rig)
