"""Commands as a user runs them: exit codes, one clear sentence, the files that they leave."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tiptrace.cli import main
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.writer import write_recording

COMMANDS = (
    *(
        "demo",
        "simulate",
        "reconstruct",
        "inspect",
        "evaluate",
        "compare",
        "export",
        "surface",
        "track",
        "depth",
    ),
    *("setup", "doctor", "record", "live", "view", "ros2"),
    *("plan-anchor", "import-gel", "calibrate gel", "calibrate check", "calibrate tip"),
    *("calibrate rig", "calibrate latency"),
)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    def call(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["tiptrace", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        return code, captured.out + captured.err

    return call


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short trial with 3-D markers in place of images."""
    path = tmp_path_factory.mktemp("cli") / "trial.mcap"
    stream = SimulatedStream(make_spec(mode="markers", travel_m=0.02, seed=3))
    write_recording(path, stream, trial=stream.trial_metadata)
    return path


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(run, command: str) -> None:  # type: ignore[no-untyped-def]
    code, text = run(*command.split(), "--help")
    assert code == 0
    assert "Example" in text
    assert f"tiptrace {command} " in " ".join(text.split())


def test_reconstruct_writes_its_files_and_prints_a_table(run, trial: Path, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    code, text = run("reconstruct", trial, "--out", tmp_path, "--method", "paper", "--beside", "ee-only")
    assert code == 0
    for word in ("trajectory RMSE [mm]", "ee-only", "8.59", "quality"):
        assert word in text
    names = {"trajectory.tum", "trajectory.csv", "events.json", "metrics.json", "report.html"}
    assert names <= {file.name for file in tmp_path.iterdir()}
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["method"] == "paper"
    assert metrics["trajectory_rmse_mm"] < 5.0


def test_truth_and_trial_metadata_do_not_reach_the_method(run, trial: Path, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    from tiptrace.streams.recording import Recording
    from tiptrace.types import TruthSample

    blind = tmp_path / "blind.mcap"
    write_recording(blind, Recording(trial), trial=None)
    assert not any(isinstance(sample, TruthSample) for sample in Recording(blind))
    for source, out in ((trial, tmp_path / "a"), (blind, tmp_path / "b")):
        assert run("reconstruct", source, "--out", out, "--no-report")[0] == 0
    a, b = (np.loadtxt(tmp_path / name / "trajectory.tum") for name in ("a", "b"))
    np.testing.assert_allclose(a, b, atol=1e-9)  # poses are written once more, hence not to the last bit


def test_names_with_brackets_and_blanks_are_shown_whole(run, trial: Path, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    odd = tmp_path / "of [today]" / "my trial.mcap"
    odd.parent.mkdir()
    odd.write_bytes(trial.read_bytes())
    code, text = run("inspect", odd)
    assert code == 0
    assert f"tiptrace reconstruct '{odd}' --out results" in text.replace("\n", "")
    for name in ("a [x]", "b [x]"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.html").write_text("of another run")
        code, _ = run("reconstruct", odd, "--out", tmp_path / name, "--method", "ee-only", "--no-report")
        assert code == 0
        assert not (tmp_path / name / "report.html").exists()
    code, text = run("compare", tmp_path / "a [x]", tmp_path / "b [x]")
    assert code == 0
    assert "nan" not in text
    assert "[x]" in text


BAD = {
    "no file": (("reconstruct", "none.mcap"), "none.mcap"),
    "no such method": (("reconstruct", "{trial}", "--method", "best"), "unknown method 'best'; valid: "),
    "no such trajectory": (("simulate", "--trajectory", "T9", "--out", "{tmp}/t.mcap"), "T1"),
    "poses missing": (("calibrate", "tip", "none.csv"), "none.csv: cannot be read"),
    "no such method beside": (
        ("reconstruct", "{trial}", "--beside", "best"),
        "unknown method 'best'; valid: ",
    ),
    "a file as results": (("reconstruct", "{trial}", "--out", "{tmp}/text.mcap"), "cannot be written"),
    "a folder as a recording": (("simulate", "--out", "{tmp}"), "is a folder"),
    "a repeat of itself": (("compare", "{tmp}", "{tmp}/../{tmp.name}"), "more than once"),
    "not a recording": (("inspect", "{tmp}/text.mcap"), "text.mcap"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_and_exit_code_2(run, trial: Path, tmp_path: Path, case: str) -> None:  # type: ignore[no-untyped-def]
    arguments, message = BAD[case]
    (tmp_path / "text.mcap").write_text("not a recording")
    code, text = run(*(a.format(trial=trial, tmp=tmp_path) for a in arguments))
    assert code == 2
    assert "error:" in text
    assert message in " ".join(text.split())
    assert "Traceback" not in text


def test_no_anchoring_frames_is_said(run, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "trial.mcap"
    stream = SimulatedStream(make_spec(mode="markers", travel_m=0.005, anchoring_s=0.0))
    write_recording(path, stream)
    code, text = run("reconstruct", path, "--out", tmp_path / "out", "--method", "paper")
    assert code == 2
    assert "without any anchoring frame" in " ".join(text.split())
