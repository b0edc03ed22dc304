"""Noise that remembers: errors of consecutive pairs are alike, and n of them are worth far fewer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tiptrace.types import FloatArray

_MAX_PHI = 0.98


def lag_one(residuals: Sequence[FloatArray]) -> float:
    """First-order autocorrelation φ of residuals, pooled over traces, in [0, 0.98]."""
    num = sum(float(r[1:] @ r[:-1]) for r in residuals)
    den = sum(float(r @ r) for r in residuals)
    return float(np.clip(num / den, 0.0, _MAX_PHI)) if den > 0 else 0.0


def ar1_covariance(n: int, sigma: float, phi: float) -> FloatArray:
    """(n, n) covariance of a first-order autoregressive sequence."""
    k = np.arange(n)
    return np.asarray(sigma**2 * phi ** np.abs(k[:, None] - k[None, :]))


def sandwich(designs: Sequence[FloatArray], sigma: float, phi: float, offset_std: float = 0.0) -> FloatArray:
    """Covariance of ordinary least squares under serial noise and one random offset per trace: (q, q).

    Args:
        designs: (n_k, q) design or Jacobian of each trace.
        sigma: Standard deviation of a single row.
        phi: Its autocorrelation from row to row.
        offset_std: Standard deviation of the offset that all rows of a trace share.
    """
    q = designs[0].shape[1]
    bread, meat = np.zeros((q, q)), np.zeros((q, q))
    for X in designs:
        noise = ar1_covariance(len(X), sigma, phi) + offset_std**2
        bread += X.T @ X
        meat += X.T @ noise @ X
    inverse = np.linalg.pinv(bread, hermitian=True)
    return np.asarray(inverse @ meat @ inverse)


def mad_sigma(residuals: FloatArray) -> float:
    """Robust standard deviation."""
    return 1.4826 * float(np.median(np.abs(residuals - np.median(residuals)))) if len(residuals) else 0.0
