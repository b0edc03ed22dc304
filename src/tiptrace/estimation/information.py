"""Information matrices over unlike units, and how much serially correlated residuals really say."""

from __future__ import annotations

import numpy as np

from tiptrace.types import FloatArray


def scaled_inverse(N: FloatArray) -> FloatArray:
    """Inverse of an information matrix over unlike units, by scaling to a unit diagonal."""
    s = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-12))
    values, vectors = np.linalg.eigh(N * np.outer(s, s))
    values = np.maximum(values, 1e-9)
    return np.asarray(np.outer(s, s) * ((vectors / values) @ vectors.T))


def residual_noise(r: FloatArray, S_inv: FloatArray) -> tuple[float, float]:
    """Variance of whitened residuals (T, 3), and the sum of their autocorrelation (Bartlett window), ≥ 1.

    The first says how noisy frames are against what was assumed of them, the product of both how much less (above 1)
    or more (below) they say together.
    """
    L = np.linalg.cholesky(S_inv + 1e-9 * np.eye(3))
    z = np.einsum("tji,tj->ti", L, r)  # (T, 3)
    z = z - z.mean(axis=0)
    T = len(z)
    variance = float(np.mean(z * z))
    if T < 8 or variance < 1e-12:
        return 1.0, 1.0
    reach = max(2, T // 5)
    lags = [float(np.mean(z[k:] * z[:-k])) * (T - k) / T / variance for k in range(1, reach)]
    correlation = 1.0 + 2.0 * sum((1.0 - k / reach) * rho for k, rho in enumerate(lags, start=1))
    return variance, max(correlation, 1.0)
