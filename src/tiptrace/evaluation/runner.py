"""Any number of trials, a few at a time: what fails is reported, what was finished is kept."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass, field, replace
from typing import Protocol

from tiptrace.errors import TipTraceError
from tiptrace.evaluation.conditions import Condition
from tiptrace.evaluation.event_matching import score_events
from tiptrace.evaluation.executors import OpenExecutor
from tiptrace.evaluation.metrics import evaluate
from tiptrace.evaluation.quality import assess
from tiptrace.evaluation.records import TrialRecord, analytic_errors
from tiptrace.evaluation.suite_store import SuiteStore
from tiptrace.evaluation.traces import TrialTraces
from tiptrace.evaluation.truth import Truth
from tiptrace.types import Event, TipTrajectory

MAX_ATTEMPTS = 3
_EVENT_KINDS = ("contact-lost", "grasp-slip")


@dataclass(frozen=True, slots=True)
class TrialTask:
    """A trial to be run.

    Attributes:
        name: Unique in the suite.
        source: What the run function needs to find it: a path, or settings as JSON.
        condition: What was varied, where known.
        level: Disturbance level of a simulated trial.
        seed: Its seed.
    """

    name: str
    source: str
    condition: Condition | None = None
    level: str = ""
    seed: int | None = None


@dataclass(frozen=True, slots=True)
class TrialRun:
    """What came of a trial.

    Attributes:
        trajectories: By method.
        truth: True tip, where known.
        analytic: The paper's analytic truth, where asked for.
        failures: Why a method gave no trajectory, by method.
        true_events: What really happened; None where nobody knows.
        slight_events: What happened too, but need not be told.
        task: The task with what its source told of condition, level and seed; None where it told nothing.
    """

    trajectories: Mapping[str, TipTrajectory]
    truth: Truth | None = None
    analytic: Truth | None = None
    failures: Mapping[str, str] = field(default_factory=dict)
    true_events: tuple[Event, ...] | None = None
    slight_events: tuple[Event, ...] = ()
    task: TrialTask | None = None


class RunTrial(Protocol):
    """Runs a trial with several methods; must be importable by name, so that workers find it."""

    def __call__(self, task: TrialTask, methods: Sequence[str]) -> TrialRun:
        """Run."""
        ...


@dataclass(frozen=True, slots=True)
class TrialResult:
    """Records and traces of a finished trial."""

    task: TrialTask
    records: tuple[TrialRecord, ...]
    traces: TrialTraces | None = None


def evaluate_trial(run_trial: RunTrial, task: TrialTask, methods: Sequence[str]) -> TrialResult:
    """Run a trial and measure it; whatever goes wrong becomes a record that says so."""
    try:
        run = run_trial(task, methods)
    except TipTraceError as error:
        return failed(task, methods, str(error))
    except Exception as error:  # noqa: BLE001 - one trial among thousands must not end the others
        return failed(task, methods, f"internal error, {type(error).__name__}: {error}")
    known = run.task or task
    records = tuple(_record(known, run, method) for method in methods)
    traces = TrialTraces.of(run.trajectories, run.truth) if run.trajectories else None
    return TrialResult(task, records, traces)


def failed(task: TrialTask, methods: Sequence[str], reason: str) -> TrialResult:
    """A trial that gave nothing."""
    return TrialResult(task, tuple(replace(_blank(task, m), failure=reason, verdict="fail") for m in methods))


def _blank(task: TrialTask, method: str) -> TrialRecord:
    return TrialRecord(task.name, method, condition=task.condition, level=task.level, seed=task.seed)


def _record(task: TrialTask, run: TrialRun, method: str) -> TrialRecord:
    trajectory = run.trajectories.get(method)
    if trajectory is None:
        return failed(task, [method], run.failures.get(method, "no result")).records[0]
    scores = {}
    if run.true_events is not None:
        told, real, slight = trajectory.events, run.true_events, run.slight_events
        scores = {kind: score_events(told, real, kind, slight=slight) for kind in _EVENT_KINDS}
    return replace(
        _blank(task, method),
        metrics=evaluate(trajectory, run.truth),
        verdict=assess(trajectory).verdict,
        analytic=analytic_errors(evaluate(trajectory, run.analytic)) if run.analytic is not None else None,
        events={kind: (s.hits, s.misses, s.false_alarms) for kind, s in scores.items()} or None,
        event_delays_s={kind: s.delays_s for kind, s in scores.items()} or None,
    )


@dataclass
class SuiteRun:
    """Runs the trials of a suite through an executor.

    At most ``in_flight`` trials are handed out at a time. A worker that dies takes the pool with it: the pool is
    opened anew and what was under way runs again, one trial at a time, so that the one to blame is found.

    Attributes:
        run_trial: Runs one trial.
        methods: Methods to run.
        store: Where finished trials are kept.
        open_executor: Opens a pool, again after one broke.
        in_flight: Trials handed out at a time.
        on_done: Called after each trial, those found finished included.
    """

    run_trial: RunTrial
    methods: Sequence[str]
    store: SuiteStore
    open_executor: OpenExecutor
    in_flight: int = 1
    on_done: Callable[[TrialTask], None] = lambda task: None
    _attempts: dict[str, int] = field(default_factory=dict)

    def run(self, tasks: Iterable[TrialTask]) -> list[TrialRecord]:
        """Run every trial that the store does not hold yet; records in the order of the tasks."""
        tasks = list(tasks)
        kept = {task.name: self._kept(task) for task in tasks}
        waiting = deque(task for task in tasks if kept[task.name] is None)
        for task in tasks:
            if kept[task.name] is not None:
                self.on_done(task)
        while waiting:
            suspects = self._one_pool(waiting, kept)
            waiting.extendleft(reversed(suspects))
        return [record for task in tasks for record in kept[task.name] or ()]

    def _kept(self, task: TrialTask) -> tuple[TrialRecord, ...] | None:
        records = self.store.read(task.name)
        if records is None or {r.method for r in records} != set(self.methods):
            return None
        if any(r.failure for r in records):  # what failed is tried again
            return None
        return tuple(records)

    def _one_pool(
        self, waiting: deque[TrialTask], kept: dict[str, tuple[TrialRecord, ...] | None]
    ) -> list[TrialTask]:
        """Work until all is done or the pool breaks; returns what was under way then."""
        pool = self.open_executor()
        running: dict[Future[TrialResult], TrialTask] = {}
        lost: list[TrialTask] = []
        try:
            while (waiting or running) and not lost:
                self._hand_out(pool, waiting, running)
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    task = running.pop(future)
                    if not future.cancelled() and isinstance(future.exception(), BrokenExecutor):
                        lost.append(task)
                    else:
                        self._keep(_result(future, task, self.methods), kept)
        except BrokenExecutor:  # while handing out
            pass
        finally:
            for future in running:
                future.cancel()
            pool.shutdown(wait=not lost)
        lost += running.values()
        return self._to_try_again(lost, kept)

    def _hand_out(
        self, pool: Executor, waiting: deque[TrialTask], running: dict[Future[TrialResult], TrialTask]
    ) -> None:
        """Fill the window; a trial that was under way when a worker died runs alone."""
        while waiting and len(running) < self.in_flight:
            alone = waiting[0].name in self._attempts
            if alone and running:
                return
            task = waiting.popleft()
            try:
                future = pool.submit(evaluate_trial, self.run_trial, task, self.methods)
            except BrokenExecutor:
                waiting.appendleft(task)
                raise
            running[future] = task
            if alone:
                return

    def _keep(self, result: TrialResult, kept: dict[str, tuple[TrialRecord, ...] | None]) -> None:
        self.store.write(result.task.name, result.records, result.traces)
        kept[result.task.name] = result.records
        self.on_done(result.task)

    def _to_try_again(
        self, lost: list[TrialTask], kept: dict[str, tuple[TrialRecord, ...] | None]
    ) -> list[TrialTask]:
        again = []
        for task in lost:
            self._attempts[task.name] = self._attempts.get(task.name, 0) + 1
            if self._attempts[task.name] < MAX_ATTEMPTS:
                again.append(task)
            else:
                self._keep(failed(task, self.methods, f"its worker died {MAX_ATTEMPTS} times"), kept)
        return again


def _result(future: Future[TrialResult], task: TrialTask, methods: Sequence[str]) -> TrialResult:
    """Result of a future; a cluster reports a trial that killed its workers as an error of its own."""
    if future.cancelled():
        return failed(task, methods, "cancelled by the scheduler")
    error = future.exception()
    return future.result() if error is None else failed(task, methods, f"{type(error).__name__}: {error}")
