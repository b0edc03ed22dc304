"""Ball presses on a virtual gel, as a user makes them to calibrate one, with the truth that a user lacks."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from tiptrace.sim.dots import DotLayout
from tiptrace.sim.gel import GEL_GRID, Float32Array, GelGrid, GelParameters, PadContact, deform
from tiptrace.sim.optics import gel_optics
from tiptrace.sim.render import CameraNoise, TactileRenderer
from tiptrace.types import FloatArray, Image

BALL_DIAMETERS_M = (3e-3, 4e-3, 6e-3, 8e-3)
"""Bearing balls that a user can buy."""

_STEEPEST = 0.94  # share of a ball's radius beyond which its flank is replaced by a straight wall


@dataclass(frozen=True, slots=True, eq=False)
class Press:
    """A rendered press and its truth.

    Attributes:
        image: (h, w, 3) BGR.
        height_m: (h, w) surface height along +z_S.
        slope: (h, w, 2) ∂z/∂x, ∂z/∂y.
        center_px: (u, v) of the ball's lowest point.
        contact_radius_px: Radius within which the surface is the ball's, to 5 % of its slope.
        ball_diameter_m: Of the ball.
        depth_m: How deep the ball's lowest point lies under the undeformed surface.
    """

    image: Image
    height_m: Float32Array
    slope: Float32Array
    center_px: tuple[float, float]
    contact_radius_px: float
    ball_diameter_m: float
    depth_m: float


def ball_penetration(
    center_m: tuple[float, float], ball_diameter_m: float, depth_m: float, grid: GelGrid = GEL_GRID
) -> FloatArray:
    """Overlap (ny, nx), m, of a ball with the undeformed gel; see :class:`~tiptrace.sim.gel.PadContact`."""
    X, Y = grid.mesh()
    R = ball_diameter_m / 2
    r = np.hypot(X - center_m[0], Y - center_m[1])
    cap = _STEEPEST * R
    on_ball = np.minimum(r, cap)
    wall = cap / np.sqrt(R**2 - cap**2)
    return np.asarray(depth_m - R + np.sqrt(R**2 - on_ball**2) - wall * (r - on_ball))


def render_press(
    renderer: TactileRenderer,
    center_px: tuple[float, float],
    ball_diameter_m: float,
    depth_m: float,
    *,
    frame: int = 0,
    grid: GelGrid = GEL_GRID,
    parameters: GelParameters | None = None,
) -> Press:
    """Press a ball into the gel of a renderer.

    Args:
        renderer: The sensor.
        center_px: Where, in its image.
        ball_diameter_m: Of the ball.
        depth_m: How deep.
        frame: Number of the exposure (noise).
        grid: Finer for balls under 2 mm.
        parameters: The gel.
    """
    sx, sy = renderer.metres_per_px
    width, height = renderer.size_px
    center_m = (center_px[0] - (width - 1) / 2) * sx, (center_px[1] - (height - 1) / 2) * sy
    none = np.zeros((0, 2))
    overlap = ball_penetration(center_m, ball_diameter_m, depth_m, grid)
    deformation = deform(PadContact(overlap, none, none), grid, parameters)
    slope_x, slope_y = renderer.slopes(deformation)
    slope = np.stack([slope_x, slope_y], axis=-1)
    return Press(
        image=renderer.render(deformation, frame),
        height_m=renderer.heights(deformation),
        slope=slope,
        center_px=center_px,
        contact_radius_px=_contact_radius(renderer, slope, center_m, ball_diameter_m)
        / float(np.sqrt(sx * sy)),
        ball_diameter_m=ball_diameter_m,
        depth_m=depth_m,
    )


def _contact_radius(
    renderer: TactileRenderer, slope: Float32Array, center_m: tuple[float, float], ball_diameter_m: float
) -> float:
    """Largest radius, m, up to which the mean radial slope is that of the ball within 5 %."""
    dx, dy = np.meshgrid(renderer.x_m - center_m[0], renderer.y_m - center_m[1])
    r = np.hypot(dx, dy)
    radial = (slope[..., 0] * dx + slope[..., 1] * dy) / np.maximum(r, 1e-9)
    R, step = ball_diameter_m / 2, renderer.metres_per_px[0]
    radii = np.arange(1.5 * step, 0.9 * R, step)
    for inner in radii:
        ring = (r >= inner) & (r < inner + step)
        expected = r[ring] / np.sqrt(R**2 - np.minimum(r[ring], 0.99 * R) ** 2)
        if ring.any() and inner > 4 * step and radial[ring].mean() < 0.95 * expected.mean():
            return float(inner)
    return float(radii[-1])


@dataclass(frozen=True, slots=True)
class PressPlan:
    """A calibration session.

    Attributes:
        gel_seeds: Gels, used in turn, see :func:`tiptrace.sim.optics.gel_optics`; None is the fitted gel. A user
            has one; the packaged network is made on several.
        layout: Dots of the gel, None for a gel without.
        columns: Presses per row of the image.
        rows: Rows of presses.
        rounds: How often the whole gel is covered.
        ball_diameters_m: Balls, used in turn.
        depth_m: Shallowest and deepest press.
        seed: Where exactly and how deep.
    """

    gel_seeds: tuple[int | None, ...] = (None,)
    layout: DotLayout | None = None
    columns: int = 8
    rows: int = 6
    rounds: int = 1
    ball_diameters_m: tuple[float, ...] = BALL_DIAMETERS_M
    depth_m: tuple[float, float] = (0.4e-3, 1.6e-3)
    seed: int = 0


def write_press_folder(
    folder: Path, plan: PressPlan, progress: Callable[[int, int], None] | None = None
) -> list[Press]:
    """Make the presses of a plan and write them as ``tiptrace calibrate gel`` reads them.

    The folder gets ``reference.png``, the images, and ``presses.csv`` with the columns ``image,
    ball_diameter_mm, center_u_px, center_v_px, contact_radius_px``. With several gels every image is lit as the
    first gel is (its ratio to its own reference is kept), so that one reference serves all.

    Args:
        folder: Created if need be.
        plan: What to press where.
        progress: Called with presses done and presses in all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sensors = [
        TactileRenderer(gel_optics(gel), plan.layout, CameraNoise(), seed=plan.seed + k)
        for k, gel in enumerate(plan.gel_seeds)
    ]
    references = [sensor.reference() for sensor in sensors]
    cv2.imwrite(str(folder / "reference.png"), references[0])
    rng = np.random.default_rng([plan.seed, 0xBA11])
    places = [place for _ in range(plan.rounds) for place in _places(plan, sensors[0].size_px, rng)]
    presses = []
    for index, place in enumerate(places):
        gel = index % len(sensors)
        diameter = float(rng.choice(plan.ball_diameters_m))
        depth = min(float(rng.uniform(*plan.depth_m)), 0.45 * diameter)
        press = render_press(sensors[gel], place, diameter, depth, frame=index)
        if gel > 0:
            press = replace(press, image=_relit(press.image, references[gel], references[0]))
        cv2.imwrite(str(folder / _name(index)), press.image)
        presses.append(press)
        if progress is not None:
            progress(index + 1, len(places))
    _write_csv(folder / "presses.csv", presses)
    return presses


def _relit(image: Image, own_reference: Image, reference: Image) -> Image:
    """The image with the same ratio to another reference."""
    ratio = image.astype(np.float32) / np.maximum(own_reference, 1)
    return np.asarray(np.clip(ratio * reference + np.float32(0.5), 0, 255).astype(np.uint8))


def _places(plan: PressPlan, size_px: tuple[int, int], rng: np.random.Generator) -> list[tuple[float, float]]:
    """A jittered grid over the whole gel, presses near the rim included."""
    width, height = size_px
    u = (np.arange(plan.columns) + 0.5) / plan.columns * width
    v = (np.arange(plan.rows) + 0.5) / plan.rows * height
    jitter = np.array([width / plan.columns, height / plan.rows]) * 0.3
    grid = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    grid += rng.uniform(-1, 1, grid.shape) * jitter
    return [(round(float(a), 2), round(float(b), 2)) for a, b in grid]


def _name(index: int) -> str:
    return f"press_{index:03d}.png"


def _write_csv(path: Path, presses: list[Press]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "ball_diameter_mm", "center_u_px", "center_v_px", "contact_radius_px"])
        for index, press in enumerate(presses):
            diameter_mm = press.ball_diameter_m * 1e3
            writer.writerow([_name(index), diameter_mm, *press.center_px, round(press.contact_radius_px, 2)])
