"""Pivot calibration from a list of tool poses: the tip in the tool frame and the point it rested on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tiptrace.errors import CalibrationError
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


@dataclass(frozen=True, slots=True)
class TipCalibration:
    """Joint solution of ``R_i c + t_i = p`` and, beside it, the paper's ``(I − R_t) p = d_t``.

    Attributes:
        pivot: Joint solution.
        paper: Fixed point by the paper's form from the first pose; None where it is undetermined.
        rotation_deg: Largest rotation between the first pose and another.
    """

    pivot: Pivot
    paper: FixedPoint | None
    rotation_deg: float


def calibrate_tip(T: FloatArray) -> TipCalibration:
    """Tip and pivot from tool poses T_B_T (n, 4, 4), m.

    Raises:
        GeometryError: fewer than three poses, or poses that do not rotate.
    """
    pivot = solve_pivot(T)
    R_t, d_t = relative_motions(T)
    accumulator = FixedPointAccumulator()
    for R, d in zip(R_t, d_t, strict=True):
        accumulator.add(R, d)
    cosine = np.clip((np.trace(R_t, axis1=1, axis2=2) - 1) / 2, -1, 1)
    return TipCalibration(pivot, accumulator.solve(), float(np.rad2deg(np.arccos(cosine.min()))))


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
