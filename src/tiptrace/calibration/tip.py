"""Pivot calibration from a list of tool poses: the tip in the tool frame and the point it rested on.

Maximum likelihood is the estimator of Stage I (``estimation/anchor.py``) with annealed Tukey weights: poses in which
the tip had moved away, or that were tracked wrongly, end with weight 0. Least squares takes every pose at its word.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from tiptrace.errors import CalibrationError
from tiptrace.estimation.anchor import fixed_point_ml
from tiptrace.estimation.observability import missing_rotation, weak_axes
from tiptrace.geometry.fixed_point import (
    FixedPoint,
    FixedPointAccumulator,
    Pivot,
    relative_motions,
    solve_pivot,
)
from tiptrace.geometry.transforms import transform
from tiptrace.types import FloatArray

_ORTHONORMAL = 1e-3
_REACH_M = 5.0  # a tracker or arm that sees further than this writes millimetres


Method = Literal["least-squares", "maximum-likelihood"]
METHODS: tuple[Method, ...] = get_args(Method)
WEAK_M = 2e-3  # a tip known worse than this along an axis is told


@dataclass(frozen=True, slots=True)
class TipCalibration:
    """Solution of ``R_i c + t_i = p`` and, beside it, the paper's ``(I − R_t) p = d_t``.

    Attributes:
        method: Which of :data:`METHODS`.
        tip: (3,) c in the tool frame, m.
        point: (3,) p in the base frame, m.
        covariance: (6, 6) of (c, p), m².
        residual_m: Root mean square length of ``R_i c + t_i − p`` over the poses in use.
        weights: (n,) of the poses; 0 = outlier.
        weak: Sentences on what the poses leave open.
        pivot: Least squares, of all poses.
        paper: Fixed point by the paper's form from the first pose; None where it is undetermined.
        rotation_deg: Largest rotation between the first pose and another.
    """

    method: Method
    tip: FloatArray
    point: FloatArray
    covariance: FloatArray
    residual_m: float
    weights: FloatArray
    weak: tuple[str, ...]
    pivot: Pivot
    paper: FixedPoint | None
    rotation_deg: float

    @property
    def sigma_m(self) -> FloatArray:
        """(3,) standard deviation of the tip along the axes of the tool."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def outliers(self) -> int:
        """Poses that were left out."""
        return int((self.weights <= 0).sum())


def calibrate_tip(T: FloatArray, method: str = "maximum-likelihood") -> TipCalibration:
    """Tip and pivot from tool poses T_B_T (n, 4, 4), m.

    Raises:
        CalibrationError: an unknown method, or more than half of the poses contradict each other.
        GeometryError: fewer than three poses, or poses that do not rotate.
    """
    if method not in METHODS:
        raise CalibrationError(f"unknown method '{method}'; valid: {', '.join(METHODS)}")
    pivot = solve_pivot(T)
    R_t, d_t = relative_motions(T)
    accumulator = FixedPointAccumulator()
    for R, d in zip(R_t, d_t, strict=True):
        accumulator.add(R, d)
    cosine = np.clip((np.trace(R_t, axis1=1, axis2=2) - 1) / 2, -1, 1)
    paper, turned_deg = accumulator.solve(), float(np.rad2deg(np.arccos(cosine.min())))
    if method == "least-squares":
        covariance = pivot.covariance.copy()
        for axis in pivot.weak_axes:  # least squares does not know what it does not know
            covariance[:3, :3] += np.outer(axis, axis)
        weak, ones = _in_words(covariance[:3, :3], T[:, :3, :3]), np.ones(len(T))
        return TipCalibration(
            "least-squares",
            pivot.tip,
            pivot.pivot,
            covariance,
            pivot.residual_m,
            ones,
            weak,
            pivot,
            paper,
            turned_deg,
        )
    ml = fixed_point_ml(T[:, :3, :3], T[:, :3, 3], outliers=True)
    if (ml.weights > 0).mean() < 0.5:
        raise CalibrationError(
            f"{int((ml.weights <= 0).sum())} of {len(T)} poses contradict the others: did the tip rest in one place?"
        )
    weak = _in_words(ml.covariance_c, T[ml.weights > 0, :3, :3])
    return TipCalibration(
        "maximum-likelihood",
        ml.c,
        ml.p,
        ml.covariance,
        ml.residual_m,
        ml.weights,
        weak,
        pivot,
        paper,
        turned_deg,
    )


def _in_words(covariance: FloatArray, R: FloatArray) -> tuple[str, ...]:
    """Weak axes of the tip in the tool frame, and the rotation that is missing."""
    sentences = []
    for axis in weak_axes(covariance, WEAK_M):
        sigma = float(np.sqrt(axis @ covariance @ axis))
        about, rms = missing_rotation(axis, np.swapaxes(R, 1, 2))  # in the tool's axes
        known = f"is known only to {sigma * 1e3:.1f} mm" if sigma < 0.5 else "is not determined"
        sentences.append(
            f"the tip along {_direction(axis)} of the tool {known}: the tool turned by {np.degrees(rms):.1f}° rms "
            f"about {_direction(about)}; turn it more about that axis"
        )
    return tuple(sentences)


def _direction(axis: FloatArray) -> str:
    k = int(np.argmax(np.abs(axis)))
    if abs(axis[k]) > 0.95:
        return "xyz"[k]
    x, y, z = axis * np.sign(axis[k])
    return f"({x:+.2f}, {y:+.2f}, {z:+.2f})"


def read_poses(path: Path) -> FloatArray:
    """Poses from a text file of 3×4 matrices, row-major, 12 numbers a line (comma or space), metres: (n, 4, 4).

    Raises:
        CalibrationError: not such a file, rotations that are none, or positions in millimetres.
    """
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: cannot be read ({error})") from None
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            row = [float(field) for field in fields]
        except ValueError:
            raise CalibrationError(f"{path}, line {number}: not a number in '{line[:40]}'") from None
        if len(row) != 12:
            raise CalibrationError(
                f"{path}, line {number}: {len(row)} numbers; a pose is 3×4, row-major: r11 r12 r13 tx r21 … tz"
            )
        rows.append(row)
    if not rows:
        raise CalibrationError(f"{path}: holds no poses")
    P = np.asarray(rows, dtype=np.float64).reshape(-1, 3, 4)
    _check_poses(P, path)
    return transform(P[:, :, :3], P[:, :, 3])


def _check_poses(P: FloatArray, path: Path) -> None:
    if not np.isfinite(P).all():
        raise CalibrationError(
            f"{path}: line {int(np.argmin(np.isfinite(P).all(axis=(1, 2)))) + 1} is not finite"
        )
    R = P[:, :, :3]
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = (off > _ORTHONORMAL) | (np.linalg.det(R) < 0)
    if bad.any():
        raise CalibrationError(
            f"{path}: pose {int(np.argmax(bad)) + 1} holds no rotation (columns 1–3, 5–7, 9–11); is it row-major?"
        )
    if np.abs(P[:, :, 3]).max() > _REACH_M:
        raise CalibrationError(
            f"{path}: positions up to {np.abs(P[:, :, 3]).max():.0f} look like mm: give metres"
        )
