"""Small trials with known answers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tiptrace.types import Anchor, FloatArray, Phase, Status, TipEstimate, TipTrajectory, TruthSample

FRAME_NS = 40_000_000
START_NS = 1_700_000_000_000_000_000


def stamps(n: int) -> list[int]:
    return [START_NS + k * FRAME_NS for k in range(n)]


def truth_of(p_B: ArrayLike) -> list[TruthSample]:
    p = np.asarray(p_B, dtype=np.float64)
    return [TruthSample(t, row) for t, row in zip(stamps(len(p)), p, strict=True)]


def trajectory_of(
    p_B: ArrayLike,
    anchoring: int,
    anchor: ArrayLike | None = None,
    covariance: FloatArray | None = None,
    status: Status = Status.OK,
    loop_ms: float | None = None,
) -> TipTrajectory:
    """Rows at the truth's instants, the first ``anchoring`` of Stage I; NaN positions are lost."""
    estimates = []
    for k, (stamp, p) in enumerate(zip(stamps(len(np.asarray(p_B))), np.asarray(p_B, float), strict=True)):
        seen = bool(np.isfinite(p).all())
        phase = Phase.ANCHORING if k < anchoring else Phase.RECONSTRUCTION
        row_status = Status.ANCHORING if k < anchoring else status
        estimates.append(
            TipEstimate(
                stamp_ns=stamp,
                phase=phase,
                status=row_status if seen else Status.LOST,
                p_B=p if seen else None,
                R_B_E=np.eye(3) if seen else None,
                covariance=covariance if seen else None,
                residual_m=1e-4 if seen else None,
                markers=16 if seen else 0,
                loop_ms=loop_ms,
            )
        )
    fixed = None
    if anchor is not None:
        fixed = Anchor(
            p_B=np.asarray(anchor, float), covariance=covariance, residual_m=2e-4, frames=anchoring
        )
    return TipTrajectory(estimates, [], fixed)


def straight_truth(anchoring: int = 5, moving: int = 20, step_m: float = 1e-3) -> FloatArray:
    """At rest at the origin, then along +x."""
    p = np.zeros((anchoring + moving, 3))
    p[anchoring:, 0] = step_m * np.arange(1, moving + 1)
    return p
