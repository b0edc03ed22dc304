"""The suite's page stands alone; traces survive their file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import OutputError
from tiptrace.evaluation.analytic import CENTRELINES
from tiptrace.evaluation.conditions import Condition, distinct_conditions
from tiptrace.evaluation.figures_suite import error_distribution, overlays
from tiptrace.evaluation.records import TrialRecord
from tiptrace.evaluation.suite_report import SuiteData, write_suite_report
from tiptrace.evaluation.traces import TrialTraces
from tiptrace.evaluation.truth import Truth

from .builders import straight_truth, trajectory_of, truth_of
from .suite_builders import metrics, suite
from .test_trial_report import Page

SVG = ("svg",)


def traces() -> Iterator[tuple[Condition, TrialTraces]]:
    for condition in distinct_conditions():
        p = CENTRELINES[condition.trajectory].offset(np.linspace(0, 0.2, 50)) * 1e3
        yield condition, TrialTraces(p, {"full": p + 0.1, "paper": p + 5.0})


def test_titles_of_a_single_condition_stay_within_the_picture():
    figure = overlays(list(traces())[:1], "local-anchoring")
    figure.draw_without_rendering()
    box = figure.texts[0].get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1


def test_a_single_trial_is_seen_in_the_distribution():
    figure = error_distribution([r for r in suite(1) if r.method == "full"][:1])
    (line,) = figure.axes[0].lines
    assert np.ptp(np.asarray(line.get_ydata(), dtype=float)) == 1.0


def test_the_page_holds_tables_figures_and_outliers(tmp_path: Path):
    records = [r for r in suite() if r.method != "ee-only"]
    k = next(i for i, r in enumerate(records) if r.method == "full" and r.metrics)
    m = records[k].metrics
    assert m is not None
    far = replace(m, trajectory_rmse_mm=9.0)
    records[k] = replace(records[k], metrics=far, report="trials/a/report.html")
    budget = {"latency": records[:30], "depth tilt": records[30:60]}
    data = SuiteData(
        "Suite", records, traces, budget, {"level": "nominal"}, {"numpy": "2"}, "tiptrace evaluate"
    )
    text = write_suite_report(tmp_path, data, SVG).read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    links = [s for s in page.sources if not s.startswith("data:image/")]
    assert links == ["trials/a/report.html"]
    for heading in (
        "Mean ± std over trials",
        "Error budget of the anchor",
        "Traces: full",
        "Outliers",
        "Failures",
        "Reproduce",
    ):
        assert heading in page.headings
    assert "no markers &amp; 50 % dark" in text
    names = {p.stem for p in (tmp_path / "figures").iterdir()}
    assert {"error_against_anchoring", "shape_by_set", "error_distribution", "overlays_paper"} <= names
    assert (tmp_path / "tables" / "overall.tex").exists()


@pytest.mark.parametrize(
    "records",
    [
        [],
        [TrialRecord("a", "full", failure="broken")],
        [TrialRecord("a.mcap", "full", metrics(1, 1, 1))],
        [TrialRecord("a.mcap", "full", metrics(float("nan"), float("nan"), float("nan")))],
    ],
    ids=["nothing", "failed", "one", "no truth"],
)
def test_hardly_any_records_still_give_a_page(tmp_path: Path, records: list[TrialRecord]):
    assert (
        Page(write_suite_report(tmp_path, SuiteData("few", records), SVG).read_text(encoding="utf-8")).open
        == []
    )


def test_traces_start_at_the_true_start_and_survive_their_file(tmp_path: Path):
    p = straight_truth() + 0.4
    estimate = p + 1e-3
    estimate[10] = np.nan
    kept = TrialTraces.of({"full": trajectory_of(estimate, 5, anchor=p[0])}, Truth.from_samples(truth_of(p)))
    assert kept.truth_mm[0] == pytest.approx([1.0, 0, 0])
    assert kept.methods_mm["full"][0] == pytest.approx([2.0, 1.0, 1.0])
    assert np.isnan(kept.methods_mm["full"][5]).all()
    kept.write(tmp_path / "t.npz")
    again = TrialTraces.read(tmp_path / "t.npz")
    np.testing.assert_allclose(again.truth_mm, kept.truth_mm, atol=1e-5)
    np.testing.assert_allclose(again.methods_mm["full"], kept.methods_mm["full"], atol=1e-5)
    untold = TrialTraces.of({"full": trajectory_of(estimate, 5)}, None)
    assert untold.methods_mm["full"][0] == pytest.approx([0.0, 0.0, 0.0])
    (tmp_path / "bad.npz").write_text("no")
    with pytest.raises(OutputError, match="bad"):
        TrialTraces.read(tmp_path / "bad.npz")
