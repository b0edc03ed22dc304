"""A batch: each recording as if it were alone; failures listed; nothing done twice, nothing stale."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tiptrace import batch
from tiptrace.batch import BatchResult, BatchSettings, run_batch
from tiptrace.batch_plan import find_recordings
from tiptrace.config import dump_yaml
from tiptrace.errors import ConfigError
from tiptrace.evaluation.executors import OpenExecutor, SerialExecutor
from tiptrace.evaluation.runner import TrialRun, TrialTask
from tiptrace.frames import FRAMES, read_frames
from tiptrace.grasp_file import GRASP
from tiptrace.outputs import CSV, read_csv
from tiptrace.reconstruction import reconstruct
from tiptrace.sim.spec import make_spec
from tiptrace.streams.recording import Recording
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.writer import write_recording
from tiptrace.using import Using

PAPER = BatchSettings("paper")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    for name, seed in (("a", 1), ("day/b", 2), ("day/c", 3)):
        stream = SimulatedStream(
            make_spec(mode="markers", travel_m=0.01, fps=5.0, anchoring_s=2.0, seed=seed)
        )
        (folder / name).parent.mkdir(exist_ok=True)
        write_recording(folder / f"{name}.mcap", stream, trial=stream.trial_metadata)
    return folder


@pytest.fixture
def mine(recordings: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    folder = tmp_path / "mine"
    (folder / "day").mkdir(parents=True)
    for name in ("a.mcap", "day/b.mcap", "day/c.mcap"):
        (folder / name).write_bytes((recordings / name).read_bytes())
    return folder


def run(
    folder: Path,
    out: Path,
    settings: BatchSettings = PAPER,
    shard: tuple[int, int] = (1, 1),
    pool: OpenExecutor | None = SerialExecutor,
) -> BatchResult:
    found = find_recordings([folder]).recordings
    return run_batch(found, settings, out, shard=shard, open_executor=pool, workers=1)


def positions(text: str) -> list[str]:
    return [line.rsplit(",", 1)[0] for line in text.splitlines()]  # the last column is a time of the clock


def test_each_recording_is_reconstructed_as_if_alone(recordings: Path, tmp_path: Path) -> None:
    result = run(recordings, tmp_path / "out")
    assert result.failures == []
    assert [r.trial for r in result.records] == ["a", "day/b", "day/c"]
    for record in result.records:
        alone = tmp_path / "alone" / record.trial
        reconstruct(Recording(recordings / f"{record.trial}.mcap"), alone, "paper", report=False)
        texts = [(folder / CSV).read_text() for folder in (alone, tmp_path / "out" / record.trial)]
        assert positions(texts[0]) == positions(texts[1])
        assert len(read_frames(tmp_path / "out" / record.trial, len(texts[0].splitlines()) - 1)) > 0
    table = pq.read_table(result.summary).to_pylist()
    assert [row["trial"] for row in table] == ["a", "day/b", "day/c"]
    assert [row["recording"] for row in table] == [
        str(recordings / f"{r.trial}.mcap") for r in result.records
    ]
    assert [row["seed"] for row in table] == [1, 2, 3]
    assert all(row["trajectory_rmse_mm"] > 0 for row in table)


def test_frames_are_those_of_the_recording(recordings: Path, tmp_path: Path) -> None:
    run(recordings, tmp_path, BatchSettings("full"))
    estimates = read_csv(tmp_path / "a" / CSV)
    stamps = read_frames(tmp_path / "a", len(estimates))
    in_file = {s.side: [] for s in Recording(recordings / "a.mcap") if hasattr(s, "side")}
    for sample in Recording(recordings / "a.mcap"):
        if hasattr(sample, "side"):
            in_file[sample.side].append(sample.stamp_ns)
    assert set(stamps[:, 1]) <= set(in_file["left"])
    assert set(stamps[:, 2]) <= set(in_file["right"])
    late_s = [(s - e.stamp_ns) * 1e-9 for s, e in zip(stamps[:, 0], estimates, strict=True)]
    assert max(map(abs, late_s)) < 0.2


def test_an_unreadable_file_is_listed_and_the_rest_goes_on(mine: Path, tmp_path: Path) -> None:
    (mine / "day" / "b.mcap").write_text("nope")
    out = tmp_path / "out"
    result = run(mine, out)
    assert [name for name, _ in result.failures] == ["day/b"]
    assert "b.mcap" in result.failures[0][1]
    table = {row["trial"]: row for row in pq.read_table(result.summary).to_pylist()}
    assert table["day/b"]["failure"]
    assert table["day/b"]["verdict"] == "fail"
    assert not table["a"]["failure"]
    assert not (out / "day" / "b" / CSV).exists()


def test_what_is_done_is_kept_and_what_failed_or_changed_is_done_again(
    mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, whole = tmp_path / "out", (mine / "day" / "b.mcap").read_bytes()
    (mine / "day" / "b.mcap").write_bytes(b"nope")
    run(mine, out)
    (mine / "day" / "b.mcap").write_bytes(whole)
    ran: list[str] = []

    def counting(task: TrialTask, methods: Sequence[str]) -> TrialRun:
        ran.append(task.name)
        return real(task, methods)

    real = batch.reconstruct_trial
    monkeypatch.setattr(batch, "reconstruct_trial", counting)
    assert run(mine, out).kept == 2
    assert ran == ["day/b"]
    (mine / "a.mcap").write_bytes(b"replaced by something else")
    result = run(mine, out)
    assert ran == ["day/b", "a"]
    assert [name for name, _ in result.failures] == ["a"]
    assert not {CSV, FRAMES} & {file.name for file in (out / "a").iterdir()}  # nothing stale beside a failure


def test_shards_fill_one_table(recordings: Path, tmp_path: Path) -> None:
    first = run(recordings, tmp_path, shard=(1, 2))
    assert [r.trial for r in first.records] == ["a", "day/c"]
    second = run(recordings, tmp_path, shard=(2, 2))
    assert [r.trial for r in second.records] == ["day/b"]
    assert pq.read_table(second.summary).column("trial").to_pylist() == ["a", "day/b", "day/c"]


def test_results_of_other_settings_are_not_mixed(recordings: Path, tmp_path: Path) -> None:
    run(recordings, tmp_path, shard=(1, 3))
    with pytest.raises(ConfigError, match="other settings"):
        run(recordings, tmp_path, BatchSettings("full"), shard=(2, 3))


def test_an_edited_rig_is_another(recordings: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(dump_yaml(Recording(recordings / "a.mcap").rig))
    settings = BatchSettings("paper", options={"rig": str(rig)})
    run(recordings, tmp_path / "out", settings, shard=(1, 3))
    assert run(recordings, tmp_path / "out", settings, shard=(1, 3)).kept == 1
    rig.write_text(rig.read_text() + "# edited\n")
    with pytest.raises(ConfigError, match=r"other settings \(rig .* → .*\)"):
        run(recordings, tmp_path / "out", settings, shard=(1, 3))


def test_a_tip_or_a_grasp_of_other_content_is_another(tmp_path: Path) -> None:
    tool, results = tmp_path / "tool.yaml", tmp_path / "results"
    results.mkdir()
    for using, file in ((Using(tip=tool), tool), (Using(anchor_from=results), results / GRASP)):
        claims = []
        for text in ("a", "a", "b"):
            file.write_text(text)
            claims.append(BatchSettings(using=using).claim())
        assert claims[0] == claims[1] != claims[2]


def test_without_pyarrow_the_table_is_csv(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tiptrace.evaluation.suite_store.find_spec", lambda name: None)
    summary = run(recordings, tmp_path, shard=(1, 3)).summary
    assert summary.name == "summary.csv"
    assert summary.read_text().splitlines()[1].startswith(str(recordings / "a.mcap"))


def die_once(task: TrialTask, methods: Sequence[str]) -> TrialRun:
    """Kills its worker at the first recording named b."""
    marker = Path(os.environ["TIPTRACE_TEST_MARKER"])
    if task.name == "day/b" and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return batch.reconstruct_trial(task, methods)


def test_a_killed_worker_costs_only_its_recording_even_a_single_one(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TIPTRACE_TEST_MARKER", str(tmp_path / "died"))
    real = batch.SuiteRun
    monkeypatch.setattr(batch, "SuiteRun", lambda _run, *args, **kwargs: real(die_once, *args, **kwargs))
    result = run(recordings, tmp_path / "out", pool=None)
    assert (tmp_path / "died").exists()
    assert result.failures == []
    assert len(result.records) == 3
