"""Robust weights: Huber for the few markers that slip, graduated Tukey for gross errors."""

from __future__ import annotations

import numpy as np

from tiptrace.types import FloatArray

_MEDIAN_CHI_3 = 1.538  # median length of a standard normal vector in three dimensions


def huber_weight(length: FloatArray, limit: float) -> FloatArray:
    """Weights of whitened residual lengths: 1 up to ``limit``, then ``limit / length``; any shape."""
    return np.asarray(limit / np.maximum(length, limit))


def tukey_weight(length: FloatArray, limit: float) -> FloatArray:
    """Biweight: falls to exactly 0 at ``limit``; any shape."""
    inside = np.clip(1.0 - (length / limit) ** 2, 0.0, None)
    return np.asarray(inside * inside)


def scale_from_median(length: FloatArray) -> float:
    """Noise scale of residual vectors in 3-D from the median of their whitened lengths, (T,) → 1."""
    return float(np.median(length) / _MEDIAN_CHI_3)


def annealed_limits(longest: float, final: float, factor: float = 1.4) -> list[float]:
    """Limits from beyond the longest residual down to ``final``: graduated non-convexity, deterministic."""
    limits = [final]
    while limits[-1] < 3.0 * longest:
        limits.append(limits[-1] * factor)
    return limits[::-1]
