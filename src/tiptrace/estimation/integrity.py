"""Does the tool still sit in the grasp, does the tip still touch, are the frames new? (``docs/estimation.md``)

Everything is judged against what the same trial showed in Stage I; nothing here changes an estimate, it only says
what the frame is worth.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.estimation.motion import Motions, TemplateFit
from tiptrace.estimation.slip_detector import SlipDetector, SlipLevels, slip_levels
from tiptrace.types import BoolArray, FloatArray, IntArray

_STILL, _STILL_SLOW = 4, 10  # frames over which a tool in the air hangs still, with and without a Stage I
_DEPTH_SHARE = 0.3  # of a swing along the closing axis, which depends on depth and is noisier


class IntegrityConfig(BaseModel):
    """Limits."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    # no marker of a finger moved by more: the image is the old one
    frozen_m: float = Field(default=2e-7, gt=0)
    stale_frames: int = Field(default=3, ge=2)
    # a slip: the tip is kicked against the hand, and the markers' pattern about the rigid fit is another afterwards
    kick_m: float = Field(default=1.3e-3, gt=0)  # second difference of the tip's displacement
    pattern_m: float = Field(default=4.0e-5, gt=0)  # rms over the markers
    pattern_alone_m: float = Field(default=4.0e-4, gt=0)  # the same, without a kick
    slip_margin: float = Field(default=1.3, ge=1)  # over what Stage I showed
    # of one marker between two frames, beyond the tool's own motion
    jump_m: float = Field(default=1.2e-3, gt=0)
    twist_limit_rad: float = Field(default=0.03, gt=0)  # of one pad's markers against the other's
    twist_frames: int = Field(default=3, ge=1)
    # the tool springs out along its axis when the tip lifts off
    release_m: float = Field(default=4.5e-4, gt=0)
    still_axial_m: float = Field(default=1.0e-4, gt=0)
    still_across_m: float = Field(default=1.5e-4, gt=0)
    unloaded_m: float = Field(default=1.5e-3, gt=0)  # across its axis, of where it hung before the hand moved
    unloaded_again_m: float = Field(default=1.0e-3, gt=0)  # of where it hung in the air before
    regain_m: float = Field(default=2e-4, gt=0)
    lost_frames: int = Field(default=5, ge=1)  # a marker not seen for so long is told
    pose_gap_s: float = Field(default=0.1, gt=0)


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
    )


@dataclass(frozen=True, slots=True)
class Findings:
    """What a frame shows.

    Attributes:
        repeated: Which fingers delivered an old frame (left, right).
        frozen: The frames stand still for longer.
        slipping: The markers no longer move as one body.
        jumped: Rows of markers that jumped.
        lost: Rows of markers in use that have not been seen for several frames.
        disagree: The pads twist against each other.
        in_contact: Whether the tip touches.
        axial_m: Displacement of the tool along its axis, out of the hand.
    """

    repeated: tuple[bool, bool]
    frozen: bool
    slipping: bool
    jumped: BoolArray
    lost: BoolArray
    disagree: bool
    in_contact: bool
    axial_m: float


class Monitor:
    """Judges frame after frame, in constant memory."""

    def __init__(self, config: IntegrityConfig) -> None:
        self._config = config
        self._last_S: FloatArray | None = None
        self._last_residual: FloatArray | None = None
        self._same = np.zeros(2, dtype=int)
        self._slip = SlipDetector(config.kick_m, config.pattern_m, config.pattern_alone_m, config.slip_margin)
        self._path: deque[FloatArray] = deque(maxlen=_STILL_SLOW)
        self._unseen = np.zeros(0, dtype=int)
        self._twisted = 0
        self._contact = True
        self._free_m: float | None = None
        self._free_E: FloatArray | None = None

    def repeated(self, x_S: FloatArray, pad: FloatArray) -> tuple[bool, bool]:
        """Whether each finger's frame equals the last one; call once per frame, first."""
        same = [False, False]
        if self._last_S is not None and self._last_S.shape == x_S.shape:
            moved = np.abs(x_S - self._last_S)  # (N, 3), NaN where lost
            for k in (0, 1):
                most = np.fmax.reduce(moved[pad == k], axis=None, initial=np.nan)  # NaN if nothing is seen
                same[k] = bool(most < self._config.frozen_m)
        self._last_S = x_S
        self._same = np.where(same, self._same + 1, 0)
        return same[0], same[1]

    @property
    def frozen(self) -> bool:
        """Whether a finger has stood still for several frames."""
        return bool(self._same.max() >= self._config.stale_frames)

    def judge(
        self,
        ref: Reference,
        motions: Motions,
        c_E: FloatArray,
        residual_E: FloatArray,
        twist_rad: float,
        repeated: tuple[bool, bool],
    ) -> Findings:
        """One frame of Stage II.

        Args:
            ref: Stage I.
            motions: One frame.
            c_E: Tip in F_E.
            residual_E: (N, 3) markers less their fitted places, NaN where lost or unused.
            twist_rad: Twist of the left pad's markers against the right's.
            repeated: From :meth:`repeated`.
        """
        c = self._config
        D = motions.R[0] @ c_E + motions.t[0] - c_E
        axial = float(D @ ref.axis_E)
        self._judge_contact(D, ref)
        slipping = self._slip.update(D, residual_E, ref.normal_E, ref.slip)
        limit = max(c.twist_limit_rad, 6.0 * ref.twist_spread_rad)
        twisted = abs(twist_rad - ref.twist_rad) > limit
        self._twisted = self._twisted + 1 if twisted else 0
        return Findings(
            repeated=repeated,
            frozen=self.frozen,
            slipping=slipping,
            jumped=self._jumped(residual_E),
            lost=self._lost(residual_E, ref.rows),
            disagree=self._twisted >= c.twist_frames,
            in_contact=self._contact,
            axial_m=axial,
        )

    def _judge_contact(self, D: FloatArray, ref: Reference) -> None:
        """In the air the tool has sprung out along its axis, hangs still, and nothing pulls it aside any more.

        None of the three alone is enough: friction on a tilted tool pulls it out as well, and on a straight path it
        is still. Gels that carry no load look alike before and after a slip, so that the place where the tool hung
        before the hand moved stays good. Without a Stage I that place is not known, and stillness has to last longer.
        """
        c = self._config
        self._path.append(D)
        frames = _STILL_SLOW if ref.start_E is None else _STILL
        if len(self._path) < frames:
            return
        path = np.array(list(self._path)[-frames:])
        along = path @ ref.axis_E  # (frames,)
        across = path - along[:, None] * ref.axis_E
        half = (across[frames // 2 :].sum(axis=0) - across[: frames // 2].sum(axis=0)) / (frames // 2)
        half -= (1.0 - _DEPTH_SHARE) * (half @ ref.normal_E) * ref.normal_E
        swing = math.sqrt(half @ half)
        if not self._contact:  # what moves against the hand is held by something
            back = self._free_m is not None and abs(float(along[-1]) - self._free_m) > c.regain_m
            self._contact = back or swing > 2.0 * c.still_across_m
            if self._contact:
                self._path.clear()
            return
        if np.ptp(along) >= c.still_axial_m or swing >= c.still_across_m:
            return
        middle = np.median(path, axis=0)
        out = float(along.min() if frames == _STILL else np.median(along)) > ref.axial_m[1] + c.release_m
        hanging = _unloaded(middle, ref, c.unloaded_m) if out else self._as_before(middle)
        if hanging:
            self._contact, self._free_m, self._free_E = False, float(np.median(along)), middle

    def _as_before(self, D: FloatArray) -> bool:
        """Whether the tool hangs where it hung in the air once before."""
        if self._free_E is None:
            return False
        return bool(np.linalg.norm(D - self._free_E) < self._config.unloaded_again_m)

    def _lost(self, residual_E: FloatArray, rows: IntArray) -> BoolArray:
        unseen = np.zeros(len(residual_E), dtype=int)
        missing = rows[~np.isfinite(residual_E[rows, 0])]
        if len(self._unseen) == len(unseen):
            unseen[missing] = self._unseen[missing] + 1
        self._unseen = unseen
        return np.asarray(unseen >= self._config.lost_frames)

    def _jumped(self, residual_E: FloatArray) -> BoolArray:
        last, self._last_residual = self._last_residual, residual_E
        if last is None or last.shape != residual_E.shape:
            return np.zeros(len(residual_E), dtype=bool)
        step = residual_E - last
        return np.asarray((step * step).sum(axis=1) > self._config.jump_m**2)  # False where lost


def _unloaded(D: FloatArray, ref: Reference, limit_m: float) -> bool:
    """Whether the tool, displaced by D (3,), is out along its axis and across it where it hung at the start."""
    if ref.start_E is None:
        return float(D @ ref.axis_E) > ref.axial_m[1]
    away = D - ref.start_E
    return bool(np.linalg.norm(away - (away @ ref.axis_E) * ref.axis_E) < limit_m)
