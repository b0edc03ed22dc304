"""From gradients to height: metric Poisson integration on a staggered grid (paper, Sec. II-B, depth)."""

from __future__ import annotations

import functools

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.errors import PerceptionError

Float32Map = NDArray[np.float32]


class PoissonSolver:
    """Least-squares height of a gradient field, for one map size.

    Minimises Σ(Δ_x z/s_x − p̄)² + Σ(Δ_y z/s_y − q̄)² where the differences Δ live half way between pixels and
    p̄, q̄ are the mean slopes of the same interval (cubic through four samples, so that a narrow bump keeps its
    height). The normal equations are a Poisson equation with natural boundaries, which the type-II cosine
    transform diagonalises: frequencies k = 0 … N − 1 with eigenvalues (2 cos(πk/N) − 2)/s². The mean (k = 0)
    is free and set to 0. A tilt is returned exactly, whatever its direction.
    """

    def __init__(self, shape: tuple[int, int], metres_per_px: tuple[float, float]) -> None:
        """Prepare a solver.

        Args:
            shape: (H, W) of the map.
            metres_per_px: (s_x, s_y), m between neighbouring samples of the map.
        """
        self.shape = shape
        self._s_x, self._s_y = (np.float32(s) for s in metres_per_px)
        self._inverse_eigenvalues = _inverse_eigenvalues(shape, metres_per_px)

    def integrate(self, p: Float32Map, q: Float32Map) -> Float32Map:
        """Height z (H, W) in m with mean 0 from p = ∂z/∂x and q = ∂z/∂y, each (H, W), m/m.

        Raises:
            PerceptionError: maps of another size, or a gradient that is not finite (one spoils every pixel).
        """
        if p.shape != self.shape or q.shape != self.shape:
            raise PerceptionError(f"gradient maps are {p.shape} and {q.shape}, expected {self.shape}")
        if not (np.isfinite(p.sum()) and np.isfinite(q.sum())):
            raise PerceptionError("gradient map holds values that are not finite; fill or mask them first")
        f = _divergence(np.ascontiguousarray(p), np.ascontiguousarray(q), 1.0 / self._s_x, 1.0 / self._s_y)
        f_hat = scipy.fft.dctn(f, type=2, norm="ortho", overwrite_x=True)
        f_hat *= self._inverse_eigenvalues
        z: Float32Map = scipy.fft.idctn(f_hat, type=2, norm="ortho", overwrite_x=True)
        return z


@compiled
def _divergence(p: Float32Map, q: Float32Map, per_s_x: np.float32, per_s_y: np.float32) -> Float32Map:
    """Differences of the interval means of p along x and of q along y, (H, W) m⁻¹; nothing flows over the border."""
    H, W = p.shape
    f = np.zeros((H, W), dtype=np.float32)
    half, cubic = np.float32(0.5), np.float32(1.0 / 24.0)
    row = np.empty(W - 1, dtype=np.float32)
    for v in range(
        H
    ):  # mean between neighbouring samples: (−p₋₁ + 13 p₀ + 13 p₁ − p₂)/24, trapezoid at the borders
        for u in range(W - 1):
            row[u] = half * (p[v, u] + p[v, u + 1])
        for u in range(1, W - 2):
            row[u] += cubic * (p[v, u] + p[v, u + 1] - p[v, u - 1] - p[v, u + 2])
        for u in range(W - 1):
            f[v, u] += per_s_x * row[u]
        for u in range(W - 1):
            f[v, u + 1] -= per_s_x * row[u]
    for v in range(H - 1):
        inner = 0 < v < H - 2
        for u in range(W):
            mean = half * (q[v, u] + q[v + 1, u])
            if inner:
                mean += cubic * (q[v, u] + q[v + 1, u] - q[v - 1, u] - q[v + 2, u])
            f[v, u] += per_s_y * mean
            f[v + 1, u] -= per_s_y * mean
    return f


@functools.lru_cache(maxsize=16)
def _inverse_eigenvalues(shape: tuple[int, int], metres_per_px: tuple[float, float]) -> Float32Map:
    """1/λ of the discrete Laplacian, (H, W), m²; 0 for the mean."""
    (H, W), (s_x, s_y) = shape, metres_per_px
    lambda_x = (2.0 * np.cos(np.pi * np.arange(W) / W) - 2.0) / s_x**2
    lambda_y = (2.0 * np.cos(np.pi * np.arange(H) / H) - 2.0) / s_y**2
    eigenvalues = lambda_y[:, None] + lambda_x[None, :]  # (H, W)
    eigenvalues[0, 0] = np.inf
    inverse = (1.0 / eigenvalues).astype(np.float32)
    inverse.setflags(write=False)
    return inverse
