"""A grasp with known truth for the estimators' tests: linear, noisy, without any of the virtual rig's physics.

The tool turns about the middle of the pads and shifts with them when its tip is displaced against the hand by u:
``D(c) = u`` exactly, which is all that the estimators assume. Gels then show a part of the markers' motion.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tiptrace.config import Gripper, Rig, Sensor, Sensors, Transform
from tiptrace.geometry.transforms import apply, interpolate, invert, rotation_exp, transform
from tiptrace.types import (
    FingerMarkers,
    FloatArray,
    Phase,
    PoseSample,
    SensedFinger,
    SensedPair,
)

RATE_HZ = 25
POSE_RATE_HZ = 125
PAD_E = np.array([0.0, 0.0, 0.14])
Q_LEFT, Q_RIGHT = (0.0, -(0.5**0.5), 0.0, 0.5**0.5), (0.5**0.5, 0.0, 0.5**0.5, 0.0)


def rig(latency_s: float | None = 0.0, latency_std_s: float | None = 1e-4) -> Rig:
    def sensor(x: float, q: tuple[float, float, float, float]) -> Sensor:
        return Sensor(
            mm_per_px=(0.0625, 0.0625),
            T_E_S=Transform(translation_m=(x, 0.0, 0.14), quaternion_xyzw=q),
            latency_s=latency_s,
            latency_std_s=latency_std_s,
        )

    return Rig(
        gripper=Gripper(opening_m=0.0062, closing_axis_E=(1.0, 0.0, 0.0)),
        sensors=Sensors(left=sensor(0.0031, Q_LEFT), right=sensor(-0.0031, Q_RIGHT)),
    )


@dataclass
class Synthetic:
    """One trial; ``pairs()`` gives what an estimator sees, ``truth`` the tip at the same instants."""

    seed: int = 0
    anchor_motion: str = "recommended"
    in_plane_m: float = 3e-5
    depth_m: float = 1e-4
    shown: tuple[float, float] = (1.0, 1.0)  # shear, depth
    latency_s: float = 0.0
    tip_offset_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    pose_noise: tuple[float, float] = (0.0, 0.0)  # m, rad
    anchoring_s: float = 4.0
    travel_s: float = 4.0
    slip_rad: float = 0.0  # about the closing axis, half way through the travel
    c: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 0.2]))

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.c_true = self.c + self.tip_offset_m
        v, u = np.meshgrid(np.linspace(-6, 6, 7), np.linspace(-8, 8, 9))
        flat = np.stack([u.ravel(), v.ravel(), np.zeros(63)], axis=1) * 1e-3
        flat[:, 2] = np.where(np.abs(flat[:, 1]) < 5e-3, -1.2e-3, 0.0)  # the tool is 10 mm wide
        self.flat_S = flat
        self.rig = rig()
        self.T_E_S = {side: self.rig.T_E_S(side) for side in ("left", "right")}
        self.tip_0 = np.array([0.4, 0.1, 0.02])
        self.R_0 = np.diag([1.0, -1.0, -1.0])

    def _hand_and_tip(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """T_B_E (T, 4, 4) and the true tip (T, 3) at times s."""
        a = np.clip(s / self.anchoring_s, 0.0, 1.0) * 2 * np.pi
        angle = {"recommended": 10.0, "two-axis": 5.0, "one-axis": 5.0, "pads": 5.0}[self.anchor_motion]
        second = 0.0 if self.anchor_motion == "one-axis" else 1.0
        w = np.deg2rad(angle) * np.stack([np.sin(a), second * np.sin(2 * a), 0 * a], axis=1)
        shift = (
            4e-3
            * np.stack([np.sin(3 * a), np.sin(4 * a), 0 * a], axis=1)
            * (self.anchor_motion == "recommended")
        )
        R = rotation_exp(w) @ self.R_0
        pivot = PAD_E if self.anchor_motion == "pads" else self.c  # about the nominal tip
        start = self.tip_0 - self.R_0 @ self.c_true  # the hand at s = 0
        t = start + self.R_0 @ pivot - R @ pivot + shift
        x = 0.02 * np.clip(s - self.anchoring_s, 0.0, None)
        t = t + np.stack([x, 0 * x, 0 * x], axis=1)
        sideways = 3e-3 * np.sin(2 * np.pi * x / 0.05)
        tip = self.tip_0 + np.stack([x, sideways, 0 * x], axis=1)
        return transform(R, t), tip

    def _in_grasp(self, u: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Motion of the tool in F_E that displaces its tip by u: 30 % shift, the rest rotation about the pads."""
        lever = self.c_true - PAD_E
        shift = u * np.array([0.3, 0.3, 1.0])
        target = lever + u - shift
        axis = np.cross(np.broadcast_to(lever, u.shape), target)
        sine = np.linalg.norm(axis, axis=1, keepdims=True)
        angle = np.arctan2(sine, target @ lever[:, None])
        twist = 0.5 * u[:, :1] / 0.06 * np.array([[0.0, 0.0, 1.0]])  # some rotation about the tool's own axis
        R = rotation_exp(axis / np.maximum(sine, 1e-15) * angle) @ rotation_exp(twist)
        return R, lever + u - np.einsum("tij,j->ti", R, lever)  # D(c) = u exactly

    def run(self) -> None:
        n = int((self.anchoring_s + self.travel_s) * RATE_HZ)
        self.s = np.arange(n) / RATE_HZ + 0.5
        s_pose = np.arange(0, n / RATE_HZ + 0.6, 1 / POSE_RATE_HZ)
        T_pose, _ = self._hand_and_tip(s_pose - 0.5)
        noise = transform(
            rotation_exp(self.pose_noise[1] * self.rng.standard_normal((len(s_pose), 3))),
            np.zeros((len(s_pose), 3)),
        )
        T_pose = T_pose @ noise
        T_pose[:, :3, 3] += self.pose_noise[0] * self.rng.standard_normal((len(s_pose), 3))
        self.poses = [PoseSample(int(a * 1e9), T) for a, T in zip(s_pose, T_pose, strict=True)]
        T_true, self.truth = self._hand_and_tip(self.s - 0.5 - self.latency_s)
        self.T_true = T_true
        u = np.einsum("tij,tj->ti", invert(T_true)[:, :3, :3], self.truth - T_true[:, :3, 3]) - self.c_true
        self.u = u
        R, d = self._in_grasp(u, self.s)
        if self.slip_rad:
            pass
        self.R_E, self.d_E = R, d

    def _markers(self, side: str, k: int) -> FloatArray:
        T_E_S = self.T_E_S[side]
        rest = apply(T_E_S, self.flat_S)
        moved = (rest - PAD_E) @ self.R_E[k].T + PAD_E + self.d_E[k]
        on_tool = self.flat_S[:, 2] < 0
        change = np.where(on_tool[:, None], apply(invert(T_E_S), moved) - self.flat_S, 0.0)
        change *= np.array([self.shown[0], self.shown[0], self.shown[1]])
        noise = self.rng.standard_normal((63, 3)) * np.array([self.in_plane_m, self.in_plane_m, self.depth_m])
        return np.asarray(self.flat_S + change + noise)

    def pairs(self) -> list[SensedPair]:
        self.run()
        out, at = [], 0
        stamps = [p.stamp_ns for p in self.poses]
        for k, s in enumerate(self.s):
            stamp = int(s * 1e9)
            last = int(np.searchsorted(stamps, stamp, side="right"))
            a, b = self.poses[last - 1], self.poses[last]
            T = interpolate(a.T_B_E, b.T_B_E, (stamp - a.stamp_ns) / (b.stamp_ns - a.stamp_ns))
            fingers = {}
            for side in ("left", "right"):
                x = self._markers(side, k)
                fingers[side] = SensedFinger(FingerMarkers(x, np.isfinite(x[:, 0])), T, self.T_E_S[side])
            phase = Phase.ANCHORING if s - 0.5 < self.anchoring_s else Phase.RECONSTRUCTION
            poses = tuple(self.poses[at : last + 1])
            at = last + 1
            out.append(SensedPair(stamp, phase, fingers["left"], fingers["right"], poses))
        return out
