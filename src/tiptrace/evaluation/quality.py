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
    "latency-changed": "the time offset between images and poses changed",
}


class QualityLimits(BaseModel):
    """Limits beyond which a trace is doubtful."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    usable_warn: float = Field(default=0.95, ge=0, le=1)  # part of the reconstruction pairs with a position
    usable_fail: float = Field(default=0.5, ge=0, le=1)
    anchor_std_warn_mm: float = Field(default=3.0, gt=0)
    fit_residual_warn_mm: float = Field(default=0.5, gt=0)  # median of the rigid fit
    held_out_warn_mm: float = Field(default=0.4, gt=0)  # Stage I frames predicted from the others
    held_out_fail_mm: float = Field(default=0.75, gt=0)
    halves_warn_sigma: float = Field(default=3.0, gt=0)  # anchors of Stage I's two halves
    prior_warn_sigma: float = Field(default=3.0, gt=0)  # anchor against the tip of the tool's file
    position_std_warn_mm: float = Field(default=1.0, gt=0)  # median along the weakest axis
    in_grasp_warn_mm: float = Field(
        default=12.0, gt=0
    )  # way of the tip against the hand: more than gels give
    closure_warn_mm: float = Field(default=1.0, gt=0)
    returned_mm: float = Field(
        default=3.0, gt=0
    )  # a tip that ends so near its anchor, after travel, has returned
    degraded_warn: float = Field(default=0.1, ge=0, le=1)


@dataclass(frozen=True, slots=True)
class Quality:
    """Verdict and the sentences that explain it."""

    verdict: Verdict
    reasons: tuple[str, ...] = ()


def assess(trajectory: TipTrajectory, limits: QualityLimits | None = None) -> Quality:
    """Judge a trace by its completeness, its anchor, its fit, its returns to known places and its events."""
    limits = limits or QualityLimits()
    rows = [e for e in trajectory.estimates if e.phase is Phase.RECONSTRUCTION]
    failures = _failures(trajectory, rows, limits)
    if failures:
        return Quality("fail", tuple(failures))
    doubts = [
        *_completeness(rows, limits),
        *_anchor(trajectory.anchor, limits),
        *_stage_one(trajectory.anchor, limits),
        *_closure(trajectory.anchor, rows, limits),
        *_fit(rows, limits),
        *_events(trajectory.events),
        *_uncertainty(trajectory.anchor, rows, limits),
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
    checks = trajectory.anchor.checks if trajectory.anchor is not None else None
    if checks is not None and checks.held_out_m * 1e3 > limits.held_out_fail_mm:
        return [
            f"the anchoring motion does not fit a resting tip: frames predicted from the others are "
            f"{checks.held_out_m * 1e3:.2f} mm off; anchor again"
        ]
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
    if (std_mm := _anchor_std_mm(anchor)) > limits.anchor_std_warn_mm:
        doubts.append(f"the anchor is uncertain by {std_mm:.1f} mm along its weakest axis")
    doubts += [
        f"the anchoring motion says little about the tip along ({x:+.2f}, {y:+.2f}, {z:+.2f})"
        for x, y, z in anchor.weak_axes
    ]
    return doubts


def _anchor_std_mm(anchor: Anchor | None) -> float:
    """Standard deviation along the anchor's weakest axis; 0 where nothing is said of it."""
    if anchor is None or anchor.covariance is None:
        return 0.0
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(anchor.covariance)[-1]))) * 1e3


def _stage_one(anchor: Anchor | None, limits: QualityLimits) -> list[str]:
    """Stage I against itself, and against what was known beforehand."""
    if anchor is None or anchor.checks is None:
        return []
    c, doubts = anchor.checks, []
    if c.held_out_m * 1e3 > limits.held_out_warn_mm:
        doubts.append(f"Stage I frames predicted from the others are {c.held_out_m * 1e3:.2f} mm off")
    if c.halves_sigma > limits.halves_warn_sigma:
        doubts.append(
            f"the anchors of Stage I's two halves are {c.halves_m * 1e3:.1f} mm apart, "
            f"{c.halves_sigma:.1f} times what is to be expected"
        )
    if c.prior_sigma is not None and c.prior_sigma > limits.prior_warn_sigma:
        doubts.append(f"the anchor is {c.prior_sigma:.1f} standard deviations off the tip of the tool's file")
    if c.in_grasp_m is not None and c.in_grasp_m * 1e3 > limits.in_grasp_warn_mm:
        doubts.append(
            f"the tip is {c.in_grasp_m * 1e3:.0f} mm from where the end effector alone would have it"
        )
    return doubts


def _closure(anchor: Anchor | None, rows: list[TipEstimate], limits: QualityLimits) -> list[str]:
    """Where the tip came to a known place: anchored anew, or back at the anchor in the end."""
    doubts = []
    if anchor is not None and anchor.checks is not None and anchor.checks.closure_m is not None:
        off_mm = anchor.checks.closure_m * 1e3
        if off_mm > limits.closure_warn_mm:
            doubts.append(f"the trace was {off_mm:.1f} mm off where the tip was anchored anew")
    returned_mm = _returned_mm(anchor, rows, limits)
    if returned_mm is not None and returned_mm > limits.closure_warn_mm:
        doubts.append(f"the tip returned to its anchor, but the trace ends {returned_mm:.1f} mm from it")
    return doubts


def _returned_mm(anchor: Anchor | None, rows: list[TipEstimate], limits: QualityLimits) -> float | None:
    """Distance of the trace's end from the anchor where the tip went away, came back and rested; else None."""
    p = [e.p_B for e in rows if e.p_B is not None and e.status.value != "relative"]
    if anchor is None or len(p) < 20:
        return None
    away_mm = np.linalg.norm(np.stack(p) - anchor.p_B, axis=1) * 1e3
    end = np.stack(p[-10:])
    rests = bool(np.linalg.norm(end - end.mean(axis=0), axis=1).max() * 1e3 < 0.3)
    returned = away_mm[-10:].max() < limits.returned_mm and away_mm.max() > 5.0 * limits.returned_mm
    return float(np.linalg.norm(end.mean(axis=0) - anchor.p_B)) * 1e3 if rests and returned else None


def _uncertainty(anchor: Anchor | None, rows: list[TipEstimate], limits: QualityLimits) -> list[str]:
    """What the covariances say, where the anchor has not been blamed already."""
    C = [e.covariance for e in rows if e.covariance is not None and e.status.value != "relative"]
    if not C or _anchor_std_mm(anchor) > limits.anchor_std_warn_mm:
        return []
    std_mm = float(np.sqrt(np.median(np.linalg.eigvalsh(np.stack(C))[:, -1]))) * 1e3
    if std_mm > limits.position_std_warn_mm:
        return [f"positions are uncertain by {std_mm:.1f} mm along their weakest axis"]
    return []


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
