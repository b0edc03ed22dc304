"""The rig of a trial, twice: as it is, and as its user believes it to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.config import Gripper, Rig, Sensor, Sensors, Tool, Transform, TransformStd
from tiptrace.geometry.transforms import quaternion_from_rotation, rotation_exp, transform
from tiptrace.sim.conditions import Hold
from tiptrace.sim.disturbances import Disturbances
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.tools import ToolShape
from tiptrace.types import SIDES, FloatArray, Side

PADS_E = np.array([0.0, 0.0, 0.140])
CALIBRATED_OPENING_M = 6.2e-3
MM_PER_PX = 0.0625
IMAGE_SIZE_PX = (320, 240)
MARKER_THRESHOLD = (0.0, 50.0)  # the usual 70 also takes 16 % of the dot-free gel, its dark corners
_ROOT_HALF = float(np.sqrt(0.5))
_QUATERNION: dict[Side, tuple[float, float, float, float]] = {
    "left": (0.0, -_ROOT_HALF, 0.0, _ROOT_HALF),
    "right": (_ROOT_HALF, 0.0, _ROOT_HALF, 0.0),
}
SIGN: dict[Side, float] = {"left": 1.0, "right": -1.0}


def true_rig(spec: TrialSpec) -> Rig:
    """The rig without any error, at the opening at which it was calibrated."""

    def sensor(side: Side) -> Sensor:
        x = SIGN[side] * 0.5 * CALIBRATED_OPENING_M
        return Sensor(
            image_size_px=IMAGE_SIZE_PX,
            mm_per_px=(MM_PER_PX, MM_PER_PX),
            T_E_S=Transform(translation_m=(x, 0.0, float(PADS_E[2])), quaternion_xyzw=_QUATERNION[side]),
            marker_threshold=MARKER_THRESHOLD,
            marker_pitch_mm=round(spec.marker_pitch_m * 1e3, 6),
        )

    gripper = Gripper(opening_m=CALIBRATED_OPENING_M, closing_axis_E=(1.0, 0.0, 0.0))
    return Rig(gripper=gripper, sensors=Sensors(left=sensor("left"), right=sensor("right")))


def true_opening_m(spec: TrialSpec, tool: ToolShape) -> float:
    """Gel surface to gel surface: the tool's thickness less what it presses into both."""
    return tool.thickness_m - 2.0 * spec.indentation_m


def _unit(rng: np.random.Generator) -> FloatArray:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def believed_rig(truth: Rig, d: Disturbances, rng: np.random.Generator) -> Rig:
    """The rig with the errors of its calibration."""
    sensors: dict[str, Sensor] = {}
    for side in SIDES:
        sensor = truth.sensor(side)
        w, shift, scale = _unit(rng), _unit(rng), rng.normal(size=2)
        T = sensor.T_E_S.matrix()
        T[:3, :3] = T[:3, :3] @ rotation_exp(np.radians(d.T_E_S_rotation_deg) * w)
        T[:3, 3] += d.T_E_S_translation_m * shift
        std = TransformStd(rotation_deg=d.T_E_S_rotation_deg, translation_m=d.T_E_S_translation_m)
        sensors[side] = sensor.model_copy(
            update={
                "T_E_S": _as_written(T),
                "T_E_S_std": std if d.T_E_S_rotation_deg or d.T_E_S_translation_m else None,
                "mm_per_px": tuple(float(MM_PER_PX * (1.0 + d.mm_per_px * s)) for s in scale),
                "latency_s": d.latency_s if d.latency_known else None,
                "latency_std_s": 0.001 if d.latency_known else None,
            }
        )
    return truth.model_copy(update={"sensors": Sensors(left=sensors["left"], right=sensors["right"])})


def _as_written(T: FloatArray) -> Transform:
    x, y, z, w = (float(c) for c in quaternion_from_rotation(T[:3, :3]))
    tx, ty, tz = (float(c) for c in T[:3, 3])
    return Transform(translation_m=(tx, ty, tz), quaternion_xyzw=(x, y, z, w))


def believed_tool(tool: ToolShape, nominal_tip_E: FloatArray, sigma_m: float) -> Tool:
    """What the user knows of the tool: its thickness, and a tip that is off by σ."""
    x, y, z = (float(c) for c in nominal_tip_E)
    sigma = max(sigma_m, 0.5e-3)
    return Tool(
        thickness_m=tool.thickness_m,
        tip_E_m=(x, y, z),
        tip_sigma_m=(sigma, sigma, sigma),
        tip_radius_m=tool.tip_radius_m,
    )


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the closing fingers find the tool: its pose in F_E before any load."""

    R: FloatArray
    p: FloatArray

    @classmethod
    def of(cls, hold: Hold, tool: ToolShape) -> Placement:
        """The tool turned about the closing axis, its gripped point at the pads' centre."""
        R = rotation_exp([np.radians(hold.angle_deg), 0.0, 0.0])
        gripped_T = tool.shank_T + np.array([0.0, hold.offset_m, -hold.above_tip_m])
        return cls(R, PADS_E - R @ gripped_T)

    @property
    def T_E_T(self) -> FloatArray:
        """(4, 4)."""
        return transform(self.R, self.p)
