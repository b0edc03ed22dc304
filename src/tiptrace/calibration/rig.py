"""The rig from calibration wiggles: what it was, what it is, and how sure that is (``docs/calibration.md``, Rig)."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date

import numpy as np

from tiptrace.calibration.rig_data import Segment
from tiptrace.calibration.rig_equations import POS, ROT, SIZE, TAU, K, SensorState
from tiptrace.calibration.rig_pitch import pitch_scale
from tiptrace.calibration.rig_solve import Pitch, Solution, solve_rig, start_state
from tiptrace.calibration.rig_start import check_arrangement, check_motion
from tiptrace.config import Rig, Sensor, Sensors, Transform, TransformStd
from tiptrace.errors import CalibrationError
from tiptrace.geometry.transforms import quaternion_from_rotation, rotation_log
from tiptrace.types import SIDES, FloatArray, Side

WANTED_POS_M, WANTED_ROT_RAD, WANTED_SCALE = 0.3e-3, np.radians(0.5), 0.005
_NOISY_M = 8e-5  # in-plane residual beyond which the rod did not stand still, or the markers slipped
_CONTRADICTION = 3.5  # sigmas between scale by motion and by pitch
_GAIN_LEFT_OUT, _LATENCY_LEFT_OUT_S = 0.008, 1.2e-3  # what a gel that is not linear adds to their errors
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class SensorCalibration:
    """One finger.

    Attributes:
        side: Finger.
        T_E_S: (4, 4) where the gripper stands at the opening that the rig states.
        rotation_std_rad: (3,) about the axes of F_S.
        translation_std_m: (3,) along the axes of F_S.
        mm_per_px: (2,).
        mm_per_px_std: (2,).
        gain: (3,) what the gel shows of its surface's motion along x and y, and of depth (NaN without depth).
        gain_std: (3,).
        latency_s: Capture stamp minus exposure.
        latency_std_s: Its standard deviation.
        turned_rad: (3,) rotation vector from the old T_E_S to the new one, in F_S.
        shifted_m: (3,) translation from the old to the new, in F_S.
        scaled: (2,) new over old mm-per-px.
    """

    side: Side
    T_E_S: FloatArray
    rotation_std_rad: FloatArray
    translation_std_m: FloatArray
    mm_per_px: FloatArray
    mm_per_px_std: FloatArray
    gain: FloatArray
    gain_std: FloatArray
    latency_s: float
    latency_std_s: float
    turned_rad: FloatArray
    shifted_m: FloatArray
    scaled: FloatArray


@dataclass(frozen=True, slots=True)
class RigCalibration:
    """Result.

    Attributes:
        rig: The new rig; what is not calibrated is as in the old one.
        sensors: By side.
        covariance: (24, 24) of both sensors' unknowns, left first: rotation and translation in F_S, ln of the scale's
            correction (2), ln of the gains (3), latency.
        residual_m: Noise of the markers along the gel.
        weak: Sentences on what the wiggle leaves open, and what to do.
    """

    rig: Rig
    sensors: dict[Side, SensorCalibration]
    covariance: FloatArray
    residual_m: float
    weak: tuple[str, ...]


def calibrate_rig(segments: list[Segment], rig: Rig, *, use_pitch: bool = True) -> RigCalibration:
    """Solve T_E_S, scale, gains and latency of both sensors.

    Args:
        segments: One or more wiggles, all with the same sensors; their gripper openings may differ.
        rig: What is believed; also tells the markers' pitch and how the pads move with the opening.
        use_pitch: Take the markers' printed pitch into account where the rig states it.

    Raises:
        CalibrationError: no wiggle, too small a motion, sensors that are swapped, mirrored, turned or inverted.
    """
    if not segments:
        raise CalibrationError("no calibration wiggle given")
    about_E: FloatArray = np.mean([rig.T_E_S(s)[:3, 3] for s in SIDES], axis=0)
    check_motion(segments, about_E)
    looks = check_arrangement(segments, rig, about_E)
    first = segments[0].pads
    start = {s: start_state(rig, s, looks[s], first[s].shift_E) for s in SIDES}
    unknown = Pitch(np.zeros(2), np.full(2, np.inf))
    pitch: dict[Side, Pitch] = {
        s: pitch_scale(first[s], rig.sensor(s).marker_pitch_mm) if use_pitch else unknown for s in SIDES
    }
    by_motion = solve_rig(segments, start, dict.fromkeys(SIDES, unknown), about_E)
    solution, contradictions = by_motion, _contradictions(by_motion, pitch)
    if any(np.isfinite(p.sigma).any() for p in pitch.values()):
        solution = solve_rig(segments, by_motion.sensors, pitch, about_E)
    sensors = {s: _sensor(s, n, solution, rig, segments) for n, s in enumerate(SIDES)}
    weak = (*contradictions, *_weak(sensors), *_restless(solution))
    return RigCalibration(_written(rig, sensors), sensors, solution.covariance, solution.in_plane_m, weak)


def _sensor(side: Side, n: int, solution: Solution, rig: Rig, segments: list[Segment]) -> SensorCalibration:
    state: SensorState = solution.sensors[side]
    sigma = np.sqrt(np.diag(solution.covariance))[n * SIZE : (n + 1) * SIZE]
    old = rig.sensor(side)
    T_old, mm = old.T_E_S.matrix(), np.array(old.mm_per_px) / state.k
    gain, gain_std = state.g.copy(), np.hypot(state.g * sigma[8:11], _GAIN_LEFT_OUT)
    if not all(s.pads[side].has_depth for s in segments):
        gain[2] = gain_std[2] = np.nan
    return SensorCalibration(
        side=side,
        T_E_S=state.T_E_S,
        rotation_std_rad=sigma[ROT],
        translation_std_m=sigma[POS],
        mm_per_px=mm,
        mm_per_px_std=mm * sigma[K],
        gain=gain,
        gain_std=gain_std,
        latency_s=state.latency_s,
        latency_std_s=float(np.hypot(sigma[TAU], _LATENCY_LEFT_OUT_S)),
        turned_rad=rotation_log(T_old[:3, :3].T @ state.T_E_S[:3, :3]),
        shifted_m=T_old[:3, :3].T @ (state.T_E_S[:3, 3] - T_old[:3, 3]),
        scaled=1.0 / state.k,
    )


def _written(rig: Rig, sensors: dict[Side, SensorCalibration]) -> Rig:
    """The old rig with what was calibrated.

    Raises:
        CalibrationError: the result is no rig: the sensors do not face each other.
    """
    new: dict[str, Sensor] = {}
    for side in SIDES:
        s = sensors[side]
        x, y, z, w = (float(v) for v in quaternion_from_rotation(s.T_E_S[:3, :3]))
        tx, ty, tz = (float(v) for v in s.T_E_S[:3, 3])
        std = TransformStd(
            rotation_deg=float(np.degrees(s.rotation_std_rad.max())),
            translation_m=min(float(s.translation_std_m.max()), 0.1),
        )
        update = {
            "T_E_S": Transform(translation_m=(tx, ty, tz), quaternion_xyzw=(x, y, z, w)),
            "T_E_S_std": std,
            "mm_per_px": (float(s.mm_per_px[0]), float(s.mm_per_px[1])),
            "latency_s": s.latency_s,
            "latency_std_s": s.latency_std_s,
            "calibrated": date.today().isoformat(),
        }
        new[side] = rig.sensor(side).model_copy(update=update)
    both = Sensors(left=new["left"], right=new["right"])
    try:
        return Rig.model_validate(rig.model_copy(update={"sensors": both}).model_dump())
    except ValueError as error:
        raise CalibrationError(f"the calibrated rig is none: {error}") from None


def _weak(sensors: dict[Side, SensorCalibration]) -> list[str]:
    """What stays less well known than a reconstruction wants."""
    sentences = []
    for side, s in sensors.items():
        for k in range(3):
            if s.translation_std_m[k] > WANTED_POS_M:
                sentences.append(
                    f"the {side} sensor's place along its {_AXES[k]} is known only to "
                    f"{s.translation_std_m[k] * 1e3:.2f} mm: wiggle longer, or turn the hand more (up to 3°)"
                )
            if s.rotation_std_rad[k] > WANTED_ROT_RAD:
                sentences.append(
                    f"the {side} sensor's orientation about its {_AXES[k]} is known only to "
                    f"{np.degrees(s.rotation_std_rad[k]):.2f}°: wiggle longer, or shift the hand more"
                )
        for k in range(2):
            share = float(s.mm_per_px_std[k] / s.mm_per_px[k])
            if share > WANTED_SCALE:
                sentences.append(
                    f"mm-per-px of the {side} sensor along {_AXES[k]} is known only to {share:.1%}: state "
                    "marker_pitch_mm in the rig file and add images of the untouched gels; else wiggle longer, or "
                    f"hold a rod that covers more of the gel along {_AXES[k]}"
                )
    return sentences


def _contradictions(by_motion: Solution, pitch: dict[Side, Pitch]) -> list[str]:
    """Scale by motion against scale by pitch."""
    sentences = []
    for n, side in enumerate(SIDES):
        for k in range(2):
            known = pitch[side]
            if not np.isfinite(known.sigma[k]):
                continue
            off = float(known.log_k[k] - np.log(by_motion.sensors[side].k[k]))
            sigma = float(
                np.hypot(known.sigma[k], np.sqrt(by_motion.covariance[n * SIZE + 6 + k, n * SIZE + 6 + k]))
            )
            if abs(off) > _CONTRADICTION * sigma:
                sentences.append(
                    f"the {side} sensor's marker pitch and its motion give scales along {_AXES[k]} that differ by "
                    f"{abs(off):.1%} ({abs(off) / sigma:.1f} σ): is marker_pitch_mm right?"
                )
    return sentences


def _restless(solution: Solution) -> list[str]:
    if solution.in_plane_m <= _NOISY_M:
        return []
    return [
        f"the markers do not follow a standing rod (residual {solution.in_plane_m * 1e3:.2f} mm): is the rod clamped "
        "firmly, does it slip in the grasp, do the poses jitter?"
    ]
