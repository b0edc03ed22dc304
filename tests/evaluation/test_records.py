"""Records on disk, and the matching of events."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import OutputError
from tiptrace.evaluation.event_matching import score_events
from tiptrace.evaluation.records import TrialRecord, analytic_errors, read_records, to_row, write_records
from tiptrace.types import Event

from .suite_builders import metrics, suite


@pytest.mark.parametrize("name", ["records.parquet", "records.csv"])
def test_round_trip(tmp_path: Path, name: str):
    records = suite(repeats=1)
    records[0] = replace(
        records[0], events={"grasp-slip": (1, 0, 2)}, analytic={"shape_rmse_mm": 1.25}, report="a.html"
    )
    records.append(TrialRecord("recording, with comma.mcap", "full", metrics(1.0, 0.5, 0.25)))
    write_records(tmp_path / name, records)
    after = read_records(tmp_path / name)
    assert [to_row(r) for r in after] == [to_row(r) for r in records]
    assert after[-1].condition is None
    assert after[0].value("analytic_shape_rmse_mm") == 1.25
    assert np.isnan(after[1].value("analytic_shape_rmse_mm"))


def test_other_files_are_refused_by_name(tmp_path: Path):
    with pytest.raises(OutputError, match=r"\.parquet or \.csv"):
        write_records(tmp_path / "x.txt", [])
    for name, content in (("a.csv", "trial\nx\n"), ("b.parquet", "no parquet")):
        (tmp_path / name).write_text(content)
        with pytest.raises(OutputError, match=name):
            read_records(tmp_path / name)
    with pytest.raises(OutputError, match="absent"):
        read_records(tmp_path / "absent.csv")


def test_analytic_errors_are_those_that_are_known():
    assert analytic_errors(metrics(1.0, 2.0, float("nan"))) == {
        "trajectory_rmse_mm": 1.0,
        "shape_rmse_mm": 2.0,
    }


S = 10**9


def test_events_match_when_they_overlap_within_the_tolerance():
    true = [
        Event("grasp-slip", 10 * S, 12 * S, ""),
        Event("grasp-slip", 20 * S, 21 * S, ""),
        Event("other", 0, S, ""),
    ]
    detected = [
        Event("grasp-slip", 11 * S, 11 * S, ""),
        Event("grasp-slip", 12 * S, 13 * S, ""),  # the same true event, told twice
        Event("grasp-slip", 21 * S + S // 4, 22 * S, ""),  # within the tolerance
        Event("grasp-slip", 40 * S, 41 * S, ""),  # nothing happened
    ]
    score = score_events(detected, true, "grasp-slip")
    assert (score.hits, score.misses, score.false_alarms) == (2, 0, 1)
    assert score.mean_delay_s == pytest.approx((1.0 + 1.25) / 2)
    strict = score_events(detected, true, "grasp-slip", tolerance_s=0.1)
    assert (strict.hits, strict.misses, strict.false_alarms) == (1, 1, 2)
    assert score_events([], true, "grasp-slip").misses == 2
    slight = [Event("grasp-slip", 40 * S, 41 * S, "")]
    assert score_events(detected, true, "grasp-slip", slight=slight).false_alarms == 0
    assert score_events([], true, "grasp-slip", slight=slight).misses == 2
