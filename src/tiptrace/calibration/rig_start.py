"""First look at a calibration wiggle, without believing the rig: where and how each sensor sits, by linear fits.

A marker that rides on the clamped rod moves in its image by ``A (v + ω × r_i)``, where (v, ω) is the rod's motion in
F_E about a point and r_i the marker's place from there. A (3, 3) and A [r_i]× are linear in the data: their rows are
the image's axes in F_E, and r_i is where the marker is. Swapped, mirrored and turned sensors show here, and nothing
has to be assumed about T_E_S.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.calibration.rig_data import HandTrack, PadTrack, Segment
from tiptrace.config import Rig
from tiptrace.errors import CalibrationError
from tiptrace.geometry.transforms import invert, rotation_log
from tiptrace.types import SIDES, FloatArray, Side

_LATENCIES_S = np.arange(-0.05, 0.2501, 0.025)
_LEAST_SHIFT_M, _LEAST_TURN_RAD = 0.05e-3, np.radians(0.2)  # standard deviation along the weakest axis
_AXES = ("x", "y", "z")
_SURE = 0.7  # cosine


@dataclass(frozen=True, slots=True)
class Look:
    """What the linear fit says of one sensor.

    Attributes:
        A: (3, 3) rows: displacement of the markers per displacement of the rod in F_E; the last is depth.
        place_E: (3,) middle of its markers in F_E, m.
        latency_s: Capture minus exposure, to some 10 ms.
        residual_m: Root mean square in-plane misfit.
    """

    A: FloatArray
    place_E: FloatArray
    latency_s: float
    residual_m: float


def look(pad: PadTrack, hand: HandTrack, about_E: FloatArray, inverse: bool = False) -> Look:
    """Fit one sensor with the hand's poses (or, ``inverse``, as if they had been recorded inverted)."""
    found = [(_fit(pad, hand, about_E, tau, inverse), tau) for tau in _LATENCIES_S]
    (A, place, rms), tau = min(found, key=lambda item: item[0][2])
    return Look(A, place, float(tau), rms)


def _fit(
    pad: PadTrack, hand: HandTrack, about_E: FloatArray, latency_s: float, inverse: bool
) -> tuple[FloatArray, FloatArray, float]:
    v, omega = motion_of_rod(hand, pad.stamps_ns - latency_s * 1e9, about_E, inverse)
    X = np.concatenate([v, omega, np.ones((len(v), 1))], axis=1)  # (T, 7)
    w = np.where(np.isfinite(pad.w), pad.w, np.nanmean(pad.w, axis=0))  # (T, N, 3)
    N = w.shape[1]
    beta, *_ = np.linalg.lstsq(X, w.reshape(len(X), -1), rcond=None)
    C = beta[:6].T.reshape(N, 3, 6)
    A = np.mean(C[..., :3], axis=0)
    rows = 3 if pad.has_depth else 2
    # rows a of A: aᵀ(ω × r) = (r × a)ᵀ ω, so the fit of ω is r × a = −[a]× r
    L = np.concatenate([_cross_left(A[k]) for k in range(rows)])  # (3 rows, 3)
    r = np.linalg.lstsq(L, np.mean(C[:, :rows, 3:], axis=0).ravel(), rcond=None)[0]
    left = (w.reshape(len(X), -1) - X @ beta).reshape(len(X), N, 3)[..., :2]
    return A, about_E + r, float(np.sqrt(np.mean(left * left)))


def _cross_left(a: FloatArray) -> FloatArray:
    """(3, 3) matrix of r ↦ r × a."""
    return np.array([[0.0, a[2], -a[1]], [-a[2], 0.0, a[0]], [a[1], -a[0], 0.0]])


def motion_of_rod(
    hand: HandTrack, stamps_ns: FloatArray, about_E: FloatArray, inverse: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Displacement (T, 3) of a point of the clamped rod in F_E, and its rotation vector (T, 3)."""
    T = hand.at(stamps_ns).T_B_E
    if inverse:
        T = invert(T)
    M = invert(T) @ T[len(T) // 2]  # (T, 4, 4)
    v = M[:, :3, :3] @ about_E + M[:, :3, 3] - about_E
    return v, rotation_log(M[:, :3, :3])


def check_motion(segments: list[Segment], about_E: FloatArray) -> None:
    """The hand must have moved about and along all axes.

    Raises:
        CalibrationError: it did not; the axis is named.
    """
    motions = [motion_of_rod(s.hand, s.pads["left"].stamps_ns, about_E) for s in segments]
    for index, (what, least, unit) in enumerate(
        (("shift", _LEAST_SHIFT_M, "mm"), ("turn", _LEAST_TURN_RAD, "°"))
    ):
        x = np.concatenate([m[index] - m[index].mean(axis=0) for m in motions])
        values, vectors = np.linalg.eigh(x.T @ x / len(x))
        size = float(np.sqrt(max(values[0], 0.0)))
        if size < least:
            a = vectors[:, 0]
            shown = size * 1e3 if index == 0 else float(np.degrees(size))
            raise CalibrationError(
                f"the hand hardly {what}s {'along' if index == 0 else 'about'} "
                f"({a[0]:+.1f}, {a[1]:+.1f}, {a[2]:+.1f}) of the end effector ({shown:.3f} {unit} rms): wiggle in all "
                "six axes, by about 0.5 mm and 2°"
            )


def check_arrangement(segments: list[Segment], rig: Rig, about_E: FloatArray) -> dict[Side, Look]:
    """Whether the sensors are connected and mounted as the rig says; returns the looks of the first segment.

    Raises:
        CalibrationError: swapped, mirrored, turned or inverted; all that is wrong, and what to change.
    """
    segment = segments[0]
    looks: dict[Side, Look] = {s: look(segment.pads[s], segment.hand, about_E) for s in SIDES}
    other = {s: look(segment.pads[s], segment.hand, about_E, inverse=True) for s in SIDES}
    as_is, inverted = (max(k.residual_m for k in kind.values()) for kind in (looks, other))
    if as_is > 2.0 * inverted and as_is > 3e-5:
        raise CalibrationError(
            "the end-effector poses are inverted: the markers move as if the recorded poses were T_E_B; record T_B_E, "
            "which maps end-effector to base coordinates"
        )
    problems = _problems(looks, rig, {s: segment.pads[s].has_depth for s in SIDES})
    if problems:
        raise CalibrationError("; ".join(problems))
    return looks


def _problems(looks: dict[Side, Look], rig: Rig, has_depth: dict[Side, bool]) -> list[str]:
    across = rig.T_E_S("left")[:3, 3] - rig.T_E_S("right")[:3, 3]
    seen = looks["left"].place_E - looks["right"].place_E
    cosine = float(seen @ across / (np.linalg.norm(seen) * np.linalg.norm(across)))
    problems = []
    swapped = cosine < -_SURE
    if swapped:
        problems.append(
            "left and right are swapped: the images of the left finger come from the right one; exchange the two "
            "topics or cameras"
        )
    elif cosine < _SURE:
        problems.append(
            "the two sensors are not where the rig says: the line from right to left is "
            f"{np.degrees(np.arccos(np.clip(cosine, -1, 1))):.0f}° off; check T_E_S and the frame of the poses"
        )
    mirrored = {}
    for side in SIDES:
        physical: Side = ("right" if side == "left" else "left") if swapped else side
        outward = (-seen if side == "left" else seen) / np.linalg.norm(seen)  # towards the other finger
        mirrored[side] = _turned(looks[side].A, rig.T_E_S(physical)[:3, :3], outward, has_depth[side])
    if mirrored["left"] and mirrored["left"] == mirrored["right"]:
        return [*problems, f"both sensors: {mirrored['left']}"]
    return [*problems, *(f"{side} sensor: {text}" for side, text in mirrored.items() if text)]


def _turned(A: FloatArray, R_E_S: FloatArray, outward_E: FloatArray, has_depth: bool) -> str:
    """What is wrong with a sensor's axes, from the fitted rows; empty if nothing."""
    a = A / np.linalg.norm(A, axis=1, keepdims=True)
    problems = []
    if has_depth and a[2] @ outward_E < -0.5:
        problems.append("depth is inverted: pressing the gel raises it; check the gel model's sign")
    handed = float(np.cross(a[0], a[1]) @ outward_E)
    cosines = a[:2] @ R_E_S[:, :2]  # (image axis seen, image axis as the rig says)
    direct, crossed = np.abs(np.diag(cosines)).min(), np.abs(cosines[[0, 1], [1, 0]]).min()
    flips = [bool(c < 0) for c in np.diag(cosines)]
    if direct > _SURE and handed < 0:
        along = "left to right" if flips[0] else "top to bottom"
        fix = "horizontal" if flips[0] else "vertical"
        problems.append(
            f"its image is mirrored {along}; set flip: {fix} (the other way if it is set already)"
        )
    elif direct > _SURE and all(flips):
        problems.append(
            "its image is turned by half; set flip: both, or check T_E_S (quaternions are x, y, z, w)"
        )
    elif crossed > _SURE:
        kind = "turned by a quarter" if handed > 0 else "turned by a quarter and mirrored"
        problems.append(f"its image is {kind}; turn it, or correct T_E_S")
    elif direct < _SURE:
        angle = np.degrees(np.arccos(np.clip(np.abs(np.diag(cosines)), 0, 1))).max()
        problems.append(
            f"its axes are {angle:.0f}° off what T_E_S says; correct T_E_S roughly and calibrate again"
        )
    return " and ".join(problems)
