"""Sensing without a calibrated gel (``depth: none``): the contact patch from the markers' motion.

Markers under the tool move as one rigid body, which is the tool. Beside it the gel is dragged along in part, or slides
by more than the tool does at the tool's edges; further out it hardly moves. So each frame is searched for the rigid
motion that most markers share, the far ones counting little, and the patch is who has shared it since. The third
coordinate is the tool's: every marker of the patch gets the indentation that the tool's thickness and the gripper's
opening imply, the others none.
"""

from __future__ import annotations

import numpy as np

from tiptrace.types import BoolArray, FloatArray

_EVIDENCE_PX = 0.4  # motion of the strongest markers below which a frame says nothing
_STRONG = 85.0  # percentile that counts as the strongest
_CAP = 0.3  # of the strongest: a marker's motion counts up to this, or to the median
_PAIR = (1.5, 3.3)  # pitches between the two markers that propose a rigid motion
_OFF_PX, _OFF = (
    0.3,
    0.3,
)  # distance from the rigid motion, and its share of the motion, that still count as shared
_STRETCH = 0.5, 0.15  # px, and share of the motion, by which a proposing pair may change its length
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
        self._i, self._j = np.nonzero(np.triu((distance > near * pitch) & (distance < far * pitch)))
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
        """Displacements (n, 2) of the rigid motion that the most weight (n,) comes within ``off`` (n,) of."""
        x = self._start
        use = tracked[self._i] & tracked[self._j]
        i, j = self._i[use], self._j[use]
        a = x[j] - x[i]  # (m, 2)
        b = a + d[j] - d[i]
        px, share = _STRETCH
        stretch = np.abs(np.linalg.norm(b, axis=1) - np.linalg.norm(a, axis=1))
        rigid = stretch < px + share * np.linalg.norm(np.stack([d[i], d[j]]), axis=2).max(axis=0)
        i, j, a, b = i[rigid], j[rigid], a[rigid], b[rigid]
        if not len(i):
            return None
        angle = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.sum(a * b, axis=1))
        proposed = _turned(x, angle, 0.5 * (x[i] + x[j]), 0.5 * (d[i] + d[j]))  # (m, n, 2)
        square = np.sum((d - proposed) ** 2, axis=2) / off**2
        score = np.clip(1.0 - square, 0.0, None) @ np.where(tracked, weight, 0.0)
        p = proposed[int(np.argmax(score))]
        for _ in range(2):
            shared = tracked & (np.linalg.norm(d - p, axis=1) < off)
            if shared.sum() < 3:
                break
            p = _rigid_fit(x, d, shared)
        return np.asarray(p)


def _turned(x: FloatArray, angle: FloatArray, centre: FloatArray, shift: FloatArray) -> FloatArray:
    """Displacements (m, n, 2) of places x (n, 2) under rotations (m,) about centres (m, 2) that are shifted (m, 2)."""
    r = x[None] - centre[:, None]
    c, s = np.cos(angle)[:, None] - 1.0, np.sin(angle)[:, None]
    turned = np.stack([c * r[..., 0] - s * r[..., 1], s * r[..., 0] + c * r[..., 1]], axis=2)
    return np.asarray(turned + shift[:, None])


def _rigid_fit(x: FloatArray, d: FloatArray, chosen: BoolArray) -> FloatArray:
    """Displacements (n, 2) of the rigid motion that fits the chosen ones best."""
    a, b = x[chosen], x[chosen] + d[chosen]
    centre, to = a.mean(axis=0), b.mean(axis=0)
    H = (a - centre).T @ (b - to)
    angle = np.arctan2(H[0, 1] - H[1, 0], H[0, 0] + H[1, 1])
    return np.asarray(_turned(x, np.array([angle]), centre[None], (to - centre)[None])[0])
