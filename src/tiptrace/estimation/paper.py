"""The paper's estimator to the letter: Algorithm 1 from the lifted markers on (``--method paper``)."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.errors import GeometryError, PerceptionError
from tiptrace.estimation.arrangement import ArrangementCheck
from tiptrace.geometry.fixed_point import FixedPointAccumulator
from tiptrace.geometry.kabsch import RigidMotion, kabsch
from tiptrace.geometry.transforms import apply
from tiptrace.types import (
    SIDES,
    Anchor,
    BoolArray,
    Event,
    FingerMarkers,
    FloatArray,
    IntArray,
    Phase,
    SensedPair,
    Side,
    Status,
    TipEstimate,
)


class PaperConfig(BaseModel):
    """Constants of the paper, Sec. II-B."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    markers_per_sensor: int = Field(default=8, ge=2)  # K_m
    discard_deepest: int = Field(default=3, ge=0)
    min_indentation_m: float = 5e-5  # a grasp that shows less than this at frame 0 is not closed


class PaperEstimator:
    """Two-stage reconstruction: Kabsch from frame 0, least-squares anchor, propagation.

    One pass, constant memory and cost per pair. During anchoring the estimate is the running p̂_B(0), empty
    while the motions leave it undetermined.
    """

    def __init__(self, config: PaperConfig | None = None) -> None:
        self._config = config or PaperConfig()
        self._chosen: dict[Side, IntArray] = {}
        self._X_0: FloatArray | None = None  # (N, 3) base frame, frame 0
        self._R_B_E_0: FloatArray = np.eye(3)
        self._fixed_point = FixedPointAccumulator()
        self._arrangement: ArrangementCheck | None = ArrangementCheck()
        self._anchor: Anchor | None = None
        self.motion: RigidMotion | None = None  # (R_t, d_t) of the latest pair
        self.events: list[Event] = []

    @property
    def anchor(self) -> Anchor | None:
        """Stage I result; None before it is solved."""
        return self._anchor

    @property
    def chosen(self) -> dict[Side, IntArray]:
        """Indices of the K_m markers in use per finger, fixed for the trial; empty before frame 0."""
        return self._chosen

    def update(self, pair: SensedPair) -> TipEstimate:
        """One step of Algorithm 1.

        Raises:
            PerceptionError: the grasp is not closed at frame 0.
            GeometryError: reconstruction begins without a single anchoring frame, or Stage I shows that an image
                is mirrored or that left and right are exchanged.
        """
        if self._X_0 is None and not self._initialise(pair):
            return TipEstimate(pair.stamp_ns, pair.phase, Status.LOST)
        motion, markers = self._motion_from_frame_0(pair)  # (R_t, d_t)
        self.motion = motion

        if pair.phase is Phase.ANCHORING:  # Stage I
            if motion is not None:
                self._fixed_point.add(motion.R, motion.d)
            self._check_arrangement(pair)
            p_0 = self._solve_anchor()
            return self._estimate(pair, motion, markers, p_0, Status.ANCHORING)
        if pair.phase is None:
            return TipEstimate(pair.stamp_ns, None, Status.LOST, markers=markers)

        if self._fixed_point.frames == 0:
            raise GeometryError(
                "reconstruction begins without any anchoring frame: the trial needs a segment marked 'anchoring' "
                "in which the hand moves while the tip rests"
            )
        if self._arrangement is not None:
            self._arrangement.verify()
            self._arrangement = None
        if self._anchor is None:
            self._refuse(pair)
            return TipEstimate(pair.stamp_ns, pair.phase, Status.UNOBSERVABLE, markers=markers)
        p_t = None if motion is None else motion.R @ self._anchor.p_B + motion.d  # Stage II, Eq. (traj_recon)
        return self._estimate(pair, motion, markers, p_t, Status.OK)

    def _initialise(self, pair: SensedPair) -> bool:
        """Frame 0: enough markers on both fingers; choose K_m of them and stack X_0."""
        needed = self._config.markers_per_sensor + self._config.discard_deepest
        if any(int(pair.finger(side).markers.tracked.sum()) < needed for side in SIDES):
            return False
        for side in SIDES:
            self._chosen[side] = self._choose(side, pair.finger(side).markers)
        self._X_0, _ = self._stack_in_base(pair)
        self._R_B_E_0 = pair.left.T_B_E[:3, :3]
        return True

    def _choose(self, side: Side, markers: FingerMarkers) -> IntArray:
        """Drop the deepest markers, keep the next K_m (Sec. II-B, depth-based marker selection)."""
        depth = np.where(markers.tracked, -markers.x_S[:, 2], -np.inf)  # (n,)
        order = np.argsort(-depth, kind="stable")
        skip, keep = self._config.discard_deepest, self._config.markers_per_sensor
        if depth[order[0]] < self._config.min_indentation_m:
            raise PerceptionError(
                f"the {side} gel shows no indentation in the first frame: the grasp closes after the recording "
                "starts, or the finger holds nothing; start the trial after the gripper has closed"
            )
        return np.sort(order[skip : skip + keep])

    def _stack_in_base(self, pair: SensedPair) -> tuple[FloatArray, BoolArray]:
        """X_t: the chosen markers of both fingers in F_B, (N, 3), and which of them are seen, (N,)."""
        x, seen = [], []
        for side in SIDES:
            finger = pair.finger(side)
            rows = self._chosen[side]
            x.append(apply(finger.T_B_E @ finger.T_E_S, finger.markers.x_S[rows]))  # ᴮT_E ᴱT_S x_S
            seen.append(finger.markers.tracked[rows])
        return np.concatenate(x), np.concatenate(seen)

    def _check_arrangement(self, pair: SensedPair) -> None:
        if self._arrangement is None:
            return
        x_S: dict[Side, FloatArray] = {}
        T_B_S: dict[Side, FloatArray] = {}
        for side in SIDES:
            finger = pair.finger(side)
            x_S[side] = finger.markers.x_S[self._chosen[side]]
            T_B_S[side] = finger.T_B_E @ finger.T_E_S
        self._arrangement.add(x_S, T_B_S)

    def _motion_from_frame_0(self, pair: SensedPair) -> tuple[RigidMotion | None, int]:
        """(R_t, d_t) by Kabsch over the markers still seen; None if they are too few or collinear."""
        assert self._X_0 is not None
        X_t, seen = self._stack_in_base(pair)
        try:
            return kabsch(self._X_0[seen], X_t[seen]), int(seen.sum())
        except GeometryError:
            return None, int(seen.sum())

    def _solve_anchor(self) -> FloatArray | None:
        """Running p̂_B(0), Eq. (fixedpoint_ls); None while the motions leave it undetermined."""
        solution = self._fixed_point.solve()
        if solution is None:
            return None
        self._anchor = Anchor(solution.p, None, solution.residual_m, solution.frames)
        return solution.p

    def _refuse(self, pair: SensedPair) -> None:
        if not any(event.kind == "anchor-refused" for event in self.events):
            detail = (
                "the anchoring motion leaves the tip undetermined: rotate the hand about two axes or more"
            )
            self.events.append(Event("anchor-refused", pair.stamp_ns, pair.stamp_ns, detail))

    def _estimate(
        self,
        pair: SensedPair,
        motion: RigidMotion | None,
        markers: int,
        p_B: FloatArray | None,
        status: Status,
    ) -> TipEstimate:
        if motion is None:
            return TipEstimate(pair.stamp_ns, pair.phase, Status.LOST, markers=markers)
        R_B_E = motion.R @ self._R_B_E_0
        return TipEstimate(
            pair.stamp_ns, pair.phase, status, p_B, R_B_E, residual_m=motion.residual_m, markers=markers
        )
