"""A slip of the tool in the grasp: the gel lets go and grips anew (``docs/estimation.md``, Integrity).

Markers ride on the gel. While the tool slips, the sheared gel relaxes within a frame or two, which kicks the tip
against the hand, and grips the tool elsewhere, which leaves the markers in another pattern about their rigid fit.
Friction at the tip alone moves the tool smoothly, and the pattern slowly.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from tiptrace.estimation.kernels import pattern_change
from tiptrace.types import FloatArray

BEFORE, AFTER = 10, 4  # frames compared
_EARLIER = 4  # frames by which the kick may precede the new pattern
_DEPTH_SHARE = 0.3  # of a kick along the closing axis, which depends on depth and is noisier


@dataclass(frozen=True, slots=True)
class SlipLevels:
    """What a trial shows without any slip: upper percentiles over Stage I.

    Attributes:
        kick_m: Second difference of the tip's displacement.
        pattern_m: Change of the markers' residual pattern.
    """

    kick_m: float
    pattern_m: float


def kicks(D: FloatArray, normal_E: FloatArray) -> FloatArray:
    """Second differences of the tip's displacement in the hand, (T, 3) → (T − 2,) m."""
    a = D[2:] - 2.0 * D[1:-1] + D[:-2]
    a = a - (1.0 - _DEPTH_SHARE) * (a @ normal_E)[:, None] * normal_E
    return np.asarray(np.sqrt((a * a).sum(axis=1)))


def slip_levels(D: FloatArray, residual: FloatArray, normal_E: FloatArray) -> SlipLevels:
    """From Stage I: displacements (T, 3) and markers' residuals (T, N, 3), m."""
    if len(D) < BEFORE + AFTER:
        return SlipLevels(0.0, 0.0)
    ends = range(BEFORE + AFTER, len(D) + 1, 3)
    patterns = [
        pattern_change(residual[k - BEFORE - AFTER : k - AFTER], residual[k - AFTER : k]) for k in ends
    ]
    return SlipLevels(float(np.percentile(kicks(D, normal_E), 98)), float(np.percentile(patterns, 75)))


class SlipDetector:
    """Frame after frame, in constant memory."""

    def __init__(self, kick_m: float, pattern_m: float, pattern_alone_m: float, margin: float) -> None:
        """Set the limits.

        Args:
            kick_m: Least kick of a slip.
            pattern_m: Least change of pattern.
            pattern_alone_m: Change of pattern that needs no kick.
            margin: A slip exceeds what Stage I showed by this factor.
        """
        self._kick_m, self._pattern_m, self._alone_m, self._margin = (
            kick_m,
            pattern_m,
            pattern_alone_m,
            margin,
        )
        self._D: deque[FloatArray] = deque(maxlen=BEFORE + AFTER)
        self._residual: deque[FloatArray] = deque(maxlen=BEFORE + AFTER)

    def update(self, D: FloatArray, residual: FloatArray, normal_E: FloatArray, usual: SlipLevels) -> bool:
        """Whether the tool has slipped within the last frames.

        Args:
            D: (3,) displacement of the tip in the hand, m.
            residual: (N, 3) markers less their fitted places, NaN where lost or unused.
            normal_E: (3,) closing axis.
            usual: What Stage I showed.
        """
        self._D.append(D)
        self._residual.append(residual)
        if len(self._D) < BEFORE + AFTER:
            return False
        kick = float(kicks(np.stack(list(self._D)[BEFORE - _EARLIER - 2 :]), normal_E).max())
        kicked = kick > max(self._kick_m, self._margin * usual.kick_m)
        rows = np.stack(self._residual)
        pattern = pattern_change(rows[:BEFORE], rows[BEFORE:])
        slipped = kicked and pattern > max(self._pattern_m, self._margin * usual.pattern_m)
        slipped |= pattern > max(self._alone_m, 4.0 * usual.pattern_m)
        if slipped:
            self._D.clear()  # the pattern after the slip is the new one
            self._residual.clear()
        return slipped
