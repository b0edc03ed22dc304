"""Limits of what counts as sound, and what Stage I showed, against which later frames are judged."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.estimation.motion import Motions, TemplateFit
from tiptrace.estimation.slip_detector import SlipLevels, SlipLimits, slip_levels
from tiptrace.geometry.transforms import rotation_log
from tiptrace.types import FloatArray, IntArray


class IntegrityConfig(BaseModel):
    """Limits."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    # no marker of a finger moved by more: the image is the old one
    frozen_m: float = Field(default=2e-7, gt=0)
    stale_frames: int = Field(default=3, ge=2)
    slip: SlipLimits = SlipLimits()
    # of one marker between two frames, beyond the tool's own motion
    jump_m: float = Field(default=1.2e-3, gt=0)
    # residual of the rigid fit beyond which it is none: in multiples of Stage I's, and at least
    misfit: float = Field(default=4.0, gt=1)
    misfit_m: float = Field(default=1.5e-4, gt=0)
    tilt_beyond_rad: float = Field(default=0.07, gt=0)  # of the tool across the pads, over Stage I's furthest
    again_frames: int = Field(default=10, ge=1)  # of misfit, after which markers are matched to dots anew
    twist_limit_rad: float = Field(default=0.03, gt=0)  # of one pad's markers against the other's
    twist_frames: int = Field(default=3, ge=1)
    # the tool springs out along its axis when the tip lifts off
    release_m: float = Field(default=4.5e-4, gt=0)
    still_axial_m: float = Field(default=1.0e-4, gt=0)
    still_across_m: float = Field(default=1.5e-4, gt=0)
    unloaded_m: float = Field(default=1.5e-3, gt=0)  # across its axis, of where it hung before the hand moved
    unloaded_again_m: float = Field(default=1.0e-3, gt=0)  # of where it hung in the air before
    withdrawn_m: float = Field(default=8.0e-4, gt=0)  # the tip, from what it touched within the last second
    regain_m: float = Field(default=2e-4, gt=0)
    landing_frames: int = Field(default=25, ge=0)  # after a loss, in which a snap of the tip is no slip
    lost_frames: int = Field(default=5, ge=1)  # a marker not seen for so long is told
    pose_gap_s: float = Field(default=0.1, gt=0)
    pause_s: float = Field(default=0.15, gt=0)  # between pairs, beyond which their motion is no kick


@dataclass(frozen=True, slots=True)
class Reference:
    """What Stage I showed.

    Attributes:
        chi2: Median χ² of the rigid fit.
        axis_E: (3,) from the pads to the tip.
        normal_E: (3,) closing axis.
        axial_m: (2,) 5th and 95th percentile of the tool's displacement along it.
        start_E: (3,) displacement D before the hand moved: nothing pulls the tip aside then. None without a Stage I.
        twist_rad: Median twist of the left pad's markers against the right's.
        twist_spread_rad: Its spread (1.48 × median absolute deviation).
        slip: How much frames differ where nothing slips.
        rows: Markers in use.
        residual_m: 95th percentile of the rigid fit's root mean square residual in the gels' planes; infinite where
            it is not known.
        tilt_rad: Furthest rotation of the tool about axes along the pads; likewise.
    """

    chi2: float
    axis_E: FloatArray
    normal_E: FloatArray
    axial_m: tuple[float, float]
    start_E: FloatArray | None
    twist_rad: float
    twist_spread_rad: float
    slip: SlipLevels
    rows: IntArray
    residual_m: float = math.inf
    tilt_rad: float = math.inf


def tilt(R: FloatArray, normal_E: FloatArray) -> FloatArray:
    """Angles (T,) of rotations (T, 3, 3) about axes along the pads: one pad's markers against the other's."""
    w = rotation_log(R)
    return np.asarray(np.linalg.norm(w - (w @ normal_E)[:, None] * normal_E, axis=1))


def reference(
    fit: TemplateFit,
    X: FloatArray,
    motions: Motions,
    c_E: FloatArray,
    normal_E: FloatArray,
    staged: bool = True,
) -> Reference:
    """What T frames show.

    Args:
        fit: Their template.
        X: (T, N, 3) markers in F_E.
        motions: Fitted to them.
        c_E: (3,) tip in F_E.
        normal_E: (3,) closing axis in F_E.
        staged: Whether the frames are a Stage I, which starts with the hand at rest.
    """
    residual = fit.residuals(X, motions)  # (T, N, 3)
    twists = np.array([fit.twist(r) for r in residual])
    axis = c_E - motions.centre.mean(axis=0)
    axis = axis / np.linalg.norm(axis)
    D = motions.R @ c_E + motions.t - c_E  # (T, 3)
    low, high = np.percentile(D @ axis, [5, 95])
    middle = float(np.median(twists))
    return Reference(
        chi2=float(np.median(motions.chi2)),
        axis_E=axis,
        normal_E=normal_E,
        axial_m=(float(low), float(high)),
        start_E=np.median(D[:5], axis=0) if staged else None,
        twist_rad=middle,
        twist_spread_rad=1.48 * float(np.median(np.abs(twists - middle))),
        slip=slip_levels(D, residual, normal_E) if staged else SlipLevels(0.0, 0.0),
        rows=np.flatnonzero(fit.trust > 0),
        residual_m=float(np.percentile(motions.residual_m, 95)),
        tilt_rad=float(tilt(motions.R, normal_E).max()) if staged else math.inf,
    )
