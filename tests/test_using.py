"""Without the usual luxuries: tips from elsewhere, displacements, smoothing, single and in batches."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tiptrace.batch import BatchSettings, run_batch
from tiptrace.batch_plan import find_recordings
from tiptrace.config import Tool, dump_yaml
from tiptrace.errors import ConfigError, GeometryError, OutputError
from tiptrace.evaluation.executors import SerialExecutor
from tiptrace.export.episodes import Source, load_episode
from tiptrace.frames import read_frames
from tiptrace.grasp_file import read_grasp
from tiptrace.outputs import read_results
from tiptrace.reconstruction import Reconstruction, reconstruct
from tiptrace.sim.spec import make_spec
from tiptrace.streams.recording import Recording
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.writer import RecordingWriter, write_recording
from tiptrace.types import MarkerSample, Phase, PhaseSample, PoseSample, Sample, Status
from tiptrace.using import Using


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("using") / "trial.mcap"
    stream = SimulatedStream(make_spec(mode="markers", travel_m=0.03, seed=4, level="clean"))
    write_recording(path, stream, trial=stream.trial_metadata)
    return path


@pytest.fixture(scope="module")
def causal(trial: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Reconstruction]:
    out = tmp_path_factory.mktemp("causal")
    return out, run(trial, out)


def run(path: Path, out: Path, using: Using | None = None, method: str = "full") -> Reconstruction:
    return reconstruct(Recording(path), out, method, report=False, using=using, threads=False)


def rewritten(
    path: Path, target: Path, keep: Sequence[type], tool: Tool | None = None, after: int = 0
) -> Path:
    """A recording of some of the samples, from an instant on."""
    source = Recording(path)
    with RecordingWriter(target, rig=source.rig, tool=tool or source.tool) as writer:
        for sample in source:
            if isinstance(sample, tuple(keep)) and sample.stamp_ns >= after:
                writer.write(sample)
    return target


def end_of_stage_one(path: Path) -> int:
    marks: list[Sample] = [s for s in Recording(path) if isinstance(s, PhaseSample)]
    return next(s.stamp_ns for s in marks if isinstance(s, PhaseSample) and s.phase is Phase.RECONSTRUCTION)


def test_smoothing_does_not_raise_the_error(trial: Path, tmp_path: Path, causal) -> None:  # type: ignore[no-untyped-def]
    smoothed = run(trial, tmp_path, Using(smooth=True))
    before, after = causal[1].metrics, smoothed.metrics
    assert after.trajectory_rmse_mm <= before.trajectory_rmse_mm
    assert after.usable_fraction == before.usable_fraction
    assert after.coverage_95 > 0.9
    assert json.loads((tmp_path / "metrics.json").read_text())["estimates"] == "smoothed"
    rows = list(
        zip(smoothed.methods[0].trajectory.estimates, causal[1].methods[0].trajectory.estimates, strict=True)
    )
    assert all(a.stamp_ns == b.stamp_ns and a.status is b.status for a, b in rows)


def test_smoothed_results_are_no_training_data(trial: Path, tmp_path: Path) -> None:
    run(trial, tmp_path, Using(smooth=True))
    with pytest.raises(OutputError, match="not causal"):
        load_episode(Source("a", tmp_path, True), "full")


def test_single_results_can_be_exported(causal) -> None:  # type: ignore[no-untyped-def]
    out, result = causal
    assert len(read_frames(out, result.metrics.frames)) == result.metrics.frames
    assert len(load_episode(Source("a", out, True), "full")) == result.metrics.frames


def test_tip_from_the_tools_file_needs_no_stage_one(trial: Path, tmp_path: Path) -> None:
    tip = read_true_tip(trial)
    file = tmp_path / "tool.yaml"
    file.write_text(dump_yaml(Tool(tip_E_m=tip, tip_sigma_m=(5e-4, 5e-4, 5e-4))))
    short = rewritten(trial, tmp_path / "b.mcap", (MarkerSample, PoseSample), after=end_of_stage_one(trial))
    result = run(short, tmp_path / "out", Using(tip=file))
    rows = result.methods[0].trajectory.estimates
    assert all(e.phase is Phase.RECONSTRUCTION for e in rows)
    assert np.mean([e.status is Status.OK for e in rows]) > 0.9


def read_true_tip(trial: Path) -> tuple[float, float, float]:
    tool = Recording(trial).tool
    assert tool is not None
    assert tool.tip_E_m is not None
    return tool.tip_E_m


def test_the_same_grasp_carries_over(trial: Path, tmp_path: Path, causal) -> None:  # type: ignore[no-untyped-def]
    short = rewritten(trial, tmp_path / "b.mcap", (MarkerSample, PoseSample), after=end_of_stage_one(trial))
    for source in (causal[0], trial):
        result = run(short, tmp_path / "out", Using(anchor_from=source))
        by_stamp = {e.stamp_ns: e for e in result.methods[0].trajectory.estimates if e.p_B is not None}
        same = [
            (e.p_B, by_stamp[e.stamp_ns].p_B)
            for e in causal[1].methods[0].trajectory.estimates
            if e.status is Status.OK and e.stamp_ns in by_stamp
        ]
        assert len(same) > 20
        assert max(float(np.linalg.norm(a - b)) for a, b in same) < 3e-4


def test_a_regrasp_is_less_certain(trial: Path, tmp_path: Path, causal) -> None:  # type: ignore[no-untyped-def]
    tight = run(trial, tmp_path / "a", Using(anchor_from=causal[0]))
    loose = run(trial, tmp_path / "b", Using(anchor_from=causal[0], regrasp=True))
    sizes = [
        float(
            np.trace(next(e.covariance for e in r.methods[0].trajectory.estimates if e.status is Status.OK))
        )
        for r in (tight, loose)
    ]
    assert sizes[1] > sizes[0] + 3 * (1.5e-3) ** 2


def test_without_anything_positions_are_displacements(trial: Path, tmp_path: Path) -> None:
    short = rewritten(trial, tmp_path / "b.mcap", (MarkerSample, PoseSample), after=end_of_stage_one(trial))
    result = run(short, tmp_path / "out")
    known = [e for e in result.methods[0].trajectory.estimates if e.p_B is not None]
    assert len(known) > 20
    assert all(e.status is Status.RELATIVE for e in known)
    assert float(np.linalg.norm(known[0].p_B)) < 1e-9
    assert any("displacements" in note for note in result.notes)


def test_the_end_of_stage_one_is_found_without_marks(trial: Path, tmp_path: Path, causal) -> None:  # type: ignore[no-untyped-def]
    unmarked = rewritten(trial, tmp_path / "b.mcap", (MarkerSample, PoseSample))
    for smooth in (False, True):
        result = run(unmarked, tmp_path / "out", Using(smooth=smooth))
        rows = [e for e in result.methods[0].trajectory.estimates if e.status is Status.OK]
        assert len(rows) > 20
        marked = {e.stamp_ns // 1_000_000: e for e in causal[1].methods[0].trajectory.estimates}
        near = [(e, marked[e.stamp_ns // 1_000_000]) for e in rows if e.stamp_ns // 1_000_000 in marked]
        assert near
        assert all(np.linalg.norm(a.p_B - b.p_B) < 5e-4 for a, b in near if b.p_B is not None)


def test_another_tools_anchor_is_refused(trial: Path, tmp_path: Path, causal) -> None:  # type: ignore[no-untyped-def]
    tool = Recording(trial).tool
    assert tool is not None
    thick = tool.model_copy(update={"thickness_m": 0.012})
    other = rewritten(trial, tmp_path / "b.mcap", (MarkerSample, PoseSample, PhaseSample), thick)
    with pytest.raises(ConfigError, match="another tool"):
        run(other, tmp_path / "out", Using(anchor_from=causal[0]))


def test_a_gel_with_other_markers_is_refused(trial: Path, tmp_path: Path, causal) -> None:  # type: ignore[no-untyped-def]
    source = Recording(trial)
    with RecordingWriter(tmp_path / "b.mcap", rig=source.rig, tool=source.tool) as writer:
        for sample in source:
            if isinstance(sample, MarkerSample):
                writer.write(replace(sample, x_S=sample.x_S[::2] + [1e-3, 0, 0]))
            elif isinstance(sample, PoseSample):
                writer.write(sample)
    with pytest.raises(GeometryError, match="regrasp"):
        run(tmp_path / "b.mcap", tmp_path / "out", Using(anchor_from=causal[0]))


def test_bad_input_is_told(trial: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.yaml"
    bare.write_text(dump_yaml(Tool(thickness_m=0.0086)))
    with pytest.raises(ConfigError, match="states no tip"):
        run(trial, tmp_path / "out", Using(tip=bare))
    with pytest.raises(ConfigError, match="cannot be read"):
        run(trial, tmp_path / "out", Using(tip=tmp_path / "none.yaml"))
    with pytest.raises(ConfigError, match="does not exist"):
        run(trial, tmp_path / "out", Using(anchor_from=tmp_path / "nothing"))
    with pytest.raises(ConfigError, match="exclude each other"):
        Using(tip=bare, relative=True)
    with pytest.raises(ConfigError, match="belongs to --anchor-from"):
        Using(regrasp=True)
    with pytest.raises(ConfigError, match="only method full"):
        run(trial, tmp_path / "out", Using(smooth=True), method="paper")
    folder = tmp_path / "paper"
    run(trial, folder, method="paper")
    with pytest.raises(OutputError, match=r"grasp\.json: missing"):
        read_grasp(folder)


def test_batches_do_the_same(trial: Path, tmp_path: Path) -> None:
    settings = BatchSettings("full", using=Using(smooth=True))
    found = find_recordings([trial]).recordings
    result = run_batch(found, settings, tmp_path / "out", open_executor=SerialExecutor)
    assert result.failures == []
    single = run(trial, tmp_path / "single", Using(smooth=True)).methods[0].trajectory
    batch = read_results(tmp_path / "out" / "trial")
    for a, b in zip(single.estimates, batch.estimates, strict=True):
        assert (a.p_B is None) == (b.p_B is None)
        if a.p_B is not None and b.p_B is not None:
            np.testing.assert_allclose(a.p_B, b.p_B, atol=1e-9)
    with pytest.raises(ConfigError, match="settings"):
        run_batch(found, BatchSettings("full"), tmp_path / "out", open_executor=SerialExecutor)


def test_what_is_used_survives_a_job_file() -> None:
    using = Using(anchor_from=Path("a/b"), regrasp=True, regrasp_sigma_m=1e-3, depth="none", smooth=True)
    assert Using.from_text(using.as_text()) == using
    assert Using().as_text() == {}
