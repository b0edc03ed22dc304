"""The report over a suite: tables, figures and what reproduces them, in one page that stands alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from tiptrace.errors import OutputError
from tiptrace.evaluation import figures_suite as draw
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.evaluation.conditions import Condition
from tiptrace.evaluation.embedding import FIGURES, EmbeddedFigure, embed_figure, render
from tiptrace.evaluation.records import TrialRecord
from tiptrace.evaluation.style import FORMATS, figure_style
from tiptrace.evaluation.suite_side_tables import budget_table
from tiptrace.evaluation.suite_tables import suite_tables
from tiptrace.evaluation.suite_values import BASELINES, methods_of, outliers
from tiptrace.evaluation.tables import write_tables
from tiptrace.evaluation.traces import TrialTraces

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REPORT = "report.html"


@dataclass(frozen=True, slots=True)
class SuiteData:
    """What a suite report shows.

    Attributes:
        title: Heading.
        records: One per trial and method.
        traces: Traces by trial, with their condition, for the overlays; read one by one.
        budget: Records with one disturbance at a time, by its name.
        settings: What the suite was set to, as text.
        versions: Version of each library that had a part in it.
        command: Command that reproduces it.
        notes: Sentences that a reader should know.
    """

    title: str
    records: Sequence[TrialRecord]
    traces: Callable[[], Iterator[tuple[Condition, TrialTraces]]] | None = None
    budget: Mapping[str, Sequence[TrialRecord]] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    command: str = ""
    notes: tuple[str, ...] = ()


def write_suite_report(folder: Path, data: SuiteData, formats: tuple[str, ...] = FORMATS) -> Path:
    """Write ``report.html``, ``figures/`` (png, svg or pdf as asked) and ``tables/``; returns the page's path.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    tables = suite_tables(data.records)
    if data.budget:
        tables.append(budget_table(data.budget))
    write_tables(folder / "tables", tables)
    try:
        (folder / FIGURES).mkdir(parents=True, exist_ok=True)
        with figure_style():
            figures = [
                embed_figure(folder / FIGURES, name, title, caption, figure, formats=formats)
                for name, title, caption, figure in _figures(data)
            ]
    except OSError as error:
        raise OutputError(f"{error.filename or folder}: cannot be written ({error.strerror})") from None
    write_atomic(folder / REPORT, _page(data, tables, figures))
    return folder / REPORT


def _page(data: SuiteData, tables: Sequence[object], figures: Sequence[EmbeddedFigure]) -> str:
    worst = {m: outliers(data.records, m) for m in methods_of(data.records)}
    return render(
        "suite_report.html.j2",
        data=data,
        tables=tables,
        figures=figures,
        outliers={m: records for m, records in worst.items() if records},
    )


def _figures(data: SuiteData) -> Iterator[tuple[str, str, str, Figure]]:
    records = data.records
    done = [r for r in records if math.isfinite(r.value("shape_rmse_mm"))]
    if not done:  # no ground truth, or nothing but failures
        return
    yield (
        "error_against_anchoring",
        "Where the error comes from",
        "Each point is a trial. The paper finds that its trajectory error follows the anchor and its shape error "
        "does not.",
        draw.error_against_anchoring(records),
    )
    if any(r.condition is not None for r in done):
        yield (
            "shape_by_set",
            "Shape error by condition set",
            "Boxes: quartiles and median; points: trials. A condition that sets share counts in each.",
            draw.shape_by_set(records),
        )
    yield (
        "error_distribution",
        "Trials within an error",
        "Methods that refuse or fail in some trials end below 1.",
        draw.error_distribution(records),
    )
    for method in [m for m in methods_of(records) if m not in BASELINES][:2]:
        if (figure := draw.against_baselines(records, method)) is not None:
            caption = (
                "Trajectory RMSE of each trial; below the line the method on the vertical axis is better."
            )
            yield f"against_baselines_{method}", f"{method}, trial by trial", caption, figure
    if data.traces is not None:
        for method in methods_of(records):
            caption = "Top view from the true start; y is stretched. A panel for each condition of each set."
            yield f"overlays_{method}", f"Traces: {method}", caption, draw.overlays(data.traces(), method)
    if data.budget:
        caption = "Simulated with one disturbance at a time, all others off."
        for metric, title in (("initial_contact_error_mm", "the anchor"), ("shape_rmse_mm", "the shape")):
            figure = draw.error_budget(data.budget, metric)
            yield f"error_budget_{metric}", f"Error budget of {title}", caption, figure
