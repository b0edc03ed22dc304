"""Trials for the runner's tests, importable by worker processes."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tiptrace.errors import RecordingError
from tiptrace.evaluation.runner import TrialRun, TrialTask
from tiptrace.evaluation.truth import Truth
from tiptrace.types import Event

from .builders import START_NS, straight_truth, trajectory_of, truth_of


def run_straight(task: TrialTask, methods: Sequence[str]) -> TrialRun:
    """A straight trace whose error is the seed in mm; ``second`` has no result on odd seeds."""
    assert task.seed is not None
    p = straight_truth()
    rng = np.random.default_rng(task.seed)
    offset = np.array([0.0, task.seed * 1e-3, 0.0])
    found = {
        m: trajectory_of(p + offset + rng.normal(0, 1e-5, p.shape), 5, anchor=offset)
        for m in methods
        if not (m == "second" and task.seed % 2)
    }
    truth = Truth.from_samples(truth_of(p))
    slip = (Event("grasp-slip", START_NS, START_NS + 10**8, ""),)
    missing = {m: "odd" for m in methods if m not in found}
    return TrialRun(found, truth, analytic=truth, failures=missing, true_events=slip)


def run_or_fail(task: TrialTask, methods: Sequence[str]) -> TrialRun:
    """Source ``unreadable`` and ``bug`` raise; ``die`` kills its worker always, ``die-once:FILE`` the first time."""
    if task.source == "unreadable":
        raise RecordingError("x.mcap: not a recording")
    if task.source == "bug":
        raise ZeroDivisionError("oops")
    if task.source == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if task.source.startswith("die-once:"):
        marker = Path(task.source.removeprefix("die-once:"))
        if not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return run_straight(task, methods)


def run_slowly(task: TrialTask, methods: Sequence[str]) -> TrialRun:
    """Long enough for a worker to die in the middle."""
    time.sleep(0.1)
    return run_straight(task, methods)
