"""Results on disk: round trip, empty positions, files that are whole or not there."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import OutputError
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.evaluation.metrics import evaluate
from tiptrace.evaluation.quality import Quality, assess
from tiptrace.geometry.transforms import rotation_exp
from tiptrace.outputs import COLUMNS, read_csv, read_results, write_results
from tiptrace.types import Anchor, Event, Phase, Status, TipEstimate, TipTrajectory

from .evaluation.builders import straight_truth, trajectory_of, truth_of

STAMP = 1_700_000_000_123_456_789


def mixed_trajectory() -> TipTrajectory:
    """Every kind of row, with numbers that need all their digits."""
    rng = np.random.default_rng(1)
    A = rng.standard_normal((3, 3)) * 1e-3
    full = [
        TipEstimate(
            stamp_ns=STAMP + k * 40_000_001,
            phase=Phase.ANCHORING if k < 3 else Phase.RECONSTRUCTION,
            status=Status.ANCHORING if k < 3 else Status.OK,
            p_B=rng.standard_normal(3),
            R_B_E=rotation_exp(rng.standard_normal(3)),
            covariance=A @ A.T,
            residual_m=1.2345678901e-5,
            markers=16,
            loop_ms=12.3456,
        )
        for k in range(6)
    ]
    empty = [
        TipEstimate(STAMP + 10**9, Phase.RECONSTRUCTION, status, markers=2)
        for status in (Status.NO_CONTACT, Status.LOST, Status.UNOBSERVABLE)
    ]
    events = [Event("marker-lost", STAMP, STAMP + 5, "marker 3, left"), Event("contact-lost", 1, 2, "é")]
    anchor = Anchor(np.array([0.1, -0.2, 1 / 3]), A @ A.T, 3.3e-5, 100, (np.array([0.0, 0.6, 0.8]),))
    return TipTrajectory([*full, *empty, TipEstimate(STAMP + 2 * 10**9, None, Status.LOST)], events, anchor)


def write(folder: Path, trajectory: TipTrajectory, quality: Quality | None = None) -> None:
    write_results(folder, trajectory, "paper", evaluate(trajectory), quality or assess(trajectory))


def test_round_trip(tmp_path: Path):
    before = mixed_trajectory()
    write(tmp_path / "new" / "folder", before)
    after = read_results(tmp_path / "new" / "folder")
    assert after.events == before.events
    assert after.anchor is not None
    assert before.anchor is not None
    np.testing.assert_array_equal(after.anchor.p_B, before.anchor.p_B)
    np.testing.assert_array_equal(after.anchor.weak_axes, before.anchor.weak_axes)
    assert len(after) == len(before)
    for a, b in zip(after.estimates, before.estimates, strict=True):
        assert (a.stamp_ns, a.phase, a.status, a.markers) == (b.stamp_ns, b.phase, b.status, b.markers)
        for name in ("p_B", "R_B_E", "covariance", "residual_m", "loop_ms"):
            x, y = getattr(a, name), getattr(b, name)
            assert (x is None) == (y is None)
            if y is not None:
                np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-11, err_msg=name)


def test_csv_has_the_columns_of_the_format_and_a_row_per_pair(tmp_path: Path):
    write(tmp_path, mixed_trajectory())
    rows = list(csv.reader((tmp_path / "trajectory.csv").open()))
    assert ",".join(rows[0]) == (
        "stamp_ns,phase,status,x_m,y_m,z_m,qx,qy,qz,qw,cov_xx_m2,cov_xy_m2,cov_xz_m2,cov_yy_m2,cov_yz_m2,"
        "cov_zz_m2,residual_m,markers,loop_ms"
    )
    assert len(rows) == 1 + 10
    for row in rows[7:10]:
        assert row[2] in {"no-contact", "lost", "unobservable"}
        assert row[3:16] == [""] * 13
    assert int(rows[1][0]) == STAMP


def test_tum_holds_the_rows_with_a_position_to_the_nanosecond(tmp_path: Path):
    trajectory = mixed_trajectory()
    write(tmp_path, trajectory)
    lines = (tmp_path / "trajectory.tum").read_text().splitlines()
    assert len(lines) == 6
    assert lines[0].split()[0] == "1700000000.123456789"
    values = np.loadtxt(tmp_path / "trajectory.tum")
    assert values.shape == (6, 8)
    np.testing.assert_allclose(values[:, 1:4], [e.p_B for e in trajectory.estimates[:6]], atol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(values[:, 4:], axis=1), 1.0)


def test_metrics_json_names_what_the_format_names(tmp_path: Path):
    p = straight_truth()
    trajectory = trajectory_of(p + np.array([0, 3e-3, 4e-3]), 5, anchor=[0, 3e-3, 4e-3], loop_ms=20.0)
    metrics = evaluate(trajectory, truth_of(p))
    write_results(tmp_path, trajectory, "paper", metrics, assess(trajectory))
    record = json.loads((tmp_path / "metrics.json").read_text())
    assert record["method"] == "paper"
    assert (record["frames"], record["anchoring_frames"]) == (25, 5)
    assert record["loop_rate_hz"] == pytest.approx({"mean": 50.0, "std": 0.0, "min": 50.0, "max": 50.0})
    assert set(record["anchor"]) >= {"p_B_m", "std_mm", "weak_axes"}
    assert record["trajectory_rmse_mm"] == pytest.approx(5.0)
    for name in ("shape", "cross_track", "along_track"):
        assert f"{name}_rmse_mm" in record
    assert record["initial_contact_error_mm"] == pytest.approx(5.0)
    assert record["quality"] == {"verdict": "pass", "reasons": []}


def test_without_truth_no_accuracy_is_claimed_and_json_stays_strict(tmp_path: Path):
    write(tmp_path, TipTrajectory())
    record = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail)
    assert "trajectory_rmse_mm" not in record
    assert record["loop_rate_hz"]["mean"] is None
    assert record["quality"]["verdict"] == "fail"
    assert read_results(tmp_path).estimates == []


def test_a_write_that_fails_leaves_the_old_file_and_no_litter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    target = tmp_path / "a.txt"
    write_atomic(target, "old")

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OutputError, match="No space"):
        write_atomic(target, "new")
    assert target.read_text() == "old"
    assert [f.name for f in tmp_path.iterdir()] == ["a.txt"]


def test_an_unwritable_folder_is_one_sentence(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write(tmp_path / "file" / "out", TipTrajectory())


def test_foreign_or_damaged_results_are_refused_by_name(tmp_path: Path):
    with pytest.raises(OutputError, match="cannot be read"):
        read_csv(tmp_path / "missing.csv")
    path = tmp_path / "trajectory.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(OutputError, match="lacks the column"):
        read_csv(path)
    path.write_text(",".join(COLUMNS) + "\n12,anchoring,wonderful" + "," * 16 + "\n")
    with pytest.raises(OutputError, match="line 2"):
        read_csv(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(OutputError, match="not a text file"):
        read_csv(path)
    write(tmp_path, mixed_trajectory())
    (tmp_path / "metrics.json").write_text("{")
    with pytest.raises(OutputError, match="not valid JSON"):
        read_results(tmp_path)
