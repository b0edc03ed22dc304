"""Command line: one module per command; only here errors become messages and exit codes."""

from __future__ import annotations

import sys

import typer
from rich.console import Console

from tiptrace.errors import TipTraceError

app = typer.Typer(
    help="Where a grasped tool touches the world.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def main() -> None:
    """Entry point: known errors become one sentence and exit code 2."""
    try:
        app()
    except TipTraceError as error:
        Console(stderr=True).print(f"[bold red]error:[/] {error}", highlight=False, soft_wrap=True)
        sys.exit(2)
