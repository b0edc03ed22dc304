"""The same numbers on a Dask cluster, also with a worker killed half way. Needs the extra ``cluster``."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from tiptrace.errors import ConfigError
from tiptrace.evaluation.executors import SerialExecutor, dask_executor
from tiptrace.evaluation.records import to_row
from tiptrace.evaluation.runner import SuiteRun, TrialTask
from tiptrace.evaluation.suite_store import SuiteStore

from .run_functions import run_slowly
from .test_runner import T3

distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
pytestmark = pytest.mark.slow


def trials(n: int) -> list[TrialTask]:
    return [TrialTask(f"trial {k}", "", T3, "clean", k) for k in range(n)]


def rows(run: SuiteRun, n: int) -> list[dict[str, Any]]:
    return [to_row(r) for r in run.run(trials(n))]


@pytest.fixture
def cluster() -> Any:
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**options) as running:
        yield running


def test_a_cluster_gives_the_same_numbers_with_a_worker_killed(cluster: Any, tmp_path: Path):
    serial = rows(SuiteRun(run_slowly, ["first"], SuiteStore(tmp_path / "a"), SerialExecutor), 24)
    with dask_executor(cluster.scheduler_address) as open_executor:
        run = SuiteRun(run_slowly, ["first"], SuiteStore(tmp_path / "b"), open_executor, in_flight=100)
        victim = next(iter(cluster.workers.values())).pid

        def kill() -> None:
            time.sleep(0.7)
            os.kill(victim, signal.SIGKILL)

        thread = threading.Thread(target=kill)
        thread.start()
        assert rows(run, 24) == serial
        thread.join()


def test_a_scheduler_that_is_not_there_is_one_sentence():
    with pytest.raises(ConfigError, match="no Dask scheduler answers"), dask_executor("tcp://127.0.0.1:1"):
        pass


def test_a_scheduler_without_workers_is_not_waited_for_for_ever():
    options = {"n_workers": 0, "dashboard_address": None}
    with (
        distributed.LocalCluster(**options) as empty,
        pytest.raises(ConfigError, match="had no worker"),
        dask_executor(empty.scheduler_address, workers_s=0.5),
    ):
        pass
