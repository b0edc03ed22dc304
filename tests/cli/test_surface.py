"""``tiptrace surface`` on files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import typer
from typer.testing import CliRunner

from tests.evaluation.builders import trajectory_of
from tiptrace.cli.surface import surface
from tiptrace.evaluation.metrics import evaluate
from tiptrace.evaluation.quality import assess
from tiptrace.outputs import write_results


def app() -> typer.Typer:
    one = typer.Typer()
    one.command()(surface)
    return one


def test_folders_in_numbers_out(tmp_path: Path):
    rng = np.random.default_rng(0)
    x = np.linspace(0, 0.2, 250)
    for name in ("a", "b"):
        p = np.stack([x, 4e-3 * np.sin(2 * np.pi * x / 0.05), np.zeros(250)], axis=1)
        trajectory = trajectory_of(p + rng.normal(0, 1e-4, p.shape) + rng.normal(0, 1e-3, 3), 0)
        write_results(tmp_path / name, trajectory, "full", evaluate(trajectory), assess(trajectory))
    arguments = [str(tmp_path / "a"), str(tmp_path / "b" / "trajectory.tum"), "--tip-radius-mm", "1.4"]
    result = CliRunner().invoke(app(), [*arguments, "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert "period [mm]" in result.output
    assert (tmp_path / "out" / "surface.json").exists()


def test_a_missing_file_is_an_error_of_ours(tmp_path: Path):
    result = CliRunner().invoke(app(), [str(tmp_path / "absent.csv")])
    assert type(result.exception).__name__ == "OutputError"
