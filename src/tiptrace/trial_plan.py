"""Which trials an evaluation runs: those of a simulated suite, or recordings with the truth that belongs to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tiptrace.errors import ConfigError
from tiptrace.evaluation.conditions import Condition
from tiptrace.evaluation.runner import TrialTask
from tiptrace.sim.suite import suite_trials
from tiptrace.trial_runs import recording_source, simulated_source


def suite_tasks(suite: str, level: str, mode: Any, seed: int, analytic: str | None) -> list[TrialTask]:
    """Trials of a simulated suite.

    Raises:
        SimulationError: an unknown suite, level or mode.
    """
    tasks = []
    for trial in suite_trials(suite, level, mode, seed):
        spec = trial.spec
        condition = Condition(spec.trajectory, spec.tool, spec.wrist, spec.grasp)
        curve = {"centreline": analytic} if analytic else None
        source = simulated_source(spec.model_dump(mode="json", exclude_none=True), curve)
        tasks.append(TrialTask(trial.name, source, condition, spec.level, spec.seed))
    return tasks


def recording_tasks(
    paths: list[Path],
    truth: Path | None,
    analytic: str | None,
    start_m: list[float] | None,
    options: dict[str, str],
) -> tuple[list[TrialTask], list[str]]:
    """Recordings in the order given, each file once, and what a user should know of them.

    Args:
        paths: Recordings, or folders of them.
        truth: Ground truth of all, or a folder with ``NAME.tum`` or ``NAME.csv`` for each; None: their own.
        analytic: Name of an analytic centreline, ``auto`` as the trial names it, or None.
        start_m: Its measured start in the base frame; None: the true tip's.
        options: Further options of ``open_recording``, as text.

    Raises:
        ConfigError: a folder without recordings.
    """
    found, notes = _expand(paths)
    tasks = []
    for path in found:
        curve = {"centreline": analytic, "start_m": start_m} if analytic else None
        tasks.append(TrialTask(str(path), recording_source(path, _truth_of(path, truth), curve, options)))
    return tasks, notes


def _expand(paths: list[Path]) -> tuple[list[Path], list[str]]:
    """Recordings in folders; bags that are folders stay whole."""
    found: dict[Path, Path] = {}
    notes = []
    for path in paths:
        is_bag = path.is_dir() and (path / "metadata.yaml").exists()
        inside = sorted(path.rglob("*.mcap")) if path.is_dir() and not is_bag else [path]
        if not inside:
            raise ConfigError(f"{path}: holds no recording (*.mcap)")
        for recording in inside:
            if recording.resolve() in found:
                notes.append(f"{recording}: given more than once, evaluated once")
            found.setdefault(recording.resolve(), recording)
    return list(found.values()), notes


def _truth_of(recording: Path, truth: Path | None) -> Path | None:
    """Truth file of a recording: the file itself, or the one of its name in a folder."""
    if truth is None or not truth.is_dir():
        return truth
    named = (truth / f"{recording.stem}{suffix}" for suffix in (".tum", ".csv"))
    return next((path for path in named if path.exists()), None)
