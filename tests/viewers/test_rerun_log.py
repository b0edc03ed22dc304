"""What lands in a Rerun file; skipped without the extra ``viz``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import OutputError
from tiptrace.sim.spec import TrialSpec
from tiptrace.snapshot import FingerView, Snapshot
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.types import SIDES, Event, Phase, Status, TipEstimate, TipTrajectory, TruthSample
from tiptrace.viewers.rerun_log import RerunLog

pytest.importorskip("rerun.chunk", reason="extra viz is not installed, or is older than its reader of files")

T0 = 1_700_000_000_000_000_000
PAIRS = 8


class Finger:
    """A finger with a depth map."""

    depth_m = np.full((24, 32), 5e-4)


def snapshot(k: int, p_B: np.ndarray | None) -> Snapshot:
    uv = np.array([[4.0, 5.0], [20.0, 10.0], [np.nan, np.nan]])
    finger = FingerView(np.full((24, 32, 3), 120, np.uint8), uv + [1.0, 0.0], uv)
    status = Status.NO_CONTACT if p_B is None else Status.OK
    covariance = None if p_B is None else np.diag([4e-8, 1e-8, 9e-8])
    estimate = TipEstimate(
        T0 + 40_000_000 * k, Phase.RECONSTRUCTION, status, p_B, np.eye(3), covariance, 2e-5, 48, 12.5
    )
    return Snapshot(estimate, finger, finger, np.eye(4), 24.9, 11.0)


def entities(path: Path) -> dict[str, int]:
    """Rows of each entity of a Rerun file, read with Rerun's own reader."""
    from rerun.chunk import RrdReader

    rows: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        rows[str(chunk.entity_path)] += chunk.num_rows
    return dict(rows)


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> dict[str, int]:
    path = tmp_path_factory.mktemp("rerun") / "trial.rrd"
    truth = [TruthSample(T0 + k, np.array([0.4, 0.0, 0.02])) for k in range(3)]
    log = RerunLog("trial", SimulatedStream(TrialSpec(seed=3, level="clean")).rig, truth)
    log.save(path)
    log.depth_of = {side: Finger() for side in SIDES}
    trajectory = TipTrajectory()
    for k in range(PAIRS):
        shown = snapshot(k, None if k == PAIRS - 1 else np.array([0.4 + 1e-3 * k, -0.1, 0.02]))
        log.show(shown)
        trajectory.append(shown.estimate)
    trajectory.events.append(Event("contact-lost", T0, T0 + 1, "the tip left the surface"))
    log.finish(trajectory)
    del log
    return entities(path)


def test_pictures_arrows_and_depth_of_both_gels_at_every_pair(logged: dict[str, int]) -> None:
    for side in SIDES:
        for what in ("image", "image/markers", "depth"):
            assert logged[f"/tactile/{side}/{what}"] == PAIRS


def test_scene(logged: dict[str, int]) -> None:
    for what in ("base", "truth", "hand/axes", "hand/left/pad", "hand/right/pad"):
        assert logged[f"/world/{what}"] == 1
    for what in ("hand", "tip", "tip/uncertainty", "tool", "trajectory"):
        assert logged[f"/world/{what}"] >= 2


def test_what_is_not_known_is_not_plotted(logged: dict[str, int]) -> None:
    for axis in "xyz":
        assert logged[f"/plots/sigma/{axis}"] == PAIRS - 1 + 1  # one more: the series' colour and name
    for what in ("residual/mm", "rate/Hz", "latency/ms"):
        assert logged[f"/plots/{what}"] == PAIRS + 1


def test_events_and_changes_of_status_are_told_once(logged: dict[str, int]) -> None:
    assert logged["/events"] == 3  # ok, no-contact, and the event


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        RerunLog("trial").save(tmp_path / "file" / "trial.rrd")
