"""The tip in its groove: one contact with friction, in plate coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tiptrace.sim.groove import Groove
from tiptrace.types import FloatArray


@dataclass(frozen=True, slots=True)
class TipLaw:
    """Tip in the groove.

    Attributes:
        normal: Stiffness of the contact, N/m.
        tangential: Stiffness of sticking friction, N/m.
        kinetic: Coefficient while sliding.
        ageing: How much rest adds to it.
        ageing_s: Rest for 63 % of that.
    """

    normal: float = 50e3
    tangential: float = 20e3
    kinetic: float = 0.2
    ageing: float = 0.04
    ageing_s: float = 1.0


@dataclass(frozen=True, slots=True)
class TipState:
    """Memory of the tip: where it last stuck (None: not in contact), and for how long it has rested."""

    anchor: FloatArray | None = None
    rest_s: float = 0.0


@dataclass(frozen=True, slots=True)
class TipForce:
    """What the groove does to the tip, plate axes.

    Attributes:
        force: (3,) N.
        stiffness: (3, 3) its derivative by the tip's position.
        normal_n: Magnitude of the normal force.
        friction: (3,) the friction part.
        normal: (3,) unit normal out of the wall.
        slipping: At the friction cone.
        anchor: (3,) where friction holds from now on.
        penetration_m: Of the tip's sphere into the wall.
        where: floor, wall, edge, plate, or ``free``.
        stored_j: Elastic energy.
    """

    force: FloatArray
    stiffness: FloatArray
    normal_n: float
    friction: FloatArray
    normal: FloatArray
    slipping: bool
    anchor: FloatArray | None
    penetration_m: float
    where: str
    stored_j: float = 0.0


_FREE = TipForce(np.zeros(3), np.zeros((3, 3)), 0.0, np.zeros(3), np.zeros(3), False, None, 0.0, "free")


def tip_force(
    groove: Groove, radius_m: float, law: TipLaw, state: TipState, p: FloatArray, kinetic: float | None = None
) -> TipForce:
    """Force of the groove on a tip at p (3,), plate coordinates.

    Friction acts at the sphere's centre: the spin moment μ N r is left out (2 % of the moment about the pads).
    """
    gap = groove.gap(p)
    pen = radius_m - gap.distance_m
    if pen <= 0.0:
        return replace(_FREE, penetration_m=pen)
    g, H = gap.gradient, gap.hessian
    k = law.normal
    size = float(np.linalg.norm(g))
    n = g / size
    N = k * pen * size
    force, J = k * pen * g, k * (pen * H - np.outer(g, g))
    stored = 0.5 * k * pen * pen
    if state.anchor is None:
        return TipForce(force, J, N, np.zeros(3), n, False, p.copy(), pen, gap.where, stored)
    P = np.eye(3) - np.outer(n, n)
    e = p - state.anchor
    t = -law.tangential * (P @ e)
    dn = P @ H / size  # (3, 3) dn/dp
    dt = -law.tangential * (P - dn * float(n @ e) - np.outer(n, e @ dn))
    mu = law.kinetic if kinetic is None else kinetic
    mu += law.ageing * (1.0 - float(np.exp(-state.rest_s / law.ageing_s)))
    t_size = float(np.linalg.norm(t))
    limit = mu * N
    if t_size <= limit:
        stored += 0.5 * t_size**2 / law.tangential
        return TipForce(force + t, J + dt, N, t, n, False, state.anchor, pen, gap.where, stored)
    u = t / t_size
    dN = k * (-g * size + pen * (H @ n))
    friction = limit * u
    dt = (limit / t_size) * (dt - np.outer(u, u @ dt)) + mu * np.outer(u, dN)
    anchor = p + friction / law.tangential
    stored += 0.5 * limit**2 / law.tangential
    return TipForce(force + friction, J + dt, N, friction, n, True, anchor, pen, gap.where, stored)


def advance_tip(state: TipState, force: TipForce, dt_s: float) -> TipState:
    """Memory after a converged step."""
    if force.anchor is None:
        return TipState()
    return TipState(force.anchor, 0.0 if force.slipping or state.anchor is None else state.rest_s + dt_s)
