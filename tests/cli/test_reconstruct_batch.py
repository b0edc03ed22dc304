"""``tiptrace reconstruct`` over many recordings, as a user runs it."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest
import typer
from typer.testing import CliRunner, Result

from tiptrace.cli.reconstruct import reconstruct
from tiptrace.errors import ConfigError
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.writer import write_recording


def run(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(reconstruct)
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    for seed in (1, 2):
        stream = SimulatedStream(
            make_spec(mode="markers", travel_m=0.01, fps=5.0, anchoring_s=2.0, seed=seed)
        )
        write_recording(folder / f"t{seed}.mcap", stream, trial=stream.trial_metadata)
    (folder / "bad.mcap").write_text("nope")
    return folder


def test_a_folder_with_a_bad_file_ends_with_exit_code_1_and_a_table(folder: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    result = run(folder, empty, "--method", "paper", "--workers", 1, "--out", tmp_path / "out")
    assert result.exit_code == 1, result.output
    text = " ".join(result.output.split())
    assert "failed: bad: " in text
    assert f"failed: {empty}: holds no recording" in text
    assert "2 of 3 recordings reconstructed" in text
    assert pq.read_table(tmp_path / "out" / "summary.parquet").num_rows == 3
    again = run(f"{folder}/t*.mcap", "--method", "paper", "--shard", "2/2", "--out", tmp_path / "out")
    assert again.exit_code == 0, again.output
    assert "1 of 1 recordings reconstructed, 1 of them before" in " ".join(again.output.split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--shard", "3/2"), "expected i/n"),
        (("--method", "best"), "unknown method 'best'"),
    ],
)
def test_wrong_requests_are_refused(
    folder: Path, tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    result = run(folder, *arguments, "--out", tmp_path)
    assert isinstance(result.exception, ConfigError)
    assert words in str(result.exception)
