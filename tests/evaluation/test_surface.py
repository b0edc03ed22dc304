"""From traces to the surface: in the base frame, with what the data do not tell said aloud."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import GeometryError, OutputError
from tiptrace.evaluation.metrics import evaluate
from tiptrace.evaluation.quality import assess
from tiptrace.evaluation.surface import Trace, fit_surface, surface_record, surface_table, write_surface
from tiptrace.geometry.transforms import rotation_exp
from tiptrace.outputs import read_any, write_results

from .builders import trajectory_of
from .test_surface_fits import groove

TILT = rotation_exp([0.03, -0.02, 0.5])
START = np.array([0.4, -0.1, 0.02])


def trace(seed: int, sigma: float = 1e-4, **more: float) -> Trace:
    rng = np.random.default_rng(seed)
    return Trace(f"trace {seed}", groove(rng, sigma=sigma, **more) @ TILT.T + START)


def test_the_surface_is_one_tip_radius_below_the_tips_centre():
    fit = fit_surface([trace(0)], tip_radius_m=1.4e-3)
    p = fit.traces[0].p_B
    below = fit.surface_points(p)
    assert np.allclose((p - below) @ fit.plane.normal_B, 1.4e-3)
    assert below[:, 2].mean() < p[:, 2].mean()
    assert fit.plane.normal_B @ TILT[:, 2] == pytest.approx(1.0, abs=1e-4)


def test_several_traces_share_their_groove():
    fit = fit_surface([trace(k) for k in range(5)])
    assert fit.centreline is not None
    assert fit.periodic is not None
    assert fit.periodic.period_m == pytest.approx(0.05, rel=0.005)
    assert fit.periodic.amplitude_m == pytest.approx(4e-3, rel=0.03)
    assert 0.2e-3 < fit.centreline.offset_std_m < 2e-3  # anchors of 1.5 mm, five of them
    quantities = [str(row[0]) for row in surface_table(fit).rows]
    assert "period [mm]" in quantities
    assert fit.notes == ()


def test_a_straight_trace_says_what_it_does_not_tell():
    fit = fit_surface([trace(0, amplitude=0.0)])
    assert fit.periodic is None
    assert any("too straight" in note for note in fit.notes)
    assert any("single trace" in note for note in fit.notes)
    assert surface_record(fit)["plane"]["slope_across_std_deg"] is None


def test_parallel_strokes_give_a_plane_and_no_common_centreline():
    across = TILT @ np.array([0.0, 0.03, 0.0])
    strokes = [Trace(str(k), trace(k, amplitude=0.0).p_B + k * across) for k in range(3)]
    fit = fit_surface(strokes)
    assert fit.centreline is None
    assert fit.plane.across_determined
    assert any("apart" in note for note in fit.notes)


@pytest.mark.parametrize(
    ("p", "words"), [(np.zeros((3, 3)), "too few"), (np.zeros((50, 3)), "does not move")]
)
def test_what_is_no_trace_is_refused(p: np.ndarray, words: str):
    with pytest.raises(GeometryError, match=words):
        fit_surface([Trace("bad.tum", p)])


def test_files_hold_the_fit(tmp_path: Path):
    fit = fit_surface([trace(0), trace(1)], tip_radius_m=1e-3)
    write_surface(tmp_path, fit)
    record = json.loads((tmp_path / "surface.json").read_text(), parse_constant=pytest.fail)
    assert record["periodic"]["period_mm"] == pytest.approx(50.0, rel=0.01)
    rows = list(csv.DictReader((tmp_path / "centreline.csv").open()))
    assert len(rows) == 201
    assert all(
        float(r["across_low95_mm"]) <= float(r["across_mm"]) <= float(r["across_high95_mm"]) for r in rows
    )
    assert (tmp_path / "surface.png").exists()
    assert (tmp_path / "surface.svg").exists()


def test_results_folders_csv_and_tum_are_read_alike(tmp_path: Path):
    p = trace(0).p_B
    trajectory = trajectory_of(p, 0, covariance=np.eye(3) * 1e-6)
    write_results(tmp_path, trajectory, "full", evaluate(trajectory), assess(trajectory))
    for path in (tmp_path, tmp_path / "trajectory.csv", tmp_path / "trajectory.tum"):
        rows = read_any(path)
        np.testing.assert_allclose([e.p_B for e in rows], p, atol=1e-11)
        assert [e.stamp_ns for e in rows] == [e.stamp_ns for e in trajectory.estimates]


@pytest.mark.parametrize("line", ["1 2 3", "a b c d e f g h", "1 0 0 0 0 0 0 5", "nan 0 0 0 0 0 0 1"])
def test_other_text_is_no_tum_file(tmp_path: Path, line: str):
    (tmp_path / "x.tum").write_text(f"# t x y z qx qy qz qw\n{line}\n")
    with pytest.raises(OutputError, match="line 2"):
        read_any(tmp_path / "x.tum")
