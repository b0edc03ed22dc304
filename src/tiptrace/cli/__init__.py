"""Command line: one module per command; only here errors become messages and exit codes."""

from __future__ import annotations

import sys

import typer
from rich.console import Console
from rich.markup import escape

import tiptrace
from tiptrace.cli.calibrate_check import calibrate_check
from tiptrace.cli.calibrate_gel import calibrate_gel
from tiptrace.cli.calibrate_latency import calibrate_latency
from tiptrace.cli.calibrate_rig import calibrate_rig
from tiptrace.cli.calibrate_tip import calibrate_tip
from tiptrace.cli.compare import compare
from tiptrace.cli.demo import demo
from tiptrace.cli.depth import depth
from tiptrace.cli.doctor import doctor
from tiptrace.cli.evaluate import evaluate
from tiptrace.cli.export import export
from tiptrace.cli.import_gel import import_gel
from tiptrace.cli.inspect import inspect
from tiptrace.cli.live import live
from tiptrace.cli.plan_anchor import plan_anchor
from tiptrace.cli.reconstruct import reconstruct
from tiptrace.cli.record import record
from tiptrace.cli.ros2 import ros2
from tiptrace.cli.setup import setup
from tiptrace.cli.simulate import simulate
from tiptrace.cli.surface import surface
from tiptrace.cli.track import track
from tiptrace.cli.view import view
from tiptrace.errors import TipTraceError

app = typer.Typer(
    help="Where a grasped tool touches the world: tip trajectories from two tactile sensors and the robot's pose.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
calibrate = typer.Typer(help="What is measured once: gel, tip, rig.", no_args_is_help=True)
app.add_typer(calibrate, name="calibrate")

app.command()(demo)
app.command()(simulate)
app.command()(reconstruct)
app.command()(inspect)
app.command()(evaluate)
app.command()(surface)
app.command()(track)
app.command()(depth)
app.command()(compare)
app.command()(export)
app.command()(setup)
app.command()(doctor)
app.command()(record)
app.command()(live)
app.command()(view)
app.command()(ros2)
app.command("plan-anchor")(plan_anchor)
app.command("import-gel")(import_gel)
calibrate.command("gel")(calibrate_gel)
calibrate.command("check")(calibrate_check)
calibrate.command("tip")(calibrate_tip)
calibrate.command("rig")(calibrate_rig)
calibrate.command("latency")(calibrate_latency)


def _version(show: bool) -> None:
    if show:
        typer.echo(f"tiptrace {tiptrace.__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version."
    ),
) -> None:
    pass


def main() -> None:
    """Entry point: known errors become one sentence and exit code 2."""
    try:
        app()
    except TipTraceError as error:
        Console(stderr=True).print(
            f"[bold red]error:[/] {escape(str(error))}", highlight=False, soft_wrap=True
        )
        sys.exit(2)
