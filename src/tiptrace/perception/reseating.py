"""Which dot is whose, when nobody saw the way between two images: all markers are matched to all dots at once.

Every marker may sit on any dot around where it was, or on none. What decides is how smoothly over the gel the
markers are displaced, and how smoothly what they moved since: both differences between neighbours are squared and cut
off, since gel that breaks loose shears. The rim of a patch tells its dots from the next ones, and a whole lattice
that seems shifted by one pitch has moved furthest. Solved by min-sum belief propagation, whose min-marginals say how
much worse every marker's second best dot is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.types import BoolArray, FloatArray

# lengths in pitches, costs in squared pitches; chosen on seeds below 1000 and on painted leaps
_REACH = 1.25  # how far a marker may have moved
_NEXT, _DIAGONAL = 1.25, 1.65  # neighbours up to there count in full, and half
_CUT = 0.25  # cost at which a difference between neighbours is an edge
_MOVED = 0.1  # cost of having moved by a pitch
_MISSING = 1.0  # cost of a marker without a dot …
_MISSING_AT_BORDER = 0.5  # … where it may have left the image
_MISSING_BESIDE = 0.1  # … and of each pair that this leaves undecided
_SHARED = 2.0  # cost of two neighbours on one dot
_ROUNDS, _DAMPING = 25, 0.5
_SURE = 0.5  # by how much a marker's second dot must be worse
_DECIDED, _DECIDED_SHARE = 0.7, 10.0  # percentile of the margins of all that decides for the whole
_SAME = 0.1  # distance up to which two places are one dot's
_NEVER = 1e9  # cost of a dot that is not to be had
_MOST = 12  # dots that a marker may choose from, "none" included


@dataclass(frozen=True, slots=True)
class Seats:
    """Dots of markers.

    Attributes:
        uv_px: (n, 2); NaN where a marker has none, or either of two.
        decided: Whether the best assignment of all is clearly better than others.
    """

    uv_px: FloatArray
    decided: bool


class Seating:
    """Matches markers of one gel to dots."""

    def __init__(self, rest_px: FloatArray, pitch_px: float) -> None:
        """Fix the neighbours on the first frame's positions (n, 2)."""
        self._rest, self._pitch = np.ascontiguousarray(rest_px), pitch_px
        distance = np.linalg.norm(rest_px[:, None] - rest_px[None], axis=2) / pitch_px
        i, j = np.nonzero(np.triu(distance < _DIAGONAL, 1))
        self._pairs = np.column_stack([i, j])  # (m, 2)
        self._weight = np.where(distance[i, j] < _NEXT, 1.0, 0.5)

    def seats(
        self, before_px: FloatArray, dots_px: FloatArray, held_px: FloatArray, shape: tuple[int, ...]
    ) -> Seats:
        """Match markers that were at places (n, 2) to dots (m, 2) of an image (H, W).

        What following them gave, at places (n, 2) or NaN, stands if nothing better is found.
        """
        if not len(dots_px):
            return Seats(np.full_like(before_px, np.nan), False)
        away = np.linalg.norm(before_px[:, None] - dots_px[None], axis=2) / self._pitch  # (n, m)
        choice = np.argsort(away, axis=1)[:, : _MOST - 1]  # (n, k) nearest first
        away = np.take_along_axis(away, choice, axis=1)
        count = np.count_nonzero(away < _REACH, axis=1) + 1
        at_border = _border_distance(before_px, shape) < self._pitch
        none = np.where(at_border, _MISSING_AT_BORDER, _MISSING)
        own = np.concatenate([none[:, None], _MOVED * away**2], axis=1)  # (n, k + 1): none, then dots
        displaced = dots_px[choice] - self._rest[:, None]  # (n, k, 2)
        moved = dots_px[choice] - before_px[:, None]
        cost = _pair_costs(
            self._pairs, self._weight, choice, count, displaced / self._pitch, moved / self._pitch
        )
        total = _min_marginals(own, count, self._pairs, cost)
        best, places = total.argmin(axis=1), dots_px[choice]
        held = self._choices(held_px, places, count)
        better_by = _sum(best, own, self._pairs, cost) - _sum(held, own, self._pairs, cost)
        if better_by > 0.0:
            return Seats(np.where((held > 0)[:, None], held_px, np.nan), better_by > _DECIDED)
        return self._read(best, total, places, at_border)

    def _choices(self, uv_px: FloatArray, places: FloatArray, count: NDArray[np.intp]) -> NDArray[np.intp]:
        """Numbers (n,) of the dots, of those at places (n, k, 2), at which markers (n, 2) are; 0 for none."""
        away = np.linalg.norm(places - uv_px[:, None], axis=2) / self._pitch
        away[np.isnan(away) | (np.arange(away.shape[1]) >= count[:, None] - 1)] = np.inf
        return np.where(away.min(axis=1) < _SAME, away.argmin(axis=1) + 1, 0)

    def _read(
        self, best: NDArray[np.intp], total: FloatArray, places: FloatArray, at_border: BoolArray
    ) -> Seats:
        """Best dots (n,) of the markers, as far as their costs (n, k + 1) are clear; at places (n, k, 2)."""
        ranked = np.sort(total[:, 1:], axis=1)
        margin = ranked[:, 1] - ranked[:, 0] if ranked.shape[1] > 1 else np.full(len(best), _NEVER)
        sure = (best > 0) & (margin > _SURE)
        uv = np.take_along_axis(places, np.maximum(best - 1, 0)[:, None, None], axis=1)[:, 0]
        telling = margin[(best > 0) & ~at_border]
        decided = bool(telling.size and np.percentile(telling, _DECIDED_SHARE) > _DECIDED)
        return Seats(np.where(sure[:, None], uv, np.nan), decided)


def _border_distance(uv_px: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Distance (n,) of places (n, 2) from the nearest border of an image (H, W)."""
    far = np.array([shape[1] - 1, shape[0] - 1]) - uv_px
    return np.asarray(np.minimum(uv_px, far).min(axis=1))


@compiled
def _pair_costs(
    pairs: NDArray[np.intp],
    weight: FloatArray,
    choice: NDArray[np.intp],
    count: NDArray[np.intp],
    displaced: FloatArray,
    moved: FloatArray,
) -> FloatArray:
    """Cost (m, k + 1, k + 1) of each choice of two neighbours."""
    cost = np.empty((len(pairs), choice.shape[1] + 1, choice.shape[1] + 1))
    for e in range(len(pairs)):
        i, j = pairs[e, 0], pairs[e, 1]
        for a in range(count[i]):
            for b in range(count[j]):
                if a == 0 or b == 0:
                    c = _MISSING_BESIDE
                elif choice[i, a - 1] == choice[j, b - 1]:
                    c = _SHARED
                else:
                    p, q = displaced[i, a - 1], displaced[j, b - 1]
                    c = min((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2, _CUT)
                    p, q = moved[i, a - 1], moved[j, b - 1]
                    c += min((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2, _CUT)
                cost[e, a, b] = weight[e] * c
    return cost


@compiled
def _sum(which: NDArray[np.intp], own: FloatArray, pairs: NDArray[np.intp], cost: FloatArray) -> float:
    """Cost of a choice (n,) of all."""
    total = 0.0
    for i in range(len(which)):
        total += own[i, which[i]]
    for e in range(len(pairs)):
        total += cost[e, which[pairs[e, 0]], which[pairs[e, 1]]]
    return total


@compiled
def _min_marginals(
    own: FloatArray, count: NDArray[np.intp], pairs: NDArray[np.intp], cost: FloatArray
) -> FloatArray:
    """Least cost of all for each choice of each marker (n, k + 1), enormous for choices that it has not."""
    total = own.copy()
    messages = np.zeros((len(pairs), 2, own.shape[1]))  # to the second of a pair, to the first
    new = np.empty(own.shape[1])
    for r in range(_ROUNDS):
        for k in range(len(pairs)):
            e = k if r % 2 == 0 else len(pairs) - 1 - k
            for way in range(2):
                i, j = pairs[e, way], pairs[e, 1 - way]
                old, back = messages[e, way], messages[e, 1 - way]
                for b in range(count[j]):
                    new[b] = _NEVER
                    for a in range(count[i]):
                        c = cost[e, a, b] if way == 0 else cost[e, b, a]
                        new[b] = min(new[b], total[i, a] - back[a] + c)
                least = new[: count[j]].min()
                for b in range(count[j]):
                    message = _DAMPING * old[b] + (1.0 - _DAMPING) * (new[b] - least)
                    total[j, b] += message - old[b]
                    old[b] = message
    for i in range(len(total)):
        total[i, count[i] :] = _NEVER
    return total
