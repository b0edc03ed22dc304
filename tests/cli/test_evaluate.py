"""``tiptrace evaluate`` on recordings: good ones, bad ones, truth from elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
import yaml
from typer.testing import CliRunner, Result

from tiptrace.cli.evaluate import evaluate
from tiptrace.cli.simulate import simulate
from tiptrace.errors import ConfigError
from tiptrace.evaluation.suite_store import file_name
from tiptrace.streams.recording import Recording
from tiptrace.tracer import METHODS


def run(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(evaluate)
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short trial at marker level."""
    folder = tmp_path_factory.mktemp("trial")
    settings = {"travel_m": 0.01, "fps": 5.0, "anchoring_s": 2.0, "mode": "markers", "level": "clean"}
    (folder / "settings.yaml").write_text(yaml.safe_dump(settings))
    simulate(out=folder / "good.mcap", settings=folder / "settings.yaml", seed=1)
    return folder / "good.mcap"


def rows(out: Path, table: str) -> list[dict[str, object]]:
    found: list[dict[str, object]] = json.loads((out / "tables" / "tables.json").read_text())[table]["rows"]
    return found


def test_an_unreadable_file_is_reported_and_the_rest_goes_on(recording: Path, tmp_path: Path):
    bad = tmp_path / "bad.mcap"
    bad.write_text("nope")
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(recording.read_bytes())
    out = tmp_path / "out"
    result = run(recording, recording, copy, bad, "--analytic", "auto", "--out", out, "--workers", 1)
    assert result.exit_code == 1
    assert "given more than once" in " ".join(result.output.split())
    assert "the same content as" in " ".join(result.output.split())
    assert result.output.count("failed:") == 1  # all methods alike
    assert {r["trial"] for r in rows(out, "failures")} == {str(bad)}
    *ours, published = rows(out, "overall")
    assert [r["method"] for r in ours] == list(METHODS)
    assert {r["trials"] for r in ours} == {"1 of 2"}
    assert published["trajectory_rmse_mm"] == "8.59 ± 2.41"
    assert all(r["trajectory_rmse_mm"] != "–" for r in ours)
    assert len(rows(out, "analytic")) == len(METHODS)
    assert (out / "report.html").exists()
    assert (out / "trials.parquet").exists()


def test_truth_may_come_from_a_file(recording: Path, tmp_path: Path):
    samples = Recording(recording).truth()
    lines = [f"{s.stamp_ns},{s.p_B[0]},{s.p_B[1]},{s.p_B[2] + 0.5}" for s in samples]
    truth = tmp_path / "truth.csv"
    truth.write_text("\n".join(["stamp_ns,x_m,y_m,z_m", *lines]))
    out = tmp_path / "out"
    result = run(recording, "--methods", "paper", "--truth", truth, "--out", out, "--workers", 1)
    assert result.exit_code == 0, result.output
    error = rows(out, "overall")[0]["trajectory_rmse_mm"]
    assert isinstance(error, str)
    assert float(error) == pytest.approx(500.0, abs=5.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "give recordings"),
        (("x.mcap", "--suite", "quick"), "give recordings"),
        (("x.mcap", "--methods", "magic"), "magic"),
        (("x.mcap", "--start", "1,2"), "x,y,z"),
    ],
)
def test_wrong_requests_are_refused(arguments: tuple[str, ...], words: str, tmp_path: Path):
    result = run(*arguments, "--out", tmp_path / "out", "--analytic", "T1")
    assert isinstance(result.exception, ConfigError)
    assert words in str(result.exception)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("x.mcap", "--analytic", "T9"), "unknown centreline 'T9'; valid: auto, T1"),
        (("x.mcap", "--start", "0.4,-0.1,0.02"), "give --analytic"),
        (("--suite", "quick", "--truth", "mocap.tum"), "--truth: a simulated suite has its own"),
    ],
)
def test_what_no_trial_can_use_is_refused_before_the_work(
    arguments: tuple[str, ...], words: str, tmp_path: Path
):
    result = run(*arguments, "--out", tmp_path / "out")
    assert isinstance(result.exception, ConfigError)
    assert words in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_a_recording_that_was_replaced_is_evaluated_again(recording: Path, tmp_path: Path):
    mine, out = tmp_path / "mine.mcap", tmp_path / "out"
    arguments = (mine, "--methods", "ee-only", "--workers", 1, "--out", out)
    mine.write_bytes(recording.read_bytes())
    assert run(*arguments).exit_code == 0
    page = out / "outliers" / file_name(str(mine)) / "report.html"
    page.parent.mkdir(parents=True)
    page.write_text("old")
    assert run(*arguments).exit_code == 0
    assert page.read_text() == "old"  # nothing is done twice
    mine.write_text("no recording any more")
    result = run(*arguments)
    assert result.exit_code == 1
    assert "is not an MCAP file" in " ".join(result.output.split())
    assert not page.exists()


def test_a_folder_without_recordings_is_refused(tmp_path: Path):
    result = run(tmp_path, "--out", tmp_path / "out")
    assert isinstance(result.exception, ConfigError)
    assert "holds no recording" in str(result.exception)
