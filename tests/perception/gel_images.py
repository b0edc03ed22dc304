"""Analytic gel images: colours linear in the surface's slopes, soft discs for dots, truth in closed form."""

from __future__ import annotations

import numpy as np

from tiptrace.calibration.gel_onnx import mlp_to_onnx
from tiptrace.perception.gel_model import Convention, GelModel

W, H = 320, 240
S_M = 62.5e-6  # metres per pixel
BASE = np.array([130.0, 120.0, 110.0])  # B, G, R of flat gel
GAIN = 90.0  # grey levels per unit slope: B shows ∂z/∂x, G shows ∂z/∂y


def grid(pitch: float = 31.0, size: tuple[int, int] = (W, H), margin: float = 16.0) -> np.ndarray:
    """Dot centres (n, 2) px of a slightly irregular grid."""
    u, v = np.meshgrid(np.arange(margin, size[0] - margin, pitch), np.arange(margin, size[1] - margin, pitch))
    uv = np.column_stack([u.ravel(), v.ravel()])
    wobble = np.column_stack([np.sin(uv[:, 1] * 0.7 + uv[:, 0]), np.cos(uv[:, 0] * 0.9)])
    return uv + 1.3 * wobble + 0.37


def paint_dots(
    image: np.ndarray, uv_px: np.ndarray, diameter: float = 10.0, level: float = 25.0
) -> np.ndarray:
    """Dots with a rim one pixel wide; their truth is their centre, no warping involved."""
    v, u = np.indices(image.shape[:2], dtype=np.float64)
    out = image.astype(np.float64)
    r = diameter / 2.0
    for cu, cv in uv_px:
        u0, u1 = int(max(cu - r - 3, 0)), int(min(cu + r + 4, image.shape[1]))
        v0, v1 = int(max(cv - r - 3, 0)), int(min(cv + r + 4, image.shape[0]))
        if u0 >= u1 or v0 >= v1:
            continue
        rho = np.hypot(u[v0:v1, u0:u1] - cu, v[v0:v1, u0:u1] - cv)
        ink = np.clip(r + 0.5 - rho, 0.0, 1.0)[..., None]
        out[v0:v1, u0:u1] = (1 - ink) * out[v0:v1, u0:u1] + ink * level
    return out


def bump(
    depth_m: float, sigma_px: float, centre: tuple[float, float] = (150.0, 130.0)
) -> tuple[np.ndarray, ...]:
    """Height z = −h of a Gaussian press and its slopes: z (H, W) m, p, q (H, W) m/m."""
    v, u = np.indices((H, W), dtype=np.float64)
    du, dv = u - centre[0], v - centre[1]
    z = -depth_m * np.exp(-(du**2 + dv**2) / (2 * sigma_px**2))
    return z, -z * du / sigma_px**2 / S_M, -z * dv / sigma_px**2 / S_M


def shade(p: np.ndarray | float = 0.0, q: np.ndarray | float = 0.0) -> np.ndarray:
    """Colours (H, W, 3) float of a gel with slopes p, q and no dots."""
    image = np.tile(BASE, (H, W, 1))
    image[..., 0] += GAIN * np.asarray(p)
    image[..., 1] += GAIN * np.asarray(q)
    return image


def to_uint8(image: np.ndarray, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Camera: noise and rounding."""
    if noise:
        image = image + np.random.default_rng(seed).normal(0.0, noise, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def linear_gel() -> GelModel:
    """The network that inverts :func:`shade` exactly."""
    Wm = np.zeros((5, 2))
    Wm[0, 0] = Wm[1, 1] = 255.0 / GAIN
    b = -BASE[:2] / GAIN
    return GelModel(mlp_to_onnx([Wm], [b], Convention(output="slopes")))
