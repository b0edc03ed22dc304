"""A slip of the tool in the grasp: the gel lets go and grips anew (``docs/estimation.md``, Integrity).

Markers ride on the gel. While the tool slips, the sheared gel relaxes within a frame or two, which kicks the tip
against the hand, and grips the tool elsewhere, which leaves the markers in another pattern about their rigid fit.
Friction at the tip alone moves the tool smoothly, and the pattern slowly.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.estimation.pattern_kernels import pattern_change
from tiptrace.types import FloatArray

BEFORE, AFTER = 10, 4  # frames compared
HOLD = 6  # frames from a suspected slip until it is told
_EARLIER = 4  # frames by which the kick may precede the new pattern
_MOST = 3.0  # that one sign counts
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


class SlipLimits(BaseModel):
    """What makes a slip. Its signs are each in units of these, or of what Stage I showed where that is more."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kick_m: float = Field(default=1.0e-3, gt=0)  # second difference of the tip's displacement
    least_kick_m: float = Field(default=9.0e-4, gt=0)
    pattern_m: float = Field(default=4.0e-5, gt=0)  # change of the markers' residuals, rms
    pattern_alone_m: float = Field(default=8.0e-4, gt=0)  # the same, without a kick
    pushed_m: float = Field(default=5.0e-4, gt=0)  # of the tip into the surface, as it seems
    margin: float = Field(default=1.3, ge=1)  # over what Stage I showed
    evidence: float = Field(default=0.6, gt=0)  # product of the three signs


class SlipDetector:
    """Frame after frame, in constant memory."""

    def __init__(self, limits: SlipLimits) -> None:
        self._limits = limits
        self._D: deque[FloatArray] = deque(maxlen=BEFORE + AFTER)
        self._residual: deque[FloatArray] = deque(maxlen=BEFORE + AFTER)
        self._suspected = 0  # frames to go until a suspected slip is told

    def update(
        self,
        D: FloatArray,
        residual: FloatArray,
        pushed_m: float,
        normal_E: FloatArray,
        usual: SlipLevels,
        held: bool = True,
    ) -> bool:
        """Whether the tool has slipped lately; told a few frames late, when no loss of contact explains the kick.

        Args:
            D: (3,) displacement of the tip in the hand, m.
            residual: (N, 3) markers less their fitted places, NaN where lost or unused.
            pushed_m: How far the tip seems to have gone into the surface within the last frames.
            normal_E: (3,) closing axis.
            usual: What Stage I showed.
            held: Whether the tip touches, and not only just again: letting go and landing kick it, too.
        """
        suspected = self._suspect(D, residual, pushed_m, normal_E, usual)
        if not held:
            self._suspected = 0
        elif suspected and not self._suspected:
            self._suspected = HOLD
        elif self._suspected:
            self._suspected -= 1
            return self._suspected == 0
        return False

    def _suspect(
        self, D: FloatArray, residual: FloatArray, pushed_m: float, normal_E: FloatArray, usual: SlipLevels
    ) -> bool:
        c = self._limits
        self._D.append(D)
        self._residual.append(residual)
        if len(self._D) < BEFORE + AFTER:
            return False
        kick = float(kicks(np.stack(list(self._D)[BEFORE - _EARLIER - 2 :]), normal_E).max())
        rows = np.stack(self._residual)
        pattern = pattern_change(rows[:BEFORE], rows[BEFORE:])
        signs = (
            min(kick / max(c.kick_m, c.margin * usual.kick_m), _MOST)
            * min(pattern / max(c.pattern_m, c.margin * usual.pattern_m), _MOST)
            * min(max(pushed_m / c.pushed_m, 0.5), 2.0)
        )
        kicked = kick > max(c.least_kick_m, c.margin * usual.kick_m)
        slipped = kicked and signs > c.evidence
        slipped |= pattern > max(c.pattern_alone_m, 4.0 * usual.pattern_m)
        if slipped:
            self._D.clear()  # the pattern after the slip is the new one
            self._residual.clear()
        return slipped
