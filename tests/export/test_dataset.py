"""Training data hold what the trajectories hold, at the recording's own frames, and never look ahead."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import typer
from typer.testing import CliRunner, Result

from tiptrace.batch import BatchSettings, run_batch
from tiptrace.batch_plan import find_recordings
from tiptrace.cli.export import export
from tiptrace.errors import ConfigError, OutputError
from tiptrace.evaluation.executors import SerialExecutor
from tiptrace.export.dataset import export_dataset
from tiptrace.export.episodes import Episode, Source, find_sources
from tiptrace.frames import FRAMES
from tiptrace.outputs import CSV, read_csv
from tiptrace.sim.spec import make_spec
from tiptrace.streams.recording import Recording
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.writer import write_recording
from tiptrace.types import MarkerSample, Phase, Sample, Status, TipEstimate


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    for seed in (1, 2):
        stream = SimulatedStream(
            make_spec(mode="markers", travel_m=0.02, fps=5.0, anchoring_s=2.0, seed=seed)
        )
        write_recording(folder / f"t{seed}.mcap", stream, trial=stream.trial_metadata)
    return folder


@pytest.fixture(scope="module")
def results(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results")
    found = find_recordings([recordings]).recordings
    run_batch(found, BatchSettings("full"), out, open_executor=SerialExecutor)
    return out


def run(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(export)
    return CliRunner().invoke(app, [str(a) for a in arguments])


def parquet(path: Path) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    table = pq.read_table(path)
    columns = {name: np.array(table.column(name).to_pylist()) for name in table.column_names}
    return columns, json.loads(pq.read_metadata(path).metadata[b"tiptrace"])


def check_same(columns: dict[str, np.ndarray[Any, Any]], results: Path, status: list[str]) -> None:
    """All episodes against the csv files that they come from."""
    estimates = [e for name in ("t1", "t2") for e in read_csv(results / name / CSV)]
    p_B = [np.full(3, np.nan) if e.p_B is None else e.p_B for e in estimates]
    covariance = [np.full((3, 3), np.nan) if e.covariance is None else e.covariance for e in estimates]
    np.testing.assert_array_equal(columns["observation.tip.position"], p_B)
    found = columns["observation.tip.covariance"].reshape(-1, 3, 3)
    np.testing.assert_array_equal(found, covariance)
    np.testing.assert_array_equal(columns["observation.tip.valid"], [e.p_B is not None for e in estimates])
    assert status == [e.status.value for e in estimates]
    counts = [len(read_csv(results / name / CSV)) for name in ("t1", "t2")]
    np.testing.assert_array_equal(columns["episode_index"], np.repeat([0, 1], counts))
    np.testing.assert_array_equal(columns["frame_index"], np.concatenate([np.arange(n) for n in counts]))


def test_parquet_holds_the_trajectories_of_results(results: Path, tmp_path: Path) -> None:
    out = tmp_path / "sub" / "tip.parquet"
    done = run(results, "--out", out)
    assert done.exit_code == 0, done.output
    columns, record = parquet(out)
    check_same(columns, results, columns["observation.tip.status"].tolist())
    assert record["estimates"] == "causal"
    assert [e["name"] for e in record["episodes"]] == ["t1", "t2"]
    assert {e["method"] for e in record["episodes"]} == {"full"}
    assert pq.ParquetFile(out).num_row_groups == 2
    assert [p.name for p in out.parent.iterdir()] == ["tip.parquet"]


def test_zarr_holds_the_trajectories_of_results(results: Path, tmp_path: Path) -> None:
    zarr = pytest.importorskip("zarr", reason="extra `export` (zarr) is not installed")
    out = tmp_path / "tip.zarr"
    done = run(results, "--to", "zarr", "--out", out)
    assert done.exit_code == 0, done.output
    group = zarr.open_group(str(out), mode="r")
    columns = {name: array[:] for name, array in group["data"].arrays()}
    values = group.attrs["status_values"]
    check_same(columns, results, [values[k] for k in columns["observation.tip.status"]])
    _, ends = group["meta/episode_ends"][:], np.flatnonzero(np.diff(columns["episode_index"])) + 1
    assert group["meta/episode_ends"][:].tolist() == [*ends, len(columns["phase"])]
    assert group.attrs["estimates"] == "causal"


def test_recordings_and_their_results_give_the_same_dataset(
    recordings: Path, results: Path, tmp_path: Path
) -> None:
    export_dataset(find_sources([recordings])[0], "parquet", tmp_path / "a.parquet")
    export_dataset(find_sources([results])[0], "parquet", tmp_path / "b.parquet")
    (a, _), (b, _) = (parquet(tmp_path / name) for name in ("a.parquet", "b.parquet"))
    for name in a:
        if a[name].dtype.kind == "f":  # the csv has 12 digits
            np.testing.assert_allclose(a[name], b[name], rtol=1e-11, atol=1e-11)
        else:
            np.testing.assert_array_equal(a[name], b[name])
    left = [
        s.stamp_ns
        for s in Recording(recordings / "t1.mcap")
        if isinstance(s, MarkerSample) and s.side == "left"
    ]
    mine = a["frame.left_stamp_ns"][a["episode"] == "t1"]
    assert set(mine.tolist()) <= set(left)
    assert len(mine) > 0.9 * len(left)


def test_what_comes_later_does_not_change_a_row(recordings: Path, tmp_path: Path) -> None:
    """A recording that ends early gives the same rows up to there: nothing looks ahead."""
    whole = Recording(recordings / "t1.mcap")
    stamps = sorted(s.stamp_ns for s in whole if isinstance(s, MarkerSample))
    end_ns = stamps[-8]  # without the last few pairs
    cut = tmp_path / "cut.mcap"
    write_recording(cut, _Until(whole, end_ns), trial=None)
    for name, path in (("whole", recordings / "t1.mcap"), ("cut", cut)):
        export_dataset([Source(name, path, False)], "parquet", tmp_path / f"{name}.parquet")
    (a, _), (b, _) = (parquet(tmp_path / f"{name}.parquet") for name in ("whole", "cut"))
    n = len(b["frame_index"]) - 2  # at the very end poses are missing
    assert n < len(a["frame_index"]) - 3
    moving = b["phase"][:n] == Phase.RECONSTRUCTION.value
    assert b["observation.tip.valid"][:n][moving].sum() >= 3
    for name in ("observation.tip.position", "observation.tip.covariance", "frame.stamp_ns"):
        np.testing.assert_allclose(a[name][:n], b[name][:n], rtol=1e-6, atol=1e-9)


class _Until:
    """A recording that was stopped early."""

    def __init__(self, whole: Recording, end_ns: int) -> None:
        self._samples: list[Sample] = [s for s in whole if s.stamp_ns <= end_ns]
        self.rig, self.tool = whole.rig, whole.tool
        self.references, self.gel_models = whole.references, whole.gel_models

    def __iter__(self):  # type: ignore[no-untyped-def]
        return iter(self._samples)


def test_displacements_and_gaps_are_not_valid() -> None:
    p = np.zeros(3)
    states = {Status.OK: p, Status.DEGRADED: p, Status.ANCHORING: p, Status.RELATIVE: p, Status.LOST: None}
    estimates = [TipEstimate(k, None, status, p_B=p_B) for k, (status, p_B) in enumerate(states.items())]
    episode = Episode.of("x", "full", np.zeros((5, 3), dtype=np.int64), [*estimates])
    assert episode.valid.tolist() == [True, True, True, False, False]
    assert np.isnan(episode.position[4]).all()
    assert np.isnan(episode.covariance).all()
    assert episode.phase == ("",) * 5


def test_an_episode_that_fails_is_listed_and_left_out(recordings: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_text("nope")
    done = run(recordings / "t1.mcap", bad, "--method", "paper", "--out", tmp_path / "tip.parquet")
    assert done.exit_code == 1
    assert "failed: bad: " in done.output
    assert [e["name"] for e in parquet(tmp_path / "tip.parquet")[1]["episodes"]] == ["t1"]


def test_recordings_beside_results_are_not_left_out_in_silence(results: Path, tmp_path: Path) -> None:
    shutil.copytree(results, tmp_path / "mixed")
    (tmp_path / "mixed" / "new.mcap").write_bytes(b"")
    sources, failures, notes = find_sources([tmp_path / "mixed"])
    assert sources
    assert all(s.results for s in sources)
    assert failures == []
    assert len(notes) == 1
    assert "1 recording(s) beside them are not" in notes[0]


def test_results_without_stamps_say_what_to_do(results: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    for file in (results / "t1").iterdir():
        if file.name != FRAMES:
            (alone / file.name).write_bytes(file.read_bytes())
    done = run(alone, "--out", tmp_path / "tip.parquet")
    assert isinstance(done.exception, OutputError)
    assert "export the recording itself" in str(done.exception)
    assert not (tmp_path / "tip.parquet").exists()


def test_nothing_is_overwritten_and_wrong_requests_are_refused(results: Path, tmp_path: Path) -> None:
    out = tmp_path / "tip.parquet"
    out.write_text("mine")
    done = run(results, "--out", out)
    assert isinstance(done.exception, OutputError)
    assert out.read_text() == "mine"
    for arguments in ((results, "--to", "hdf5"), (results, "--method", "best"), (tmp_path / "none*",)):
        assert isinstance(run(*arguments, "--out", tmp_path / "x").exception, ConfigError)
