"""The two pads: fields of point springs at rest in F_E, and their memory (design, section 7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
