"""The grooved plate: five centrelines of the paper or a user's own, an open channel, a pit at its start.

The channel is what a ball-end cutter of radius ``radius_m`` leaves when its centre follows the centreline at plate
level (z = 0), deeper over the pit. Plate coordinates: x along the travel, z up; the plate lies in the base frame at
``origin_B`` without rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tiptrace.errors import SimulationError
from tiptrace.types import FloatArray

RADIUS_M = 1.5e-3
SPAN_M = 0.2
Derivatives = tuple[float, float, float, float]  # f, f', f'', f'''


@dataclass(frozen=True, slots=True)
class Centreline:
    """A planar curve y = f(x), continued along its tangents beyond [0, span].

    Attributes:
        name: Its name.
        inside: f and its first three derivatives at x within [0, span], SI.
        span_m: Length along x.
    """

    name: str
    inside: Callable[[float], Derivatives]
    span_m: float = SPAN_M

    def at(self, x: float) -> Derivatives:
        """f and its first three derivatives at any x."""
        if 0.0 <= x <= self.span_m:
            return self.inside(x)
        end = 0.0 if x < 0.0 else self.span_m
        f, slope, _, _ = self.inside(end)
        return f + slope * (x - end), slope, 0.0, 0.0

    def points(self, x: FloatArray) -> FloatArray:
        """(n, 3) centreline points in plate coordinates, m."""
        return np.array([[xi, self.at(float(xi))[0], 0.0] for xi in x])

    def mirrored(self) -> Centreline:
        """The curve with y reversed."""

        def inside(x: float) -> Derivatives:
            f, f1, f2, f3 = self.inside(x)
            return -f, -f1, -f2, -f3

        return Centreline(f"{self.name}-mirrored", inside, self.span_m)

    def check(self, radius_m: float) -> Centreline:
        """Return the curve itself when a tip of a groove of this radius can follow it.

        Raises:
            SimulationError: curved more sharply than the groove's own radius.
        """
        for x in np.linspace(0.0, self.span_m, 4001):
            _, f1, f2, _ = self.inside(float(x))
            bend = abs(f2) / (1.0 + f1 * f1) ** 1.5
            if bend * radius_m >= 1.0:
                raise SimulationError(
                    f"curve '{self.name}' is too sharp for the tip at x = {x * 1e3:.1f} mm: its radius there is "
                    f"{1e3 / bend:.2f} mm, the groove needs more than {radius_m * 1e3:.1f} mm"
                )
        return self


def _line(_: float) -> Derivatives:
    return 0.0, 0.0, 0.0, 0.0


def _arc(x: float, deviation_m: float = 8e-3) -> Derivatives:
    """Circular arc through (0, 0) and (span, 0) with the given greatest deviation."""
    half = 0.5 * SPAN_M
    radius = (half * half + deviation_m * deviation_m) / (2.0 * deviation_m)
    u = x - half
    root = float(np.sqrt(radius * radius - u * u))
    return root - (radius - deviation_m), -u / root, -(radius**2) / root**3, -3.0 * radius**2 * u / root**5


def _sine(period_m: float, amplitude_m: float) -> Callable[[float], Derivatives]:
    k = 2.0 * float(np.pi) / period_m

    def inside(x: float) -> Derivatives:
        s, c = float(np.sin(k * x)), float(np.cos(k * x))
        A = amplitude_m
        return A * s, A * k * c, -A * k * k * s, -A * k**3 * c

    return inside


TRAJECTORIES: dict[str, Centreline] = {
    "T1": Centreline("T1", _line),
    "T2": Centreline("T2", _arc),
    "T3": Centreline("T3", _sine(50e-3, 4e-3)),
    "T4": Centreline("T4", _sine(20e-3, 2e-3)),
    "T5": Centreline("T5", _sine(100e-3, 8e-3)),
}


def named_centreline(name: str) -> Centreline:
    """A centreline of the paper: T1 line, T2 arc, T3–T5 sinusoids.

    Raises:
        SimulationError: an unknown name.
    """
    if name not in TRAJECTORIES:
        raise SimulationError(f"unknown trajectory '{name}'; valid trajectories: {', '.join(TRAJECTORIES)}")
    return TRAJECTORIES[name]


def centreline_from_csv(path: Path) -> Centreline:
    """A user's curve: rows ``x, y`` in mm, x increasing; a natural cubic spline runs through them.

    The curve is shifted so that it starts at x = 0.

    Raises:
        SimulationError: a file that cannot be read, fewer than 4 points, x not increasing, a curve too sharp.
    """
    from scipy.interpolate import CubicSpline

    try:
        rows = np.atleast_2d(np.loadtxt(path, delimiter=",", comments="#", ndmin=2))
    except (OSError, ValueError) as error:
        raise SimulationError(f"{path}: not a curve of rows 'x, y' in mm ({error})") from None
    if rows.shape[1] != 2 or len(rows) < 4 or not np.all(np.isfinite(rows)):
        raise SimulationError(
            f"{path}: a curve needs at least 4 finite rows 'x, y' in mm, got shape {rows.shape}"
        )
    if not np.all(np.diff(rows[:, 0]) > 0):
        raise SimulationError(f"{path}: x must increase from row to row: the hand travels along +x only")
    x, y = (rows - rows[0, :1] * [1.0, 0.0]).T * 1e-3
    spline = CubicSpline(x, y, bc_type="natural")

    def inside(at: float) -> Derivatives:
        return float(spline(at)), float(spline(at, 1)), float(spline(at, 2)), float(spline(at, 3))

    return Centreline(path.stem, inside, float(x[-1]))


@dataclass(frozen=True, slots=True)
class Pit:
    """Dip of the groove at its start that holds the tip in Stage I: a steep wall behind, a long ramp ahead.

    The ramp flattens slowly enough for the tip to leave without a jump: contact force times curvature stays below
    the grasp's stiffness along the travel.

    Attributes:
        depth_m: How deep.
        ahead_m: Length of the ramp in the direction of travel, along x; it is cubic.
        behind_m: Length of the wall behind, a parabola.
        round_m: Half length of the rounding at the bottom.
    """

    depth_m: float = 0.5e-3
    ahead_m: float = 6.0e-3
    behind_m: float = 0.9e-3
    round_m: float = 0.1e-3

    def at(self, x: float) -> tuple[float, float, float]:
        """Centreline height z_c and its first two derivatives along x."""
        if self.depth_m == 0.0 or x >= self.ahead_m or x <= -self.behind_m:
            return 0.0, 0.0, 0.0
        e = self.round_m
        if abs(x) >= e:
            return self._flank(x)
        (z0, s0, _), (z1, s1, _) = self._flank(-e), self._flank(e)  # a cubic joins the flanks
        h, u = 2 * e, (x + e) / (2 * e)
        a, b = h * s0 - (z1 - z0), -h * s1 + (z1 - z0)
        q = (1 - u) * a + u * b
        z = (1 - u) * z0 + u * z1 + u * (1 - u) * q
        dz = (z1 - z0 + (1 - 2 * u) * q + u * (1 - u) * (b - a)) / h
        ddz = (-2 * q + 2 * (1 - 2 * u) * (b - a)) / (h * h)
        return z, dz, ddz

    def _flank(self, x: float) -> tuple[float, float, float]:
        sign, length, n = (1.0, self.ahead_m, 3) if x > 0 else (-1.0, self.behind_m, 2)
        w = 1.0 - abs(x) / length
        d = self.depth_m
        return (
            -d * w**n,
            sign * n * d * w ** (n - 1) / length,
            -n * (n - 1) * d * w ** (n - 2) / (length * length),
        )


@dataclass(frozen=True, slots=True)
class Gap:
    """Distance of a point from the groove's wall, edge or the plate.

    Attributes:
        distance_m: From the point to the solid; negative inside.
        gradient: (3,) of the distance.
        hessian: (3, 3) of the distance, 1/m.
        lateral_m: Signed distance from the centreline in the plate's plane.
        along_m: x of the foot point on the centreline.
        where: ``floor``, ``wall``, ``edge`` or ``plate``.
    """

    distance_m: float
    gradient: FloatArray
    hessian: FloatArray
    lateral_m: float
    along_m: float
    where: str


_EZ = np.array([0.0, 0.0, 1.0])
_EZZ = np.outer(_EZ, _EZ)


@dataclass(frozen=True, slots=True)
class Groove:
    """An open groove in a flat plate.

    Attributes:
        line: Centreline at plate level.
        pit: Dip at the start.
        radius_m: Radius of the semicircular section.
    """

    line: Centreline
    pit: Pit = Pit()
    radius_m: float = RADIUS_M

    def gap(self, p: FloatArray) -> Gap:
        """Distance of the point p (3,) in plate coordinates from the solid, with derivatives."""
        x, lat, grad_l, hess_l, grad_x, hess_x = self._foot(float(p[0]), float(p[1]))
        z, r = float(p[2]), self.radius_m
        sign = 1.0 if lat >= 0 else -1.0
        if z > 0.0:
            if abs(lat) >= r:
                return Gap(z, _EZ, np.zeros((3, 3)), lat, x, "plate")
            u = r - abs(lat)
            distance = float(np.hypot(u, z))
            grad_u = -sign * grad_l
            gradient = (u * grad_u + z * _EZ) / distance
            hessian = (
                np.outer(grad_u, grad_u) + _EZZ - u * sign * hess_l - np.outer(gradient, gradient)
            ) / distance
            return Gap(distance, gradient, hessian, lat, x, "edge")
        z_c, z_c1, z_c2 = self.pit.at(x)
        zeta = z - z_c
        if zeta >= 0.0:  # between the lowered axis and the plate the walls are upright
            return Gap(r - abs(lat), -sign * grad_l, -sign * hess_l, lat, x, "wall")
        rho = max(float(np.hypot(lat, zeta)), 1e-9)
        grad_z = _EZ - z_c1 * grad_x
        hess_z = -z_c2 * np.outer(grad_x, grad_x) - z_c1 * hess_x
        gradient = (lat * grad_l + zeta * grad_z) / rho
        hessian = np.outer(grad_l, grad_l) + lat * hess_l + np.outer(grad_z, grad_z) + zeta * hess_z
        hessian = (hessian - np.outer(gradient, gradient)) / rho
        return Gap(r - rho, -gradient, -hessian, lat, x, "floor")

    def _foot(
        self, px: float, py: float
    ) -> tuple[float, float, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Foot point x, signed lateral distance lat, and gradients and Hessians (3-D) of lat and x."""
        x = px
        for _ in range(30):
            f, f1, f2, _ = self.line.at(x)
            g = (px - x) + (py - f) * f1
            slope = -1.0 - f1 * f1 + (py - f) * f2
            step = g / min(slope, -0.1)
            x -= float(np.clip(step, -2e-3, 2e-3))
            if abs(step) < 1e-13:
                break
        f, f1, f2, f3 = self.line.at(x)
        v = float(np.hypot(1.0, f1))
        tau, nu = np.array([1.0, f1, 0.0]) / v, np.array([-f1, 1.0, 0.0]) / v
        lat = (px - x) * nu[0] + (py - f) * nu[1]
        kappa = f2 / v**3
        kappa1 = f3 / v**3 - 3.0 * f1 * f2 * f2 / v**5  # dκ/dx
        s = max(1.0 - kappa * lat, 0.05)
        w = v * s
        hess_l = -kappa / s * np.outer(tau, tau)
        grad_x = tau / w
        dw_dx = f1 * f2 / v * s - v * kappa1 * lat
        hess_x = (
            kappa * v * np.outer(nu, grad_x) / w
            - dw_dx / w**2 * np.outer(tau, grad_x)
            + v * kappa / w**2 * np.outer(tau, nu)
        )
        return x, float(lat), nu, hess_l, grad_x, hess_x
