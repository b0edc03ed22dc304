"""What a marker's neighbours say about it: a displacement field that is smooth over the grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tiptrace.types import BoolArray, FloatArray

_NEIGHBOURS = 8
_DAMPING = 0.4  # of the affine part, in neighbours: few or one-sided neighbours predict their mean
_SWEEPS = 30


class Neighbourhood:
    """Local affine prediction of each marker's displacement from those around it."""

    def __init__(self, rest_px: FloatArray) -> None:
        """Fix the neighbours on the first frame's positions (n, 2)."""
        n = len(rest_px)
        distance = np.linalg.norm(rest_px[:, None] - rest_px[None], axis=2)
        np.fill_diagonal(distance, np.inf)
        k = min(_NEIGHBOURS, n - 1)
        self.neighbours: NDArray[np.intp] = np.argsort(distance, axis=1)[:, :k]  # (n, k)
        self.pitch_px = float(np.median(distance.min(axis=1)))
        rows = np.arange(n)[:, None]
        offset = (rest_px[self.neighbours] - rest_px[:, None]) / self.pitch_px  # (n, k, 2)
        A = np.concatenate([np.ones((n, k, 1)), offset], axis=2)  # (n, k, 3)
        w = 1.0 / (0.5 + distance[rows, self.neighbours] / self.pitch_px) ** 2  # (n, k)
        AtW = np.swapaxes(A, 1, 2) * w[:, None, :]  # (n, 3, k)
        M = AtW @ A + np.diag([1e-9, _DAMPING, _DAMPING])[None]
        self._P = np.zeros((n, n))  # prediction = P @ displacement
        self._P[rows, self.neighbours] = np.linalg.solve(M, AtW)[:, 0]
        self._near = np.zeros((n, n))
        self._near[rows, self.neighbours] = 1.0

    def predict(self, displacement_px: FloatArray, known: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Displacement (n, 2) of every marker from its neighbours', and (n,) whether two of them are known.

        Unknown ones take part with what their own neighbours predict for them.
        """
        enough = np.asarray(self._near @ known >= 2)
        if not known.any():
            return np.zeros_like(displacement_px), enough
        x = np.where(known[:, None], displacement_px, displacement_px[known].mean(axis=0))
        unknown = np.flatnonzero(~known)
        if unknown.size:
            P = self._P[unknown]
            for _ in range(_SWEEPS):
                step = P @ x
                settled = np.abs(step - x[unknown]).max() < 0.02
                x[unknown] = step
                if settled:
                    break
        return self._P @ x, enough
