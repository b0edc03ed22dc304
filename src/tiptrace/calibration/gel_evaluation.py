"""What a calibrated gel is worth: normals, ball radius and depth on presses that it was not trained on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.calibration.gel_circles import ball_radius_px
from tiptrace.calibration.gel_data import Circle, Press, PressFolder
from tiptrace.perception.depth import untouched_gel, zero_level
from tiptrace.perception.fill import smooth_fill
from tiptrace.perception.gel_model import GelModel
from tiptrace.perception.poisson import PoissonSolver
from tiptrace.types import BoolArray, FloatArray, Image

Float32Map = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class PressScore:
    """One press, measured by a network.

    Attributes:
        name: Image file.
        circle: Contact.
        normal_error_deg: Median angle between measured and true normal inside the contact.
        depth_rms_m: Rms depth error inside the contact, up to a constant.
        radius_error: Relative error of the ball's radius, from a sphere fitted to the measured depth.
        depth_m: (H, W) measured depth.
    """

    name: str
    circle: Circle
    normal_error_deg: float
    depth_rms_m: float
    radius_error: float
    depth_m: Float32Map


def measured_slopes(gel: GelModel, image: Image, background: Float32Map, dots: BoolArray) -> Float32Map:
    """Slopes (H, W, 2) of an image by a network, filled under the dots."""
    H, W = image.shape[:2]
    v, u = np.indices((H, W), dtype=np.float32)
    unit_uv = np.stack([u / W, v / H], axis=-1).reshape(-1, 2)
    smooth = np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8), dtype=np.float32)
    colours = gel.convention.colours(smooth, background).reshape(-1, 3)
    return smooth_fill(gel.slopes(colours, unit_uv).reshape(H, W, 2), dots)


def score_press(gel: GelModel, press: Press, circle: Circle, folder: PressFolder) -> PressScore:
    """Measure a press with a network and compare with its ball."""
    s = np.asarray(folder.mm_per_px) * 1e-3
    slopes = measured_slopes(gel, press.image, folder.background, press.dots)
    flat = measured_slopes(gel, folder.reference, folder.background, np.zeros_like(press.dots))
    H, W = press.dots.shape
    solver = PoissonSolver((H, W), (float(s[0]), float(s[1])))
    change = slopes - smooth_fill(flat, press.dots)
    depth = -solver.integrate(change[..., 0], change[..., 1])
    depth -= zero_level(depth, *untouched_gel(depth, change))
    v, u = np.indices((H, W), dtype=np.float64)
    d = np.stack([u - circle.u, v - circle.v], axis=-1)
    rho2 = np.sum(d * d, axis=-1)
    inside = (rho2 < (0.95 * circle.radius) ** 2) & ~press.dots
    R_px = ball_radius_px(press, folder)
    true = (d / np.sqrt(np.maximum(R_px**2 - rho2, 1.0))[..., None])[inside]  # (n, 2)
    z_true = -np.sqrt(np.maximum(R_px**2 - rho2, 1.0))[inside] * float(s.mean())
    error = -depth[inside] - z_true
    radius = fitted_radius_px(depth / float(s.mean()), circle, inside)
    return PressScore(
        name=press.name,
        circle=circle,
        normal_error_deg=float(np.median(angles_deg(slopes[inside], true))),
        depth_rms_m=float(np.std(error)),
        radius_error=radius / R_px - 1.0,
        depth_m=depth,
    )


def angles_deg(a: NDArray[np.floating], b: NDArray[np.floating]) -> FloatArray:
    """Angles (n,) between normals with slopes a and b, (n, 2) each."""
    dot = 1.0 + np.sum(a * b, axis=1)
    norm = np.sqrt((1.0 + np.sum(a * a, axis=1)) * (1.0 + np.sum(b * b, axis=1)))
    return np.asarray(np.degrees(np.arccos(np.clip(dot / norm, -1.0, 1.0))))


def fitted_radius_px(depth_px: NDArray[np.floating], circle: Circle, inside: BoolArray) -> float:
    """Radius of the sphere through a depth map in pixels: ρ² + z² = 2 x·c + k, linear in c and k."""
    v, u = np.nonzero(inside)
    x = np.stack([u - circle.u, v - circle.v, -depth_px[inside].astype(np.float64)], axis=1)
    A = np.column_stack([2.0 * x, np.ones(len(x))])
    solution = np.linalg.lstsq(A, np.sum(x * x, axis=1), rcond=None)[0]
    return float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 0.0)))
