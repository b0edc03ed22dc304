"""How a gel's colour changes with its slope: a smooth model fitted to presses, generous with few data.

The colour of a pixel over that of the untouched gel is taken as

    I_c / B_c = 1 + Σ_ij a_cij [φ_i(n) − φ_i(e_z)] ψ_j(u, v)

with φ the monomials of the unit normal n up to the third degree (what diffuse, extended lamps leave of their
light) and ψ low powers of the place (lamps are near). It is linear in its coefficients, so that twenty presses
fix it, and flat gel looks untouched exactly. The network then learns its inverse from as many samples as it
wants, evenly over slopes and places, with the camera's own noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.types import FloatArray

_RIDGE = 1e-4


@dataclass(frozen=True, slots=True)
class Shading:
    """Colour ratio as a function of slope and place.

    Attributes:
        coefficients: (k, 3), channels B, G, R.
        normal_degree: Highest degree in the normal.
        place_degree: Highest degree in the place.
        sigma: (3,) residual of the fit, grey levels.
        max_slope: Steepest slope that was fitted.
    """

    coefficients: FloatArray
    normal_degree: int
    place_degree: int
    sigma: FloatArray
    max_slope: float

    def ratio_change(self, slopes: FloatArray, unit_uv: FloatArray) -> FloatArray:
        """I/B − 1, (n, 3), at slopes (n, 2) and places (n, 2)."""
        basis = _basis(slopes, unit_uv, self.normal_degree, self.place_degree)
        return np.asarray(basis @ self.coefficients)


def fit_shading(
    slopes: FloatArray,
    unit_uv: FloatArray,
    colours: FloatArray,
    background: FloatArray,
    *,
    normal_degree: int = 3,
    place_degree: int = 2,
) -> Shading:
    """Least squares in grey levels, so that dark corners do not count more than they tell.

    Args:
        slopes: (n, 2) true slopes.
        unit_uv: (n, 2) u/W, v/H.
        colours: (n, 3) grey levels.
        background: (n, 3) grey levels of the untouched gel at the same pixels.
        normal_degree: Highest degree in the normal.
        place_degree: Highest degree in the place.
    """
    basis = _basis(slopes, unit_uv, normal_degree, place_degree)  # (n, k)
    coefficients = np.empty((basis.shape[1], 3))
    sigma = np.empty(3)
    for c in range(3):
        A = basis * background[:, c : c + 1]
        y = colours[:, c] - background[:, c]
        scale = A.std(axis=0) + 1e-9
        A /= scale
        normal_matrix = A.T @ A + _RIDGE * len(A) * np.eye(A.shape[1])
        coefficients[:, c] = np.linalg.solve(normal_matrix, A.T @ y)
        sigma[c] = np.sqrt(np.mean((A @ coefficients[:, c] - y) ** 2))
        coefficients[:, c] /= scale
    steepest = float(np.percentile(np.hypot(slopes[:, 0], slopes[:, 1]), 99.5))
    return Shading(coefficients, normal_degree, place_degree, sigma, steepest)


def _basis(slopes: FloatArray, unit_uv: FloatArray, normal_degree: int, place_degree: int) -> FloatArray:
    n_z = 1.0 / np.sqrt(1.0 + np.sum(slopes * slopes, axis=1))
    a, b = slopes[:, 0] * n_z, slopes[:, 1] * n_z
    x, y = 2.0 * unit_uv[:, 0] - 1.0, 2.0 * unit_uv[:, 1] - 1.0
    phi = [a**i * b**j for i, j in _powers(normal_degree) if i + j > 0]
    phi += [a**i * b**j * n_z - (i + j == 0) for i, j in _powers(normal_degree - 1)]  # flat gel: 0
    psi = [x**i * y**j for i, j in _powers(place_degree)]
    return np.stack([f * g for f in phi for g in psi], axis=1)


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
