"""What a marker's neighbours say about it: a displacement field that is smooth over the grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.types import BoolArray, FloatArray

_NEIGHBOURS = 8
_DAMPING = 0.4  # of the affine part, in neighbours: few or one-sided neighbours predict their mean
_SWEEPS = 30
_ROUNDS = 3  # of dropping the displacements furthest off …
_AMONG_WORST = 0.7  # … by at least so much of the worst
_SETTLED_PX = 0.02  # change of a sweep below which no further one is made


class Neighbourhood:
    """Local affine prediction of each marker's displacement from those around it."""

    def __init__(self, rest_px: FloatArray) -> None:
        """Fix the neighbours on the first frame's positions (n, 2)."""
        n = len(rest_px)
        distance = np.linalg.norm(rest_px[:, None] - rest_px[None], axis=2)
        np.fill_diagonal(distance, np.inf)
        k = min(_NEIGHBOURS, n - 1)
        self.neighbours: NDArray[np.intp] = np.ascontiguousarray(
            np.argsort(distance, axis=1)[:, :k]
        )  # (n, k)
        self.pitch_px = float(np.median(distance.min(axis=1)))
        rows = np.arange(n)[:, None]
        offset = (rest_px[self.neighbours] - rest_px[:, None]) / self.pitch_px  # (n, k, 2)
        A = np.concatenate([np.ones((n, k, 1)), offset], axis=2)  # (n, k, 3)
        w = 1.0 / (0.5 + distance[rows, self.neighbours] / self.pitch_px) ** 2  # (n, k)
        AtW = np.swapaxes(A, 1, 2) * w[:, None, :]  # (n, 3, k)
        M = AtW @ A + np.diag([1e-9, _DAMPING, _DAMPING])[None]
        self._P = np.ascontiguousarray(
            np.linalg.solve(M, AtW)[:, 0]
        )  # (n, k): prediction = P · displacements

    def predict(self, displacement_px: FloatArray, known: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Displacement (n, 2) of every marker from its neighbours', and (n,) whether two of them are known.

        Unknown ones take part with what their own neighbours predict for them.
        """
        return _predict(self._P, self.neighbours, np.ascontiguousarray(displacement_px), known)

    def drop_strays(self, displacement_px: FloatArray, known: BoolArray, limit_px: float) -> BoolArray:
        """Those of the known displacements (n, 2) that their neighbours, all at once, do not speak against."""
        predicted, enough = self.predict(displacement_px, known)
        return _within(displacement_px, predicted, enough, known, limit_px)

    def agreeing(
        self, displacement_px: FloatArray, known: BoolArray, limit_px: float
    ) -> tuple[BoolArray, FloatArray]:
        """Known displacements (n, 2) less those off their neighbours', worst first, and how far each is off (n,)."""
        return _agreeing(self._P, self.neighbours, np.ascontiguousarray(displacement_px), known, limit_px)


@compiled
def _predict(
    P: FloatArray, neighbours: NDArray[np.intp], displacement: FloatArray, known: BoolArray
) -> tuple[FloatArray, BoolArray]:
    n = len(known)
    enough = np.zeros(n, dtype=np.bool_)
    x, mean = displacement.copy(), np.zeros(2)
    for i in range(n):
        count = 0
        for j in neighbours[i]:
            count += known[j]
        enough[i] = count >= 2
        if known[i]:
            mean += x[i]
    mean /= max(known.sum(), 1)
    for i in range(n):
        if not known[i]:
            x[i] = mean
    for _ in range(_SWEEPS):
        predicted = _from_neighbours(P, neighbours, x)
        change = 0.0
        for i in range(n):
            if not known[i]:
                change = max(change, abs(predicted[i, 0] - x[i, 0]), abs(predicted[i, 1] - x[i, 1]))
                x[i] = predicted[i]
        if change == 0.0:
            return predicted, enough
        if change < _SETTLED_PX:
            break
    return _from_neighbours(P, neighbours, x), enough


@compiled
def _from_neighbours(P: FloatArray, neighbours: NDArray[np.intp], x: FloatArray) -> FloatArray:
    """Local affine fit (n, 2) of displacements x (n, 2), at each marker."""
    predicted = np.zeros((len(P), 2))
    for i in range(len(P)):
        for k in range(P.shape[1]):
            j = neighbours[i, k]
            predicted[i, 0] += P[i, k] * x[j, 0]
            predicted[i, 1] += P[i, k] * x[j, 1]
    return predicted


@compiled
def _within(
    displacement: FloatArray, predicted: FloatArray, enough: BoolArray, known: BoolArray, limit: float
) -> BoolArray:
    """Known ones (n,) that lie within a limit of their prediction, where there is one."""
    kept = known.copy()
    for i in range(len(known)):
        off = np.hypot(displacement[i, 0] - predicted[i, 0], displacement[i, 1] - predicted[i, 1])
        kept[i] &= off < limit or not enough[i]
    return kept


@compiled
def _agreeing(
    P: FloatArray, neighbours: NDArray[np.intp], displacement: FloatArray, known: BoolArray, limit: float
) -> tuple[BoolArray, FloatArray]:
    kept, off = known.copy(), np.zeros(len(known))
    for _ in range(_ROUNDS):
        predicted, enough = _predict(P, neighbours, displacement, kept)
        worst = 0.0
        for i in range(len(kept)):
            off[i] = np.hypot(displacement[i, 0] - predicted[i, 0], displacement[i, 1] - predicted[i, 1])
            if kept[i] and enough[i] and off[i] > limit:
                worst = max(worst, off[i])
        if worst == 0.0:
            break
        for i in range(len(kept)):
            if enough[i] and off[i] > limit and off[i] >= _AMONG_WORST * worst:
                kept[i] = False
    return kept, off
