"""Stage I as it comes in: bounded memory, a running estimate, and the solve at its end."""

from __future__ import annotations

from collections import deque
from copy import copy, deepcopy
from dataclasses import dataclass, replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tiptrace.errors import GeometryError
from tiptrace.estimation.anchor import TipPrior, covariance_from_information
from tiptrace.estimation.grasp_slips import GraspSlipConfig, Parts, only, through_slips
from tiptrace.estimation.integrity_reference import Reference, reference
from tiptrace.estimation.motion import MotionConfig, Motions, TemplateFit
from tiptrace.estimation.pads import PadMarkers
from tiptrace.estimation.patch import PatchConfig, trust
from tiptrace.estimation.pose_track import HandStates, smooth_at
from tiptrace.estimation.tip_map import TipMap, assumed_tip_map, solve_tip_map
from tiptrace.estimation.tip_map_config import DRIFT, TAU, C, TipMapConfig
from tiptrace.geometry.transforms import skew
from tiptrace.types import SIDES, BoolArray, FloatArray, IntArray, PoseSample, Side


class StageOneConfig(BaseModel):
    """Memory and effort."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    memory_frames: int = Field(default=1500, ge=10)
    memory_poses: int = Field(default=30000, ge=100)
    solve_frames: int = Field(default=250, ge=10)  # more are thinned out evenly
    template_rounds: int = Field(default=3, ge=1)
    slips: GraspSlipConfig = GraspSlipConfig()


@dataclass(frozen=True, slots=True)
class Anchoring:
    """What Stage I leaves for Stage II."""

    tip_map: TipMap
    fit: TemplateFit
    trust: FloatArray
    stamps_ns: FloatArray
    motions: Motions
    hand: HandStates | None
    reference: Reference
    start_ns: int
    slips_ns: tuple[tuple[int, int], ...] = ()  # last frame before and first after each slip in it

    @property
    def tool_rotations(self) -> FloatArray:
        """(T, 3, 3) rotations of the tool in F_B."""
        if self.hand is None:
            return self.motions.R
        return np.asarray(self.hand.T_B_E[:, :3, :3] @ self.motions.R)

    @property
    def chosen(self) -> dict[Side, IntArray]:
        """Indices of the markers in use per finger."""
        return {side: np.flatnonzero(self.trust[self.fit.pad == pad] > 0.0) for pad, side in enumerate(SIDES)}

    def carried_over(self, stamp_ns: int, sigma_m: float = 2e-4) -> Anchoring:
        """The same grasp in a later trial: no more drift, a little less certain."""
        theta, covariance = self.tip_map.theta.copy(), self.tip_map.covariance.copy()
        theta[DRIFT] = 0.0
        covariance[C, C] += sigma_m**2 * np.eye(3)
        return replace(
            self, tip_map=replace(self.tip_map, theta=theta, covariance=covariance), start_ns=stamp_ns
        )

    def with_latency(self, other: TipMap) -> Anchoring:
        """The same anchor with the time offset of another solve."""
        theta, covariance = self.tip_map.theta.copy(), self.tip_map.covariance.copy()
        theta[TAU] = other.latency_s
        covariance[TAU, :] = covariance[:, TAU] = 0.0
        covariance[TAU, TAU] = other.covariance[TAU, TAU]
        return replace(self, tip_map=replace(self.tip_map, theta=theta, covariance=covariance))

    def phase(self, stamp_ns: float) -> float:
        """t/T_I − 1."""
        return (stamp_ns - self.start_ns) * 1e-9 / self.tip_map.duration_s - 1.0


class StageOne:
    """Collects the anchoring segment."""

    def __init__(
        self,
        config: StageOneConfig,
        patch: PatchConfig,
        motion: MotionConfig,
        tip_map: TipMapConfig,
        half_width_s: float,
    ) -> None:
        self._config, self._patch, self._motion, self._tip_map = config, patch, motion, tip_map
        self._half_s = half_width_s
        self._frames: deque[tuple[int, PadMarkers]] = deque(maxlen=config.memory_frames)
        self._poses: deque[PoseSample] = deque(maxlen=config.memory_poses)
        self._sum_S: FloatArray | None = None
        self._seen: FloatArray | None = None
        self._count = 0
        self._fitted: tuple[FloatArray, FloatArray, TemplateFit, FloatArray, Motions] | None = None

    def __len__(self) -> int:
        return self._count

    def add_poses(self, poses: tuple[PoseSample, ...]) -> None:
        """Pose samples of the segment."""
        last = self._poses[-1].stamp_ns if self._poses else -1
        self._poses.extend(p for p in poses if p.stamp_ns > last)

    def add(self, stamp_ns: int, markers: PadMarkers) -> None:
        """A frame of the segment."""
        if self._sum_S is None or self._seen is None:
            self._sum_S, self._seen = np.zeros_like(markers.x_S), np.zeros(len(markers.x_S))
        self._tally(markers, 1)
        self._frames.append((stamp_ns, markers))

    def _tally(self, markers: PadMarkers, sign: int) -> None:
        assert self._sum_S is not None
        assert self._seen is not None
        seen = np.isfinite(markers.x_S[:, 0])
        self._sum_S += np.where(seen[:, None], sign * markers.x_S, 0.0)
        self._seen += sign * seen
        self._count += sign

    def trust(self) -> FloatArray:
        """(N,) weight of every marker, from its mean place so far."""
        assert self._sum_S is not None
        assert self._seen is not None
        seen = self._seen[:, None]
        mean = np.where(seen > 0.5 * self._count, self._sum_S / np.maximum(seen, 1.0), np.nan)
        pad = self._frames[-1][1].pad
        return np.concatenate([trust(mean[pad == k], self._patch) for k in (0, 1)])

    def first_fit(self) -> TemplateFit:
        """Fit to the mean of the first frames, for the running estimate."""
        head = [m for _, m in list(self._frames)[:5]]
        M = _first_seen(np.stack([m.X for m in head]))
        return TemplateFit(M, head[0].pad, head[0].axes, self.trust(), self._motion)

    def solve(
        self, latency: tuple[float, float] | None, prior: TipPrior | None, known: TipMap | None = None
    ) -> Anchoring:
        """Template, motions and tip map of the segment; ``known`` is an earlier map of the same gels.

        Raises:
            GeometryError: too few frames, markers or poses.
        """
        stamps, X, fit, weights, motions = self._fitted or self._fit_template()
        duration = max((stamps[-1] - stamps[0]) * 1e-9, 1e-3)
        good: BoolArray = motions.sides[:, 0] * motions.sides[:, 1] > 0
        if good.sum() < 3:
            raise GeometryError("Stage I has fewer than 3 frames with markers on both fingers")
        kept, X = stamps[good], X[good]
        phase = (kept - stamps[0]) * 1e-9 / duration - 1.0
        track = np.array([p.stamp_ns for p in self._poses], dtype=np.float64)
        T = np.array([p.T_B_E for p in self._poses])
        if len(track) < 4:
            raise GeometryError(f"Stage I has {len(track)} end-effector poses, at least 4 are needed")

        def hand_at(latency_s: float) -> HandStates:
            return smooth_at(track, T, kept - latency_s * 1e9, self._half_s)

        def solution(p: Parts) -> TipMap:
            return solve_tip_map(
                p.motions,
                hand_at,
                phase,
                duration,
                self._tip_map,
                latency,
                prior,
                self._normal,
                known,
                p.steps,
            )

        whole = Parts([fit], [only(motions, good)], [], X)
        parts, tip_map = through_slips(whole, solution, self._motion, self._config.slips)
        ref = parts.reference(tip_map.c, self._normal)
        hand = hand_at(tip_map.latency_s)
        slips = tuple((int(kept[k - 1]), int(kept[k])) for k in parts.cuts)
        return Anchoring(tip_map, parts.last, weights, kept, parts.motions, hand, ref, int(stamps[0]), slips)

    def assume(self, tip: TipPrior, latency: tuple[float, float] | None) -> Anchoring:
        """Stand-in for Stage I with a tip from elsewhere: the first frames only give the template."""
        fit = self.first_fit()
        X = np.stack([m.X for _, m in self._frames])
        motions = fit.fit(X)
        tip_map = assumed_tip_map(tip, self._tip_map, latency, self._normal)
        stamps = np.array([s for s, _ in self._frames], dtype=np.float64)
        ref = reference(fit, X, motions, tip.c, self._normal, staged=False)
        return Anchoring(tip_map, fit, self.trust(), stamps, motions, None, ref, int(stamps[0]))

    @property
    def centre_E(self) -> FloatArray:
        """(3,) middle of the pads in F_E."""
        return np.asarray(np.nanmean(self._frames[-1][1].X, axis=0))

    @property
    def _normal(self) -> FloatArray:
        return self._frames[-1][1].axes[0, :, 2]

    def fresh(self) -> StageOne:
        """An empty segment with the same settings in which no slips are sought: in mid-trial they are watched for."""
        still = self._config.model_copy(update={"slips": self._config.slips.model_copy(update={"most": 0})})
        return StageOne(still, self._patch, self._motion, self._tip_map, self._half_s)

    def copy(self) -> StageOne:
        """The segment as it is now, to be solved later; nothing is added to a copy."""
        other = copy(self)
        other._frames, other._poses = self._frames.copy(), self._poses.copy()
        other._sum_S, other._seen = deepcopy((self._sum_S, self._seen))
        return other

    def prepare(self) -> None:
        """Fit a copy's template, so that its solves have less to do."""
        self._fitted = self._fit_template()

    def keep_from(self, stamp_ns: int) -> None:
        """Forget frames and poses before an instant."""
        while self._frames and self._frames[0][0] < stamp_ns:
            self._tally(self._frames.popleft()[1], -1)
        while self._poses and self._poses[0].stamp_ns < stamp_ns - 500_000_000:
            self._poses.popleft()

    def keep_until(self, stamp_ns: int) -> None:
        """Forget frames after an instant: the segment turned out to have ended there."""
        while len(self._frames) > 3 and self._frames[-1][0] > stamp_ns:
            self._frames.pop()

    def _fit_template(self) -> tuple[FloatArray, FloatArray, TemplateFit, FloatArray, Motions]:
        """Template from all frames, alternating with the motions."""
        if len(self._frames) < 3:
            raise GeometryError(f"Stage I has {len(self._frames)} frames, at least 3 are needed")
        step = -(-len(self._frames) // self._config.solve_frames)
        frames = list(self._frames)[::step]
        stamps = np.array([s for s, _ in frames], dtype=np.float64)
        X = np.stack([m.X for _, m in frames])  # (T, N, 3)
        first, weights = frames[0][1], self.trust()
        M, start = _first_seen(X), None
        for _ in range(self._config.template_rounds):
            fit = TemplateFit(M, first.pad, first.axes, weights, self._motion)
            motions = fit.fit(X, start)
            M, start = fit.refined_template(X, motions), (motions.R, motions.t)
        fit = TemplateFit(M, first.pad, first.axes, weights, self._motion)
        return stamps, X, fit, weights, fit.fit(X, start)


def _first_seen(X: FloatArray) -> FloatArray:
    """Mean of the first frames in which each marker is seen, (T, N, 3) → (N, 3)."""
    head = X[: max(1, min(5, len(X)))]
    seen: BoolArray = np.isfinite(head[..., 0])
    total = np.maximum(seen.sum(axis=0), 1)[:, None]
    M = np.where(seen[..., None], head, 0.0).sum(axis=0) / total
    return np.asarray(np.where(np.any(seen, axis=0).reshape(-1, 1), M, np.nan))


class RunningTip:
    """Tip so far during Stage I: 6×6 normal equations of ``T_B_E (R c + t) = p``, the gel taken at its word.

    That the gel may show a tenth less or more is carried as one common unknown that is considered, not solved for.
    """

    def __init__(self, prior: TipPrior | None, sigma_m: float, gain_sigma: float) -> None:
        self._N, self._b, self._frames = np.zeros((6, 6)), np.zeros(6), 0
        self._gain = np.zeros(6)  # Aᵀ W ∂y/∂gain
        self._gain_sigma, self._sigma_m = gain_sigma, sigma_m
        self._lever: FloatArray = np.array([0.0, 0.0, 0.06]) if prior is None else prior.c
        self._from_centre = prior is None
        if prior is not None:
            self._N[:3, :3] = np.linalg.inv(prior.covariance)
            self._b[:3] = self._N[:3, :3] @ prior.c

    def add(self, motions: Motions, T_B_E: FloatArray) -> None:
        """One frame."""
        R_BE, t_BE, R, t = T_B_E[:3, :3], T_B_E[:3, 3], motions.R[0], motions.t[0]
        c = motions.centre[0] + self._lever if self._from_centre else self._lever
        B = np.concatenate([-skew(c - motions.centre[0]), np.eye(3)], axis=1)
        S = B @ motions.covariance[0] @ B.T + self._sigma_m**2 * np.eye(3)
        W = R_BE @ np.linalg.inv(S) @ R_BE.T
        A = np.concatenate([R_BE @ R, -np.eye(3)], axis=1)
        AW = A.T @ W
        self._N += AW @ A
        self._b -= AW @ (R_BE @ t + t_BE)
        self._gain += AW @ (R_BE @ (R @ c + t - c))
        self._frames += 1

    def solve(self) -> tuple[FloatArray, FloatArray] | None:
        """(p, its covariance), None before there is any."""
        if self._frames < 3:
            return None
        covariance = covariance_from_information(self._N)
        theta = covariance @ self._b
        shift = self._gain_sigma * (covariance @ self._gain)
        total = covariance + np.outer(shift, shift)
        return theta[3:], total[3:, 3:]
