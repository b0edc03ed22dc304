"""``tiptrace record``: cameras and robot into a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def record(
    rig: Annotated[Path, typer.Option(help="rig.yaml, with references beside it (tiptrace setup).")],
    robot: Annotated[str, typer.Option(help="ur://HOST, ros2, replay:FILE, or none.")],
    out: Annotated[Path, typer.Option(help="Recording to write, *.mcap; never overwritten.")],
    left: Annotated[str | None, typer.Option(help="Left camera, in place of the rig file's.")] = None,
    right: Annotated[str | None, typer.Option(help="Right camera, in place of the rig file's.")] = None,
    tool: Annotated[
        Path | None, typer.Option(help="tool.yaml; default: the one beside the rig file.")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="End after so many seconds.", min=0.1)] = None,
    wait: Annotated[
        bool, typer.Option("--wait", help="Begin with the first mark (space), not at once.")
    ] = False,
) -> None:
    """Record two cameras and a robot; synced to the disk every second, whatever happens.

    Space marks the end of the anchoring, again the end of the trial; q stops.

    Example: tiptrace record --rig rig.yaml --robot ur://192.168.1.10 --out trial.mcap --duration 30
    """
    import signal
    from contextlib import ExitStack

    from rich.console import Console

    from tiptrace.cli.live_terminal import device_table, keys, print_gel_health
    from tiptrace.live.recording import RecordingSession
    from tiptrace.live.start import (
        camera_addresses,
        gel_health,
        make_session,
        read_rig_folder,
        refuse_to_overwrite,
    )

    console = Console()
    refuse_to_overwrite(out)
    folder = read_rig_folder(rig, tool)
    addresses = camera_addresses(folder.rig, {"left": left, "right": right})
    parts = make_session(folder, addresses, robot, out=out)
    assert parts.recorder is not None
    recorder, stream = parts.recorder, parts.stream
    session = RecordingSession(stream, recorder, wait_for_mark=wait)
    before = signal.signal(signal.SIGTERM, lambda *_: session.stop())
    try:
        with ExitStack() as stack:
            stack.enter_context(stream)
            print_gel_health(console, {str(k): v for k, v in gel_health(stream).items()})
            stack.enter_context(keys(session))
            begins = "space begins, " if wait else ""
            console.print(f"recording {out}; {begins}q or Ctrl-C stops", markup=False, soft_wrap=True)
            try:
                summary = session.run(duration)
            except KeyboardInterrupt:
                summary = None
                if recorder.error is not None:
                    raise recorder.error from None
    finally:
        signal.signal(signal.SIGTERM, before)
        if recorder.file.exists():
            console.print(f"recording: {recorder.file}", highlight=False, markup=False, soft_wrap=True)
    console.print(device_table(stream.health()))
    if summary is not None:
        text = f"{summary.images} images, {summary.poses} poses in {summary.seconds:.1f} s"
        lost = summary.recorder.dropped
        console.print(
            text + (f"; {lost} samples lost: the disk did not keep up" if lost else ""), highlight=False
        )
