"""What several commands print."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
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
    from tiptrace.evaluation.result_table import COLUMNS, result_rows

    console = Console()
    rows = result_rows(result.methods, result.truth)
    shown = [k for k in range(len(COLUMNS)) if k == 0 or any(row.cells[k] != "–" for row in rows[:-1])]
    table = Table(title=title)
    for k in shown:
        table.add_column(COLUMNS[k], justify="left" if k == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*(row.cells[k] for k in shown), style="dim" if row.published else "")
    console.print(table)
    colour = {"pass": "green", "warn": "yellow", "fail": "red"}[result.quality.verdict]
    console.print(f"quality without ground truth: [{colour}]{result.quality.verdict}[/]")
    for reason in result.quality.reasons:
        console.print(f"  · {reason}", highlight=False)
