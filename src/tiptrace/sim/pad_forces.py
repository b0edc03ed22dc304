"""Forces of the pads' springs on the tool, with their exact derivative.

Everything is expressed in F_E, where the pads are at rest. A wrench is (6,): force and moment about the tip; a
stiffness (6, 6) is its derivative by (v, w), the tool's translation of the tip and rotation about it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiptrace.geometry.transforms import skew
from tiptrace.sim.pads import GelLaw, Pads, PadState
from tiptrace.sim.tools import Overlap, ToolShape
from tiptrace.types import BoolArray, FloatArray

IntArray = NDArray[np.intp]


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
    overlap = tool.overlap((pads.X - p) @ R, pads.side)
    k = np.flatnonzero(overlap.depth > 0.0)  # springs in contact
    creep = _Creep.over(dt_s, law)
    normal = _normal_forces(pads, overlap, state, k, R, p, creep)
    rub = _friction_forces(pads, state, k, R, p, creep, friction * normal.size)
    J = normal.stiffness + rub.stiffness
    if rub.slipping.any():
        J -= _slip_coupling(normal, overlap, rub, k, R, friction)
    shear, tangential = np.zeros((len(pads), 2)), np.zeros((len(pads), 2))
    size, slipping = np.zeros(len(pads)), np.zeros(len(pads), dtype=bool)
    shear[k], tangential[k], size[k], slipping[k] = rub.shear.T, rub.t.T, normal.size, rub.slipping
    stored = normal.stored_j + 0.5 * law.shear * pads.area_m2 * float(np.sum(rub.shear**2))
    return PadForces(normal.wrench + rub.wrench, J, overlap.depth, size, shear, tangential, slipping, stored)


@dataclass(frozen=True, slots=True)
class _Creep:
    """One implicit step of the relaxing branch: force = k (instant · x − memory · x_relaxed)."""

    instant: float
    memory: float

    @classmethod
    def over(cls, dt_s: float, law: GelLaw) -> _Creep:
        rho = dt_s / law.creep_s
        return cls(1.0 - law.creep * rho / (1.0 + rho), law.creep / (1.0 + rho))


@dataclass(frozen=True, slots=True)
class _Normal:
    """Normal forces of the k springs in contact; G (6, k) are their unit wrenches."""

    wrench: FloatArray
    stiffness: FloatArray
    f: FloatArray
    k_n: FloatArray
    G: FloatArray
    r: FloatArray
    lean: FloatArray
    size: FloatArray
    stored_j: float


def _normal_forces(
    pads: Pads, o: Overlap, state: PadState, k: IntArray, R: FloatArray, p: FloatArray, creep: _Creep
) -> _Normal:
    law, kn = pads.law, pads.law.normal * pads.area_m2
    depth, slope_b, slope_l = o.depth[k], o.slope_b[k], o.slope_l[k]
    r = pads.X[k].T - p[:, None]  # (3, k)
    m = R @ np.stack([-pads.side[k], slope_b, slope_l])  # (3, k) ∇ overlap: along the tool's normal
    hard = law.stiffening / law.thickness_m
    f = kn * (creep.instant * depth - creep.memory * state.depth_v[k] + hard * depth * depth)  # (k,)
    k_n = np.where(f > 0.0, kn * (creep.instant + 2.0 * hard * depth), 0.0)
    f = np.maximum(f, 0.0)
    G = _wrenches(r, m)
    J = -(G * k_n) @ G.T
    for axis, bend in ((1, o.bend_b), (2, o.bend_l)):
        weight = f * bend[k]
        if weight.any():
            Gb = _wrenches(r, np.broadcast_to(R[:, axis, None], r.shape))
            J -= (Gb * weight) @ Gb.T
    fm = f * m
    F = skew(fm.sum(axis=1))
    rf = r @ fm.T  # (3, 3) Σ r fᵀ
    J[:3, 3:] -= F
    J[3:, :3] += F
    J[3:, 3:] += np.eye(3) * np.trace(rf) - rf.T
    lean = np.sqrt(1.0 + slope_b**2 + slope_l**2)
    return _Normal(G @ f, J, f, k_n, G, r, lean, f * lean, 0.5 * kn * float(depth @ depth))


@dataclass(frozen=True, slots=True)
class _Friction:
    """Friction of the k springs in contact; rows of t and shear are (x_S, y_S)."""

    wrench: FloatArray
    stiffness: FloatArray
    t: FloatArray
    shear: FloatArray
    slipping: BoolArray
    G_slip: FloatArray


def _friction_forces(
    pads: Pads,
    state: PadState,
    k: IntArray,
    R: FloatArray,
    p: FloatArray,
    creep: _Creep,
    limit: FloatArray,
) -> _Friction:
    ks = pads.law.shear * pads.area_m2
    ex, ey = pads.ex[k].T, pads.ey[k].T  # (3, k)
    a = R @ state.q[k].T  # (3, k) held points relative to the tip
    gap = a - (pads.X[k].T - p[:, None])
    s = np.stack([np.sum(gap * ex, axis=0), np.sum(gap * ey, axis=0)])  # (2, k)
    relaxed = state.shear_v[k].T
    holds = state.anchored[k] & (limit > 0.0)
    t = np.where(holds, -ks * (creep.instant * s - creep.memory * relaxed), 0.0)
    size = np.maximum(np.sqrt(t[0] ** 2 + t[1] ** 2), 1e-300)
    slipping = holds & (size > limit)
    scale = np.where(slipping, limit / size, 1.0)
    u = t / size
    t = t * scale
    Gx, Gy = _wrenches(a, ex), _wrenches(a, ey)
    stick = np.where(
        holds, ks * creep.instant * scale, 0.0
    )  # return mapping: stiff across the slip direction
    along = np.where(slipping, stick, 0.0)
    J = -(Gx * (stick - along * u[0] ** 2)) @ Gx.T - (Gy * (stick - along * u[1] ** 2)) @ Gy.T
    G_slip = np.zeros((6, 0))
    if slipping.any():
        cross = (Gx * (along * u[0] * u[1])) @ Gy.T
        J += cross + cross.T
        G_slip = u[0] * Gx + u[1] * Gy
    af = a @ (t[0] * ex + t[1] * ey).T  # (3, 3) Σ a fᵀ
    J[3:, 3:] += af - np.eye(3) * np.trace(af)
    followed = (creep.memory * ks * relaxed - t) / (ks * creep.instant)
    shear = np.where(holds, np.where(slipping, followed, s), 0.0)
    return _Friction(Gx @ t[0] + Gy @ t[1], J, t, shear, slipping, G_slip)


def _slip_coupling(
    normal: _Normal, o: Overlap, rub: _Friction, k: IntArray, R: FloatArray, friction: float
) -> FloatArray:
    """(6, 6) how the friction of slipping springs follows their normal force and its direction."""
    on = np.where(rub.slipping, friction, 0.0)
    J = (rub.G_slip * (on * normal.lean * normal.k_n)) @ normal.G.T
    for axis, slope, bend in ((1, o.slope_b, o.bend_b), (2, o.slope_l, o.bend_l)):
        weight = on * normal.f * slope[k] * bend[k] / normal.lean
        if weight.any():
            Ge = _wrenches(normal.r, np.broadcast_to(R[:, axis, None], normal.r.shape))
            J += (rub.G_slip * weight) @ Ge.T
    return np.asarray(J)


def _wrenches(r: FloatArray, f: FloatArray) -> FloatArray:
    """(6, k) wrenches (f, r × f) of forces f at r, (3, k) each."""
    G = np.empty((6, r.shape[1]))
    G[:3] = f
    G[3] = r[1] * f[2] - r[2] * f[1]
    G[4] = r[2] * f[0] - r[0] * f[2]
    G[5] = r[0] * f[1] - r[1] * f[0]
    return G


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
