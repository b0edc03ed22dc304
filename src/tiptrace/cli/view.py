"""``tiptrace view``: watch a recording, in Rerun or on a page of its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tiptrace.cli.options import MapFile

if TYPE_CHECKING:
    from tiptrace.snapshot import Snapshot
    from tiptrace.streams.foreign import ForeignRecording
    from tiptrace.streams.recording import Recording
    from tiptrace.tracer import TipTracer
    from tiptrace.types import TipTrajectory


def view(
    path: Annotated[Path, typer.Argument(help="Recording (.mcap), or any ROS 2 bag with --map and --rig.")],
    page: Annotated[
        bool, typer.Option("--page", help="Serve the page and replay in real time; needs no extra.")
    ] = False,
    save: Annotated[Path | None, typer.Option(help="Write a Rerun file (.rrd) and open nothing.")] = None,
    method: Annotated[str, typer.Option(help="full, paper, or a baseline.")] = "full",
    address: Annotated[
        str, typer.Option(help="HOST:PORT of the page; only 127.0.0.1 unless told so.")
    ] = "127.0.0.1:8321",
    speed: Annotated[float, typer.Option(min=0.01, help="Of the page's replay; 1 is real time.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="End with the recording, in place of Ctrl-C.")] = False,
    rig: Annotated[Path | None, typer.Option(help="rig.yaml, in place of the attached one.")] = None,
    tool: Annotated[Path | None, typer.Option(help="tool.yaml, in place of the attached one.")] = None,
    map_file: MapFile = None,
) -> None:
    """Watch a recording: images with marker arrows, depth, the scene in 3-D, uncertainty, plots and events.

    Examples:

      tiptrace view trial.mcap

      tiptrace view trial.mcap --save trial.rrd

      tiptrace view trial.mcap --page
    """
    from importlib.util import find_spec

    from tiptrace.streams.sources import open_recording

    stream = open_recording(path, map_file=map_file, rig=rig, tool=tool)
    if page or (save is None and find_spec("rerun") is None):
        _page(stream, path.name, method, address, speed, once)
    else:
        _rerun(stream, path.name, method, save)


def _page(
    stream: Recording | ForeignRecording, name: str, method: str, address: str, speed: float, once: bool
) -> None:
    from tiptrace.viewers.live import parse_address
    from tiptrace.viewers.page import PageServer

    with PageServer(*parse_address(address), title=name) as server:
        typer.echo(f"page: {server.url}   (Ctrl-C ends)")
        try:
            _replay(stream, method, lambda _: server.show, pace=speed)
            while not once:
                time.sleep(0.2)
        except KeyboardInterrupt:
            return


def _rerun(stream: Recording | ForeignRecording, name: str, method: str, save: Path | None) -> None:
    from tiptrace.viewers.rerun_log import RerunLog

    log = RerunLog(name, stream.rig, stream.truth())
    if save is not None:
        log.save(save)
    else:
        log.spawn()

    def show(tracer: TipTracer) -> Callable[[Snapshot], None]:
        log.depth_of = tracer.sensing.fingers
        return log.show

    trajectory = _replay(stream, method, show)
    log.finish(trajectory)
    if save is not None:
        typer.echo(f"written: {save}   (open it with: rerun {save})")


def _replay(
    stream: Recording | ForeignRecording,
    method: str,
    show: Callable[[TipTracer], Callable[[Snapshot], None]],
    pace: float | None = None,
) -> TipTrajectory:
    from tiptrace.pipeline import open_tracer, trace
    from tiptrace.viewers.steps import SnapshotViewer

    with open_tracer(stream, method) as tracer:
        return trace(stream, tracer, SnapshotViewer(tracer, show(tracer), pace))
