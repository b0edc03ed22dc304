"""The robot's pose as a function of time, from samples that come a little out of order."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from tiptrace.geometry.screw import interpolate_screw
from tiptrace.types import FloatArray, PoseSample

_stamp = attrgetter("stamp_ns")


@dataclass(frozen=True, slots=True)
class PoseGap:
    """No pose can be claimed: stamps of the samples around, None before the first and after the last."""

    before_ns: int | None
    after_ns: int | None


class PoseTrack:
    """T_B_E by interpolation on SE(3), never by extrapolation.

    Args:
        max_gap_ns: Between samples further apart than this nothing is interpolated.
        delay_ns: A sample may come this much later than a newer one.
        lag_ns: How far the track may fall behind other streams before it is no longer waited for; also the
            length of the history that is kept.
    """

    def __init__(self, max_gap_ns: int, delay_ns: int, lag_ns: int) -> None:
        self._max_gap_ns = max_gap_ns
        self._delay_ns = delay_ns
        self._lag_ns = lag_ns
        self._samples: list[PoseSample] = []
        self._taken_ns: int | None = None  # samples up to here have been handed out

    def add(self, sample: PoseSample) -> bool:
        """Insert a sample; False if its instant is taken already or too long ago."""
        samples = self._samples
        place = bisect_left(samples, sample.stamp_ns, key=_stamp)
        repeated = place < len(samples) and samples[place].stamp_ns == sample.stamp_ns
        late = self._taken_ns is not None and sample.stamp_ns <= self._taken_ns
        if repeated or late:
            return False
        samples.insert(place, sample)
        horizon_ns = samples[-1].stamp_ns - 2 * self._lag_ns - self._max_gap_ns
        if samples[0].stamp_ns < horizon_ns:
            del samples[: max(bisect_left(samples, horizon_ns, key=_stamp) - 1, 0)]
        return True

    def complete_to(self, stamp_ns: int, newest_image_ns: int | None) -> bool:
        """Whether all samples around an instant have come, or are no longer waited for."""
        if newest_image_ns is not None and stamp_ns <= newest_image_ns - self._lag_ns:
            return True
        place = bisect_left(self._samples, stamp_ns, key=_stamp)
        return (
            place < len(self._samples)
            and self._samples[place].stamp_ns <= self._samples[-1].stamp_ns - self._delay_ns
        )

    def at(self, stamps_ns: Sequence[int]) -> FloatArray | PoseGap:
        """T_B_E at some instants, (n, 4, 4), or the first gap that one of them lies in."""
        brackets = []
        for stamp_ns in stamps_ns:
            bracket = self._around(stamp_ns)
            if isinstance(bracket, PoseGap):
                return bracket
            brackets.append(bracket)
        T_0 = np.stack([before.T_B_E for before, _, _ in brackets])
        T_1 = np.stack([after.T_B_E for _, after, _ in brackets])
        return interpolate_screw(T_0, T_1, np.array([fraction for _, _, fraction in brackets]))

    def _around(self, stamp_ns: int) -> tuple[PoseSample, PoseSample, float] | PoseGap:
        """The samples around an instant, and how far it lies between them."""
        samples = self._samples
        place = bisect_left(samples, stamp_ns, key=_stamp)
        after = samples[place] if place < len(samples) else None
        if after is not None and after.stamp_ns == stamp_ns:
            return after, after, 0.0
        before = samples[place - 1] if place > 0 else None
        if before is None or after is None:
            return PoseGap(before.stamp_ns if before else None, after.stamp_ns if after else None)
        span_ns = after.stamp_ns - before.stamp_ns
        if span_ns > self._max_gap_ns:
            return PoseGap(before.stamp_ns, after.stamp_ns)
        return before, after, (stamp_ns - before.stamp_ns) / span_ns

    def take_until(self, stamp_ns: int) -> tuple[PoseSample, ...]:
        """Samples up to an instant that have not been handed out before, in order."""
        samples = self._samples
        end = bisect_left(samples, stamp_ns + 1, key=_stamp)
        first = 0 if self._taken_ns is None else bisect_left(samples, self._taken_ns + 1, key=_stamp)
        taken = tuple(samples[first:end])
        self._taken_ns = stamp_ns
        return taken
