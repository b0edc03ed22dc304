"""A grasp from another recording (``--anchor-from``), and what a step of Stage II hands to a smoother."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tiptrace.errors import GeometryError
from tiptrace.estimation.motion import MotionConfig, Motions, TemplateFit
from tiptrace.estimation.pose_track import HandStates
from tiptrace.estimation.stage_one import Anchoring, StageOne
from tiptrace.types import FloatArray, IntArray

_NEAR = 0.45  # of the markers' pitch
_LEAST_MATCHED = 0.7  # of the template's trusted markers


@dataclass(frozen=True, slots=True)
class StageTwoStep:
    """One pair of Stage II.

    Attributes:
        pair_ns: Capture of the pair.
        motions: In-grasp motion of one frame.
        hand: The hand at its exposure.
        anchoring: What was known of tip and grasp.
        extra: (3, 3) m² that events add to the covariance.
    """

    pair_ns: int
    motions: Motions
    hand: HandStates
    anchoring: Anchoring
    extra: FloatArray


def carried_over(other: Anchoring, seen: StageOne, stamp_ns: int, config: MotionConfig) -> Anchoring:
    """The same grasp in a later trial, its template's markers found among this recording's.

    Args:
        other: What the other trial left.
        seen: The first frames of this one.
        stamp_ns: Now.
        config: Noise of the markers.

    Raises:
        GeometryError: the markers do not match: the gel was changed, or the tool gripped anew.
    """
    now = seen.first_fit()
    template, pad, trust = other.fit.template, other.fit.pad, other.trust
    M, weight = np.full_like(now.template, np.nan), np.zeros(len(now.template))
    became = np.full(len(template), -1, dtype=np.intp)  # this recording's number of each of its markers
    wanted = matched = 0
    for k in (0, 1):
        old, new = np.flatnonzero(pad == k), np.flatnonzero(now.pad == k)
        rows = _matches(template[old], now.template[new])
        found = rows >= 0
        M[new[rows[found]]] = template[old[found]]
        weight[new[rows[found]]] = trust[old[found]]
        became[old[found]] = new[rows[found]]
        wanted += int((trust[old] > 0).sum())
        matched += int((trust[old[found]] > 0).sum())
    if matched < max(_LEAST_MATCHED * wanted, 4):
        raise GeometryError(
            f"the other recording's grasp does not fit this one: {matched} of its {wanted} markers were found; was the "
            "tool gripped anew (--regrasp), or the gel changed?"
        )
    fit = TemplateFit(M, now.pad, now.axes, weight, config)
    carried = other.carried_over(stamp_ns)
    kept = became[carried.reference.rows]
    reference = replace(carried.reference, rows=kept[kept >= 0])
    return replace(carried, fit=fit, trust=weight, reference=reference)


def _matches(old: FloatArray, new: FloatArray) -> IntArray:
    """Row of ``new`` for each of ``old`` (−1: none), mutually nearest after a common shift, (n, 3) and (m, 3)."""
    usable_old, usable_new = np.isfinite(old[:, 0]), np.isfinite(new[:, 0])
    rows = np.full(len(old), -1, dtype=np.intp)
    if usable_old.sum() < 2 or usable_new.sum() < 2:
        return rows
    a, b = np.flatnonzero(usable_old), np.flatnonzero(usable_new)
    between = np.linalg.norm(new[b][:, None] - new[b][None], axis=2)
    np.fill_diagonal(between, np.inf)
    reach = _NEAR * float(np.median(between.min(axis=1)))
    shift = np.zeros(3)
    for _ in range(3):
        distance = np.linalg.norm(old[a][:, None] + shift - new[b][None], axis=2)
        nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
        good = (back[nearest] == np.arange(len(a))) & (distance.min(axis=1) < reach)
        if not good.any():
            return rows
        shift = np.median(new[b][nearest[good]] - old[a][good], axis=0)
    rows[a[good]] = b[nearest[good]]
    return rows
