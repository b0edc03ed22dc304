"""What is kept of a trial's trajectories for the figures of a suite: positions alone, single precision."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from tiptrace.errors import OutputError
from tiptrace.evaluation.atomic import write_atomic
from tiptrace.evaluation.error_series import initial_point
from tiptrace.evaluation.truth import Truth
from tiptrace.types import FloatArray, Phase, TipTrajectory

_TRUTH = "truth"


@dataclass(frozen=True, slots=True)
class TrialTraces:
    """Traces of one trial over its reconstruction segment, from the true start, mm.

    Attributes:
        truth_mm: (n, 3) true tip at the instants of the first method's rows; empty without a truth.
        methods_mm: (n, 3) estimates by method, NaN where there is none.
    """

    truth_mm: FloatArray
    methods_mm: Mapping[str, FloatArray]

    @classmethod
    def of(cls, trajectories: Mapping[str, TipTrajectory], truth: Truth | None) -> Self:
        """From trajectories in the base frame."""
        first = next(iter(trajectories.values()))
        stamps = [e.stamp_ns for e in first.estimates if e.phase is Phase.RECONSTRUCTION]
        truth_B = np.zeros((0, 3)) if truth is None else truth.at(stamps)
        origin = np.zeros(3)
        if truth is not None and np.isfinite(start := initial_point(first, truth)[1]).all():
            origin = start
        elif (seen := _positions(first)[np.isfinite(_positions(first)).all(axis=1)]).size:
            origin = seen[0]
        methods = {name: (_positions(t) - origin) * 1e3 for name, t in trajectories.items()}
        return cls((truth_B - origin) * 1e3, methods)

    def write(self, path: Path) -> None:
        """Write a compressed npz.

        Raises:
            OutputError: it cannot be written.
        """
        buffer = io.BytesIO()
        arrays = {_TRUTH: self.truth_mm, **{f"method:{k}": v for k, v in self.methods_mm.items()}}
        np.savez_compressed(buffer, **{k: v.astype(np.float32) for k, v in arrays.items()})  # type: ignore[arg-type]
        write_atomic(path, buffer.getvalue())

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read what :meth:`write` wrote.

        Raises:
            OutputError: it cannot be read.
        """
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: stored[name].astype(np.float64) for name in stored.files}
            truth = arrays.pop(_TRUTH)
        except (OSError, KeyError, ValueError) as error:
            raise OutputError(f"{path}: not a file of traces ({error})") from None
        return cls(truth, {name.removeprefix("method:"): v for name, v in arrays.items()})


def _positions(trajectory: TipTrajectory) -> FloatArray:
    rows = [e for e in trajectory.estimates if e.phase is Phase.RECONSTRUCTION]
    return np.array([np.full(3, np.nan) if e.p_B is None else e.p_B for e in rows]).reshape(-1, 3)
