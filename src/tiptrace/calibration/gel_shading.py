"""How a gel's colour changes with its slope: a lamp model fitted to presses, generous with few data.

Lamps are many, wide and near. Whatever their arrangement, a diffuse coating shows a sum over directions l of
what shines from there times the rounded cosine soft⁺(n · l); so the colour over that of the untouched gel is

    I_c / B_c = 1 + Σ_kj a_ckj [φ_k(n) − φ_k(e_z)] ψ_j(u, v),   φ_k(n) = soft⁺(n · l_k), n_x, n_y, n_z and squares

with fixed directions l_k all around, low and half high, and ψ low powers of the place. It is linear in its
coefficients, so that twenty presses fix it, and flat gel looks untouched exactly. The network then learns its
inverse from as many samples as it wants, evenly over slopes and places, with the camera's own noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.types import FloatArray

_RIDGE = 1e-3
_AZIMUTHS = 16
_ELEVATIONS = (0.05, 0.3)  # rad
_SOFTNESS = 0.05


@dataclass(frozen=True, slots=True)
class Shading:
    """Colour ratio as a function of slope and place.

    Attributes:
        coefficients: (k, 3), channels B, G, R.
        place_degree: Highest power of the place.
        sigma: (3,) residual of the fit, grey levels.
        max_slope: Steepest slope that was fitted.
    """

    coefficients: FloatArray
    place_degree: int
    sigma: FloatArray
    max_slope: float

    def ratio_change(self, slopes: FloatArray, unit_uv: FloatArray) -> FloatArray:
        """I/B − 1, (n, 3), at slopes (n, 2) and places (n, 2)."""
        return np.asarray(_basis(slopes, unit_uv, self.place_degree) @ self.coefficients)


def fit_shading(
    slopes: FloatArray,
    unit_uv: FloatArray,
    colours: FloatArray,
    background: FloatArray,
    *,
    place_degree: int = 1,
) -> Shading:
    """Ridge regression in grey levels, so that dark corners do not count more than they tell.

    Args:
        slopes: (n, 2) true slopes.
        unit_uv: (n, 2) u/W, v/H.
        colours: (n, 3) grey levels.
        background: (n, 3) grey levels of the untouched gel at the same pixels.
        place_degree: Highest power of the place; 0 where all presses are in one place.
    """
    flat = Shading(np.zeros(()), place_degree, np.zeros(3), 0.0)
    coefficients, sigma = _ridge(flat, slopes, unit_uv, colours, background)
    steepest = float(np.percentile(np.hypot(slopes[:, 0], slopes[:, 1]), 99.5))
    return Shading(coefficients, place_degree, sigma, steepest)


def fit_change(
    known: Shading, slopes: FloatArray, unit_uv: FloatArray, colours: FloatArray, background: FloatArray
) -> FloatArray:
    """Coefficients (k, 3) to add to a known shading for another gel, small where presses say nothing."""
    return _ridge(known, slopes, unit_uv, colours, background)[0]


def _ridge(
    known: Shading, slopes: FloatArray, unit_uv: FloatArray, colours: FloatArray, background: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Coefficients (k, 3) beyond what is known, and the residual's rms (3,)."""
    basis = _basis(slopes, unit_uv, known.place_degree)  # (n, k)
    k = basis.shape[1]
    expected = basis @ np.broadcast_to(known.coefficients, (k, 3))  # (n, 3)
    coefficients, sigma = np.empty((k, 3)), np.empty(3)
    for c in range(3):
        A = basis * background[:, c : c + 1]
        y = colours[:, c] - background[:, c] * (1.0 + expected[:, c])
        scale = A.std(axis=0) + 1e-9
        A /= scale
        x = np.linalg.solve(A.T @ A + _RIDGE * len(A) * np.eye(k), A.T @ y)
        sigma[c] = np.sqrt(np.mean((A @ x - y) ** 2))
        coefficients[:, c] = x / scale
    return coefficients, sigma


def _basis(slopes: FloatArray, unit_uv: FloatArray, place_degree: int) -> FloatArray:
    """(n, k): every φ_k(n) − φ_k(e_z) times every power of the place."""
    n_z = 1.0 / np.sqrt(1.0 + np.sum(slopes * slopes, axis=1))
    a, b = slopes[:, 0] * n_z, slopes[:, 1] * n_z
    smooth = np.stack([a, b, n_z - 1.0, a * a, a * b, b * b], axis=1)
    lamps = _soft_positive(np.stack([a, b, n_z], axis=1) @ _LAMPS) - _soft_positive(_LAMPS[2])
    phi = np.concatenate([smooth, lamps], axis=1)  # (n, 38)
    x, y = 2.0 * unit_uv[:, 0] - 1.0, 2.0 * unit_uv[:, 1] - 1.0
    psi = [x**i * y**j for i in range(place_degree + 1) for j in range(place_degree + 1 - i)]
    return np.concatenate([phi * g[:, None] for g in psi], axis=1)


def _soft_positive(x: FloatArray) -> FloatArray:
    """max(x, 0) with its corner rounded: lamps are wide."""
    return np.asarray(0.5 * (x + np.sqrt(np.square(x) + _SOFTNESS**2)))


def _lamp_directions() -> FloatArray:
    """(3, lamps) unit vectors all around at each elevation."""
    azimuth = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    rings = [
        np.stack([np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.full(_AZIMUTHS, np.sin(e))])
        for e in _ELEVATIONS
    ]
    return np.concatenate(rings, axis=1)


_LAMPS = _lamp_directions()
