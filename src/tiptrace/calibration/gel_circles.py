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

_ROUNDS = 5
_ONE_PLACE = 0.25  # of the width and height of the image
_FIT_PIXELS = 600  # of each press while circles are sought
_MISFIT = 2.5  # residual, in units of the usual one, at which the contact ends
_GROWTH = 0.97  # the contact ends where the colour changes most, a little blurred
_MOST = 0.97  # of the largest change: on steep contacts colour is saturated beyond, and a circle further out too wide
_NOT_STEEPER = 0.94  # sine of the steepest slope taken from a ball


@dataclass(frozen=True, slots=True)
class PressSamples:
    """Pixels inside a contact: slopes (n, 2), places (n, 2), colours (n, 3) and background (n, 3)."""

    slopes: FloatArray
    unit_uv: FloatArray
    colours: FloatArray
    background: FloatArray


def find_circles(folder: PressFolder) -> list[Circle]:
    """Contact circle of every press. Circles that the user gives are not needed and not believed.

    Raises:
        CalibrationError: a press that changes the image too little to be found.
    """
    circles = [_from_colour_change(press, folder) for press in folder.presses]
    limits = [_limit(p, c, folder) for p, c in zip(folder.presses, circles, strict=True)]
    place_degree = 0 if in_one_place(circles, folder) else 1
    shading = _fit(folder, circles, 0.8, place_degree)
    for _ in range(_ROUNDS):
        circles = [
            _refine(press, circle, shading, folder, limit)
            for press, circle, limit in zip(folder.presses, circles, limits, strict=True)
        ]
        shading = _fit(folder, circles, 0.95, place_degree)
    return circles


def locate(press: Press, folder: PressFolder, shading: Shading) -> Circle:
    """Contact circle of a press that had no part in the shading model, so that it can be held out.

    Raises:
        CalibrationError: a press that changes the image too little to be found.
    """
    circle = _from_colour_change(press, folder)
    limit = _limit(press, circle, folder)
    for _ in range(_ROUNDS):
        circle = _refine(press, circle, shading, folder, limit)
    return circle


def in_one_place(circles: list[Circle], folder: PressFolder) -> bool:
    """Whether the contacts span too little of the gel to teach how colours depend on the place."""
    H, W = folder.reference.shape[:2]
    spread = np.ptp([(c.u, c.v) for c in circles], axis=0) / (W, H)
    return bool((spread < _ONE_PLACE).any())


def ball_radius_px(press: Press, folder: PressFolder) -> float:
    """Radius of the ball at the image's scale (mean of x and y)."""
    return 0.5 * press.ball_diameter_mm / float(np.mean(folder.mm_per_px))


def contact_samples(
    press: Press, circle: Circle, folder: PressFolder, share: float = 0.95, most: int = 100_000
) -> PressSamples:
    """Pixels within a share of the contact radius, dots left out; every k-th if there are too many."""
    H, W = folder.reference.shape[:2]
    r = share * circle.radius
    u0, u1 = max(int(circle.u - r), 0), min(int(circle.u + r) + 2, W)
    v0, v1 = max(int(circle.v - r), 0), min(int(circle.v + r) + 2, H)
    v, u = np.mgrid[v0:v1, u0:u1]
    d = np.stack([u - circle.u, v - circle.v], axis=-1)  # (h, w, 2)
    R = max(ball_radius_px(press, folder), circle.radius / _NOT_STEEPER)
    rho2 = np.sum(d * d, axis=-1)
    seen = np.flatnonzero((rho2 < r * r) & ~press.dots[v0:v1, u0:u1])
    seen = seen[:: len(seen) // most + 1]
    slopes = (
        d / np.sqrt(np.maximum(R * R - rho2, 1.0))[..., None]
    )  # ∂z/∂x = x/√(R² − ρ²): deeper in the middle
    return PressSamples(
        slopes=slopes.reshape(-1, 2)[seen],
        unit_uv=np.stack([u / W, v / H], axis=-1).reshape(-1, 2)[seen],
        colours=press.image[v0:v1, u0:u1].reshape(-1, 3)[seen].astype(np.float64),
        background=folder.background[v0:v1, u0:u1].reshape(-1, 3)[seen].astype(np.float64),
    )


def _fit(folder: PressFolder, circles: list[Circle], share: float, place_degree: int) -> Shading:
    parts = [
        contact_samples(press, circle, folder, share, _FIT_PIXELS)
        for press, circle in zip(folder.presses, circles, strict=True)
    ]
    stacked = [np.concatenate([getattr(p, name) for p in parts]) for name in PressSamples.__slots__]
    return fit_shading(*stacked, place_degree=place_degree)


def _from_colour_change(press: Press, folder: PressFolder) -> Circle:
    """First guess. Flat gel in the middle of the blob of changed colour: the centre; where the colour has changed
    as much as it ever does, gel is steepest: the contact's edge."""
    change = smooth_fill(press.image.astype(np.float32) - folder.background, press.dots)
    scale = folder.reference.shape[1] / 320.0
    size = np.linalg.norm(cv2.GaussianBlur(change, (0, 0), 1.5 * scale), axis=2)
    blob = (size > max(0.3 * float(size.max()), 4.0)).astype(np.uint8)
    k = 2 * round(8 * scale) + 1
    blob = cv2.morphologyEx(blob, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (k, k)))
    outlines, _ = cv2.findContours(blob, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        raise CalibrationError(f"{press.name}: shows no press; remove it from presses.csv")
    (cu, cv), outer = cv2.minEnclosingCircle(max(outlines, key=cv2.contourArea))
    v, u = np.indices(size.shape)
    rho = np.hypot(u - cu, v - cv)
    calm = np.where(rho < 0.6 * outer, size + 0.2 * float(size.max()) * (rho / outer) ** 2, np.inf)
    centre_v, centre_u = (float(x) for x in np.unravel_index(int(np.argmin(calm)), size.shape))
    return Circle(centre_u, centre_v, max(_steepest(size, centre_u, centre_v, 1.5 * outer), 3.0 * scale))


def _steepest(size: FloatArray, cu: float, cv: float, limit: float) -> float:
    """Radius (px) around a centre at which the mean colour change reaches nearly its largest value."""
    v, u = np.indices(size.shape)
    ring = np.hypot(u - cu, v - cv).astype(np.intp)
    near = ring < max(limit, 4)
    profile = np.bincount(ring[near], weights=size[near]) / np.maximum(np.bincount(ring[near]), 1)
    level = _MOST * float(profile.max())
    k = int(np.argmax(profile >= level))
    if k == 0:
        return 0.5
    return k + 0.5 - float((profile[k] - level) / (profile[k] - profile[k - 1]))


def _limit(press: Press, circle: Circle, folder: PressFolder) -> float:
    """Largest radius (px) that a contact may get: the ball's own, or where the first guess ended."""
    return min(_NOT_STEEPER * ball_radius_px(press, folder), _GROWTH * circle.radius)


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
    s = contact_samples(press, circle, folder, share, _FIT_PIXELS)
    R = ball_radius_px(press, folder)
    sine = s.slopes / np.sqrt(1.0 + np.sum(s.slopes**2, axis=1, keepdims=True)) - np.asarray(shift) / R
    slopes = sine / np.sqrt(np.maximum(1.0 - np.sum(sine**2, axis=1, keepdims=True), 1e-2))
    predicted = s.background * (1.0 + shading.ratio_change(slopes, s.unit_uv))
    return np.asarray((predicted - s.colours).ravel())


def _contact_radius(
    press: Press, circle: Circle, shading: Shading, folder: PressFolder, limit: float
) -> float:
    """Largest radius up to which the ball's colours fit."""
    wide = Circle(circle.u, circle.v, min(1.25 * circle.radius, limit))
    s = contact_samples(press, wide, folder, 1.0, 3 * _FIT_PIXELS)
    if len(s.slopes) < 30:
        return circle.radius
    predicted = s.background * (1.0 + shading.ratio_change(s.slopes, s.unit_uv))
    misfit = np.linalg.norm(predicted - s.colours, axis=1)
    sine = np.linalg.norm(s.slopes, axis=1) / np.sqrt(1.0 + np.sum(s.slopes**2, axis=1))
    rho = sine * ball_radius_px(press, folder)
    bins = np.linspace(0.0, wide.radius, 16)
    which = np.digitize(rho, bins) - 1
    profile = np.array([np.median(misfit[which == k]) if (which == k).any() else 0.0 for k in range(15)])
    usual = max(float(np.median(profile[:8])), float(np.linalg.norm(shading.sigma)))
    bad = np.flatnonzero(profile > _MISFIT * usual)
    bad = bad[bad >= 8]
    return max(float(bins[bad[0]]), 0.6 * limit) if bad.size else wide.radius
