"""Where the tip really was: samples of the true position, looked up at the instant of an estimate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tiptrace.types import FloatArray, TruthSample

StampArray = NDArray[np.int64]

DEFAULT_MAX_GAP_S = 0.25


@dataclass(frozen=True, slots=True)
class Truth:
    """True tip (centre of its sphere) over time.

    Attributes:
        stamps_ns: (n,) strictly increasing.
        p_B: (n, 3) m, finite.
        max_gap_s: Longest gap between two samples that is bridged by interpolation.
    """

    stamps_ns: StampArray
    p_B: FloatArray
    max_gap_s: float = DEFAULT_MAX_GAP_S

    @classmethod
    def from_samples(cls, samples: Iterable[TruthSample], max_gap_s: float = DEFAULT_MAX_GAP_S) -> Self:
        """Sort samples by stamp; drop those that are not finite, and repeated stamps."""
        samples = list(samples)
        stamps = np.array([s.stamp_ns for s in samples], dtype=np.int64)  # (n,)
        p_B = np.array([s.p_B for s in samples], dtype=np.float64).reshape(-1, 3)  # (n, 3)
        finite = np.isfinite(p_B).all(axis=1)
        stamps, first = np.unique(stamps[finite], return_index=True)
        return cls(stamps_ns=stamps, p_B=p_B[finite][first], max_gap_s=max_gap_s)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def at(self, stamps_ns: ArrayLike) -> FloatArray:
        """True positions at given instants, linear in between: (m,) ns → (m, 3) m.

        NaN outside the recorded span and inside gaps longer than ``max_gap_s``: nothing is extrapolated.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        p = np.full((len(stamps), 3), np.nan)
        if len(self) == 0:
            return p
        right = np.searchsorted(self.stamps_ns, stamps, side="left")  # first sample at or after the stamp
        exact = (right < len(self)) & (self.stamps_ns[np.minimum(right, len(self) - 1)] == stamps)
        p[exact] = self.p_B[right[exact]]
        inside = ~exact & (right > 0) & (right < len(self))
        r, t = right[inside], stamps[inside]
        gap = (self.stamps_ns[r] - self.stamps_ns[r - 1]).astype(np.float64)  # (k,) ns
        w = ((t - self.stamps_ns[r - 1]) / gap)[:, None]
        between = (1 - w) * self.p_B[r - 1] + w * self.p_B[r]
        between[gap > self.max_gap_s * 1e9] = np.nan
        p[inside] = between
        return p

    def nearest(self, stamp_ns: int) -> tuple[FloatArray, float]:
        """True position at an instant for which there must be one: (3,) m, and s to the sample that stands in.

        An estimate belongs to the exposure, which may lie a latency before the first sample of the truth; up to
        ``max_gap_s`` outside the recorded span the first or last sample stands in. NaN farther out and in gaps.
        """
        p = self.at([stamp_ns])[0]
        if len(self) == 0 or np.isfinite(p).all():
            return p, 0.0
        end = 0 if stamp_ns < self.stamps_ns[0] else -1
        away_s = abs(int(self.stamps_ns[end]) - stamp_ns) * 1e-9
        outside = stamp_ns < self.stamps_ns[0] or stamp_ns > self.stamps_ns[-1]
        return (self.p_B[end], away_s) if outside and away_s <= self.max_gap_s else (p, 0.0)

    def between(self, start_ns: int, end_ns: int) -> tuple[StampArray, FloatArray]:
        """Samples of an interval, both ends interpolated where possible: (k,) ns and (k, 3) m."""
        inside = (self.stamps_ns > start_ns) & (self.stamps_ns < end_ns)
        stamps = np.concatenate([[start_ns], self.stamps_ns[inside], [end_ns]]).astype(np.int64)
        p = self.at(stamps)
        finite = np.isfinite(p).all(axis=1)
        return stamps[finite], p[finite]
