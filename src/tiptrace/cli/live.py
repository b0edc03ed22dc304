"""``tiptrace live``: the tip as it goes."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tiptrace.live.session import LiveSession
    from tiptrace.live.start import RigFolder


def live(
    rig: Annotated[Path, typer.Option(help="rig.yaml, with references beside it (tiptrace setup).")],
    robot: Annotated[str, typer.Option(help="ur://HOST, ros2, or replay:FILE.")],
    left: Annotated[str | None, typer.Option(help="Left camera, in place of the rig file's.")] = None,
    right: Annotated[str | None, typer.Option(help="Right camera, in place of the rig file's.")] = None,
    method: Annotated[str, typer.Option(help="full, paper, or a baseline.")] = "full",
    tool: Annotated[
        Path | None, typer.Option(help="tool.yaml; default: the one beside the rig file.")
    ] = None,
    record: Annotated[Path | None, typer.Option(help="Write a recording at the same time.")] = None,
    duration: Annotated[float | None, typer.Option(help="End after so many seconds.", min=0.1)] = None,
    wait: Annotated[
        bool, typer.Option("--wait", help="Begin with the first mark (space), not at once.")
    ] = False,
    view: Annotated[bool, typer.Option("--view", help="Open a viewer (Rerun, else the page).")] = False,
    serve: Annotated[
        str | None, typer.Option(help="Serve the page at HOST:PORT; only 127.0.0.1 unless told so.")
    ] = None,
) -> None:
    """Trace the tip live: two cameras and a robot, the same loop as on recordings.

    In Stage I rotate the hand about the resting tip: the standard deviation of the tip shrinks per axis, and the line
    below says which motion is missing and when it is enough. Space marks the end of the anchoring; without it the end
    is found when the hand sets off.

    Examples:

      tiptrace live --rig rig.yaml --robot ur://192.168.1.10 --record trial.mcap

      tiptrace live --rig rig.yaml --robot replay:trial.mcap --left http://127.0.0.1:8081/ --right http://127.0.0.1:8082/
    """
    from tiptrace.live.start import (
        camera_addresses,
        make_session,
        read_rig_folder,
        refuse_to_overwrite,
    )
    from tiptrace.viewers.live import parse_address

    folder = read_rig_folder(rig, tool)
    _check_enough(folder, robot)
    if serve is not None:
        parse_address(serve)
    if record is not None:
        refuse_to_overwrite(record)
    addresses = camera_addresses(folder.rig, {"left": left, "right": right})
    session = make_session(folder, addresses, robot, method=method, out=record, wait_for_mark=wait)
    run_session(session, duration, view=view, serve=serve)


def _check_enough(folder: RigFolder, robot: str) -> None:
    """What a recording can do without and an estimate cannot, told before anything is opened.

    Raises:
        ConfigError: no robot, or no image of an untouched gel.
    """
    from tiptrace.errors import ConfigError
    from tiptrace.streams.topics import REFERENCE_FILE
    from tiptrace.types import SIDES

    if robot == "none":
        raise ConfigError(
            "--robot none: without poses no tip can be traced; give the robot, or record the images alone with "
            "tiptrace record"
        )
    for side in SIDES:
        if side not in folder.references:
            raise ConfigError(
                f"no {REFERENCE_FILE[side]} beside the rig file: depth is measured against the untouched gel; take it "
                "with tiptrace setup, or put it there"
            )


def run_session(
    session: LiveSession, duration_s: float | None, *, view: bool = False, serve: str | None = None
) -> None:
    """Open, check the gels, run until stopped, and say what it was.

    Raises:
        TipTraceError: what ended the session early, or the recording.
    """
    import signal
    from contextlib import ExitStack

    from rich.console import Console

    from tiptrace.cli.live_terminal import Terminal, keys, print_gel_health, print_summary
    from tiptrace.live.start import gel_health

    console = Console()
    before = signal.signal(signal.SIGTERM, lambda *_: session.stop())
    try:
        with ExitStack() as stack:
            stack.enter_context(session.stream)
            print_gel_health(console, {str(k): v for k, v in gel_health(session.stream).items()})
            if view or serve is not None:
                console.print(
                    stack.enter_context(_viewer(session, view, serve)), highlight=False, markup=False
                )
            stack.enter_context(Terminal(session, console).shown())
            stack.enter_context(keys(session))
            try:
                summary = session.run(duration_s, opened=True)
            except KeyboardInterrupt:
                summary = session.summary()
    finally:
        signal.signal(signal.SIGTERM, before)
        if session.recorder is not None and session.recorder.file.exists():
            console.print(
                f"recording: {session.recorder.file}", highlight=False, markup=False, soft_wrap=True
            )
    print_summary(console, summary)
    if session.recorder is not None and session.recorder.error is not None:
        raise session.recorder.error


def _viewer(session: LiveSession, view: bool, serve: str | None) -> AbstractContextManager[str]:
    """Whatever of the viewers is installed; gives what to tell the user."""
    import importlib

    from tiptrace.errors import ConfigError

    try:
        module = importlib.import_module("tiptrace.viewers.live")
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("tiptrace"):
            raise ConfigError("this installation has no viewer; run without --view and --serve") from None
        raise
    watched: AbstractContextManager[str] = module.watch_live(session, view=view, serve=serve)
    return watched
