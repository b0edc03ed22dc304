"""The report of one trial: a page that stands alone, and each of its figures as bitmap and vector file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tiptrace.errors import OutputError
from tiptrace.evaluation import figures_sensing as sensing
from tiptrace.evaluation import figures_trajectory as space
from tiptrace.evaluation.embedding import FIGURES, EmbeddedFigure, embed_figure, render
from tiptrace.evaluation.quality import assess
from tiptrace.evaluation.report_data import ReportData
from tiptrace.evaluation.result_table import COLUMNS, result_rows
from tiptrace.evaluation.style import FORMATS, figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REPORT = "report.html"


def _has_positions(data: ReportData) -> bool:
    return any(e.p_B is not None for m in data.methods for e in m.trajectory.estimates)


@dataclass(frozen=True, slots=True)
class _Section:
    """A figure of the page: when it can be drawn, what it says, and how its picture is embedded."""

    name: str
    title: str
    caption: str
    draw: Callable[[ReportData], Figure]
    wanted: Callable[[ReportData], bool]
    bitmap: bool = False


_SECTIONS = (
    _Section(
        "trajectory",
        "Where the tip went",
        "Reconstruction segment, from the true start. The top panel has equal axes; the two below stretch the "
        "deviation to the side and in height so that it can be seen. Shaded: ± 2σ of the first method, where "
        "it gives a covariance.",
        space.overlay_top,
        _has_positions,
    ),
    _Section(
        "trajectory_3d",
        "In space",
        "The same traces in the base frame, equal axes.",
        space.overlay_3d,
        _has_positions,
    ),
    _Section(
        "error",
        "Error over time",
        "Top: distance to the true tip at the same instant, while anchoring that of the running estimate (cut "
        "off where it is still undetermined). Middle: distance to the true path, whatever the instant. "
        "Bottom: how far the estimate is ahead of the true tip along its path; friction makes the tip trail "
        "the hand, and a method that does not see this leads.",
        space.error_over_time,
        lambda d: d.truth is not None and _has_positions(d),
    ),
    _Section(
        "markers",
        "What the gels saw",
        "Tracked markers at the first and last pair. Arrows: displacement since frame 0, enlarged as stated. "
        "Orange: the markers of the rigid fit.",
        sensing.tactile_markers,
        lambda d: bool(d.tactile),
        bitmap=True,
    ),
    _Section(
        "depth",
        "Indentation",
        "Depth maps, positive = pressed in, untouched gel at 0.",
        sensing.depth_maps,
        sensing.has_depth,
        bitmap=True,
    ),
    _Section(
        "anchoring",
        "Anchoring fit",
        "Stage I: the tip rests and the hand moves about it. How well each pair agrees with one fixed point, "
        "and how the estimate settles as pairs come in.",
        sensing.anchoring_fit,
        sensing.has_anchoring,
    ),
    _Section(
        "times",
        "Speed",
        "Time from the pair of images, decoding included, to the tip; the first pair also detects the markers "
        "and loads the networks.",
        sensing.step_times,
        sensing.has_times,
    ),
    _Section(
        "events",
        "Status and events",
        "What each estimate is worth, and what happened.",
        space.events_timeline,
        lambda d: bool(d.main.trajectory.estimates),
    ),
)


def write_trial_report(folder: Path, data: ReportData, formats: tuple[str, ...] = FORMATS) -> Path:
    """Write ``report.html`` and ``figures/``, each figure as png, svg or pdf as asked; returns the page's path.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    try:
        (folder / FIGURES).mkdir(parents=True, exist_ok=True)
        with figure_style():
            figures = list(_figures(folder / FIGURES, data, formats))
        page = folder / REPORT
        page.write_text(render_page(data, figures), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{error.filename or folder}: cannot be written ({error.strerror})") from None
    return page


def render_page(data: ReportData, figures: list[EmbeddedFigure]) -> str:
    """The page's text."""
    return render(
        "trial_report.html.j2",
        data=data,
        figures=figures,
        columns=COLUMNS,
        rows=result_rows(data.methods, data.truth),
        quality=assess(data.main.trajectory),
        events=data.main.trajectory.events,
    )


def _figures(folder: Path, data: ReportData, formats: tuple[str, ...]) -> Iterator[EmbeddedFigure]:
    for s in _SECTIONS:
        if s.wanted(data):
            yield embed_figure(folder, s.name, s.title, s.caption, s.draw(data), s.bitmap, formats)
