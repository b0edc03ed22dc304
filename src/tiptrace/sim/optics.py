"""How a GelSight Mini looks: colour of the coating against its slope and place, untouched background, lamps.

The law is that of diffuse lamps of finite extent. For channel c and surface normal n,

    E_c(n, x) = ambient_c + Σ_k strength_ck · soft⁺(n · l_ck(x)),   I_c = B_c(x) · E_c(n, x) / E_c(e_z, x)

with soft⁺ a rounded max(·, 0) (lamps are wide, shadows are soft), l_ck(x) the direction of lamp k seen from x
(lamps are near: it turns with x), and B_c the colour of the untouched gel, a polynomial in position. The
coefficients come from real presses (``scripts/fit_optics.py``) and lie in ``sim/data/optics.json``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

import numpy as np

from tiptrace.sim.gel import Float32Array
from tiptrace.types import FloatArray

HALF_WIDTH_M, HALF_HEIGHT_M = 10e-3, 7.5e-3  # scale of the background polynomial


@dataclass(frozen=True, slots=True, eq=False)
class Optics:
    """Lamps, coating and untouched colour of one gel; channels in the order B, G, R.

    Attributes:
        background: (3, k) coefficients of the untouched colour, grey levels, over ``background_powers()``.
        lamp_toward: (3, lamps, 3) unit vectors from the image centre towards each lamp, F_S with z flipped so
            that a flat gel's normal, seen by the camera, is (0, 0, 1).
        lamp_strength: (3, lamps) relative strength.
        ambient: (3,) share of light that does not depend on the slope.
        softness: (3,) half-width of the rounding of max(·, 0).
        lamp_distance_m: Distance of the lamps; their direction turns by x / distance.
        gloss: Strength of the broad highlight, grey levels.
        balance: (3, 3) share by which each channel's untouched colour differs from the polynomial: everywhere,
            per half width to the right, per half height downwards.
    """

    background: FloatArray
    lamp_toward: FloatArray
    lamp_strength: FloatArray
    ambient: FloatArray
    softness: FloatArray
    lamp_distance_m: float = 0.03
    gloss: float = 0.0
    balance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


def background_powers(degree: int = 6) -> list[tuple[int, int]]:
    """Exponents (of x, of y) of the background polynomial, in the order of its coefficients."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def background_basis(x_m: FloatArray, y_m: FloatArray, degree: int = 6) -> FloatArray:
    """Values of the basis at points, (..., k)."""
    u, v = x_m / HALF_WIDTH_M, y_m / HALF_HEIGHT_M
    return np.stack([u**i * v**j for i, j in background_powers(degree)], axis=-1)


def untouched_colour(optics: Optics, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
    """Colour of the untouched gel at points, (..., 3), grey levels."""
    degree = next(d for d in range(20) if len(background_powers(d)) == optics.background.shape[1])
    polynomial = background_basis(x_m, y_m, degree) @ optics.background.T
    tilt = np.stack([np.ones_like(x_m), x_m / HALF_WIDTH_M, y_m / HALF_HEIGHT_M], axis=-1) @ optics.balance.T
    return np.asarray(np.clip(polynomial * (1 + tilt), 2, 250))


def irradiance(
    optics: Optics,
    channel: int,
    slope_x: FloatArray | Float32Array,
    slope_y: FloatArray | Float32Array,
    x_m: FloatArray,
    y_m: FloatArray,
    precision: type[np.floating] = np.float32,
) -> Any:
    """E_c for surface slopes ∂z/∂x, ∂z/∂y at places in metres; the arrays broadcast.

    The camera looks along +z_S at the back of the coating, so that the normal it sees is
    (∂z/∂x, ∂z/∂y, −1) turned towards it: n ∝ (z_x, z_y, 1) in axes with z flipped.
    """
    inverse = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    soft2 = precision(optics.softness[channel] ** 2)
    shape = np.broadcast_shapes(slope_x.shape, x_m.shape, y_m.shape)
    E = np.full(shape, optics.ambient[channel], precision)
    turn_x, turn_y = (np.asarray(v / optics.lamp_distance_m, precision) for v in (x_m, y_m))
    for toward, strength in zip(optics.lamp_toward[channel], optics.lamp_strength[channel], strict=True):
        lx, ly, lz = toward.astype(precision)
        facing = ((lx - turn_x) * slope_x + (ly - turn_y) * slope_y + lz) * inverse
        E += precision(0.5 * strength) * (facing + np.sqrt(facing * facing + soft2))
    return E


def fitted_data() -> dict[str, Any]:
    """What ``scripts/fit_optics.py`` found."""
    text = (resources.files("tiptrace.sim") / "data" / "optics.json").read_text(encoding="utf-8")
    data: dict[str, Any] = json.loads(text)
    return data


def nominal_optics() -> Optics:
    """The marker gel that was fitted to real images."""
    return optics_from_dict(fitted_data())


def press_optics() -> Optics:
    """The gel without markers on which the real presses were made: the same lamps, its own colour."""
    data = fitted_data()
    return optics_from_dict(data | {"background": data["background_presses"]})


def optics_from_dict(data: dict[str, Any]) -> Optics:
    """Optics from the fitted file: lamps as azimuth and elevation in degrees."""
    azimuth, elevation = (np.radians(np.asarray(data[k], float)) for k in ("azimuth_deg", "elevation_deg"))
    toward = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
    )
    return Optics(
        background=np.asarray(data["background"], float),
        lamp_toward=toward,
        lamp_strength=np.asarray(data["strength"], float),
        ambient=np.asarray(data["ambient"], float),
        softness=np.asarray(data["softness"], float),
        lamp_distance_m=float(data["lamp_distance_m"]),
        gloss=float(data.get("gloss", 0.0)),
    )


def gel_optics(seed: int | None) -> Optics:
    """Another gel of the same make: lamps within a degree, light within some per cent.

    Args:
        seed: None gives the fitted gel itself.
    """
    nominal = nominal_optics()
    if seed is None:
        return nominal
    rng = np.random.default_rng([seed, 0x6E1])
    turned = _turn(nominal.lamp_toward, rng, np.radians(0.7))
    strength = nominal.lamp_strength * np.exp(rng.normal(0, 0.03, nominal.lamp_strength.shape))
    return replace(
        nominal,
        balance=rng.normal(0, 0.05, (3, 3)),
        lamp_toward=turned,
        lamp_strength=strength,
        ambient=nominal.ambient * np.exp(rng.normal(0, 0.04, 3)),
        lamp_distance_m=nominal.lamp_distance_m * float(np.exp(rng.normal(0, 0.08))),
        gloss=float(rng.uniform(2, 8)),
    )


def unseen_optics(seed: int) -> Optics:
    """Optics from beyond the range of :func:`gel_optics`: shinier, harder shadows, lamps elsewhere."""
    gel = gel_optics(seed)
    rng = np.random.default_rng([seed, 0x5EE])
    return replace(
        gel,
        balance=gel.balance + rng.normal(0, 0.10, (3, 3)),
        lamp_toward=_turn(gel.lamp_toward, rng, np.radians(4.0)),
        lamp_strength=gel.lamp_strength * np.exp(rng.normal(0, 0.15, gel.lamp_strength.shape)),
        softness=gel.softness * float(rng.uniform(0.5, 0.7)),
        lamp_distance_m=gel.lamp_distance_m * float(rng.uniform(0.55, 0.7)),
        gloss=float(rng.uniform(12, 22)),
    )


def _turn(toward: FloatArray, rng: np.random.Generator, angle: float) -> FloatArray:
    turned = toward + rng.normal(0, angle, toward.shape)
    turned[..., 2] = np.maximum(turned[..., 2], 0.1)
    return np.asarray(turned / np.linalg.norm(turned, axis=-1, keepdims=True))
