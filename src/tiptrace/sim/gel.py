"""The soft gel under a rigid tool: surface height, tangential displacement, where material points go.

Everything is in F_S: origin on the undeformed surface at the image centre, +x image right, +y image down,
+z out of the gel towards the object. The surface is found as the lowest elastic membrane on the tool: inside
the contact it is the tool's surface, outside it relaxes over millimetres (the gel is 4 mm thick). All steps
are continuous in the tool's position, so nothing jumps when the tool crosses a grid line.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from tiptrace.types import FloatArray

Float32Array = NDArray[np.float32]
Order = Literal[1, 3]


@dataclass(frozen=True, slots=True, eq=False)
class GelGrid:
    """Regular grid of surface points in F_S; fields on it are indexed [y, x].

    Attributes:
        x_m: (nx,) columns, increasing, evenly spaced.
        y_m: (ny,) rows, increasing, with the same spacing.
    """

    x_m: FloatArray
    y_m: FloatArray

    @property
    def pitch_m(self) -> float:
        """Distance between neighbours."""
        return float(self.x_m[1] - self.x_m[0])

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return len(self.y_m), len(self.x_m)

    def mesh(self) -> tuple[FloatArray, FloatArray]:
        """X and Y of every grid point, (ny, nx) each, m."""
        X, Y = np.meshgrid(self.x_m, self.y_m)
        return X, Y

    def at(
        self, values: FloatArray | Float32Array, points: FloatArray, order: Literal[1, 3] = 3
    ) -> FloatArray:
        """Interpolate a field (ny, nx) at points (n, 2), m, by splines of the given order."""
        rows = (points[:, 1] - self.y_m[0]) / self.pitch_m
        columns = (points[:, 0] - self.x_m[0]) / self.pitch_m
        field_values = np.asarray(values, dtype=np.float64)
        at = np.stack([rows, columns])
        if order == 1:
            return ndimage.map_coordinates(field_values, at, order=1, mode="nearest")
        return ndimage.map_coordinates(field_values, at, order=3, mode="nearest")


def grid_over(width_m: float, height_m: float, pitch_m: float = 0.25e-3, margin_m: float = 2e-3) -> GelGrid:
    """Grid centred on the image, a margin wider on each side."""
    nx, ny = (2 * round((size / 2 + margin_m) / pitch_m) for size in (width_m, height_m))
    x_m = pitch_m * (np.arange(nx, dtype=np.float64) - (nx - 1) / 2)
    y_m = pitch_m * (np.arange(ny, dtype=np.float64) - (ny - 1) / 2)
    return GelGrid(x_m, y_m)


GEL_GRID = grid_over(20e-3, 15e-3)


@dataclass(frozen=True, slots=True)
class PadContact:
    """What the physics knows of one pad at one instant.

    Attributes:
        penetration_m: (ny, nx) overlap of the rigid tool with the undeformed gel at each grid point: ≥ 0
            inside the contact, negative where there is a gap. It must be continuous in space: beyond the
            tool's outline let it fall by ``WALL_SLOPE`` times the distance to the outline
            (``p(nearest point of the outline) − WALL_SLOPE · distance``), never to −∞ in one step.
        nodes_m: (k, 2) rest positions of the surface points in contact, m; k may be 0.
        shear_m: (k, 2) tangential displacement of the surface at these points, m.
    """

    penetration_m: FloatArray
    nodes_m: FloatArray
    shear_m: FloatArray


WALL_SLOPE = 3.0
"""Fall of penetration per metre beyond a tool's outline: a gel does not follow a steeper wall."""


@dataclass(frozen=True, slots=True)
class GelParameters:
    """How the gel yields around and under a contact.

    Attributes:
        thickness_m: Gel from coating to backing.
        skirt_m: Distance over which the surface rises beside a contact.
        tail_m: Distance of the wide, shallow part of the skirt.
        tail_weight: Strength w of the wide part, below 1.
        rounding_m: Radius over which the coating bridges the tool's own edges.
        coating_m: Radius over which it rounds the rim of the contact.
        shear_decay_m: Distance over which tangential displacement dies out beside the contact.
        follow_m: Reach of a contact node's displacement inside the contact (about the nodes' pitch).
        bulge: Share of the displaced gel that rises beside the contact, over about its thickness.
    """

    thickness_m: float = 4e-3
    skirt_m: float = 1.0e-3
    tail_m: float = 2.2e-3
    tail_weight: float = 0.35
    rounding_m: float = 0.3e-3
    coating_m: float = 0.1e-3
    shear_decay_m: float = 2.5e-3
    follow_m: float = 1.0e-3
    bulge: float = 0.0


def unseen_gel(seed: int) -> GelParameters:
    """A gel of another law: nearly incompressible, so that it bulges beside a contact, and of other stiffness."""
    rng = np.random.default_rng([seed, 0x6E15])
    return GelParameters(
        skirt_m=float(rng.uniform(0.55e-3, 0.75e-3)),
        tail_weight=0.0,
        shear_decay_m=float(rng.choice([rng.uniform(1.2e-3, 1.7e-3), rng.uniform(3.5e-3, 4.5e-3)])),
        bulge=float(rng.uniform(0.15, 0.3)),
    )


@dataclass(frozen=True, slots=True)
class GelDeformation:
    """A deformed gel.

    Attributes:
        grid: Where the fields are sampled.
        height_m: (ny, nx) surface height along +z_S: 0 untouched, negative pressed in.
        engaged: (ny, nx) how far the surface follows the tool sideways: 1 in contact, falling to 0 outside.
        contact: What caused it.
        parameters: The gel.
    """

    grid: GelGrid
    height_m: Float32Array
    engaged: Float32Array
    contact: PadContact
    parameters: GelParameters = field(default_factory=GelParameters)

    def displacement(self, points_xy: FloatArray) -> FloatArray:
        """Displacement (n, 3), m, of the surface points that rest at ``points_xy`` (n, 2), m."""
        shear = _shear_at(self, points_xy)  # (n, 2)
        height = self.grid.at(self.height_m, points_xy + shear)  # (n,)
        return np.column_stack([shear, height])

    def dots(self, rest_xy: FloatArray, shown_fraction: float = 1.0) -> FloatArray:
        """Positions (n, 3), m, of dots that lie below the surface and show a fraction of its motion.

        Args:
            rest_xy: (n, 2) rest positions, m.
            shown_fraction: Share of the surface's tangential displacement that a dot makes.
        """
        moved = rest_xy + shown_fraction * _shear_at(self, rest_xy)  # (n, 2)
        return np.column_stack([moved, self.grid.at(self.height_m, moved)])


def untouched(grid: GelGrid = GEL_GRID, parameters: GelParameters | None = None) -> GelDeformation:
    """The gel before any contact."""
    gap = PadContact(np.full(grid.shape, -1e-3), np.zeros((0, 2)), np.zeros((0, 2)))
    zero = np.zeros(grid.shape, np.float32)
    return GelDeformation(grid, zero, zero.copy(), gap, parameters or GelParameters())


def deform(
    contact: PadContact, grid: GelGrid = GEL_GRID, parameters: GelParameters | None = None
) -> GelDeformation:
    """Surface and displacement field of the gel under a tool.

    Args:
        contact: Overlap and contact nodes, sampled on ``grid``.
        grid: Where fields are sampled.
        parameters: The gel; defaults to a fresh GelSight Mini pad.
    """
    gel = parameters or GelParameters()
    overlap = contact.penetration_m.astype(np.float32)
    if not (overlap > 0).any():
        return replace(untouched(grid, gel), contact=contact)
    depth = _drape(_round_edges(overlap, gel.rounding_m / grid.pitch_m), grid.pitch_m, gel)
    engaged = _spread(_coverage(overlap), grid.pitch_m, gel.shear_decay_m)
    height = -depth
    if gel.bulge > 0:
        height += np.float32(gel.bulge) * (1 - engaged) * _blur(depth, 0.6 * gel.thickness_m / grid.pitch_m)
    return GelDeformation(grid, height, engaged, contact, gel)


def _round_edges(overlap: Float32Array, radius_cells: float) -> Float32Array:
    """Bridge kinks of the tool, so that no edge falls between grid lines; spheres stay spheres (2 G − G²)."""
    once = _blur(np.maximum(overlap, np.float32(-1e-3)), radius_cells)
    return np.asarray(np.minimum(overlap, 2 * once - _blur(once, radius_cells)), dtype=np.float32)


def _coverage(overlap: Float32Array) -> Float32Array:
    """Share of each grid cell that is in contact: the distance to the rim, overlap / |∇overlap|, in cells."""
    slope_y, slope_x = np.gradient(overlap)  # per cell
    steepness = np.sqrt(slope_x**2 + slope_y**2)
    covered = 0.5 + overlap / np.maximum(steepness, np.float32(1e-6))
    return np.asarray(np.clip(covered, 0, 1), dtype=np.float32)


def _drape(overlap: Float32Array, pitch_m: float, gel: GelParameters) -> Float32Array:
    """Depth u of the membrane over the tool.

    Where the tool is away, −λ² ∇²u + u = w G_tail u: an exponential skirt of length λ with a long, shallow tail
    as an elastic layer has it. Relaxed as u = max(overlap, γ G_σ u + (1 − γ) w G_tail u) with γ = 1 − σ²/(2 λ²),
    from wide to narrow σ, so that it converges in a fixed number of steps.
    """
    u: Float32Array = np.maximum(overlap, 0)
    for share, steps in ((0.8, 8), (0.4, 8), (0.2, 8)):  # σ as a share of λ
        kept = np.float32(1 - 0.5 * share**2)
        far = (1 - kept) * np.float32(gel.tail_weight) * _blur(u, gel.tail_m / pitch_m)
        for _ in range(steps):
            u = np.maximum(overlap, kept * _blur(u, share * gel.skirt_m / pitch_m) + far)
    return _blur(u, gel.coating_m / pitch_m)


def _spread(contact: Float32Array, pitch_m: float, decay_m: float) -> Float32Array:
    """1 in contact, about e^(−distance/decay) outside, by the same relaxation, from coarse to fine."""
    a = contact
    for share, steps in ((0.4, 14), (0.2, 8), (0.1, 8)):  # σ as a share of the decay
        kept = np.float32(1 - 0.5 * share**2)
        for _ in range(steps):
            a = np.maximum(contact, kept * _blur(a, share * decay_m / pitch_m))
    return a


def _blur(values: Float32Array, sigma_cells: float) -> Float32Array:
    size = 2 * int(np.ceil(2.5 * sigma_cells)) + 1
    out = cv2.GaussianBlur(values, (size, size), sigma_cells, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.float32)


def _shear_at(deformation: GelDeformation, points: FloatArray) -> FloatArray:
    """Tangential displacement (n, 2): a local rigid-like fit to the contact nodes, fading outside."""
    contact, gel = deformation.contact, deformation.parameters
    if len(contact.nodes_m) == 0:
        return np.zeros((len(points), 2))
    overlap = np.maximum(deformation.grid.at(contact.penetration_m, contact.nodes_m, order=1), 0)  # (k,)
    weight = (
        overlap / max(float(overlap.max()), 1e-6)
    ) ** 2 + 1e-6  # lightly loaded nodes at the rim count little
    fit = _local_linear(points, contact.nodes_m, contact.shear_m, weight, gel.follow_m)
    engaged = deformation.grid.at(deformation.engaged, points, order=1)
    return fit * np.clip(engaged, 0, 1)[:, None]


def _local_linear(
    points: FloatArray, nodes: FloatArray, values: FloatArray, weight: FloatArray, reach: float
) -> FloatArray:
    """Moving least squares of first order: exact for fields linear in position, bounded outside.

    The reach grows with the distance to the contact, so that the field fades smoothly from all of its near side.
    """
    d2 = ((points[:, None] - nodes[None]) ** 2).sum(-1)  # (n, k)
    gap = d2.min(axis=1, keepdims=True)
    nearest = gap - reach**2 * np.log(np.exp((gap - d2) / reach**2).sum(axis=1, keepdims=True))  # smooth
    spread = reach**2 + 4 * np.maximum(nearest, 0)
    w = weight * np.exp((gap - d2) / (2 * spread))
    w /= w.sum(axis=1, keepdims=True)
    products = [nodes[:, i] * other[:, j] for other in (nodes, values) for i in (0, 1) for j in (0, 1)]
    moments = np.einsum("nk,kf->nf", w, np.column_stack([nodes, values, *products]))  # (n, 12)
    centre, mean = moments[:, :2], moments[:, 2:4]
    C = moments[:, 4:8].reshape(-1, 2, 2) - centre[:, :, None] * centre[:, None, :]
    B = moments[:, 8:12].reshape(-1, 2, 2) - centre[:, :, None] * mean[:, None, :]
    slope = np.linalg.solve(C + 1e-3 * reach**2 * np.eye(2), B)  # (n, 2, 2)
    offset = points - centre
    far = np.linalg.norm(offset, axis=1, keepdims=True) / (1.5 * reach)
    return np.asarray(mean + np.einsum("ni,nij->nj", offset / (1 + far**8) ** 0.125, slope))


def spline_coefficients(values: Float32Array) -> Float32Array:
    """Coefficients of the cubic B-splines that pass through a field on the grid."""
    return ndimage.spline_filter(values, order=3, mode="mirror", output=np.float32)


def spline_basis(knots_m: FloatArray, points_m: FloatArray, derivative: int = 0) -> sparse.csr_array:
    """Matrix (n, m) from m cubic B-spline coefficients on even knots to values (or slopes) at n points.

    Sparse, so that sampling a field stays on one core and costs four products a point and direction.
    """
    pitch = float(knots_m[1] - knots_m[0])
    t = np.clip((points_m - knots_m[0]) / pitch, 1, len(knots_m) - 2.001)
    cell = np.floor(t).astype(int)
    f = t - cell
    if derivative == 0:
        taps = [
            (1 - f) ** 3 / 6,
            (3 * f**3 - 6 * f**2 + 4) / 6,
            (-3 * f**3 + 3 * f**2 + 3 * f + 1) / 6,
            f**3 / 6,
        ]
    else:
        taps = [-((1 - f) ** 2) / 2, (3 * f**2 - 4 * f) / 2, (-3 * f**2 + 2 * f + 1) / 2, f**2 / 2]
    weights = np.stack(taps, axis=1) / pitch**derivative  # (n, 4)
    columns = cell[:, None] + np.arange(-1, 3)
    rows = np.repeat(np.arange(len(t)), 4)
    entries = (weights.ravel().astype(np.float32), (rows, columns.ravel()))
    return sparse.csr_array(entries, shape=(len(t), len(knots_m)))
