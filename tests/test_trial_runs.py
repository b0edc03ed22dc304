"""Several methods over one trial: what is shared, what is refused."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tiptrace import trial_runs
from tiptrace.evaluation.runner import TrialTask
from tiptrace.evaluation.truth import Truth
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.tracer import METHODS, Sensing
from tiptrace.trial_runs import run_trial, simulated_source
from tiptrace.types import FloatArray, Observation, Phase, Sample, SensedPair, TipTrajectory, TruthSample

SHORT = {"travel_m": 0.01, "fps": 5.0, "anchoring_s": 2.0, "mode": "markers", "level": "clean", "seed": 1}


def task() -> TrialTask:
    spec = make_spec(**SHORT)
    return TrialTask("short", simulated_source(spec.model_dump(mode="json", exclude_none=True)))


@pytest.fixture
def sensed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The chain of every pair that is sensed."""
    calls: list[str] = []
    call = Sensing.__call__

    def counting(self: Sensing, observation: Observation) -> SensedPair:
        calls.append(self._config.method)
        return call(self, observation)

    monkeypatch.setattr(Sensing, "__call__", counting)
    return calls


def test_images_are_sensed_once_for_each_chain(sensed: list[str]):
    run = run_trial(task(), list(METHODS))
    assert not run.failures
    pairs = len(run.trajectories["full"])
    assert sensed.count("full") == sensed.count("paper") == pairs
    assert list(run.trajectories) == list(METHODS)


def test_a_baseline_named_first_leaves_the_loop_rate_to_the_method(sensed: list[str]):
    run = run_trial(task(), ["ee-only", "full"])
    assert list(run.trajectories) == ["ee-only", "full"]
    assert all(e.loop_ms is not None for e in run.trajectories["full"].estimates)
    assert set(sensed) == {"full"}


def test_a_baseline_gives_the_same_alone_as_beside_others():
    beside = run_trial(task(), ["full", "paper", "local-anchoring"]).trajectories["local-anchoring"]
    alone = run_trial(task(), ["local-anchoring"]).trajectories["local-anchoring"]
    pairs = zip(beside.estimates, alone.estimates, strict=True)
    assert all((a.p_B is None and b.p_B is None) or (a.p_B == b.p_B).all() for a, b in pairs)


def test_the_oracle_starts_where_the_tip_was():
    run = run_trial(task(), ["full", "ee-oracle"])
    trajectory, truth = run.trajectories["ee-oracle"], run.truth
    assert truth is not None
    first = next(e for e in trajectory.estimates if e.phase is Phase.RECONSTRUCTION)
    assert first.p_B is not None
    assert abs(first.p_B - truth.nearest(first.stamp_ns)[0]).max() < 1e-3


def test_without_truth_the_oracle_fails_by_name_and_the_rest_goes_on(monkeypatch: pytest.MonkeyPatch):
    class Blind(SimulatedStream):
        def __iter__(self) -> Iterator[Sample]:
            return (s for s in super().__iter__() if not isinstance(s, TruthSample))

    monkeypatch.setattr(trial_runs, "SimulatedStream", Blind)
    run = run_trial(task(), ["paper", "ee-oracle"])
    assert list(run.trajectories) == ["paper"]
    assert "needs a ground truth" in run.failures["ee-oracle"]
    assert run.truth is None


def test_a_method_without_an_anchor_does_not_cost_the_others_their_analytic_truth(
    monkeypatch: pytest.MonkeyPatch,
):
    real = trial_runs.initial_point
    asked: list[int] = []

    def first_refused(trajectory: TipTrajectory, truth: Truth) -> tuple[FloatArray, FloatArray]:
        asked.append(1)
        return (np.full(3, np.nan),) * 2 if len(asked) == 1 else real(trajectory, truth)

    monkeypatch.setattr(trial_runs, "initial_point", first_refused)
    spec = make_spec(**SHORT).model_dump(mode="json", exclude_none=True)
    source = simulated_source(spec, {"centreline": "T3"})
    run = run_trial(TrialTask("short", source), ["full", "paper"])
    assert run.analytic is not None
    assert not run.failures
