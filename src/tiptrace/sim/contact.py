"""Contact laws of the virtual rig: two pads of point springs, and the tip in its groove.

Everything is expressed in F_E, where the pads are at rest. A wrench is (6,): force and moment about the tip; a
stiffness (6, 6) is its derivative by (v, w), the tool's translation of the tip and rotation about it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tiptrace.geometry.transforms import skew
from tiptrace.sim.groove import Groove
from tiptrace.sim.tools import ToolShape
from tiptrace.types import SIDES, BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class GelLaw:
    """Mechanics of a pad: E, ν and thickness give the springs (design, section 7).

    Attributes:
        youngs_pa: Young's modulus.
        poisson: Poisson's ratio.
        thickness_m: Gel thickness h.
        confinement: k_n = confinement · E / h, since the gel cannot escape sideways.
        friction: Coulomb coefficient between pad and tool.
        creep: Fraction of the stiffness that relaxes.
        creep_s: Its time constant.
        stiffening: Growth of the normal stiffness with strain: f = k δ (1 + stiffening · δ / h).
    """

    youngs_pa: float = 0.15e6
    poisson: float = 0.48
    thickness_m: float = 4e-3
    confinement: float = 1.9
    friction: float = 0.9
    creep: float = 0.10
    creep_s: float = 8.0
    stiffening: float = 0.0

    @property
    def normal(self) -> float:
        """k_n, N/m³."""
        return self.confinement * self.youngs_pa / self.thickness_m

    @property
    def shear(self) -> float:
        """k_s = G/h, N/m³."""
        return self.youngs_pa / (2.0 * (1.0 + self.poisson)) / self.thickness_m


NODES = (20, 15)  # springs per pad along x_S and y_S
FACE_M = (20e-3, 15e-3)
_STAGGER = (0.0, 0.4, -0.2, 0.2, -0.4)  # of the pitch, column by column


def node_grid() -> FloatArray:
    """(300, 2) rest positions of one pad's springs in the gel plane of F_S, m.

    Columns are staggered along y: a tool's edge, which runs along x, meets springs one by one and not a whole row
    at once, so that the force on it varies smoothly.
    """
    axes = [(np.arange(n) + 0.5) * (size / n) - 0.5 * size for n, size in zip(NODES, FACE_M, strict=True)]
    x, y = np.meshgrid(*axes)
    y = y + np.resize(_STAGGER, NODES[0]) * (FACE_M[1] / NODES[1])
    return np.stack([x.ravel(), y.ravel()], axis=1)


@dataclass(frozen=True, slots=True)
class Pads:
    """The springs of both pads in F_E, left first: n = 2 · 300.

    Attributes:
        law: Gel mechanics.
        area_m2: Area of a spring.
        X: (n, 3) rest positions.
        ex: (n, 3) x_S of each spring's pad.
        ey: (n, 3) y_S.
        ez: (n, 3) z_S.
        side: (n,) +1 left, −1 right.
    """

    law: GelLaw
    area_m2: float
    X: FloatArray
    ex: FloatArray
    ey: FloatArray
    ez: FloatArray
    side: FloatArray

    @classmethod
    def at(cls, T_E_S: dict[str, FloatArray], law: GelLaw) -> Pads:
        """Pads at their sensor poses, (4, 4) each, by side."""
        grid = node_grid()
        T = np.stack([T_E_S[side] for side in SIDES])  # (2, 4, 4)
        k = len(grid)
        X = np.concatenate([grid @ Ti[:3, :2].T + Ti[:3, 3] for Ti in T])
        ex, ey, ez = (np.repeat(T[:, :3, j], k, axis=0) for j in range(3))
        area = FACE_M[0] * FACE_M[1] / k
        return cls(law, area, X, ex, ey, ez, np.repeat([1.0, -1.0], k))

    def __len__(self) -> int:
        return len(self.X)


@dataclass(frozen=True, slots=True)
class PadState:
    """Memory of the pads.

    Attributes:
        anchored: (n,) whether the spring holds the tool.
        q: (n, 3) material point of the tool that each spring holds, F_T.
        depth_v: (n,) relaxed part of the overlap, m.
        shear_v: (n, 2) relaxed part of the shear, m.
    """

    anchored: BoolArray
    q: FloatArray
    depth_v: FloatArray
    shear_v: FloatArray

    @classmethod
    def fresh(cls, n: int) -> PadState:
        """Pads that touch nothing."""
        return cls(np.zeros(n, dtype=bool), np.zeros((n, 3)), np.zeros(n), np.zeros((n, 2)))


@dataclass(frozen=True, slots=True)
class PadForces:
    """What the pads do to the tool at a pose.

    Attributes:
        wrench: (6,) on the tool about the tip, F_E.
        stiffness: (6, 6) its derivative; not symmetric where springs slip.
        depth: (n,) overlap, m, negative outside.
        normal_n: (n,) normal force magnitude.
        shear: (n, 2) elastic displacement of the gel's surface in F_S, m.
        tangential: (n, 2) friction force on the tool along (x_S, y_S), N.
        slipping: (n,) springs at the friction cone.
        stored_j: Elastic energy in the springs.
    """

    wrench: FloatArray
    stiffness: FloatArray
    depth: FloatArray
    normal_n: FloatArray
    shear: FloatArray
    tangential: FloatArray
    slipping: BoolArray
    stored_j: float


def pad_forces(
    pads: Pads, tool: ToolShape, state: PadState, R: FloatArray, p: FloatArray, dt_s: float, friction: float
) -> PadForces:
    """Forces of the springs on a tool with orientation R and tip p in F_E, an implicit step of dt after ``state``.

    Normal springs derive from the energy of the overlap, so their force acts along the tool's surface normal;
    friction springs hold a material point until the Coulomb cone is reached, then follow it (return mapping).
    """
    law = pads.law
    rho = dt_s / law.creep_s
    instant = 1.0 - law.creep * rho / (1.0 + rho)  # share of the stiffness acting on the new displacement
    memory = law.creep / (1.0 + rho)  # and on the relaxed part
    r = pads.X - p  # (n, 3)
    o = tool.overlap(r @ R, pads.side)
    m = (
        np.stack([-pads.side, o.slope_b, o.slope_l], axis=1) @ R.T
    )  # (n, 3) ∇ overlap: along the tool's normal
    touching = o.depth > 0.0
    kn = law.normal * pads.area_m2
    hard = law.stiffening / law.thickness_m
    depth = np.where(touching, o.depth, 0.0)
    f_n = kn * (instant * depth - memory * state.depth_v + hard * depth * depth)  # (n,)
    pressed = touching & (f_n > 0.0)
    f_n = np.where(pressed, f_n, 0.0)
    k_n = np.where(pressed, kn * (instant + 2.0 * hard * depth), 0.0)
    Gn = np.concatenate([m, np.cross(r, m)], axis=1)  # (n, 6)
    f = f_n[:, None] * m
    F = f.sum(axis=0)
    wrench = f_n @ Gn
    J = -Gn.T @ (k_n[:, None] * Gn)
    for axis, bend in ((1, o.bend_b), (2, o.bend_l)):
        weight = f_n * bend
        if np.any(weight):
            e = R[:, axis]
            Gb = np.concatenate([np.broadcast_to(e, r.shape), np.cross(r, e)], axis=1)
            J += Gb.T @ (weight[:, None] * -Gb)
    SF = skew(F)
    J[:3, 3:] -= SF
    J[3:, :3] += SF
    J[3:, 3:] += np.eye(3) * float(np.sum(r * f)) - f.T @ r
    # friction
    ks = law.shear * pads.area_m2
    a = state.q @ R.T  # (n, 3) held points relative to the tip
    gap = a - r
    s = np.stack([np.sum(gap * pads.ex, axis=1), np.sum(gap * pads.ey, axis=1)], axis=1)  # (n, 2)
    holds = state.anchored & pressed
    t = np.where(holds[:, None], -ks * (instant * s - memory * state.shear_v), 0.0)
    m_norm = np.sqrt(1.0 + o.slope_b**2 + o.slope_l**2)
    normal = f_n * m_norm
    limit = friction * normal
    size = np.sqrt(t[:, 0] ** 2 + t[:, 1] ** 2)
    slipping = holds & (size > limit)
    scale = np.where(slipping, limit / np.maximum(size, 1e-300), 1.0)
    unit = t / np.maximum(size, 1e-300)[:, None]
    t = t * scale[:, None]
    Gx = np.concatenate([pads.ex, np.cross(a, pads.ex)], axis=1)
    Gy = np.concatenate([pads.ey, np.cross(a, pads.ey)], axis=1)
    wrench = wrench + t[:, 0] @ Gx + t[:, 1] @ Gy
    stick = np.where(
        holds, ks * instant * scale, 0.0
    )  # tangent of the return mapping: across the slip direction
    along = np.where(slipping, stick, 0.0)
    ux, uy = unit[:, 0], unit[:, 1]
    J -= Gx.T @ ((stick - along * ux * ux)[:, None] * Gx) + Gy.T @ ((stick - along * uy * uy)[:, None] * Gy)
    cross = Gx.T @ ((along * ux * uy)[:, None] * Gy)
    J += cross + cross.T
    if np.any(slipping):
        Gu = ux[:, None] * Gx + uy[:, None] * Gy
        J -= Gu.T @ (np.where(slipping, friction * m_norm * k_n, 0.0)[:, None] * Gn)
        for axis, slope, bend in (
            (1, o.slope_b, o.bend_b),
            (2, o.slope_l, o.bend_l),
        ):  # the normal's own change
            weight = np.where(slipping, friction * f_n * slope * bend / m_norm, 0.0)
            if np.any(weight):
                e = R[:, axis]
                Ge = np.concatenate([np.broadcast_to(e, r.shape), np.cross(r, e)], axis=1)
                J -= Gu.T @ (weight[:, None] * Ge)
    ft = t[:, :1] * pads.ex + t[:, 1:] * pads.ey
    J[3:, 3:] += a.T @ ft - np.eye(3) * float(np.sum(a * ft))
    shear = np.where(slipping[:, None], (memory * ks * state.shear_v - t) / (ks * instant), s)
    shear = np.where(holds[:, None], shear, 0.0)
    stored = 0.5 * kn * float(np.sum(depth * depth)) + 0.5 * ks * float(np.sum(shear * shear))
    return PadForces(wrench, J, o.depth, normal, shear, t, slipping, stored)


def advance_pads(
    pads: Pads, state: PadState, forces: PadForces, R: FloatArray, p: FloatArray, dt_s: float
) -> PadState:
    """Memory after a converged step: slipped springs follow the tool, new contacts take hold, old ones let go."""
    rho = dt_s / pads.law.creep_s
    pressed = forces.normal_n > 0.0
    held = state.anchored & pressed
    new = pressed & ~state.anchored
    gap = state.q @ R.T + p - pads.X
    s = np.stack([np.sum(gap * pads.ex, axis=1), np.sum(gap * pads.ey, axis=1)], axis=1)
    back = np.where((held & forces.slipping)[:, None], forces.shear - s, 0.0)  # (n, 2) slip of the held point
    q = state.q + (back[:, :1] * pads.ex + back[:, 1:] * pads.ey) @ R
    surface = pads.X - np.maximum(forces.depth, 0.0)[:, None] * pads.ez
    q = np.where(new[:, None], (surface - p) @ R, q)
    depth = np.maximum(forces.depth, 0.0)
    return PadState(
        anchored=pressed,
        q=q,
        depth_v=(state.depth_v + rho * depth) / (1.0 + rho),
        shear_v=(state.shear_v + rho * forces.shear) / (1.0 + rho),
    )


# --- tip ---------------------------------------------------------------------------------------------------


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
