"""What a marker's neighbours say about it: a displacement field that is smooth over the grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tiptrace.types import BoolArray, FloatArray

_NEIGHBOURS = 8


class Neighbourhood:
    """Local affine prediction of each marker's displacement from those around it."""

    def __init__(self, rest_px: FloatArray) -> None:
        """Fix the neighbours on the first frame's positions (n, 2)."""
        distance = np.linalg.norm(rest_px[:, None] - rest_px[None], axis=2)
        np.fill_diagonal(distance, np.inf)
        k = min(_NEIGHBOURS, len(rest_px) - 1)
        self.neighbours: NDArray[np.intp] = np.argsort(distance, axis=1)[:, :k]  # (n, k)
        self.pitch_px = float(np.median(distance.min(axis=1)))
        rows = np.arange(len(rest_px))[:, None]
        offset = (rest_px[self.neighbours] - rest_px[:, None]) / self.pitch_px  # (n, k, 2)
        self._A = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=2)  # (n, k, 3)
        self._weight = 1.0 / (0.5 + distance[rows, self.neighbours] / self.pitch_px) ** 2  # (n, k)

    def predict(self, displacement_px: FloatArray, known: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Displacement (n, 2) of every marker from its known neighbours', and (n,) whether they sufficed.

        The affine part is damped, so that few or one-sided neighbours predict their mean.
        """
        use = known[self.neighbours]  # (n, k)
        w = np.where(use, self._weight, 0.0)
        d = np.where(use[..., None], displacement_px[self.neighbours], 0.0)  # (n, k, 2)
        AtW = np.swapaxes(self._A, 1, 2) * w[:, None, :]  # (n, 3, k)
        damping = np.array([1e-6, 0.4, 0.4])
        M = AtW @ self._A + np.diag(damping)[None]  # (n, 3, 3)
        coefficients = np.linalg.solve(M, AtW @ d)  # (n, 3, 2)
        return coefficients[:, 0], np.asarray(use.sum(axis=1) >= 2)
