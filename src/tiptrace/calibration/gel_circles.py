"""Where a ball touches the gel: contact circles found from the images, or those given, refined.

A ball's slope is known from its radius and the distance to the contact's centre. With a shading model, the
centre is where the predicted colours fit best; the contact ends where they stop fitting. Model and circles are
improved in turn, from the safe middle outwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tiptrace.calibration.gel_data import Circle, Press, PressFolder
from tiptrace.calibration.gel_shading import Shading, fit_shading
from tiptrace.errors import CalibrationError
from tiptrace.perception.fill import smooth_fill
from tiptrace.types import FloatArray

_ROUNDS = 6
_MISFIT = 3.0  # residual, in units of the typical one in the middle, at which the contact ends
_NOT_STEEPER = 0.94  # sine of the steepest slope taken from a ball


@dataclass(frozen=True, slots=True)
class PressSamples:
    """Pixels inside a contact: slopes (n, 2), places (n, 2), colours (n, 3) and background (n, 3)."""

    slopes: FloatArray
    unit_uv: FloatArray
    colours: FloatArray
    background: FloatArray


def find_circles(folder: PressFolder, place_degree: int) -> tuple[list[Circle], Shading]:
    """Contact circle of every press, and the shading that they agree on.

    Raises:
        CalibrationError: a press that changes the image too little to be found.
    """
    circles = [press.circle or _from_colour_change(press, folder) for press in folder.presses]
    limits = [ball_radius_px(press, folder) * _NOT_STEEPER for press in folder.presses]
    inner = [0.6] * len(circles)
    shading = _fit(folder, circles, inner, place_degree)
    for _ in range(_ROUNDS):
        circles = [
            _refine(press, circle, shading, folder, limit)
            for press, circle, limit in zip(folder.presses, circles, limits, strict=True)
        ]
        shading = _fit(folder, circles, [0.95] * len(circles), place_degree)
    return circles, shading


def ball_radius_px(press: Press, folder: PressFolder) -> float:
    """Radius of the ball at the image's scale (mean of x and y)."""
    return 0.5 * press.ball_diameter_mm / float(np.mean(folder.mm_per_px))


def contact_samples(press: Press, circle: Circle, folder: PressFolder, share: float = 0.95) -> PressSamples:
    """Pixels within a share of the contact radius, dots left out."""
    H, W = folder.reference.shape[:2]
    r = share * circle.radius
    u0, u1 = max(int(circle.u - r), 0), min(int(circle.u + r) + 2, W)
    v0, v1 = max(int(circle.v - r), 0), min(int(circle.v + r) + 2, H)
    v, u = np.mgrid[v0:v1, u0:u1]
    d = np.stack([u - circle.u, v - circle.v], axis=-1)  # (h, w, 2)
    R = max(ball_radius_px(press, folder), circle.radius / _NOT_STEEPER)
    rho2 = np.sum(d * d, axis=-1)
    seen = (rho2 < r * r) & ~press.dots[v0:v1, u0:u1]
    slopes = (
        d / np.sqrt(np.maximum(R * R - rho2, 1.0))[..., None]
    )  # ∂z/∂x = x/√(R² − ρ²): deeper in the middle
    return PressSamples(
        slopes=slopes[seen],
        unit_uv=np.stack([u / W, v / H], axis=-1)[seen],
        colours=press.image[v0:v1, u0:u1][seen].astype(np.float64),
        background=folder.background[v0:v1, u0:u1][seen].astype(np.float64),
    )


def _fit(folder: PressFolder, circles: list[Circle], shares: list[float], place_degree: int) -> Shading:
    parts = [
        contact_samples(press, circle, folder, share)
        for press, circle, share in zip(folder.presses, circles, shares, strict=True)
    ]
    stacked = [np.concatenate([getattr(p, name) for p in parts]) for name in PressSamples.__slots__]
    thin = max(len(stacked[0]) // 60_000, 1)
    return fit_shading(*(s[::thin] for s in stacked), place_degree=place_degree)


def _from_colour_change(press: Press, folder: PressFolder) -> Circle:
    """First guess: the blob of changed colour; the contact is its inner part."""
    change = smooth_fill(press.image.astype(np.float32) - folder.background, press.dots)
    scale = folder.reference.shape[1] / 320.0
    size = np.linalg.norm(cv2.GaussianBlur(change, (0, 0), 2.0 * scale), axis=2)
    blob = (size > max(0.25 * float(size.max()), 4.0)).astype(np.uint8)
    count, _, stats, centroids = cv2.connectedComponentsWithStats(blob)
    if count < 2:
        raise CalibrationError(f"{press.name}: shows no press; remove it from presses.csv or give its circle")
    best = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    radius = 0.6 * float(np.sqrt(stats[best, cv2.CC_STAT_AREA] / np.pi))
    return Circle(float(centroids[best, 0]), float(centroids[best, 1]), max(radius, 3.0 * scale))


def _refine(press: Press, circle: Circle, shading: Shading, folder: PressFolder, limit: float) -> Circle:
    """Gauss–Newton on the centre, then the radius at which the residual leaves that of the middle."""
    for _ in range(2):
        residual = _residual(press, circle, shading, folder, 0.9)
        J = (
            np.stack(
                [
                    _residual(press, circle, shading, folder, 0.9, (du, dv)) - residual
                    for du, dv in ((0.5, 0.0), (0.0, 0.5))
                ],
                axis=1,
            )
            / 0.5
        )  # (m, 2)
        step = -np.linalg.lstsq(J, residual, rcond=None)[0]
        step *= min(1.0, 0.25 * circle.radius / max(float(np.linalg.norm(step)), 1e-9))
        circle = Circle(circle.u + float(step[0]), circle.v + float(step[1]), circle.radius)
    return Circle(circle.u, circle.v, _contact_radius(press, circle, shading, folder, limit))


def _residual(
    press: Press,
    circle: Circle,
    shading: Shading,
    folder: PressFolder,
    share: float,
    shift: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """Predicted minus seen colours (3n,) over a disc that stays put while the ball's centre shifts."""
    s = contact_samples(press, circle, folder, share)
    R = ball_radius_px(press, folder)
    sine = s.slopes / np.sqrt(1.0 + np.sum(s.slopes**2, axis=1, keepdims=True)) - np.asarray(shift) / R
    slopes = sine / np.sqrt(np.maximum(1.0 - np.sum(sine**2, axis=1, keepdims=True), 1e-2))
    predicted = s.background * (1.0 + shading.ratio_change(slopes, s.unit_uv))
    return np.asarray((predicted - s.colours).ravel())


def _contact_radius(
    press: Press, circle: Circle, shading: Shading, folder: PressFolder, limit: float
) -> float:
    """Largest radius up to which the ball's colours fit; it grows by at most a quarter per round."""
    wide = Circle(circle.u, circle.v, min(1.25 * circle.radius, limit))
    s = contact_samples(press, wide, folder, 1.0)
    if len(s.slopes) < 30:
        return circle.radius
    predicted = s.background * (1.0 + shading.ratio_change(s.slopes, s.unit_uv))
    misfit = np.linalg.norm(predicted - s.colours, axis=1)
    sine = np.linalg.norm(s.slopes, axis=1) / np.sqrt(1.0 + np.sum(s.slopes**2, axis=1))
    rho = sine * ball_radius_px(press, folder)
    bins = np.linspace(0.0, wide.radius, 16)
    which = np.digitize(rho, bins) - 1
    profile = np.array([np.median(misfit[which == k]) if (which == k).any() else 0.0 for k in range(15)])
    middle = float(np.median(profile[:8]))
    bad = np.flatnonzero(profile > _MISFIT * max(middle, 0.5))
    bad = bad[bad >= 6]
    return float(bins[bad[0]]) if bad.size else wide.radius
