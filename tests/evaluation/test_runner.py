"""Many trials: kept, continued, and not ended by the ones that fail."""

from __future__ import annotations

from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tiptrace.errors import ConfigError, OutputError
from tiptrace.evaluation.conditions import Condition
from tiptrace.evaluation.executors import SerialExecutor, local_executor
from tiptrace.evaluation.records import TrialRecord, to_row
from tiptrace.evaluation.runner import SuiteRun, TrialTask
from tiptrace.evaluation.suite_store import SuiteStore, file_name

from .run_functions import run_or_fail, run_straight

T3 = Condition("T3", "O1", "W1", "G1")


def tasks(n: int, **sources: str) -> list[TrialTask]:
    return [TrialTask(f"trial {k}", sources.get(f"t{k}", ""), T3, "clean", k) for k in range(n)]


def numbers(records: list[TrialRecord]) -> list[dict[str, Any]]:
    return [to_row(r) for r in records]


def test_records_come_in_order_with_their_metrics(tmp_path: Path):
    records = SuiteRun(run_straight, ["first", "second"], SuiteStore(tmp_path), SerialExecutor).run(tasks(4))
    assert [(r.trial, r.method) for r in records][:3] == [
        ("trial 0", "first"),
        ("trial 0", "second"),
        ("trial 1", "first"),
    ]
    assert records[4].value("trajectory_rmse_mm") == pytest.approx(2.0, abs=0.05)
    assert records[4].value("analytic_trajectory_rmse_mm") == pytest.approx(2.0, abs=0.05)
    assert records[3].failure == "odd"
    assert records[4].events == {"contact-lost": (0, 0, 0), "grasp-slip": (0, 1, 0)}
    assert records[4].condition == T3


def test_a_stopped_run_continues_where_it_was(tmp_path: Path):
    ran: list[str] = []

    def counting(task: TrialTask, methods: Any) -> Any:
        ran.append(task.name)
        return run_straight(task, methods)

    store = SuiteStore(tmp_path)
    SuiteRun(counting, ["first"], store, SerialExecutor).run(tasks(3))
    done: list[str] = []
    run = SuiteRun(counting, ["first"], store, SerialExecutor, on_done=lambda t: done.append(t.name))
    records = run.run(tasks(5))
    assert ran == [f"trial {k}" for k in range(5)]
    assert len(records) == len(done) == 5
    damaged = next((tmp_path / "records").iterdir())
    damaged.write_bytes(b"half a fi")
    SuiteRun(counting, ["first"], store, SerialExecutor).run(tasks(5))
    assert len(ran) == 6


def test_what_fails_is_reported_by_name_and_tried_again_next_time(tmp_path: Path):
    run = SuiteRun(run_or_fail, ["first"], SuiteStore(tmp_path), SerialExecutor)
    records = run.run(tasks(3, t0="unreadable", t2="bug"))
    assert records[0].failure == "x.mcap: not a recording"
    assert records[1].failure == ""
    assert records[2].failure == "internal error, ZeroDivisionError: oops"
    again = SuiteRun(run_or_fail, ["first"], SuiteStore(tmp_path), SerialExecutor).run(tasks(3))
    assert not any(r.failure for r in again)


def test_processes_give_the_same_numbers_and_survive_the_death_of_one(tmp_path: Path):
    marker = tmp_path / "died"
    serial = SuiteRun(run_straight, ["first"], SuiteStore(tmp_path / "a"), SerialExecutor).run(tasks(6))
    parallel = SuiteRun(run_or_fail, ["first"], SuiteStore(tmp_path / "b"), local_executor(2), in_flight=3)
    assert numbers(parallel.run(tasks(6, t2=f"die-once:{marker}"))) == numbers(serial)
    assert marker.exists()


def test_a_trial_that_always_kills_its_worker_is_blamed_alone(tmp_path: Path):
    run = SuiteRun(run_or_fail, ["first"], SuiteStore(tmp_path), local_executor(2), in_flight=2)
    records = run.run(tasks(4, t1="die"))
    assert [bool(r.failure) for r in records] == [False, True, False, False]
    assert "died" in records[1].failure


def test_no_more_trials_are_handed_out_than_asked_for(tmp_path: Path):
    class Counting(SerialExecutor):
        most = 0
        open_futures = 0

        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            Counting.open_futures += 1
            Counting.most = max(Counting.most, Counting.open_futures)
            return super().submit(fn, *args, **kwargs)

    def finished(_: TrialTask) -> None:
        Counting.open_futures -= 1

    SuiteRun(run_straight, ["first"], SuiteStore(tmp_path), Counting, in_flight=4, on_done=finished).run(
        tasks(40)
    )
    assert Counting.most == 4


def test_a_folder_keeps_to_its_settings(tmp_path: Path):
    store = SuiteStore(tmp_path)
    store.claim({"level": "nominal", "methods": "paper"})
    store.claim({"level": "nominal", "methods": "paper"})
    with pytest.raises(ConfigError, match="level nominal → hard"):
        store.claim({"level": "hard", "methods": "paper"})


def test_settings_that_cannot_be_read_are_told(tmp_path: Path):
    (tmp_path / "suite.json").write_text("")
    with pytest.raises(OutputError, match="does not tell which settings"):
        SuiteStore(tmp_path).claim({"level": "nominal"})


def test_a_trial_whose_file_has_changed_is_not_finished(tmp_path: Path):
    file = tmp_path / "trial.mcap"
    file.write_text("before")
    (task,) = tasks(1)
    out = tmp_path / "out"
    store = SuiteStore(out, {task.name: [file]})
    assert store.read(task.name) is None
    SuiteRun(run_straight, ["first"], store, SerialExecutor).run([task])
    assert SuiteStore(out, {task.name: [file]}).read(task.name) is not None
    file.write_text("another trial")
    assert SuiteStore(out, {task.name: [file]}).read(task.name) is None


def test_traces_come_back_with_their_condition(tmp_path: Path):
    store = SuiteStore(tmp_path)
    records = SuiteRun(run_straight, ["first"], store, SerialExecutor).run(tasks(2))
    found = list(store.traces(records))
    assert [c for c, _ in found] == [T3, T3]
    assert np.allclose(found[1][1].methods_mm["first"][:, 1], 1.0, atol=0.1)
    assert store.finish(records).exists()


@pytest.mark.parametrize("name", ["T3-O1-W1-G1-r0", "a/b.mcap", "a_b.mcap", "ü", "x" * 200, "..", "a b"])
def test_any_name_becomes_a_file(name: str):
    plain = file_name(name)
    assert plain not in {"", ".", ".."}
    assert "/" not in plain
    assert len(plain) <= 80


def test_different_names_become_different_files():
    names = ["a/b", "a_b", "a b", "a__b", "x" * 100, "x" * 101]
    assert len({file_name(n) for n in names}) == len(names)
