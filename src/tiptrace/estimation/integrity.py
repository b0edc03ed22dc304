"""Does the tool still sit in the grasp, does the tip still touch, are the frames new? (``docs/estimation.md``)

Everything is judged against what the same trial showed in Stage I; nothing here changes an estimate, it only says
what the frame is worth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.estimation.contact_watch import ContactWatch
from tiptrace.estimation.integrity_reference import IntegrityConfig, Reference, tilt
from tiptrace.estimation.motion import Motions
from tiptrace.estimation.slip_detector import SlipDetector
from tiptrace.types import BoolArray, FloatArray, IntArray


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
        misfit: The markers are far from moving as one body, or the tracker cannot tell whose dots are whose.
        in_contact: Whether the tip touches.
        axial_m: Displacement of the tool along its axis, out of the hand.
    """

    repeated: tuple[bool, bool]
    frozen: bool
    slipping: bool
    jumped: BoolArray
    lost: BoolArray
    disagree: bool
    misfit: bool
    in_contact: bool
    axial_m: float


class Monitor:
    """Judges frame after frame, in constant memory."""

    def __init__(self, config: IntegrityConfig) -> None:
        self._config = config
        self._last_S: FloatArray | None = None
        self._last_residual: FloatArray | None = None
        self._same = np.zeros(2, dtype=int)
        self._slip = SlipDetector(config.slip)
        self._watch = ContactWatch(config)
        self._misfits = 0
        self._landed = config.landing_frames  # frames since the tip touched again
        self._unseen = np.zeros(0, dtype=int)
        self._twisted = 0

    def restart(self) -> None:
        """Judge against another reference from here on: displacements start from another template."""
        self._watch = ContactWatch(self._config)
        self._slip = SlipDetector(self._config.slip)
        self._last_residual = None
        self._twisted = 0

    def resume(self) -> None:
        """Go on after a pause: what moved meanwhile is no kick."""
        self._slip = SlipDetector(self._config.slip)
        self._last_residual = None

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
        T_B_E: FloatArray,
        residual_E: FloatArray,
        twist_rad: float,
        repeated: tuple[bool, bool],
        doubtful: bool = False,
    ) -> Findings:
        """One frame of Stage II.

        Args:
            ref: Stage I.
            motions: One frame.
            c_E: Tip in F_E.
            T_B_E: (4, 4) hand.
            residual_E: (N, 3) markers less their fitted places, NaN where lost or unused.
            twist_rad: Twist of the left pad's markers against the right's.
            repeated: From :meth:`repeated`.
            doubtful: Whether the tracker of a finger cannot tell whose dots are whose.
        """
        c = self._config
        D = motions.R[0] @ c_E + motions.t[0] - c_E
        axial = float(D @ ref.axis_E)
        in_contact = self._watch.update(D, c_E, T_B_E, ref)
        self._landed = self._landed + 1 if in_contact else 0
        held = in_contact and self._landed >= c.landing_frames
        slipping = self._slip.update(D, residual_E, self._watch.pushed_m, ref.normal_E, ref.slip, held)
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
            misfit=doubtful or self._astray(ref, motions),
            in_contact=in_contact,
            axial_m=axial,
        )

    def _astray(self, ref: Reference, motions: Motions) -> bool:
        """Whether markers fit no rigid motion, or one that no tool makes: all of one pad are a pitch away."""
        c = self._config
        loose = float(motions.residual_m[0]) > max(c.misfit_m, c.misfit * ref.residual_m)
        astray = loose or float(tilt(motions.R, ref.normal_E)[0]) > ref.tilt_rad + c.tilt_beyond_rad
        self._misfits = self._misfits + 1 if astray else 0
        return astray

    @property
    def bewildered(self) -> bool:
        """Whether the markers have been astray for so long that they had better be matched to dots anew."""
        return self._misfits % self._config.again_frames == self._config.again_frames - 1

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
