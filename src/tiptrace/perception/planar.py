"""Sensing without a calibrated gel (``depth: none``): the contact patch from the markers' motion.

Markers under the tool move as one rigid body, which is the tool. Beside it the gel is dragged along in part, or slides
by more than the tool does at the tool's edges; further out it hardly moves. So each frame is searched for the rigid
motion that most markers share, the far ones counting little, and the patch is who has shared it since. The third
coordinate is the tool's: every marker of the patch gets the indentation that the tool's thickness and the gripper's
opening imply, the others none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.types import BoolArray, FloatArray

_EVIDENCE_PX = 0.4  # motion of the strongest markers below which a frame says nothing
_STRONG = 85.0  # percentile that counts as the strongest
_CAP = 0.3  # of the strongest: a marker's motion counts up to this, or to the median
_PAIR = (1.5, 3.3)  # pitches between the two markers that propose a rigid motion
_OFF_PX, _OFF = 0.3, 0.3  # distance from the rigid motion, and its share of it, that count as shared
_STRETCH_PX, _STRETCH = 0.5, 0.15  # change of a proposing pair's length, and its share of the motion
_MOST_PX = 8.0  # motion beyond which a frame weighs no more
_ENOUGH_PX2 = 20.0  # squared motion, summed, from which on the patch is told
_SHARE = 0.5  # of the strongest markers' agreement that the patch has
_LEAST = 6  # markers in the patch


class MotionPatch:
    """Contact patch from each marker's agreement with the rigid motion, frame after frame; constant memory."""

    def __init__(self, rest_px: FloatArray) -> None:
        """Markers at these positions (n, 2) in the beginning; motions count from the first frame's."""
        self._start = rest_px.copy()
        self._first = True
        distance = np.linalg.norm(rest_px[:, None] - rest_px[None], axis=2)
        np.fill_diagonal(distance, np.inf)
        pitch = float(np.median(distance.min(axis=1)))
        near, far = _PAIR
        i, j = np.nonzero(np.triu((distance > near * pitch) & (distance < far * pitch)))
        self._pairs = np.column_stack([i, j])  # (m, 2)
        self._shared, self._seen = np.zeros(len(rest_px)), np.zeros(len(rest_px))  # px² of motion, summed

    def update(self, uv_px: FloatArray, tracked: BoolArray) -> BoolArray:
        """Take the next frame's positions (n, 2) in and return the patch (n,). Without motion: every marker."""
        if self._first:
            self._start[tracked], self._first = uv_px[tracked], False
        d = np.where(tracked[:, None], uv_px - self._start, 0.0)
        self._agree(d, tracked)
        if self._seen.max() < _ENOUGH_PX2:
            return np.ones(len(d), dtype=np.bool_)
        share = self._shared / np.maximum(self._seen, 1e-9)
        least = min(_LEAST, len(share))
        limit = min(_SHARE * np.percentile(share, _STRONG), np.sort(share)[-least])
        return np.asarray(share >= limit)

    def _agree(self, d: FloatArray, tracked: BoolArray) -> None:
        """Tally who shares the rigid motion in displacements d (n, 2)."""
        length = np.linalg.norm(d, axis=1)
        strong = float(np.percentile(length[tracked], _STRONG)) if tracked.any() else 0.0
        if strong < _EVIDENCE_PX:
            return
        counted = np.minimum(length, max(float(np.median(length[tracked])), _CAP * strong))
        off = _OFF_PX + _OFF * np.maximum(length, 0.5 * counted.max())
        p = self._shared_motion(d, tracked, counted**2, off)
        if p is None:
            return
        typical = float(np.sqrt(np.mean(np.sum(p[tracked] ** 2, axis=1))))
        near = np.linalg.norm(d - p, axis=1) < _OFF_PX + _OFF * typical
        weight = min(typical, _MOST_PX) ** 2
        self._seen[tracked] += weight
        self._shared[near & tracked] += weight

    def _shared_motion(
        self, d: FloatArray, tracked: BoolArray, weight: FloatArray, off: FloatArray
    ) -> FloatArray | None:
        """Displacements (n, 2) of the rigid motion that most weight (n,) shares to within ``off`` (n,)."""
        x = self._start
        score, angle, *place = _best_proposal(self._pairs, x, d, tracked, weight, off)
        if score == 0.0:
            return None
        centre, shift = np.array(place).reshape(2, 2)
        p = _turned(x, angle, centre, shift)
        for _ in range(2):
            shared = tracked & (np.linalg.norm(d - p, axis=1) < off)
            if shared.sum() < 3:
                break
            p = _rigid_fit(x, d, shared)
        return p


def _turned(x: FloatArray, angle: float, centre: FloatArray, shift: FloatArray) -> FloatArray:
    """Displacements (n, 2) of places x (n, 2) under a rotation about a centre (2,) that is shifted (2,)."""
    r = x - centre
    c, s = np.cos(angle) - 1.0, np.sin(angle)
    return np.asarray(np.stack([c * r[:, 0] - s * r[:, 1], s * r[:, 0] + c * r[:, 1]], axis=1) + shift)


def _rigid_fit(x: FloatArray, d: FloatArray, chosen: BoolArray) -> FloatArray:
    """Displacements (n, 2) of the rigid motion that fits the chosen ones best."""
    a, b = x[chosen], x[chosen] + d[chosen]
    centre, to = a.mean(axis=0), b.mean(axis=0)
    H = (a - centre).T @ (b - to)
    angle = float(np.arctan2(H[0, 1] - H[1, 0], H[0, 0] + H[1, 1]))
    return _turned(x, angle, centre, to - centre)


@compiled
def _best_proposal(
    pairs: NDArray[np.intp],
    x: FloatArray,
    d: FloatArray,
    tracked: BoolArray,
    weight: FloatArray,
    off: FloatArray,
) -> tuple[float, float, float, float, float, float]:
    """Score, angle, centre and shift (u, v each) of the pair's motion that most weight shares; score 0: none."""
    best = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for e in range(len(pairs)):
        i, j = pairs[e, 0], pairs[e, 1]
        if not (tracked[i] and tracked[j]):
            continue
        au, av = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1]
        bu, bv = au + d[j, 0] - d[i, 0], av + d[j, 1] - d[i, 1]
        further = max(np.hypot(d[i, 0], d[i, 1]), np.hypot(d[j, 0], d[j, 1]))
        if abs(np.hypot(bu, bv) - np.hypot(au, av)) >= _STRETCH_PX + _STRETCH * further:
            continue
        angle = np.arctan2(au * bv - av * bu, au * bu + av * bv)
        c, s = np.cos(angle) - 1.0, np.sin(angle)
        u, v = 0.5 * (x[i, 0] + x[j, 0]), 0.5 * (x[i, 1] + x[j, 1])
        du, dv = 0.5 * (d[i, 0] + d[j, 0]), 0.5 * (d[i, 1] + d[j, 1])
        score = 0.0
        for k in range(len(x)):
            if tracked[k]:
                ru, rv = x[k, 0] - u, x[k, 1] - v
                eu = d[k, 0] - (c * ru - s * rv + du)
                ev = d[k, 1] - (s * ru + c * rv + dv)
                score += weight[k] * max(1.0 - (eu * eu + ev * ev) / off[k] ** 2, 0.0)
        if score > best[0]:
            best = (score, angle, u, v, du, dv)
    return best
