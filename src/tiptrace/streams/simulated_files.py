"""Simulated trials as files: one, or a suite in parallel; a killed run continues where it stopped."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from tiptrace.errors import OutputError, SimulationError, TipTraceError
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.suite import SuiteTrial
from tiptrace.streams.recording import Recording
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.truth_table import TruthTable
from tiptrace.streams.writer import write_recording
from tiptrace.types import Sample, TruthSample

_THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class WrittenTrial:
    """What became of a trial.

    Attributes:
        name: The trial.
        path: Its recording.
        frames: Image pairs simulated; 0 where the file was there already or the trial failed.
        error: Why it failed; None where it did not.
    """

    name: str
    path: Path
    frames: int = 0
    error: str | None = None


def write_trial(
    spec: TrialSpec, path: Path, truth: Path | None = None, progress: Callable[[], None] | None = None
) -> int:
    """Simulate a trial into a recording, and its truth into a table; returns the number of frames.

    The truth is written even where the simulation stops early: what was simulated is kept.

    Raises:
        SimulationError: the trial cannot be performed; what came before is in ``<name>.partial.mcap``.
    """
    table = TruthTable()
    stream = SimulatedStream(spec, on_frame=table.add if truth is not None else None)

    def tick(sample: Sample) -> None:
        if progress is not None and isinstance(sample, TruthSample):
            progress()

    try:
        write_recording(path, stream, trial=stream.trial_metadata, progress=tick)
    finally:
        if truth is not None and table.rows:
            table.write(truth)
    return stream.frame_count


def write_suite(
    trials: Sequence[SuiteTrial], folder: Path, workers: int = 1, truth: bool = False
) -> Iterator[WrittenTrial]:
    """Simulate a suite into a folder, yielding each trial as it is done; trials that are there are left alone.

    Raises:
        SimulationError: a file of that name holds another trial.
        OutputError: the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be a folder for the trials ({error.strerror}); choose another"
        ) from None
    todo: list[tuple[SuiteTrial, Path, Path | None]] = []
    for trial in trials:
        path = folder / f"{trial.name}.mcap"
        table = folder / f"{trial.name}.truth.parquet" if truth else None
        if path.exists():
            _check_same(trial, path)  # also where only the table is missing: the recording is written again
        if path.exists() and (table is None or table.exists()):
            yield WrittenTrial(trial.name, path)
        else:
            todo.append((trial, path, table))
    if workers <= 1:
        for trial, path, table in todo:
            yield _attempt(trial, path, table)
        return
    yield from _in_parallel(todo, workers)


def _in_parallel(
    todo: Sequence[tuple[SuiteTrial, Path, Path | None]], workers: int
) -> Iterator[WrittenTrial]:
    from multiprocessing import get_context

    before = {name: os.environ.get(name) for name in _THREAD_LIMITS}
    os.environ.update(dict.fromkeys(_THREAD_LIMITS, "1"))  # spawned workers inherit it
    try:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            futures = [pool.submit(_attempt, trial, path, table) for trial, path, table in todo]
            for future in as_completed(futures):
                yield future.result()
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _attempt(trial: SuiteTrial, path: Path, truth: Path | None) -> WrittenTrial:
    try:
        return WrittenTrial(trial.name, path, write_trial(trial.spec, path, truth))
    except TipTraceError as error:
        return WrittenTrial(trial.name, path, error=str(error))


def _check_same(trial: SuiteTrial, path: Path) -> None:
    if Recording(path).trial.get("spec") != trial.spec.model_dump(mode="json", exclude_none=True):
        raise SimulationError(
            f"{path}: holds a trial with other settings; choose another folder or remove the file"
        )
