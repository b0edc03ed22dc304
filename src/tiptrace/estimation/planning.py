"""Which anchoring motion to make, and what it will tell (``docs/estimation.md``, Planning).

A motion is judged by the very solve that will be used: noise-free motions of a linear grasp with the rig's noise
levels go through the tip map, whose covariance is the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.config import Rig
from tiptrace.estimation.motion import MotionConfig, Motions, TemplateFit
from tiptrace.estimation.pose_track import HandStates, smooth_at
from tiptrace.estimation.tip_map import solve_tip_map
from tiptrace.estimation.tip_map_config import P, TipMapConfig
from tiptrace.geometry.transforms import invert, rotation_exp, transform
from tiptrace.types import SIDES, FloatArray

_FPS, _POSE_HZ, _LEAD_S = 25.0, 125.0, 0.3
_RAMP_S = 0.3  # of a motion's start and end
_DEFAULT_STRAIN_M = 2.5e-3
_SHIFT_SHARE = 0.3  # of a tip displacement that the tool makes by shifting in the pads; the rest it turns
_PATCH_HALF_M = 7e-3


@dataclass(frozen=True, slots=True)
class Wiggle:
    """A motion about the nominal tip: harmonics of its duration, zero at both ends.

    Attributes:
        name: What to call it.
        rotation_deg: Amplitude about x and y of the hand's start orientation.
        shift_m: Amplitude along them.
        duration_s: Length.
        about_tip: Else about the pads.
        cycles: Of rotation x, rotation y, shift x, shift y.
    """

    name: str
    rotation_deg: tuple[float, float]
    shift_m: tuple[float, float] = (0.0, 0.0)
    duration_s: float = 4.0
    about_tip: bool = True
    cycles: tuple[int, int, int, int] = (2, 1, 3, 4)

    def poses(self, s: FloatArray, tip_E: FloatArray, pads_E: FloatArray) -> FloatArray:
        """Hand relative to its start, T_E0_E (T, 4, 4), at times (T,) s."""
        a = 2 * np.pi * np.clip(s / self.duration_s, 0.0, 1.0)[:, None] * np.array(self.cycles)
        since, until = s / _RAMP_S, (self.duration_s - s) / _RAMP_S
        swell = np.clip(np.minimum(since, until), 0.0, 1.0)[:, None]  # a robot cannot start at full speed
        wave = swell * swell * (3.0 - 2.0 * swell) * np.sin(a)
        w = np.radians(self.rotation_deg) * wave[:, :2]
        R = rotation_exp(np.concatenate([w, np.zeros((len(s), 1))], axis=1))
        pivot = tip_E if self.about_tip else pads_E
        shift = np.concatenate([np.array(self.shift_m) * wave[:, 2:], np.zeros((len(s), 1))], axis=1)
        return transform(R, pivot - R @ pivot + shift)


CANDIDATES = (
    Wiggle("recommended", (10.0, 10.0), (4e-3, 4e-3)),
    Wiggle("gentle", (6.0, 6.0), (2e-3, 2e-3)),
    Wiggle("two-axis", (5.0, 5.0)),
    Wiggle("one-axis", (0.0, 5.0)),
    Wiggle("pads", (5.0, 5.0), about_tip=False),
)


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a motion will give.

    Attributes:
        wiggle: The motion.
        sigma_m: (3,) standard deviation of the tip along the start axes of the hand.
        worst_sigma_m: Along the worst direction.
        displacement_m: Largest displacement of the tip against the hand.
        pad_shear_m: Largest shear of the gel at the patch's ends.
        force_n: Largest contact force, preload included.
        speed_mps: Largest speed of the hand's origin.
        within_strain: Whether the shear stays below the pads' limit.
    """

    wiggle: Wiggle
    sigma_m: FloatArray
    worst_sigma_m: float
    displacement_m: float
    pad_shear_m: float
    force_n: float
    speed_mps: float
    within_strain: bool


@dataclass(frozen=True, slots=True)
class Task:
    """What the motion has to work with.

    Attributes:
        rig: Sensor poses and limits.
        tip_E: (3,) nominal tip, m.
        tip_sigma_m: How far off it may be, per axis; the prediction is for an error of this size.
        preload_n: Contact force after pressing down.
        stiffness_n_per_m: Of the grasp at the tip, across and along the tool.
    """

    rig: Rig
    tip_E: FloatArray
    tip_sigma_m: float = 3e-3
    preload_n: float = 3.0
    stiffness_n_per_m: tuple[float, float] = (1200.0, 3000.0)

    @property
    def pads_E(self) -> FloatArray:
        """(3,) middle between the pads."""
        return np.asarray(np.mean([self.rig.T_E_S(s)[:3, 3] for s in SIDES], axis=0))

    @property
    def strain_limit_m(self) -> float:
        """Shear that the pads bear."""
        stated = [self.rig.sensor(s).max_strain_mm for s in SIDES]
        return min((v * 1e-3 for v in stated if v is not None), default=_DEFAULT_STRAIN_M)


def predict(wiggle: Wiggle, task: Task, motion: MotionConfig | None = None) -> Prediction:
    """Standard deviations, loads and speeds of a motion."""
    s = np.arange(0.0, wiggle.duration_s, 1.0 / _FPS)
    s_pose = np.arange(-_LEAD_S, wiggle.duration_s + _LEAD_S, 1.0 / _POSE_HZ)
    track = wiggle.poses(s_pose, task.tip_E, task.pads_E)
    c = task.tip_E + task.tip_sigma_m * np.array([1.0, -1.0, 1.0]) / np.sqrt(
        3.0
    )  # where the tip may really be
    T = wiggle.poses(s, task.tip_E, task.pads_E)
    u = np.einsum("tij,j->ti", invert(T)[:, :3, :3], c) + invert(T)[:, :3, 3] - c  # (T, 3) tip held at c
    motions = _motions(u, c, task, motion or MotionConfig())

    def hand_at(latency_s: float) -> HandStates:
        return smooth_at(s_pose * 1e9, track, (s - latency_s) * 1e9, 0.05)

    config = TipMapConfig()
    phase = s / wiggle.duration_s - 1.0
    tip_map = solve_tip_map(motions, hand_at, phase, wiggle.duration_s, config, (0.0, config.latency_std_s))
    covariance = tip_map.covariance[P, P]
    moved = float(np.linalg.norm(u, axis=1).max())
    lever = float(np.linalg.norm(c - task.pads_E))
    shear = moved * (_SHIFT_SHARE + (1 - _SHIFT_SHARE) * _PATCH_HALF_M / lever)
    across, along = task.stiffness_n_per_m
    force = task.preload_n + float(np.hypot(across * np.linalg.norm(u[:, :2], axis=1), along * u[:, 2]).max())
    return Prediction(
        wiggle=wiggle,
        sigma_m=np.sqrt(np.diag(covariance)),
        worst_sigma_m=float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])),
        displacement_m=moved,
        pad_shear_m=shear,
        force_n=force,
        speed_mps=float(np.linalg.norm(np.diff(track[:, :3, 3], axis=0), axis=1).max() * _POSE_HZ),
        within_strain=shear <= task.strain_limit_m,
    )


def _motions(u: FloatArray, c: FloatArray, task: Task, config: MotionConfig) -> Motions:
    """Exact in-grasp motions that displace the tip by u, with the covariance of a plain patch of markers."""
    M, pad, axes = _patch(task)
    lever = c - task.pads_E
    shift = u * np.array([_SHIFT_SHARE, _SHIFT_SHARE, 1.0])
    w = np.cross(lever, u - shift) / float(lever @ lever)
    R = rotation_exp(w)
    t = c + u - np.einsum("tij,j->ti", R, c)
    fit = TemplateFit(M, pad, axes, np.ones(len(M)), config)
    X = M @ np.swapaxes(R, 1, 2) + t[:, None]
    fitted = fit.fit(X)
    return Motions(
        R, t, fitted.covariance, fitted.centre, fitted.residual_m, fitted.weights, fitted.chi2, fitted.sides
    )


def _patch(task: Task) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Interior markers of a tool some 8 mm wide: 3 × 7 per pad at 2 mm."""
    v, u = np.meshgrid(np.arange(-1, 2) * 2e-3, np.arange(-3, 4) * 2e-3)
    flat = np.stack([u.ravel(), v.ravel(), np.full(u.size, -1e-3)], axis=1)
    T = [task.rig.T_E_S(side) for side in SIDES]
    M = np.concatenate([flat @ t[:3, :3].T + t[:3, 3] for t in T])
    return M, np.repeat([0, 1], len(flat)), np.stack([t[:3, :3] for t in T])
