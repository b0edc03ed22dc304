"""Scale of a sensor from the printed pitch of its markers."""

from __future__ import annotations

import numpy as np

from tiptrace.calibration.rig_data import PadTrack
from tiptrace.calibration.rig_solve import Pitch
from tiptrace.types import FloatArray

_UNTOUCHED, _PRESSED = 0.001, 0.005  # what a print and a stretched gel may be off, σ
_NEAR = 0.25  # of the pitch: how far a marker may be off its place in the grid
_UNKNOWN = Pitch(np.zeros(2), np.full(2, np.inf))


def pitch_scale(pad: PadTrack, pitch_mm: float | None) -> Pitch:
    """ln of the stated scale over the true one, and its σ, per axis; σ is infinite where no grid is found."""
    if pitch_mm is None or len(pad.rest) < 6:
        return _UNKNOWN
    pitch = pitch_mm * 1e-3
    basis = _basis(pad.rest, pitch)
    if basis is None:
        return _UNKNOWN
    middle = pad.rest[np.argmin(np.linalg.norm(pad.rest - pad.rest.mean(axis=0), axis=1))]
    ij = np.round((pad.rest - middle) @ np.linalg.inv(basis))  # (M, 2): p = middle + ij @ basis
    A = np.column_stack([np.ones(len(ij)), ij])
    if np.ptp(ij, axis=0).min() < 1:
        return _UNKNOWN
    solution, *_ = np.linalg.lstsq(A, pad.rest, rcond=None)
    left = pad.rest - A @ solution
    kept = np.linalg.norm(left, axis=1) < _NEAR * pitch
    if kept.sum() < 6 or np.linalg.matrix_rank(A[kept]) < 3:
        return _UNKNOWN
    solution, *_ = np.linalg.lstsq(A[kept], pad.rest[kept], rcond=None)
    left = pad.rest[kept] - A[kept] @ solution
    steps = solution[1:]  # (2, 2) rows: one step of the grid along each of its axes
    k = np.linalg.norm(steps, axis=0) / pitch  # (k_x cos, −k_x sin) and (k_y sin, k_y cos) by columns
    information = A[kept].T @ A[kept]
    share = np.sqrt(np.diag(np.linalg.inv(information))[1:].max())
    spread = np.sqrt(np.mean(left**2, axis=0)) * share / pitch  # (2,)
    floor = _UNTOUCHED if pad.untouched else _PRESSED
    return Pitch(np.log(k), np.hypot(spread, floor))


def _basis(p: FloatArray, pitch: float) -> FloatArray | None:
    """(2, 2) rows: the grid's steps nearest to x and to y, from the distances of neighbours."""
    d = (p[:, None] - p[None]).reshape(-1, 2)
    length = np.linalg.norm(d, axis=1)
    d = d[(length > 0.75 * pitch) & (length < 1.25 * pitch)]
    rows = []
    for axis in (0, 1):
        along = d[np.abs(d[:, axis]) > 0.8 * np.linalg.norm(d, axis=1)]
        if len(along) < 2:
            return None
        rows.append(np.median(along * np.sign(along[:, axis : axis + 1]), axis=0))
    basis = np.array(rows)
    return basis if abs(float(np.linalg.det(basis))) > 0.5 * pitch**2 else None
