"""Slips of the tool in the grasp during Stage I: the markers' pattern about their rigid fit is another afterwards.

Markers ride on the gel. After a slip they stand elsewhere on the tool: each part of Stage I between slips has a
template of its own, and the tip a place of its own in it. The tip rests all the while, which ties the parts together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.estimation.integrity_reference import Reference, reference
from tiptrace.estimation.motion import MotionConfig, Motions, TemplateFit
from tiptrace.estimation.slip_detector import SlipLevels
from tiptrace.estimation.tip_map import TipMap
from tiptrace.types import BoolArray, FloatArray


class GraspSlipConfig(BaseModel):
    """When a slip is believed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    suspicion: float = Field(default=3.0, ge=1)  # unrest of Stage I below which nothing is sought
    share: float = Field(default=0.25, gt=0, lt=1)  # of the markers' residual variance that a change explains
    pattern_m: float = Field(default=8e-5, gt=0)  # rms over the markers and frames that it explains
    relief: float = Field(
        default=0.6, gt=0, le=1
    )  # the first slip, and one that the pattern does not show, bring the unrest down by at least this
    most: int = Field(
        default=4, ge=0
    )  # slips sought in Stage I; 0: such a Stage I keeps its large covariance
    least_frames: int = Field(default=10, ge=5)  # between slips


class Parts:
    """Stage I cut at slips, each part with its own template."""

    def __init__(
        self, fits: Sequence[TemplateFit], parts: Sequence[Motions], cuts: Sequence[int], X: FloatArray
    ) -> None:
        """Take what was fitted.

        Args:
            fits: Template of each of the K + 1 parts.
            parts: Their motions.
            cuts: K first frames after a slip.
            X: (T, N, 3) markers in F_E of all frames.
        """
        self.fits, self.cuts, self.X = tuple(fits), tuple(cuts), X
        self.motions = join(parts)
        self._bounds = (0, *cuts, len(X))

    @property
    def last(self) -> TemplateFit:
        """Template that Stage II goes on with."""
        return self.fits[-1]

    def reference(self, c_E: FloatArray, normal_E: FloatArray) -> Reference:
        """What Stage I showed: range and unrest from all frames, the markers' pattern since the last slip."""
        whole = reference(self.last, self.X, self.motions, c_E, normal_E)
        if not self.cuts:
            return whole
        rows = [slice(a, b) for a, b in pairwise(self._bounds)]
        each = [
            reference(fit, self.X[r], only(self.motions, r), c_E, normal_E)
            for fit, r in zip(self.fits, rows, strict=True)
        ]
        slip = SlipLevels(max(r.slip.kick_m for r in each), max(r.slip.pattern_m for r in each))
        return replace(
            each[-1], axial_m=whole.axial_m, start_E=whole.start_E, slip=slip, tilt_rad=whole.tilt_rad
        )

    @property
    def steps(self) -> FloatArray | None:
        """(T, K) −1 before and 0 after each slip; None without any."""
        if not self.cuts:
            return None
        frames = np.arange(len(self.X))
        return np.stack([-(frames < k).astype(np.float64) for k in self.cuts], axis=1)

    def residual(self) -> FloatArray:
        """(T, N, 3) markers less their fitted places, in-plane, F_E, NaN where lost."""
        spans = zip(self.fits, self._bounds[:-1], self._bounds[1:], strict=True)
        return np.concatenate(
            [_in_plane(f, self.X[a:b], only(self.motions, slice(a, b))) for f, a, b in spans]
        )

    def next_cut(self, config: GraspSlipConfig) -> int | None:
        """First frame after the most likely further slip, None where the pattern shows none."""
        r = self.residual()
        seen = np.isfinite(r)
        total = float(np.sum(r[seen] ** 2))
        found = [_best_cut(r[a:b], a, config.least_frames) for a, b in pairwise(self._bounds)]
        gain, at = max(found)
        rms = np.sqrt(gain / max(int(seen[..., 0].sum()), 1))
        return at if gain > config.share * total and rms > config.pattern_m else None

    def jump(self, residual: FloatArray, config: GraspSlipConfig) -> int | None:
        """First frame after the likeliest jump of the resting tip's residuals (T, 3) m; None between too few frames."""
        found = [_best_cut(residual[a:b, None], a, config.least_frames) for a, b in pairwise(self._bounds)]
        gain, at = max(found)
        return at if gain > 0.0 else None

    def cut_at(self, frame: int, motion: MotionConfig, rounds: int = 2) -> Parts:
        """The same with one slip more."""
        cuts = sorted((*self.cuts, frame))
        bounds = (0, *cuts, len(self.X))
        fits, parts = [], []
        for a, b in pairwise(bounds):
            fit = self.fits[sum(k <= a for k in self.cuts)]
            own = only(self.motions, slice(a, b))
            for _ in range(rounds):
                M = fit.refined_template(self.X[a:b], own)
                fit = TemplateFit(M, fit.pad, fit.axes, fit.trust, motion)
                own = fit.fit(self.X[a:b], (own.R, own.t))
            fits.append(fit)
            parts.append(own)
        return Parts(fits, parts, cuts, self.X)


def through_slips(
    parts: Parts, solution: Callable[[Parts], TipMap], motion: MotionConfig, config: GraspSlipConfig
) -> tuple[Parts, TipMap]:
    """Cut Stage I at slips for as long as that makes the tip rest.

    A slip shows in the markers' pattern about their rigid fit. One that turns all of them alike does not, and is taken
    from the tip's own residuals, which then have to become far smaller.

    Args:
        parts: Stage I in one.
        solution: Solves for the tip with given parts.
        motion: Of the fits.
        config: When a slip is believed.
    """
    tip_map = solution(parts)
    first = tip_map.unrest
    if first < config.suspicion:
        return parts, tip_map
    while len(parts.cuts) < config.most:
        tries = [(parts.next_cut(config), tip_map.unrest if parts.cuts else config.relief * first)]
        if tip_map.unrest > config.suspicion:
            tries.append((parts.jump(tip_map.residual, config), config.relief * tip_map.unrest))
        found = _first_relief(parts, solution, motion, tries)
        if found is None:
            break
        parts, tip_map = found
    if parts.cuts:  # slips explain too much at times: no surer than the root of what was unexplained
        tip_map = tip_map.inflated(np.sqrt(first) / tip_map.unrest)
    return parts, tip_map


def _first_relief(
    parts: Parts,
    solution: Callable[[Parts], TipMap],
    motion: MotionConfig,
    tries: Sequence[tuple[int | None, float]],
) -> tuple[Parts, TipMap] | None:
    """Of (frame, largest unrest) the first cut after which the tip rests so well."""
    for at, limit in tries:
        if at is None:
            continue
        further = parts.cut_at(at, motion)
        tip_map = solution(further)
        if tip_map.unrest <= limit:
            return further, tip_map
    return None


def _in_plane(fit: TemplateFit, X: FloatArray, m: Motions) -> FloatArray:
    """(T, N, 3) markers less their fitted places without depth, F_E; NaN where lost or not in use."""
    r = X - (fit.template @ np.swapaxes(m.R, 1, 2) + m.t[:, None])
    normal = fit.axes[fit.pad.astype(int)][:, :, 2]  # (N, 3)
    r = r - np.sum(r * normal, axis=2, keepdims=True) * normal
    return np.asarray(np.where((fit.trust > 0)[:, None], r, np.nan))


def _best_cut(r: FloatArray, first: int, least: int) -> tuple[float, int]:
    """Sum of squares that two means explain beyond one, and the first frame of the second; r (n, N, 3)."""
    n = len(r)
    if n < 2 * least:
        return 0.0, first
    total = np.cumsum(np.nan_to_num(r), axis=0)
    count = np.maximum(np.cumsum(np.isfinite(r[..., :1]), axis=0), 1e-9)
    k = np.arange(least, n - least + 1)
    after, left = total[-1] - total[k - 1], np.maximum(count[-1] - count[k - 1], 1e-9)
    explained = np.sum(total[k - 1] ** 2 / count[k - 1], axis=(1, 2)) + np.sum(after**2 / left, axis=(1, 2))
    best = int(np.argmax(explained))
    return float(explained[best] - np.sum(total[-1] ** 2 / count[-1])), first + int(k[best])


def only(m: Motions, rows: slice | BoolArray) -> Motions:
    """Some frames of the motions."""
    return Motions(*(getattr(m, name)[rows] for name in Motions.__slots__))


def join(parts: Sequence[Motions]) -> Motions:
    """Motions one after another."""
    return Motions(*(np.concatenate([getattr(m, name) for m in parts]) for name in Motions.__slots__))
