"""What an anchoring motion leaves open, in words that tell the user what to do."""

from __future__ import annotations

import numpy as np

from tiptrace.geometry.transforms import rotation_log
from tiptrace.types import FloatArray

_AXES = ("x", "y", "z")
_LEAST_DEG = 2.0


def weak_axes(covariance: FloatArray, limit_m: float) -> tuple[FloatArray, ...]:
    """Directions in which a position is worse known than a limit, worst first, (3,) each."""
    values, vectors = np.linalg.eigh(covariance)
    order = np.argsort(-values)
    return tuple(vectors[:, k] for k in order if np.sqrt(max(values[k], 0.0)) > limit_m)


def rotation_spread(R: FloatArray) -> FloatArray:
    """Second moment of the rotations about their mean, (T, 3, 3) → (3, 3) rad², in the fixed frame."""
    U, _, Vt = np.linalg.svd(R.mean(axis=0))
    mean = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    w = rotation_log(R @ mean.T)  # (T, 3)
    return np.asarray(w.T @ w / len(w))


def missing_rotation(axis: FloatArray, R: FloatArray) -> tuple[FloatArray, float]:
    """Axis about which the hand should turn to determine a weak direction, and its rms rotation so far.

    A point is seen by rotation about axes perpendicular to the direction in question; of these the one with the
    least motion so far helps most.

    Args:
        axis: (3,) weak direction.
        R: (T, 3, 3) rotations of the tool in the fixed frame.
    """
    u = np.linalg.svd(axis[None])[2][1:]  # (2, 3) perpendicular to it
    spread = u @ rotation_spread(R) @ u.T
    values, vectors = np.linalg.eigh(spread)
    return vectors[:, 0] @ u, float(np.sqrt(max(values[0], 0.0)))


def advice(weak: tuple[FloatArray, ...], covariance: FloatArray, R: FloatArray, limit_m: float) -> str:
    """One sentence per weak direction: how badly it is known, and which motion is missing."""
    sentences = []
    for axis in weak[:2]:
        sigma = float(np.sqrt(axis @ covariance @ axis))
        about, rms = missing_rotation(axis, R)
        needed = rms * (sigma / (0.5 * limit_m)) if sigma < 0.5 else np.radians(4.0)  # σ falls as 1/rotation
        more = float(np.clip(np.degrees(np.sqrt(2.0) * (needed - rms)), _LEAST_DEG, 15.0))
        known = f"only to {sigma * 1e3:.1f} mm" if sigma < 0.5 else "not at all"
        sentences.append(
            f"along {_name(axis)} the tip is determined {known}: rotate {np.ceil(more):.0f}° more about {_name(about)}"
        )
    return "; ".join(sentences)


def _name(axis: FloatArray) -> str:
    """``x`` where an axis of the base is near, else its components."""
    k = int(np.argmax(np.abs(axis)))
    if abs(axis[k]) > 0.9:
        return f"{_AXES[k]} of the base"
    a = axis * np.sign(axis[k])
    return f"({a[0]:.1f}, {a[1]:.1f}, {a[2]:.1f}) of the base"
