"""Natural cubic smoothing spline with its smoother matrix (Reinsch 1967).

The same curve as ``scipy.interpolate.make_smoothing_spline``, which gives no matrix; the matrix is what carries the
noise of the data to the curve, and solving all columns at once makes cross-validation a hundred times faster.
"""

from __future__ import annotations

import numpy as np

from tiptrace.types import FloatArray


class SmoothingSpline:
    """Minimises ``Σ w (y − g)² + λ ∫ g''²`` on fixed knots for any data and any λ."""

    def __init__(self, u: FloatArray, weight: FloatArray) -> None:
        """Prepare for knots u (n,), strictly increasing, n ≥ 5, and weights (n,)."""
        self._u, self._weight = u, weight
        h = np.diff(u)  # (n-1,)
        n = len(u)
        Q = np.zeros((n, n - 2))  # second divided differences
        j = np.arange(n - 2)
        Q[j, j], Q[j + 1, j], Q[j + 2, j] = 1 / h[:-1], -1 / h[:-1] - 1 / h[1:], 1 / h[1:]
        self._Q = Q
        self._R = np.zeros((3, n - 2))  # upper bands, as solveh_banded wants them
        self._R[2] = (h[:-1] + h[1:]) / 3
        self._R[1, 1:] = h[1:-1] / 6
        QtWQ = (Q / weight[:, None]).T @ Q  # (n-2, n-2), five bands
        self._K = np.zeros((3, n - 2))
        for band in range(3):
            self._K[2 - band, band:] = np.diagonal(QtWQ, band)

    def fit(self, y: FloatArray, smoothing: float) -> FloatArray:
        """Smoothed values at the knots: (n,) or (n, k), λ → the same shape."""
        from scipy.linalg import solveh_banded

        gamma = solveh_banded(self._R + smoothing * self._K, self._Q.T @ y)  # second derivatives (n-2, …)
        correction = smoothing * (self._Q @ gamma)
        return np.asarray(y - correction / (self._weight if y.ndim == 1 else self._weight[:, None]))

    def at(self, g: FloatArray, x: FloatArray, derivative: int = 0) -> FloatArray:
        """The curve through smoothed values g (n,) or (n, k), between the knots: (m,) → (m,) or (m, k)."""
        from scipy.interpolate import CubicSpline

        return np.asarray(CubicSpline(self._u, g, bc_type="natural")(x, derivative))

    def matrix(self, smoothing: float) -> FloatArray:
        """S with ``fit(y) = S y``, (n, n)."""
        return self.fit(np.eye(len(self._u)), smoothing)
