"""Whether a trace can be relied on, judged without ground truth."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.types import Anchor, Event, Phase, TipEstimate, TipTrajectory

Verdict = Literal["pass", "warn", "fail"]

# Events that touch the position itself; the others mark what was bridged.
_SERIOUS = {
    "grasp-slip": "the tool slipped in the grasp",
    "contact-lost": "the tip left the surface",
    "left-right-disagreement": "the two fingers disagree",
    "pose-gap": "the robot's poses have a gap",
}


class QualityLimits(BaseModel):
    """Limits beyond which a trace is doubtful."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    usable_warn: float = Field(default=0.95, ge=0, le=1)  # part of the reconstruction pairs with a position
    usable_fail: float = Field(default=0.5, ge=0, le=1)
    anchor_std_warn_mm: float = Field(default=3.0, gt=0)
    fit_residual_warn_mm: float = Field(default=0.5, gt=0)  # median of the rigid fit
    degraded_warn: float = Field(default=0.1, ge=0, le=1)


@dataclass(frozen=True, slots=True)
class Quality:
    """Verdict and the sentences that explain it."""

    verdict: Verdict
    reasons: tuple[str, ...] = ()


def assess(trajectory: TipTrajectory, limits: QualityLimits | None = None) -> Quality:
    """Judge a trace by its completeness, its anchor, its fit and its events."""
    limits = limits or QualityLimits()
    rows = [e for e in trajectory.estimates if e.phase is Phase.RECONSTRUCTION]
    failures = _failures(trajectory, rows, limits)
    if failures:
        return Quality("fail", tuple(failures))
    doubts = [
        *_completeness(rows, limits),
        *_anchor(trajectory.anchor, limits),
        *_fit(rows, limits),
        *_events(trajectory.events),
    ]
    return Quality("warn" if doubts else "pass", tuple(doubts))


def _failures(trajectory: TipTrajectory, rows: list[TipEstimate], limits: QualityLimits) -> list[str]:
    if not trajectory.estimates:
        return ["the recording holds no usable image pair"]
    if not rows:
        return ["the recording ends before the reconstruction segment"]
    refused = [e.detail for e in trajectory.events if e.kind == "anchor-refused"]
    usable = _usable(rows)
    if refused and usable == 0:
        return [f"the anchor was refused: {refused[-1]}"]
    if usable < limits.usable_fail:
        counts = Counter(e.status.value for e in rows if e.p_B is None)
        return [f"only {usable:.0%} of the reconstruction pairs have a position ({_listed(counts)})"]
    return []


def _completeness(rows: list[TipEstimate], limits: QualityLimits) -> list[str]:
    doubts = []
    if (usable := _usable(rows)) < limits.usable_warn:
        counts = Counter(e.status.value for e in rows if e.p_B is None)
        doubts.append(f"{1 - usable:.0%} of the reconstruction pairs have no position ({_listed(counts)})")
    degraded = float(np.mean([e.status.value == "degraded" for e in rows]))
    if degraded > limits.degraded_warn:
        doubts.append(f"{degraded:.0%} of the reconstruction pairs are degraded")
    if any(e.status.value == "relative" for e in rows):
        doubts.append("positions are displacements from the first contact: there is no absolute anchor")
    return doubts


def _anchor(anchor: Anchor | None, limits: QualityLimits) -> list[str]:
    if anchor is None:
        return []
    doubts = []
    if anchor.covariance is not None:
        std_mm = float(np.sqrt(max(0.0, np.linalg.eigvalsh(anchor.covariance)[-1]))) * 1e3
        if std_mm > limits.anchor_std_warn_mm:
            doubts.append(f"the anchor is uncertain by {std_mm:.1f} mm along its weakest axis")
    doubts += [
        f"the anchoring motion says little about the tip along ({x:+.2f}, {y:+.2f}, {z:+.2f})"
        for x, y, z in anchor.weak_axes
    ]
    return doubts


def _fit(rows: list[TipEstimate], limits: QualityLimits) -> list[str]:
    residuals_mm = [e.residual_m * 1e3 for e in rows if e.residual_m is not None]
    if residuals_mm and (median := float(np.median(residuals_mm))) > limits.fit_residual_warn_mm:
        return [f"the markers do not move as one rigid body (median residual {median:.2f} mm)"]
    return []


def _events(events: list[Event]) -> list[str]:
    counts = Counter(e.kind for e in events if e.kind in _SERIOUS)
    return [f"{_SERIOUS[kind]} ({n} event{'s' if n > 1 else ''})" for kind, n in counts.items()]


def _usable(rows: list[TipEstimate]) -> float:
    return float(np.mean([e.p_B is not None for e in rows]))


def _listed(counts: Counter[str]) -> str:
    return ", ".join(f"{n} {name}" for name, n in counts.most_common())
