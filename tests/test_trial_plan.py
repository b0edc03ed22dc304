"""Which trials an evaluation runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tiptrace.errors import ConfigError, SimulationError
from tiptrace.evaluation.conditions import Condition
from tiptrace.sim.disturbances import LEVELS, Disturbances
from tiptrace.trial_plan import budget_tasks, recording_tasks, suite_tasks


def disturbances(source: str) -> Disturbances:
    return Disturbances(**json.loads(source)["spec"]["disturbances"])


def test_the_papers_suite_has_its_trials_each_with_a_name_of_its_own():
    tasks = suite_tasks("paper", "hard", "markers", 3, "auto")
    assert len({t.name for t in tasks}) == len({t.seed for t in tasks}) == 51
    assert {t.level for t in tasks} == {"hard"}
    assert json.loads(tasks[0].source)["analytic"] == {"centreline": "auto"}
    assert sum(t.condition == Condition("T3", "O1", "W1", "G1") for t in tasks) == 7
    with pytest.raises(SimulationError, match="valid suites"):
        suite_tasks("large", "hard", "markers", 0, None)


def test_a_budget_has_one_disturbance_at_a_time():
    plan = budget_tasks("nominal", 0, 3)
    assert {len(tasks) for tasks in plan.values()} == {3}
    none, nominal = Disturbances(), LEVELS["nominal"]
    assert disturbances(plan["none"][0].source) == none
    assert disturbances(plan["all"][0].source) == nominal
    changed: list[str] = []
    for name, tasks in plan.items():
        if name in {"none", "all"}:
            continue
        own = disturbances(tasks[0].source)
        fields = {f for f in Disturbances.model_fields if getattr(own, f) != getattr(none, f)}
        assert fields, name
        if "markers" not in fields:
            assert not fields & set(changed), name
            changed += fields
    assert disturbances(plan["latency"][0].source).latency_s == nominal.latency_s
    assert (
        disturbances(plan["slow slip in the grasp"][0].source).grasp_drift_deg == 3.0
    )  # nominal leaves it out
    assert len({t.name for tasks in plan.values() for t in tasks}) == 3 * len(plan)


def test_recordings_in_folders_each_once_with_the_truth_of_their_name(tmp_path: Path):
    for name in ("b/2.mcap", "b/1.mcap", "a.mcap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    truth = tmp_path / "truth"
    truth.mkdir()
    (truth / "1.tum").touch()
    tasks, notes = recording_tasks(
        [tmp_path / "a.mcap", tmp_path / "b", tmp_path / "a.mcap"], truth, "T2", [0.0, 0.0, 0.0], {}
    )
    assert [Path(t.name).name for t in tasks] == ["a.mcap", "1.mcap", "2.mcap"]
    assert [Path(n.partition(":")[0]).name for n in notes] == ["a.mcap", "a.mcap", "2.mcap"]
    assert sum("given more than once" in n for n in notes) == 1
    assert sum("what the recording itself holds counts" in n for n in notes) == 2
    sources = [json.loads(t.source) for t in tasks]
    assert [s["truth"] for s in sources] == [None, str(truth / "1.tum"), None]
    assert sources[0]["analytic"] == {"centreline": "T2", "start_m": [0.0, 0.0, 0.0]}
    with pytest.raises(ConfigError, match="holds no recording"):
        recording_tasks([truth], None, None, None, {})


def test_a_rosbag_folder_stays_whole(tmp_path: Path):
    bag = tmp_path / "bag"
    bag.mkdir()
    for name in ("metadata.yaml", "bag_0.mcap", "bag_1.mcap"):
        (bag / name).touch()
    tasks, _ = recording_tasks([bag], None, None, None, {"map_file": "map.yaml"})
    assert [t.name for t in tasks] == [str(bag)]
