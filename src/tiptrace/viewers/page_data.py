"""What the page is sent: plain numbers in millimetres and seconds, pictures as jpeg."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np

from tiptrace.snapshot import FingerView, Snapshot
from tiptrace.types import SIDES

Row = list[Any]
_MAX_EVENTS = 30


def path_row(snapshot: Snapshot, start_ns: int) -> Row:
    """A point of the trajectory: t (s), x, y, z (mm), their standard deviations (mm), status."""
    estimate = snapshot.estimate
    unknown: list[float | None] = [None] * 3
    return [
        round((estimate.stamp_ns - start_ns) * 1e-9, 3),
        *(_mm(estimate.p_B) or unknown),
        *(sigma_mm(snapshot) or unknown),
        estimate.status.value,
    ]


def state(snapshot: Snapshot, start_ns: int) -> dict[str, Any]:
    """Everything but the trajectory."""
    estimate = snapshot.estimate
    events = snapshot.events[-_MAX_EVENTS:]
    message: dict[str, Any] = {
        "t": (estimate.stamp_ns - start_ns) * 1e-9,
        "status": estimate.status.value,
        "phase": estimate.phase.value if estimate.phase else None,
        "p": _mm(estimate.p_B),
        "sigma": sigma_mm(snapshot),
        "ellipse": ellipse(snapshot),
        "rate": _finite(snapshot.rate_hz),
        "latency": _finite(snapshot.latency_ms),
        "loop": _finite(estimate.loop_ms),
        "residual": None if estimate.residual_m is None else _finite(estimate.residual_m * 1e3),
        "markers": estimate.markers,
        "advice": snapshot.advice,
        "notes": list(snapshot.notes),
        "events": [{"t": (e.start_ns - start_ns) * 1e-9, "kind": e.kind, "detail": e.detail} for e in events],
    }
    for side in SIDES:
        message[side] = _finger(snapshot.finger(side))
    return message


def sigma_mm(snapshot: Snapshot) -> list[float] | None:
    """Standard deviation per axis; None without a position or a covariance."""
    estimate = snapshot.estimate
    if estimate.p_B is None or estimate.covariance is None:
        return None
    return _mm(np.sqrt(np.maximum(np.diag(estimate.covariance), 0.0)))


def ellipse(snapshot: Snapshot) -> list[float] | None:
    """1σ ellipse in the base's x-y plane: half axes (mm) and angle of the first (rad)."""
    estimate = snapshot.estimate
    if estimate.p_B is None or estimate.covariance is None or not np.isfinite(estimate.covariance).all():
        return None
    values, vectors = np.linalg.eigh(estimate.covariance[:2, :2])  # (2,), (2, 2)
    a, b = (1e3 * float(np.sqrt(max(v, 0.0))) for v in values[::-1])
    return [a, b, float(np.arctan2(vectors[1, 1], vectors[0, 1]))]


def _finger(view: FingerView) -> dict[str, Any] | None:
    arrows: list[list[float]] = []
    if view.uv_px is not None and view.uv_start_px is not None and len(view.uv_px) == len(view.uv_start_px):
        rows = np.hstack([view.uv_start_px, view.uv_px])  # (n, 4)
        arrows = np.round(rows[np.isfinite(rows).all(axis=1)], 1).tolist()
    if view.image is None:
        return {"size": [320, 240], "arrows": arrows} if arrows else None
    height, width = view.image.shape[:2]
    _, data = cv2.imencode(".jpg", view.image, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return {"size": [width, height], "arrows": arrows, "jpeg": base64.b64encode(data.tobytes()).decode()}


def _mm(vector: Any) -> list[float] | None:
    if vector is None or not np.isfinite(vector).all():
        return None
    return [round(float(v) * 1e3, 4) for v in vector]


def _finite(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
