"""The report page stands alone, leaves out what is missing, and says what the paper's row is."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import OutputError
from tiptrace.evaluation.report_data import MethodResult, ReportData
from tiptrace.evaluation.result_table import COLUMNS, result_rows
from tiptrace.evaluation.trial_report import write_trial_report
from tiptrace.types import Phase, Status, TipEstimate, TipTrajectory

from .builders import straight_truth, trajectory_of
from .report_builders import full_report

SVG = ("svg",)
VOID = {"meta", "img", "br", "link"}


class Page(HTMLParser):
    """Collects what a page loads, its headings, and whether its tags balance."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.open: list[str] = []
        self.headings: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [v or "" for k, v in attrs if k in {"src", "href"}]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("report")
    return folder, write_trial_report(folder, full_report()).read_text(encoding="utf-8")


def test_the_page_loads_nothing_from_elsewhere(full: tuple[Path, str]):
    page = Page(full[1])
    assert page.open == []
    assert len(page.sources) == 8
    assert all(s.startswith("data:image/") for s in page.sources)
    assert "http" not in re.sub(r'"data:[^"]*"', "", full[1])


def test_every_figure_is_there_as_bitmap_and_vector(full: tuple[Path, str]):
    folder, _ = full
    names = {"trajectory", "trajectory_3d", "error", "markers", "depth", "anchoring", "times", "events"}
    found = {f.name for f in (folder / "figures").iterdir()}
    assert found == {f"{name}.{kind}" for name in names for kind in ("png", "svg")}


def test_everything_that_was_given_is_shown(full: tuple[Path, str]):
    text = full[1]
    headings = Page(text).headings
    for heading in ("Result", "Where the tip went", "Error over time", "What the gels saw", "Indentation"):
        assert heading in headings
    for heading in ("Anchoring fit", "Speed", "Status and events", "Settings", "Reproduce"):
        assert heading in headings
    assert "8.59 ± 2.41" in text
    assert "published, hardware, n = 51" in text
    assert "tiptrace demo --out demo" in text
    assert "2 of 16 &lt;left&gt;" in text  # details are text, not markup


def test_a_bare_trajectory_is_enough(tmp_path: Path):
    p = straight_truth()
    data = ReportData("bare", (MethodResult("full", trajectory_of(p, 5)),))
    page = Page(write_trial_report(tmp_path, data, SVG).read_text(encoding="utf-8"))
    assert page.headings == ["Result", "Where the tip went", "In space", "Anchoring fit", "Status and events"]


@pytest.mark.parametrize(
    "trajectory",
    [
        TipTrajectory(),
        TipTrajectory([TipEstimate(5, Phase.RECONSTRUCTION, Status.LOST)]),
        TipTrajectory([TipEstimate(5, Phase.RECONSTRUCTION, Status.OK, p_B=np.ones(3))]),
        TipTrajectory([TipEstimate(5, None, Status.OK, p_B=np.ones(3))]),
    ],
    ids=["empty", "lost", "one row", "no phase"],
)
def test_hardly_any_data_still_gives_a_page(tmp_path: Path, trajectory: TipTrajectory):
    data = replace(full_report(), methods=(MethodResult("paper", trajectory),), anchoring=None, tactile=())
    for variant in (data, replace(data, truth=None, step_ms={})):
        assert Page(write_trial_report(tmp_path, variant, SVG).read_text(encoding="utf-8")).open == []


def test_gels_without_markers_depth_or_survivors(tmp_path: Path):
    data = full_report()
    bare = replace(data.tactile[0], uv_first_px=None, depth_first_mm=None, depth_last_mm=None)
    uv = data.tactile[1].uv_first_px
    assert uv is not None
    dead = replace(data.tactile[1], uv_last_px=np.full_like(uv, np.nan), depth_last_mm=None, selected=None)
    page = write_trial_report(tmp_path, replace(data, tactile=(bare, dead)), SVG).read_text(encoding="utf-8")
    assert "What the gels saw" in page


def test_travel_in_any_direction_has_a_stretched_view(tmp_path: Path):
    p = straight_truth() @ np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1.0]])
    data = ReportData("turned", (MethodResult("full", trajectory_of(p, 5)),))
    assert write_trial_report(tmp_path, data, SVG).exists()


def test_rows_hold_numbers_with_the_columns_units():
    data = full_report()
    rows = result_rows(data.methods, data.truth)
    assert [row.published for row in rows] == [False, False, True]
    assert all(len(row.cells) == len(COLUMNS) for row in rows)
    assert rows[2].cells[1:4] == ("8.59 ± 2.41", "5.96 ± 1.16", "9.48 ± 3.77")
    assert rows[2].cells[6] == "14.00 ± 4.11"
    assert rows[0].cells[8] == "95"
    untold = result_rows(data.methods, None)
    assert untold[0].cells[1] == "–"


def test_a_page_that_cannot_be_written_is_one_sentence(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_trial_report(tmp_path / "file", full_report())
