"""Does the tip touch? In the air nothing presses the tool into the hand or pulls it aside; the hand withdraws it."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from tiptrace.estimation.integrity_reference import IntegrityConfig, Reference
from tiptrace.types import FloatArray

_STILL, _STILL_SLOW = 4, 10  # frames over which a tool in the air hangs still, with and without a Stage I
_DEPTH_SHARE = 0.3  # of a swing along the closing axis, which depends on depth and is noisier
_RELEASE = 7  # frames at most between the first stir of a tip that lets go and a tool that hangs still
_WAY_M = 2e-3  # least path whose direction counts
_PATH, _SECOND = 32, 25  # frames of the tip's path that are kept, and those whose height counts


class ContactWatch:
    """Frame after frame, in constant memory.

    Of a tip in the air four things are true, and friction, a tilted tool, a straight path or a slip in the grasp
    imitate three of them at most: the tool has sprung out along its axis, it hangs still, nothing pulls it aside, and
    the tip has withdrawn from the path on which it touched. A slip lets the gel spring back as well, but then the
    markers seem to push the tip *into* the surface. Gels that carry no load look alike before and after a slip, so
    that the place where the tool hung before the hand moved stays good. Without a Stage I that place is not known,
    and stillness has to last longer.
    """

    def __init__(self, config: IntegrityConfig) -> None:
        self._config = config
        self._D: deque[FloatArray] = deque(maxlen=_STILL_SLOW)
        self._p_B: deque[FloatArray] = deque(maxlen=_PATH)
        self._axis_B: FloatArray = np.zeros(3)  # from the pads to the tip
        self._free_m: float | None = None
        self._free_E: FloatArray | None = None
        self._since = _SECOND  # frames since contact was regained
        self.in_contact = True

    def update(self, D: FloatArray, c_E: FloatArray, T_B_E: FloatArray, ref: Reference) -> bool:
        """Whether the tip touches.

        Args:
            D: (3,) displacement of the tip in the hand, F_E.
            c_E: (3,) tip in the grasp.
            T_B_E: (4, 4) hand.
            ref: What Stage I showed.
        """
        self._D.append(D)
        self._p_B.append(T_B_E[:3, :3] @ (c_E + D) + T_B_E[:3, 3])
        self._axis_B = T_B_E[:3, :3] @ ref.axis_E
        self._since += 1
        frames = _STILL_SLOW if ref.start_E is None else _STILL
        if len(self._D) < frames:
            return self.in_contact
        D_now = np.array(list(self._D)[-frames:])
        along = D_now @ ref.axis_E  # (frames,)
        swing = self._swing(D_now, along, ref)
        if not self.in_contact:  # what moves against the hand is held by something
            c = self._config
            back = self._free_m is not None and abs(float(along[-1]) - self._free_m) > c.regain_m
            if back or swing > 2.0 * c.still_across_m:
                self.in_contact, self._since = True, 0
                self._D.clear()
        elif self._hangs(D_now, along, swing, ref):
            self.in_contact, self._free_m = False, float(np.median(along))
            self._free_E = np.median(D_now, axis=0)
        return self.in_contact

    def _swing(self, D: FloatArray, along: FloatArray, ref: Reference) -> float:
        """How far the tool moved across its axis from the first half of the frames (n, 3) to the second."""
        n = len(D) // 2
        across = D - along[:, None] * ref.axis_E
        half = (across[n:].sum(axis=0) - across[:n].sum(axis=0)) / n
        half -= (1.0 - _DEPTH_SHARE) * (half @ ref.normal_E) * ref.normal_E
        return math.sqrt(half @ half)

    def _hangs(self, D: FloatArray, along: FloatArray, swing: float, ref: Reference) -> bool:
        """Whether a tool that touched until now hangs in the air."""
        c = self._config
        if np.ptp(along) >= c.still_axial_m or swing >= c.still_across_m:
            return False
        middle = np.median(D, axis=0)
        out = float(along.min() if len(D) == _STILL else np.median(along)) > ref.axial_m[1] + c.release_m
        if self._since < _SECOND and self._as_before(middle):
            return True  # not held by anything after all
        return bool((out and _unloaded(middle, ref, c.unloaded_m)) or self._as_before(middle)) and (
            self._withdrawn_m() > c.withdrawn_m
        )

    def _height(self) -> FloatArray:
        """Of the tip's places so far (n,), towards the surface and across the path that the tip took, m."""
        p = np.array(self._p_B)
        before = p[:-_RELEASE]
        way = before[-1] - before[0]
        square = float(way @ way)
        across = self._axis_B - (self._axis_B @ way) * way / square if square > _WAY_M**2 else self._axis_B
        return np.asarray(p @ across / np.linalg.norm(across))

    def _withdrawn_m(self) -> float:
        """How far the tip is above where it touched within the last second; infinite at the beginning."""
        if len(self._p_B) <= _RELEASE + 1:
            return math.inf
        height = self._height()
        return float(np.median(height[:-_RELEASE][-_SECOND:]) - np.median(height[-2:]))

    @property
    def pushed_m(self) -> float:
        """How far the tip seems to have gone into the surface within the last frames; 0 at the beginning."""
        if len(self._p_B) <= _RELEASE + 4:
            return 0.0
        height = self._height()
        return float(np.median(height[-3:]) - np.median(height[-_RELEASE - 3 : -_RELEASE + 1]))

    def _as_before(self, D: FloatArray) -> bool:
        """Whether the tool hangs where it hung in the air once before."""
        if self._free_E is None:
            return False
        return bool(np.linalg.norm(D - self._free_E) < self._config.unloaded_again_m)


def _unloaded(D: FloatArray, ref: Reference, limit_m: float) -> bool:
    """Whether the tool, displaced by D (3,), is out along its axis and across it where it hung at the start."""
    if ref.start_E is None:
        return float(D @ ref.axis_E) > ref.axial_m[1]
    away = D - ref.start_E
    return bool(np.linalg.norm(away - (away @ ref.axis_E) * ref.axis_E) < limit_m)
