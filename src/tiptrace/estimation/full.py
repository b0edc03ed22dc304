"""``--method full``: anchoring, motion, map, propagation and integrity as one causal pass (``docs/estimation.md``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tiptrace.config import Rig, Tool
from tiptrace.estimation.anchor import TipPrior
from tiptrace.estimation.arrangement import ArrangementWatch
from tiptrace.estimation.carry_over import StageTwoStep, carried_over
from tiptrace.estimation.event_log import EventLog
from tiptrace.estimation.full_config import FullConfig
from tiptrace.estimation.integrity import Findings, Monitor
from tiptrace.estimation.motion import Motions, TemplateFit
from tiptrace.estimation.observability import advice, weak_axes
from tiptrace.estimation.pads import PadMarkers
from tiptrace.estimation.phases import PhaseDetector
from tiptrace.estimation.pose_track import HandStates, PoseTrack
from tiptrace.estimation.priors import calibrated_latency, require_tip, tip_prior
from tiptrace.estimation.propagation import Tip, Velocity, propagate
from tiptrace.estimation.reanchor import Reanchoring
from tiptrace.estimation.stage_one import Anchoring, RunningTip, StageOne
from tiptrace.estimation.tip_map_config import P
from tiptrace.estimation.verdict import Verdict
from tiptrace.estimation.warm_up import warm_up
from tiptrace.types import Anchor, Event, FloatArray, Phase, PoseSample, SensedPair, Status, TipEstimate

_TEMPLATE_FRAMES = 5
_TOO_FEW = "fewer markers than a rigid motion needs, or none on one pad"
_SLIPPED_EARLY = (
    "the tool slipped in the grasp while its tip rested: Stage I was solved in parts, before and after"
)


class FullEstimator:
    """Marker pairs in, tip with covariance out. One pass, constant cost and memory."""

    def __init__(
        self,
        config: FullConfig | None = None,
        rig: Rig | None = None,
        tool: Tool | None = None,
        anchor_from: TipPrior | Anchoring | None = None,
    ) -> None:
        """Set up.

        Args:
            config: Settings.
            rig: For the calibrated latency.
            tool: For the tip's prior, and for the tip itself where there is no Stage I.
            anchor_from: Replaces Stage I (``--anchor-from``). In the same grasp the other trial's
                :attr:`anchoring`, whose marker template carries over; after a regrasp its :attr:`tip_E`, inflated.
        """
        warm_up()  # the first frame should not wait
        self._config = c = config or FullConfig()
        self._latency = calibrated_latency(rig)
        self._prior = tip_prior(tool) if c.use_tip_prior else None
        self._given: TipPrior | Anchoring | None = anchor_from
        if anchor_from is None and not c.use_stage_one and not c.relative:
            self._given = require_tip(tool)
        self._staged = self._given is None and c.use_stage_one
        self._marked = True
        self._track = PoseTrack(c.pose_memory_s, c.pose_half_width_s)
        self._stage_one = StageOne(c.stage_one, c.patch, c.motion, c.tip_map, c.pose_half_width_s)
        self._running = RunningTip(self._prior, c.tip_noise_m, c.tip_map.map_sigma)
        self._phases = PhaseDetector(c.phases)
        self._arrangement = ArrangementWatch()
        self._monitor = Monitor(c.integrity)
        self._reanchoring = Reanchoring(c.reanchor, self._stage_one)
        self._fit_I: TemplateFit | None = None
        self._last_motion: tuple[FloatArray, FloatArray] | None = None
        self._anchoring: Anchoring | None = None
        self._anchor: Anchor | None = None
        self._refused = self._relative = False
        self._first: Tip | None = None  # first contact, for displacements
        self._last_ns = 0  # last pair that Stage II could use
        self._in_grasp = (0.0, 0)  # sum of squares of the tip's way against the hand, frames
        self._closure_m: float | None = None
        self._in_grasp_velocity = Velocity()
        self.events: list[Event] = []
        self._log = EventLog(self.events)
        self._verdict = Verdict(self._log, c.slip_sigma_m)
        self.on_step: Callable[[StageTwoStep], None] | None = None  # for whoever smooths afterwards

    @property
    def anchoring_end_ns(self) -> int | None:
        """End of Stage I where it was found from the data, ns; frames up to its detection came as anchoring."""
        return self._phases.end_ns

    @property
    def anchor(self) -> Anchor | None:
        """Stage I result; None before it is solved, where it was refused, and for displacements."""
        if self._anchor is None or self._anchor.checks is None or not self._in_grasp[1]:
            return self._anchor
        rms = float(np.sqrt(self._in_grasp[0] / self._in_grasp[1]))
        checks = replace(self._anchor.checks, in_grasp_m=rms, closure_m=self._closure_m)
        return replace(self._anchor, checks=checks)

    @property
    def anchoring(self) -> Anchoring | None:
        """Everything that Stage I left, refused or not."""
        return self._anchoring

    @property
    def running_covariance(self) -> FloatArray | None:
        """(3, 3) m² of the tip as Stage I knows it so far, however badly; None before there is any."""
        solution = self._running.solve()
        return None if solution is None else solution[1]

    @property
    def tip_E(self) -> TipPrior | None:
        """The tip in F_E for another trial with the same grasp (``--anchor-from``); None without an anchor."""
        if self._anchoring is None or self._anchor is None:
            return None
        tip_map = self._anchoring.tip_map
        return TipPrior(tip_map.c, tip_map.covariance[:3, :3])

    def update(self, pair: SensedPair) -> TipEstimate:
        """Process the next pair."""
        markers = PadMarkers.of(pair)
        poses = pair.poses or (PoseSample(pair.stamp_ns, pair.left.T_B_E),)
        self._track.extend(poses)
        repeated = self._monitor.repeated(markers.x_S, markers.pad)
        phase, self._marked = pair.phase or self._found_phase(pair), pair.phase is not None
        if phase is Phase.ANCHORING and self._staged:
            return self._stage_one_step(replace(pair, phase=phase, poses=poses), markers)
        if self._anchoring is None and not self._begin_stage_two(pair, poses, markers):
            return TipEstimate(self._exposure_ns(pair.stamp_ns), phase, Status.LOST)
        return self._stage_two_step(replace(pair, phase=phase, poses=poses), markers, repeated)

    @property
    def bewildered(self) -> bool:
        """Whether markers have been astray for some frames: matching them to dots anew may help."""
        return self._monitor.bewildered

    def use_pause(self) -> None:
        """Do some of what no estimate waits for, between two pairs; estimates do not depend on it."""
        self._reanchoring.advance()

    def _found_phase(self, pair: SensedPair) -> Phase:
        """Where no marks tell it; without a Stage I all is Stage II."""
        return self._phases.update(pair.stamp_ns, pair.left.T_B_E) if self._staged else Phase.RECONSTRUCTION

    # --- Stage I --------------------------------------------------------------------------------------------

    def _stage_one_step(self, pair: SensedPair, markers: PadMarkers) -> TipEstimate:
        self._stage_one.add_poses(pair.poses)
        self._stage_one.add(pair.stamp_ns, markers)
        n = len(self._stage_one)
        if n in (1, 2, _TEMPLATE_FRAMES):
            self._fit_I, self._last_motion = self._stage_one.first_fit(), None
        if n >= _TEMPLATE_FRAMES:
            self._arrangement.add(pair, self._stage_one.trust)
        assert self._fit_I is not None
        motions = self._fit(self._fit_I, markers)
        stamp_ns = self._exposure_ns(pair.stamp_ns)
        used = int((motions.weights > 0).sum())
        estimate = TipEstimate(stamp_ns, pair.phase, Status.ANCHORING, markers=used)
        hand = self._hand(stamp_ns)
        if hand is None or not self._usable(motions) or n < _TEMPLATE_FRAMES:
            return estimate
        T_B_E = hand.T_B_E[0]
        self._running.add(motions, T_B_E)
        residual = float(motions.residual_m[0])
        estimate = replace(estimate, R_B_E=T_B_E[:3, :3] @ motions.R[0], residual_m=residual)
        solution = self._running.solve()
        if not (self._marked or self._phases.turned):
            return estimate  # a hand that only travels is no Stage I
        if solution is None or weak_axes(solution[1], self._config.refuse_sigma_m):
            return estimate
        return replace(estimate, p_B=solution[0], covariance=solution[1])

    def _begin_stage_two(self, pair: SensedPair, poses: tuple[PoseSample, ...], markers: PadMarkers) -> bool:
        """Solve Stage I, or stand in for it; False while there are too few frames for a template."""
        self._last_motion = None
        if len(self._stage_one) >= _TEMPLATE_FRAMES and self._staged:
            if self._phases.end_ns is not None:
                self._stage_one.keep_until(self._phases.end_ns)
            complaint = self._arrangement.complaint() if self._marked else None
            if complaint is None:
                self._accept(self._stage_one.solve(self._latency, self._prior), pair.stamp_ns)
            else:
                self._anchoring = self._stage_one.assume(self._unknown_tip(), self._latency)
                self._refuse(pair.stamp_ns, complaint)
            return True
        self._stage_one.add_poses(poses)
        self._stage_one.add(pair.stamp_ns, markers)
        if len(self._stage_one) < _TEMPLATE_FRAMES or self._hand(self._exposure_ns(pair.stamp_ns)) is None:
            return False
        tip = self._given
        if isinstance(tip, Anchoring):
            self._anchoring = carried_over(tip, self._stage_one, pair.stamp_ns, self._config.motion)
            return True
        if tip is None:
            self._relative = True
            tip = self._unknown_tip()
        self._anchoring = self._stage_one.assume(tip, self._latency)
        return True

    def _unknown_tip(self) -> TipPrior:
        """Somewhere beyond the pads: a lever is needed even where no position is claimed."""
        away, sigma = self._config.unknown_tip_m
        covariance = np.diag([0.5 * sigma, 0.5 * sigma, sigma]) ** 2
        return TipPrior(self._stage_one.centre_E + [0.0, 0.0, away], covariance)

    def _refuse(self, stamp_ns: int, why: str) -> None:
        self._refused = True
        self._log.note("anchor-refused", stamp_ns, stamp_ns, why)

    def _accept(self, anchoring: Anchoring, stamp_ns: int) -> None:
        """Take the anchor, or refuse it and say which motion is missing."""
        self._anchoring = anchoring
        tip_map, limit = anchoring.tip_map, self._config.refuse_sigma_m
        for before, after in anchoring.slips_ns:
            self._log.note("grasp-slip", self._exposure_ns(before), self._exposure_ns(after), _SLIPPED_EARLY)
        covariance = tip_map.covariance[P, P]
        weak = weak_axes(covariance, limit)
        if weak:
            self._refuse(stamp_ns, advice(weak, covariance, anchoring.tool_rotations, limit))
            return
        self._anchor = Anchor(
            tip_map.p, covariance, tip_map.residual_m, tip_map.frames, checks=tip_map.checks
        )

    # --- Stage II -------------------------------------------------------------------------------------------

    def _stage_two_step(
        self, pair: SensedPair, markers: PadMarkers, repeated: tuple[bool, bool]
    ) -> TipEstimate:
        assert self._anchoring is not None
        stamp_ns = self._exposure_ns(pair.stamp_ns)
        motions = self._fit(self._anchoring.fit, markers)
        estimate = TipEstimate(stamp_ns, pair.phase, Status.LOST, markers=int((motions.weights > 0).sum()))
        if self._refused:
            return replace(estimate, status=Status.UNOBSERVABLE)
        hand = self._hand(stamp_ns)
        if hand is None:
            self._log.note("pose-gap", stamp_ns, stamp_ns, "no end-effector poses about this instant")
            return estimate
        if not self._usable(motions):
            self._log.note("too-few-markers", stamp_ns, stamp_ns, _TOO_FEW)
            return estimate
        tip = self._propagate(pair.stamp_ns, motions, hand)
        if pair.stamp_ns - self._last_ns > self._config.integrity.pause_s * 1e9:
            self._monitor.resume()
        self._last_ns = pair.stamp_ns
        findings = self._judge(markers, motions, hand, repeated)
        if findings.slipping:
            self._reanchoring.abandon()
        status, extra = self._verdict.of(stamp_ns, findings)
        self._report_step(pair.stamp_ns, motions, hand, extra)
        R_B_E = hand.T_B_E[0, :3, :3] @ motions.R[0]
        estimate = replace(estimate, status=status, R_B_E=R_B_E, residual_m=float(motions.residual_m[0]))
        self._try_reanchoring(pair, markers, tip.p_B, R_B_E)
        if status is Status.NO_CONTACT:
            return estimate
        if self._relative:
            return self._displacement(estimate, tip, extra)
        self._set_anchor_from_given(tip)
        return replace(estimate, p_B=tip.p_B, covariance=tip.covariance + extra)

    def _report_step(self, stamp_ns: int, motions: Motions, hand: HandStates, extra: FloatArray) -> None:
        if self.on_step is not None and self._anchoring is not None:
            self.on_step(StageTwoStep(stamp_ns, motions, hand, self._anchoring, extra))

    def _propagate(self, stamp_ns: int, motions: Motions, hand: HandStates) -> Tip:
        assert self._anchoring is not None
        a = self._anchoring
        tip = propagate(a.tip_map, motions, 0, hand, a.phase(stamp_ns), self._config.tip_noise_m)
        v = self._in_grasp_velocity.update(stamp_ns, hand.T_B_E[0, :3, :3] @ tip.moved_E)
        self._in_grasp = (self._in_grasp[0] + float(tip.moved_E @ tip.moved_E), self._in_grasp[1] + 1)
        late = a.tip_map.covariance[15, 15] * np.outer(v, v)
        return replace(tip, covariance=tip.covariance + late)

    def _judge(
        self, markers: PadMarkers, motions: Motions, hand: HandStates, repeated: tuple[bool, bool]
    ) -> Findings:
        assert self._anchoring is not None
        a = self._anchoring
        residual = a.fit.residuals(markers.X[None], motions)[0]
        c, twist, doubtful = a.tip_map.c, a.fit.twist(residual), markers.doubtful
        return self._monitor.judge(
            a.reference, motions, c, hand.T_B_E[0], residual, twist, repeated, doubtful
        )

    def _displacement(self, estimate: TipEstimate, tip: Tip, extra: FloatArray) -> TipEstimate:
        """Displacement from the first contact; what both ends share of the unknown tip cancels."""
        assert self._anchoring is not None
        if self._first is None:
            self._first = tip
        J = tip.jacobian - self._first.jacobian
        covariance = J @ self._anchoring.tip_map.covariance @ J.T + tip.own + self._first.own + extra
        moved = tip.p_B - self._first.p_B
        return replace(estimate, status=Status.RELATIVE, p_B=moved, covariance=covariance)

    def _set_anchor_from_given(self, tip: Tip) -> None:
        """With a tip from elsewhere the anchor is the first contact."""
        if self._anchor is None:
            self._anchor = Anchor(tip.p_B, tip.covariance, 0.0, 0)

    def _try_reanchoring(
        self, pair: SensedPair, markers: PadMarkers, p_B: FloatArray, R_B_E: FloatArray
    ) -> None:
        """When the tip rests again while the hand turns, anchor anew: after a slip, or where it helps."""
        assert self._anchoring is not None
        if self._relative:
            return
        renewed = self._reanchoring.update(pair, markers, p_B, R_B_E, self._anchoring.tip_map)
        if renewed is None:
            return
        tip_map = renewed.anchoring.tip_map
        if renewed.latency_change_s is not None:
            self._anchoring = self._anchoring.with_latency(tip_map)
            detail = f"images are {renewed.latency_change_s * 1e3:+.0f} ms later against the robot's poses than before"
            self._log.note("latency-changed", pair.stamp_ns, pair.stamp_ns, detail)
        variance, limit = tip_map.covariance[P, P], self._config.refuse_sigma_m
        better = np.trace(variance) < np.trace(self._anchoring.tip_map.covariance[P, P])
        if weak_axes(variance, limit) or not (self._verdict.slipped or better or renewed.contradicts):
            return
        self._anchoring, self._last_motion = renewed.anchoring, None
        self._monitor.restart()
        self._verdict.slipped = False
        self._closure_m = max(self._closure_m or 0.0, renewed.off_m)
        sigma = np.sqrt(np.linalg.eigvalsh(variance)[-1]) * 1e3
        detail = (
            f"the tip rested while the hand turned: anchored anew, to {sigma:.1f} mm; "
            f"the trace was {renewed.off_m * 1e3:.1f} mm off"
        )
        self._log.note("re-anchored", pair.stamp_ns, pair.stamp_ns, detail)

    # --- shared ---------------------------------------------------------------------------------------------

    def _fit(self, fit: TemplateFit, markers: PadMarkers) -> Motions:
        motions = fit.fit(markers.X[None], self._last_motion)
        self._last_motion = (motions.R, motions.t) if self._usable(motions) else None
        return motions

    def _usable(self, motions: Motions) -> bool:
        """Enough markers, on both pads."""
        used = np.count_nonzero(motions.weights[0])
        return bool(used >= self._config.motion.min_markers and motions.sides[0].min() > 0)

    def _exposure_ns(self, stamp_ns: int) -> int:
        if self._anchoring is not None:
            return stamp_ns - round(self._anchoring.tip_map.latency_s * 1e9)
        mean_s = self._config.tip_map.latency_s if self._latency is None else self._latency[0]
        return stamp_ns - round(mean_s * 1e9)

    def _hand(self, stamp_ns: int) -> HandStates | None:
        known = (
            self._track.covers(stamp_ns) and self._track.gap_s(stamp_ns) <= self._config.integrity.pose_gap_s
        )
        return self._track.at([stamp_ns]) if known else None
