"""Suite tables: the numbers they hold and the forms they take."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tiptrace.evaluation.conditions import CONDITION_SETS, Condition, distinct_conditions, sets_of
from tiptrace.evaluation.suite_side_tables import events_table, failures_table
from tiptrace.evaluation.suite_tables import (
    correlation_table,
    overall_table,
    sets_table,
    suite_tables,
    wins_table,
)
from tiptrace.evaluation.suite_values import outliers, set_values
from tiptrace.evaluation.tables import Table, columns, write_tables

from .suite_builders import suite


def test_the_papers_sets_hold_twelve_distinct_conditions():
    assert len(distinct_conditions()) == 12
    assert [len(c) for c in CONDITION_SETS.values()] == [5, 4, 3, 3]
    assert sets_of(Condition("T3", "O1", "W1", "G1")) == ("A", "B", "D")
    assert sets_of(Condition("T3", "O2", "W1", "G1")) == ("B", "C")


def test_the_virtual_rig_has_the_same_sets():
    from tiptrace.sim import conditions as rig

    rigs = {name: {c.name for c in group} for name, group in rig.CONDITION_SETS.items()}
    assert rigs == {name: {str(c) for c in group} for name, group in CONDITION_SETS.items()}


def test_overall_is_mean_and_std_over_trials_with_the_published_row():
    records = suite()
    table = overall_table(records)
    paper = [r.value("trajectory_rmse_mm") for r in records if r.method == "paper" and r.metrics]
    row = table.text_rows()[1]
    assert row[:2] == ["paper", "47 of 48"]
    assert row[2] == f"{np.mean(paper):.2f} ± {np.std(paper, ddof=1):.2f}"
    last = table.text_rows()[-1]
    assert last[0] == "published, hardware, n = 51"
    assert last[2:5] == ["8.59 ± 2.41", "5.96 ± 1.16", "9.48 ± 3.77"]


def test_a_shared_condition_counts_in_each_set():
    records = suite(repeats=4)
    assert [len(set_values(records, "full", s, "shape_rmse_mm")) for s in "ABCD"] == [20, 16, 12, 12]
    row = sets_table(records).text_rows()[0]
    assert row[0] == "full"
    assert row[1].endswith("(20)")
    assert sets_table(records).text_rows()[-1][1] == "5.0 … 6.6"


def test_anchoring_explains_the_trajectory_and_not_the_shape():
    rows = {(r["method"], r["metric"]): r for r in correlation_table(suite()).records()}
    assert rows["paper", "trajectory RMSE [mm]"]["rho"] > 0.9
    assert rows["paper", "trajectory RMSE [mm]"]["p_value"] == "< 0.001"
    assert abs(rows["paper", "shape RMSE [mm]"]["rho"]) < 0.4
    assert rows["paper", "shape RMSE [mm]"]["paper_rho"] == 0.16
    assert rows["full", "shape RMSE [mm]"]["rho"] is None  # its contact error does not vary


def test_wins_are_counted_over_trials_that_both_finished():
    rows = {(r["method"], r["baseline"], r["metric"]): r for r in wins_table(suite()).records()}
    row = rows["full", "ee-only", "trajectory RMSE [mm]"]
    assert (row["n"], row["wins"], row["losses"]) == (48, 48, 0)
    assert row["p_value"] == "< 0.001"
    assert rows["full", "paper", "shape RMSE [mm]"]["n"] == "47 of 48"
    assert ("ee-only", "paper", "shape RMSE [mm]") not in rows


def test_failures_are_listed_by_name_and_reason():
    table = failures_table(suite())
    assert table.rows == (("T1-O1-W1-G1-0", "paper", "no markers & 50 % dark"),)
    assert "failures" in {t.name for t in suite_tables(suite())}


def test_events_are_added_up_over_trials():
    own = [r for r in suite(repeats=1) if r.method == "full"]
    records = [replace(r, events={"grasp-slip": (1, 2, 3)}) for r in own]
    assert events_table(records).rows == (("full", "grasp-slip", 12, 24, 36, "–"),)
    late = [replace(r, event_delays_s={"grasp-slip": (0.25 + 0.5 * (k % 2),)}) for k, r in enumerate(records)]
    assert events_table(late).rows == (("full", "grasp-slip", 12, 24, 36, "0.50"),)


def test_outliers_are_far_above_the_rest():
    records = suite()
    k = next(i for i, r in enumerate(records) if r.method == "full" and r.metrics)
    m = records[k].metrics
    assert m is not None
    records[k] = replace(records[k], metrics=replace(m, trajectory_rmse_mm=30.0))
    assert outliers(records, "full") == [records[k]]
    assert outliers(records[:3], "full") == []


def test_no_records_no_tables():
    assert suite_tables([]) == []


EXAMPLE = Table(
    "some_table",
    "A & B",
    columns(("method", "method"), ("error_mm", "error [mm]"), ("n", "n"), ("note", "50 %|x")),
    (("a_b", 1 / 3, 4, "1 ± 2"), ("c", float("nan"), 0, None)),
    "Note.",
)


def test_csv_and_json_keep_full_precision_and_unknowns(tmp_path: Path):
    rows = list(csv.DictReader(io.StringIO(EXAMPLE.csv())))
    assert float(rows[0]["error_mm"]) == 1 / 3
    assert (rows[1]["error_mm"], rows[1]["note"], rows[1]["n"]) == ("", "", "0")
    write_tables(tmp_path, [EXAMPLE])
    loaded = json.loads((tmp_path / "tables.json").read_text(), parse_constant=pytest.fail)
    assert loaded["some_table"]["rows"][1] == {"method": "c", "error_mm": None, "n": 0, "note": None}
    assert {p.name for p in tmp_path.iterdir()} == {
        "some_table.csv",
        "some_table.tex",
        "tables.json",
        "tables.md",
    }


def test_markdown_has_a_cell_per_column():
    lines = EXAMPLE.markdown().splitlines()
    assert lines[2] == r"| method | error [mm] | n | 50 %\|x |"
    assert lines[4] == "| a_b | 0.33 | 4 | 1 ± 2 |"
    assert lines[5] == "| c | – | 0 | – |"


def test_latex_is_escaped_and_balanced():
    text = EXAMPLE.latex()
    assert r"a\_b & 0.33 & 4 & 1 $\pm$ 2 \\" in text
    assert r"\caption{A \& B}" in text
    assert r"50 \%|x" in text
    assert text.count("{") == text.count("}")
    assert text.count(r"\begin{") == text.count(r"\end{") == 2
