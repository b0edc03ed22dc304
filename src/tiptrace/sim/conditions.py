"""Conditions of the paper: wrists and grasps (values chosen here), the twelve conditions and the 51 trials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tiptrace.errors import SimulationError
from tiptrace.geometry.transforms import rotation_exp
from tiptrace.types import FloatArray


@dataclass(frozen=True, slots=True)
class Wrist:
    """Orientation of the hand in the base frame.

    Attributes:
        name: Its name.
        euler_xyz_deg: R_B_E = Rz(c) Ry(b) Rx(a) from (a, b, c).
    """

    name: str
    euler_xyz_deg: tuple[float, float, float]

    @property
    def R_B_E(self) -> FloatArray:
        """(3, 3) orientation."""
        a, b, c = np.radians(self.euler_xyz_deg)
        return rotation_exp([0, 0, c]) @ rotation_exp([0, b, 0]) @ rotation_exp([a, 0, 0])


@dataclass(frozen=True, slots=True)
class Hold:
    """How the fingers hold the tool (paper: G1–G3).

    Attributes:
        name: Its name.
        above_tip_m: Distance from the tip's centre to the pads' centre along the shank.
        angle_deg: In-plane angle of the tool about the closing axis.
        offset_m: Distance of the pads' centre from the shank's axis, along the width.
    """

    name: str
    above_tip_m: float
    angle_deg: float
    offset_m: float


WRISTS: dict[str, Wrist] = {
    "W1": Wrist("W1", (180.0, 0.0, 0.0)),
    "W2": Wrist("W2", (180.0, 12.0, 0.0)),
    "W3": Wrist("W3", (170.0, 0.0, 20.0)),
}
HOLDS: dict[str, Hold] = {
    "G1": Hold("G1", 60e-3, 0.0, 0.0),
    "G2": Hold("G2", 52e-3, 8.0, 0.0),
    "G3": Hold("G3", 66e-3, -6.0, 1.0e-3),
}


def named_wrist(name: str) -> Wrist:
    """A wrist pose W1–W3.

    Raises:
        SimulationError: an unknown name.
    """
    if name not in WRISTS:
        raise SimulationError(f"unknown wrist '{name}'; valid wrists: {', '.join(WRISTS)}")
    return WRISTS[name]


def named_hold(name: str) -> Hold:
    """A grasp G1–G3.

    Raises:
        SimulationError: an unknown name.
    """
    if name not in HOLDS:
        raise SimulationError(f"unknown grasp '{name}'; valid grasps: {', '.join(HOLDS)}")
    return HOLDS[name]


@dataclass(frozen=True, slots=True, order=True)
class Condition:
    """One cell of the paper's table."""

    trajectory: str
    tool: str
    wrist: str
    grasp: str

    @property
    def name(self) -> str:
        """For example ``T3-O1-W1-G1``."""
        return f"{self.trajectory}-{self.tool}-{self.wrist}-{self.grasp}"


CONDITION_SETS: dict[str, tuple[Condition, ...]] = {
    "A": tuple(Condition(f"T{k}", "O1", "W1", "G1") for k in range(1, 6)),
    "B": tuple(Condition("T3", f"O{k}", "W1", "G1") for k in range(1, 5)),
    "C": tuple(Condition("T3", "O2", f"W{k}", "G1") for k in range(1, 4)),
    "D": tuple(Condition("T3", "O1", "W1", f"G{k}") for k in range(1, 4)),
}
CONDITIONS: tuple[Condition, ...] = tuple(sorted({c for group in CONDITION_SETS.values() for c in group}))
_SHARED = Condition("T3", "O1", "W1", "G1")


def paper_trials() -> tuple[tuple[Condition, int], ...]:
    """The 51 trials as (condition, repeat): 11 conditions 4 times, the one that the sets share 7 times."""
    return tuple((c, k) for c in CONDITIONS for k in range(7 if c == _SHARED else 4))
