"""Sensing without a calibrated gel (``depth: none``): the contact patch from the markers' motion.

Markers under the tool move with it, the others hardly. The third coordinate is the tool's: every marker of the
patch gets the indentation that the tool's thickness and the gripper's opening imply, the others none.
"""

from __future__ import annotations

import numpy as np

from tiptrace.types import BoolArray, FloatArray

_MOVES = 0.55  # of the strongest markers' motion, above which a marker belongs to the patch
_EVIDENCE_PX = 0.4  # motion of the strongest markers below which nothing can be said
_STRONG = 85.0  # percentile that counts as the strongest


class MotionPatch:
    """Contact patch from the mean square displacement of each marker; constant memory."""

    def __init__(self, rest_px: FloatArray) -> None:
        """Displacements count from these positions (n, 2): of the untouched gel, where it was seen."""
        self._rest = rest_px
        self._sum = np.zeros(len(rest_px))
        self._count = np.zeros(len(rest_px))

    def update(self, uv_px: FloatArray, tracked: BoolArray) -> BoolArray:
        """Take the next frame's positions (n, 2) in and return the patch (n,). Without motion: every marker."""
        squared = np.sum((uv_px - self._rest) ** 2, axis=1)
        self._sum[tracked] += squared[tracked]
        self._count[tracked] += 1
        motion = np.sqrt(self._sum / np.maximum(self._count, 1))  # (n,) px rms
        strong = float(np.percentile(motion[self._count > 0], _STRONG)) if (self._count > 0).any() else 0.0
        if strong < _EVIDENCE_PX:
            return np.ones(len(motion), dtype=np.bool_)
        return np.asarray(motion > _MOVES * strong, dtype=np.bool_)
