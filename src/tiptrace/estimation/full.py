"""``--method full``: anchoring, motion, map, propagation and integrity as one causal pass (``docs/estimation.md``)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.config import Rig, Tool
from tiptrace.errors import GeometryError
from tiptrace.estimation.anchor import TipPrior
from tiptrace.estimation.motion import MotionConfig, Motions, TemplateFit
from tiptrace.estimation.observability import advice, weak_axes
from tiptrace.estimation.pads import PadMarkers
from tiptrace.estimation.patch import PatchConfig
from tiptrace.estimation.pose_track import HandStates, PoseTrack
from tiptrace.estimation.propagation import Tip, propagate
from tiptrace.estimation.stage_one import Anchoring, RunningTip, StageOne, StageOneConfig
from tiptrace.estimation.tip_map import P, TipMapConfig
from tiptrace.types import Anchor, Event, FloatArray, Phase, PoseSample, SensedPair, Status, TipEstimate


class FullConfig(BaseModel):
    """Settings of the full estimator; the defaults were chosen on simulated trials with seeds below 1000."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    patch: PatchConfig = PatchConfig()
    motion: MotionConfig = MotionConfig()
    tip_map: TipMapConfig = TipMapConfig()
    stage_one: StageOneConfig = StageOneConfig()
    use_tip_prior: bool = True
    refuse_sigma_m: float = Field(default=2e-3, gt=0)
    pose_half_width_s: float = Field(default=0.05, gt=0)
    pose_memory_s: float = Field(default=1.0, gt=0.2)
    tip_noise_m: float = Field(default=1e-4, gt=0)  # hand pose and model at the tip, per frame


class FullEstimator:
    """Marker pairs in, tip with covariance out. One pass, constant cost and memory."""

    def __init__(
        self, config: FullConfig | None = None, rig: Rig | None = None, tool: Tool | None = None
    ) -> None:
        self._config = config or FullConfig()
        c = self._config
        self._latency = calibrated_latency(rig)
        self._prior = tip_prior(tool) if c.use_tip_prior else None
        self._track = PoseTrack(c.pose_memory_s, c.pose_half_width_s)
        self._stage_one = StageOne(c.stage_one, c.patch, c.motion, c.tip_map, c.pose_half_width_s)
        self._running = RunningTip(self._prior, c.tip_noise_m, c.tip_map.map_sigma)
        self._running_fit: TemplateFit | None = None
        self._last_motion: tuple[FloatArray, FloatArray] | None = None
        self._anchoring: Anchoring | None = None
        self._anchor: Anchor | None = None
        self._refused = False
        self._rate = _Rate()
        self.events: list[Event] = []

    @property
    def anchor(self) -> Anchor | None:
        """Stage I result; None before it is solved and where it was refused."""
        return self._anchor

    @property
    def anchoring(self) -> Anchoring | None:
        """Everything that Stage I left, refused or not."""
        return self._anchoring

    def update(self, pair: SensedPair) -> TipEstimate:
        """Process the next pair.

        Raises:
            GeometryError: reconstruction begins without a usable Stage I.
        """
        markers = PadMarkers.of(pair)
        poses = pair.poses or (PoseSample(pair.stamp_ns, pair.left.T_B_E),)
        self._track.extend(poses)
        if pair.phase is Phase.ANCHORING:
            self._stage_one.add_poses(poses)
            return self._stage_one_step(pair, markers)
        if self._anchoring is None:
            self._finish_stage_one(pair)
        return self._stage_two_step(pair, markers)

    # --- Stage I --------------------------------------------------------------------------------------------

    def _stage_one_step(self, pair: SensedPair, markers: PadMarkers) -> TipEstimate:
        self._stage_one.add(pair.stamp_ns, markers)
        n = len(self._stage_one)
        if n in (1, 2, 5):
            self._running_fit = self._stage_one.first_fit()
            self._last_motion = None
        assert self._running_fit is not None
        motions = self._fit(self._running_fit, markers)
        stamp_ns = self._exposure_ns(pair.stamp_ns)
        estimate = TipEstimate(
            stamp_ns, pair.phase, Status.ANCHORING, markers=int((motions.weights > 0).sum())
        )
        hand = self._hand(stamp_ns)
        if hand is None or not self._usable(motions):
            return estimate
        if n < 5:  # before the running template stands
            return estimate
        T_B_E = hand.T_B_E[0]
        self._running.add(motions, T_B_E)
        estimate = replace(
            estimate, R_B_E=T_B_E[:3, :3] @ motions.R[0], residual_m=float(motions.residual_m[0])
        )
        solution = self._running.solve()
        if solution is None or weak_axes(solution[1], self._config.refuse_sigma_m):
            return estimate
        return replace(estimate, p_B=solution[0], covariance=solution[1])

    def _finish_stage_one(self, pair: SensedPair) -> None:
        """Solve Stage I and accept or refuse the anchor."""
        self._anchoring = self._stage_one.solve(self._latency, self._prior)
        self._last_motion = None
        tip_map, limit = self._anchoring.tip_map, self._config.refuse_sigma_m
        covariance = tip_map.covariance[P, P]
        weak = weak_axes(covariance, limit)
        if weak:
            self._refused = True
            R = self._anchoring.tool_rotations
            self._note("anchor-refused", pair.stamp_ns, advice(weak, covariance, R, limit))
            return
        self._anchor = Anchor(tip_map.p, covariance, tip_map.residual_m, tip_map.frames, weak)

    # --- Stage II -------------------------------------------------------------------------------------------

    def _stage_two_step(self, pair: SensedPair, markers: PadMarkers) -> TipEstimate:
        assert self._anchoring is not None
        stamp_ns = self._exposure_ns(pair.stamp_ns)
        motions = self._fit(self._anchoring.fit, markers)
        used = int((motions.weights > 0).sum())
        if self._refused:
            return TipEstimate(stamp_ns, pair.phase, Status.UNOBSERVABLE, markers=used)
        hand = self._hand(stamp_ns)
        if hand is None or not self._usable(motions):
            return TipEstimate(stamp_ns, pair.phase, Status.LOST, markers=used)
        tip = self._propagate(pair.stamp_ns, motions, hand)
        return TipEstimate(
            stamp_ns,
            pair.phase,
            Status.OK,
            p_B=tip.p_B,
            R_B_E=hand.T_B_E[0, :3, :3] @ motions.R[0],
            covariance=tip.covariance,
            residual_m=float(motions.residual_m[0]),
            markers=used,
        )

    def _propagate(self, stamp_ns: int, motions: Motions, hand: HandStates) -> Tip:
        assert self._anchoring is not None
        a = self._anchoring
        tip = propagate(a.tip_map, motions, 0, hand, a.phase(stamp_ns), self._config.tip_noise_m)
        v = self._rate.update(
            stamp_ns, hand.T_B_E[0, :3, :3] @ tip.moved_E
        )  # in-grasp part of the tip's velocity
        late = a.tip_map.covariance[15, 15] * np.outer(v, v)
        return replace(tip, covariance=tip.covariance + late)

    # --- shared ---------------------------------------------------------------------------------------------

    def _fit(self, fit: TemplateFit, markers: PadMarkers) -> Motions:
        motions = fit.fit(markers.X[None], self._last_motion)
        self._last_motion = (motions.R, motions.t) if self._usable(motions) else None
        return motions

    def _usable(self, motions: Motions) -> bool:
        """Enough markers, on both pads."""
        used = motions.weights[0] > 0
        return bool(used.sum() >= self._config.motion.min_markers and motions.sides[0].min() > 0)

    def _exposure_ns(self, stamp_ns: int) -> int:
        if self._anchoring is not None:
            return stamp_ns - round(self._anchoring.tip_map.latency_s * 1e9)
        mean_s = self._config.tip_map.latency_s if self._latency is None else self._latency[0]
        return stamp_ns - round(mean_s * 1e9)

    def _hand(self, stamp_ns: int) -> HandStates | None:
        return self._track.at([stamp_ns]) if self._track.covers(stamp_ns) else None

    def _note(self, kind: str, stamp_ns: int, detail: str) -> None:
        self.events.append(Event(kind, stamp_ns, stamp_ns, detail))


class _Rate:
    """Velocity of a point from its positions, smoothed over about a tenth of a second."""

    def __init__(self) -> None:
        self._last: tuple[int, FloatArray] | None = None
        self._v: FloatArray = np.zeros(3)

    def update(self, stamp_ns: int, x: FloatArray) -> FloatArray:
        if self._last is not None and stamp_ns > self._last[0]:
            dt = (stamp_ns - self._last[0]) * 1e-9
            keep = np.exp(-dt / 0.1)
            self._v = keep * self._v + (1.0 - keep) * (x - self._last[1]) / dt
        self._last = (stamp_ns, x)
        return self._v


def calibrated_latency(rig: Rig | None) -> tuple[float, float] | None:
    """Mean and standard deviation of capture minus exposure in s, where the rig states it for both sensors."""
    if rig is None:
        return None
    sensors = (rig.sensors.left, rig.sensors.right)
    known = [(s.latency_s, s.latency_std_s or 0.005) for s in sensors if s.latency_s is not None]
    if len(known) < 2:
        return None
    return float(np.mean([m for m, _ in known])), float(max(s for _, s in known))


def tip_prior(tool: Tool | None) -> TipPrior | None:
    """Tip and covariance from the tool's file, where it states both."""
    if tool is None or tool.tip_E_m is None or tool.tip_sigma_m is None:
        return None
    return TipPrior(np.array(tool.tip_E_m), np.diag(np.square(tool.tip_sigma_m)))


def require_tip(tool: Tool | None) -> TipPrior:
    """The tool's tip, or an error that says what to write.

    Raises:
        GeometryError: the tool's file states no tip.
    """
    prior = tip_prior(tool)
    if prior is None:
        raise GeometryError("the tool's file states no tip: add tip_E_m and tip_sigma_m to tool.yaml")
    return prior
