"""Marker dots of a gel: layout, where they go when it deforms, what they take from the light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from tiptrace.sim.gel import Float32Array, GelDeformation
from tiptrace.types import FloatArray

_STEP_M = 0.3e-3  # distance over which a dot's stretch is measured
_MOST_STRAIN = 0.3


@dataclass(frozen=True, slots=True)
class DotLayout:
    """A printed grid of dots.

    Attributes:
        columns: Dots along x.
        rows: Dots along y.
        pitch_m: Distance along x and y.
        diameter_m: Of a dot.
        offset_m: Centre of the grid in F_S.
        angle_deg: Turn of the grid in the image.
        jitter_m: Standard deviation of a dot's place.
        uneven: Standard deviation of diameter and roundness, a share.
        darkness: Share of the coating's light that a dot takes.
        edge_m: Softness (σ) of a dot's edge.
        glint: Brightest highlight in a dot, grey levels.
    """

    columns: int = 10
    rows: int = 8
    pitch_m: tuple[float, float] = (31.4 * 0.0625e-3, 32.2 * 0.0625e-3)
    diameter_m: float = 10.5 * 0.0625e-3
    offset_m: tuple[float, float] = (0.0, 0.0)
    angle_deg: float = 0.0
    jitter_m: float = 0.02e-3
    uneven: float = 0.03
    darkness: float = 0.73
    edge_m: float = 0.075e-3
    glint: float = 8.0

    def draw(self, rng: np.random.Generator) -> Dots:
        """The dots of one gel."""
        i, j = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        grid = np.stack(
            [(i - (self.columns - 1) / 2) * self.pitch_m[0], (j - (self.rows - 1) / 2) * self.pitch_m[1]]
        )
        a = np.radians(self.angle_deg)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        rest = grid.reshape(2, -1).T @ turn.T + np.asarray(self.offset_m)  # (n, 2)
        n = len(rest)
        rest = rest + rng.normal(0, self.jitter_m, (n, 2))
        radius = self.diameter_m / 2 * (1 + rng.normal(0, self.uneven, n))
        squeeze = rng.normal(0, self.uneven, (n, 2))
        shape = np.stack(
            [[1 + squeeze[:, 0], squeeze[:, 1]], [squeeze[:, 1], 1 - squeeze[:, 0]]]
        )  # (2, 2, n)
        glint = self.glint * np.clip(rng.normal(0, 1, n), 0, 2) / 2
        at = rng.normal(0, self.diameter_m / 8, (n, 2))
        return Dots(rest, radius, np.moveaxis(shape, 2, 0), glint, at, self.darkness, self.edge_m)


@dataclass(frozen=True, slots=True, eq=False)
class Dots:
    """The dots of one gel at rest.

    Attributes:
        rest_xy: (n, 2) centres, m.
        radius_m: (n,).
        shape: (n, 2, 2) symmetric map from a disc to the printed outline.
        glint: (n,) highlight inside the dot, grey levels.
        glint_at: (n, 2) its place from the dot's centre, m.
        darkness: Share of light taken.
        edge_m: Softness of the edge.
    """

    rest_xy: FloatArray
    radius_m: FloatArray
    shape: FloatArray
    glint: FloatArray
    glint_at: FloatArray
    darkness: float
    edge_m: float


@dataclass(frozen=True, slots=True, eq=False)
class DotTruth:
    """True dots in one image.

    Attributes:
        uv_px: (n, 2) centres in the image.
        x_S: (n, 3) what the dots show: their positions in F_S, m, at the height of the surface over them.
        outline_px: (n, 2, 2) map from the unit disc to the dot's outline in pixels.
        px_per_metre: (2,).
    """

    uv_px: FloatArray
    x_S: FloatArray
    outline_px: FloatArray
    px_per_metre: FloatArray


def place_dots(
    dots: Dots,
    deformation: GelDeformation,
    shown_fraction: float,
    metres_per_px: tuple[float, float],
    size_px: tuple[int, int],
) -> DotTruth:
    """Where the dots of a deformed gel are, and how they are stretched."""
    rest = dots.rest_xy
    step_x, step_y = np.array([_STEP_M, 0.0]), np.array([0.0, _STEP_M])
    around = np.concatenate([rest, rest + step_x, rest + step_y])
    moved = deformation.dots(around, shown_fraction)
    n = len(rest)
    at = moved[:n]
    F = np.stack([moved[n : 2 * n, :2] - at[:, :2], moved[2 * n :, :2] - at[:, :2]], axis=-1) / _STEP_M
    F = _bounded(F)
    px = 1 / np.asarray(metres_per_px)
    centre = (np.asarray(size_px) - 1) / 2
    outline = px[:, None] * (F @ dots.shape * dots.radius_m[:, None, None])
    return DotTruth(at[:, :2] * px + centre, at, outline, px)


def _bounded(F: FloatArray) -> FloatArray:
    """A dot is stiffer than bare gel: its own strain levels off at ``_MOST_STRAIN``."""
    strain = F - np.eye(2)  # (n, 2, 2)
    size = np.linalg.norm(strain, axis=(1, 2), keepdims=True)
    return np.asarray(np.eye(2) + strain / np.sqrt(1 + (size / _MOST_STRAIN) ** 2))


def dot_transmission(
    dots: Dots, truth: DotTruth, shape: tuple[int, int]
) -> tuple[Float32Array, Float32Array]:
    """Share of light (h, w) that the dots let through, and the light (h, w) of the glints on them.

    A dot's edge is the integral of a Gaussian across its outline, so that its centre is exact at any
    sub-pixel position.
    """
    kept, shine = np.ones(shape, np.float32), np.zeros(shape, np.float32)
    edge_px = dots.edge_m * float(truth.px_per_metre.mean())
    half = int(np.ceil(np.abs(truth.outline_px).sum(axis=2).max() + 4 * edge_px))
    base = np.round(truth.uv_px).astype(int)
    span = np.arange(-half, half + 1)
    du = (span[None, :] + (base - truth.uv_px)[:, :1]).astype(np.float32)  # (n, m)
    dv = (span[None, :] + (base - truth.uv_px)[:, 1:]).astype(np.float32)
    inverse = np.linalg.inv(truth.outline_px).astype(np.float32)
    p = inverse[:, 0, 0, None, None] * du[:, None, :] + inverse[:, 0, 1, None, None] * dv[:, :, None]
    q = inverse[:, 1, 0, None, None] * du[:, None, :] + inverse[:, 1, 1, None, None] * dv[:, :, None]
    radius_px = np.sqrt(np.abs(np.linalg.det(truth.outline_px))).astype(np.float32)[:, None, None]
    inside = (1 - np.sqrt(p * p + q * q)) * radius_px / np.float32(edge_px)  # in σ of the edge
    cover = np.float32(0.5) * (1 + erf(inside * np.float32(np.sqrt(0.5))))
    g = (dots.glint_at * truth.px_per_metre).astype(np.float32)
    away = (du - g[:, :1])[:, None, :] ** 2 + (dv - g[:, 1:])[:, :, None] ** 2
    glint = dots.glint.astype(np.float32)[:, None, None] * np.exp(-away / np.float32(2 * 1.2**2)) * cover
    for (u, v), c, s in zip(base, 1 - np.float32(dots.darkness) * cover, glint, strict=True):
        _into(kept, c, u - half, v - half, np.multiply)
        _into(shine, s, u - half, v - half, np.add)
    return kept, shine


def _into(image: Float32Array, patch: Float32Array, u: int, v: int, operation: np.ufunc) -> None:
    """Combine a patch into an image at column u, row v, as far as it lies inside."""
    top, left = max(v, 0), max(u, 0)
    bottom, right = min(v + patch.shape[0], image.shape[0]), min(u + patch.shape[1], image.shape[1])
    if bottom > top and right > left:
        view = image[top:bottom, left:right]
        operation(view, patch[top - v : bottom - v, left - u : right - u], out=view)
