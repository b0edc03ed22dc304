"""What several commands print."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

if TYPE_CHECKING:
    from tiptrace.reconstruction import Reconstruction


def progress_bar() -> Progress:
    """A bar on standard error that leaves nothing behind."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True), transient=True)


def print_results(result: Reconstruction, title: str) -> None:
    """Result table of one trial, then the verdict and what the user should know."""
    from tiptrace.evaluation.result_table import COLUMNS, MISSING, result_rows

    console = Console()
    rows = result_rows(result.methods, result.truth)
    table = Table(title=escape(title))
    table.add_column("")
    for row in rows:
        table.add_column(row.cells[0], justify="right", style="dim" if row.published else "")
    for k in range(1, len(COLUMNS)):
        values = [row.cells[k] for row in rows]
        if any(value != MISSING for value in values[:-1]):
            table.add_row(escape(COLUMNS[k]), *values)
    console.print(table)
    colour = {"pass": "green", "warn": "yellow", "fail": "red"}[result.quality.verdict]
    console.print(f"quality without ground truth: [{colour}]{result.quality.verdict}[/]")
    for reason in result.quality.reasons:
        console.print(f"  · {reason}", highlight=False, markup=False)
