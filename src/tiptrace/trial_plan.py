"""Which trials an evaluation runs: those of a simulated suite, or recordings with the truth that belongs to them."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from pathlib import Path
from typing import Any, cast

from tiptrace.errors import ConfigError
from tiptrace.evaluation.conditions import Condition
from tiptrace.evaluation.runner import TrialTask
from tiptrace.sim.disturbances import LEVELS, Disturbances, LevelName, MarkerNoise
from tiptrace.sim.spec import make_spec
from tiptrace.sim.suite import suite_trials
from tiptrace.trial_runs import recording_source, simulated_source

_OPENING_M = 0.5e-3
_BUDGET: dict[str, tuple[str, ...]] = {
    "white marker noise": ("markers.in_plane_m", "markers.depth_m"),
    "slow depth tilt": ("markers.tilt_rad", "markers.tilt_s"),
    "depth bias and gain": ("markers.bias_m", "markers.shown_depth"),
    "shown shear": ("shown_shear",),
    "sensor rotation (T_E_S)": ("T_E_S_rotation_deg",),
    "sensor position (T_E_S)": ("T_E_S_translation_m",),
    "gripper opening": ("opening_m",),
    "latency": ("latency_s",),
    "robot pose noise": ("pose_noise_m", "pose_noise_deg"),
    "nominal tip": ("nominal_tip_m",),
    "slow slip in the grasp": ("grasp_drift_deg",),
}


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


def budget_tasks(level: str, seed: int, repeats: int) -> dict[str, list[TrialTask]]:
    """Trials of (T3, O1, W1, G1) at marker level with one disturbance at a time, by its name.

    Each has the strength that it has at the level; what the level leaves out has the strength of ``hard``, and the
    gripper's opening is 0.5 mm off. ``none`` has no disturbance at all, ``all`` is the level itself.

    Raises:
        SimulationError: an unknown level.
    """
    make_spec(level=level)
    return {
        name: [_budget_task(name, disturbances, seed * 100 + k) for k in range(repeats)]
        for name, disturbances in _one_at_a_time(level).items()
    }


def _one_at_a_time(level: str) -> dict[str, Disturbances]:
    chosen, hard = LEVELS[cast(LevelName, level)], LEVELS["hard"]
    values = {**hard.model_dump(), **{k: v for k, v in chosen.model_dump().items() if v}}
    values["opening_m"] = _OPENING_M
    plan: dict[str, Disturbances] = {"none": Disturbances()}
    for name, fields in _BUDGET.items():
        own = {field: values[field] for field in fields if "." not in field}
        markers = {
            f.removeprefix("markers."): values["markers"][f.removeprefix("markers.")]
            for f in fields
            if "." in f
        }
        plan[name] = Disturbances(**own, markers=MarkerNoise(**markers))
    return plan | {"all": chosen}


def _budget_task(name: str, disturbances: Disturbances, seed: int) -> TrialTask:
    spec = make_spec(mode="markers", seed=seed, disturbances=disturbances)
    condition = Condition(spec.trajectory, spec.tool, spec.wrist, spec.grasp)
    source = simulated_source(spec.model_dump(mode="json", exclude_none=True))
    return TrialTask(f"{name}, seed {seed}", source, condition, "budget", seed)


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
        own = _truth_of(path, truth)
        if truth is not None and own is None:
            notes.append(
                f"{path}: no {path.stem}.tum or .csv in {truth}; what the recording itself holds counts"
            )
        tasks.append(TrialTask(str(path), recording_source(path, own, curve, options)))
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
    return _without_copies(list(found.values()), notes), notes


def _without_copies(recordings: list[Path], notes: list[str]) -> list[Path]:
    """Files of different content; of those with the same one the first. Only files of equal size are read."""
    sizes = Counter(_size(path) for path in recordings)
    first: dict[str, Path] = {}
    kept = []
    for path in recordings:
        size = _size(path)
        if size > 0 and sizes[size] > 1:
            with path.open("rb") as file:
                other = first.setdefault(hashlib.file_digest(file, "sha256").hexdigest(), path)
            if other != path:
                notes.append(f"{path}: the same content as {other}, evaluated once")
                continue
        kept.append(path)
    return kept


def _size(path: Path) -> int:
    """Bytes; 0 for what is no readable file, which will say so itself."""
    return path.stat().st_size if path.is_file() and os.access(path, os.R_OK) else 0


def _truth_of(recording: Path, truth: Path | None) -> Path | None:
    """Truth file of a recording: the file itself, or the one of its name in a folder."""
    if truth is None or not truth.is_dir():
        return truth
    named = (truth / f"{recording.stem}{suffix}" for suffix in (".tum", ".csv"))
    return next((path for path in named if path.exists()), None)
