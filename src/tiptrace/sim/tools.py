"""Tools: rigid bodies with a smooth section where the pads hold them and a spherical tip.

Tool frame F_T: origin at the centre of the tip's sphere, +z_T along the gripped shank towards the tip, x_T across
the fingers (the side at +x_T faces the left pad), y_T along the width. The surface that faces a pad is a height
function of width and length, so a gel point's overlap with the tool is explicit and smooth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from tiptrace.errors import SimulationError
from tiptrace.types import FloatArray

TIP_RADIUS_M = 1.4e-3
LENGTH_M = 86e-3
THICKNESS_M = 8.6e-3
THICKNESS_RANGE_M = (5e-3, 20e-3)
_GRAVITY = 9.81
_FLANK_SLOPE = float(np.tan(np.radians(60.0)))  # steeper walls leave the gel: it cannot follow them


class Drop(Protocol):
    """How far the surface lies below the flat, and its first two derivatives, at the distance u beyond it."""

    def drop(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n,) drop m, slope, curvature 1/m; zero for u ≤ 0."""
        ...


@dataclass(frozen=True, slots=True)
class Corner:
    """An edge: the surface bends away over ``run_m`` with continuous curvature, then falls at a straight slope.

    Attributes:
        run_m: Length over which it bends.
        slope: Slope of the flank.
    """

    run_m: float
    slope: float = _FLANK_SLOPE

    def drop(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See :class:`Drop`; the curvature is a raised cosine."""
        L, w = self.run_m, 2.0 * np.pi / self.run_m
        v = np.clip(u, 0.0, L)
        g = self.slope / L * (0.5 * v * v - (1.0 - np.cos(w * v)) / w**2) + self.slope * np.maximum(
            u - L, 0.0
        )
        return g, self.slope / L * (v - np.sin(w * v) / w), self.slope / L * (1.0 - np.cos(w * v))


@dataclass(frozen=True, slots=True)
class Round:
    """A cylinder's surface, straight beyond the flank's slope (which is deeper than any contact).

    Attributes:
        radius_m: Its radius.
    """

    radius_m: float

    def drop(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See :class:`Drop`."""
        r, u_c = self.radius_m, self.radius_m * _FLANK_SLOPE / float(np.hypot(1.0, _FLANK_SLOPE))
        v = np.clip(u, 0.0, u_c)
        root = np.sqrt(r * r - v * v)
        return (
            r - root + _FLANK_SLOPE * np.maximum(u - u_c, 0.0),
            v / root,
            np.where(u < u_c, r * r / root**3, 0.0),
        )


@dataclass(frozen=True, slots=True)
class Overlap:
    """How far gel points lie inside the tool, with derivatives along width (b) and length (l).

    Attributes:
        depth: (n,) overlap along x_T, m; negative outside.
        slope_b: (n,) d(half thickness)/db.
        slope_l: (n,) d(half thickness)/dl.
        bend_b: (n,) second derivative along b, 1/m.
        bend_l: (n,) second derivative along l, 1/m.
    """

    depth: FloatArray
    slope_b: FloatArray
    slope_l: FloatArray
    bend_b: FloatArray
    bend_l: FloatArray


@dataclass(frozen=True, slots=True)
class ToolShape:
    """A tool (paper: O1–O4).

    Attributes:
        name: Its name.
        section: What the section looks like, in words.
        thickness_m: Across the fingers.
        flat_m: Width of the flat that faces a pad, between the corners' fillets.
        corner: Its corners.
        width_m: Overall width, for drawing and for the mass.
        length_m: From the upper end to the lowest point of the tip.
        bend_deg: Angle by which the lower shank leaves the gripped one, towards +x_T; the paper's bent tool is
            held with its tip behind (a tip ahead of the hand would leave the pit with a snap).
        bend_above_tip_m: Height of the bend above the tip's centre, along the gripped shank.
        density: kg/m³.
        tip_radius_m: Radius of the tip's sphere.
    """

    name: str
    section: str
    thickness_m: float
    flat_m: float
    corner: Drop
    width_m: float
    length_m: float = LENGTH_M
    bend_deg: float = 0.0
    bend_above_tip_m: float = 0.0
    density: float = 1240.0
    tip_radius_m: float = TIP_RADIUS_M

    @property
    def shank_T(self) -> FloatArray:
        """(3,) a point of the gripped shank's axis at the tip's height: where a straight tool's tip would be."""
        return np.array([-self.bend_above_tip_m * np.tan(np.radians(self.bend_deg)), 0.0, 0.0])

    @property
    def top_m(self) -> float:
        """z_T of the upper end (negative)."""
        return self.tip_radius_m - self.length_m

    @property
    def weight_n(self) -> float:
        """Weight, N."""
        return _GRAVITY * self.density * self.thickness_m * self.width_m * self.length_m * 0.9

    @property
    def centre_of_mass_T(self) -> FloatArray:
        """(3,) centre of mass, m."""
        middle = np.array([0.0, 0.0, 0.5 * (self.top_m + self.tip_radius_m)])
        return np.asarray(self.shank_T * 0.8 + middle)

    def overlap(self, y_T: FloatArray, side: FloatArray) -> Overlap:
        """Overlap of gel points with the half of the tool that faces their pad.

        Args:
            y_T: (n, 3) points in the tool frame, m.
            side: (n,) +1 for the left pad (at +x_T), −1 for the right.
        """
        a = side * (y_T[:, 0] - self.shank_T[0])  # (n,) distance from the mid-plane towards the pad
        b = y_T[:, 1]
        drop, slope, bend = self.corner.drop(np.abs(b) - 0.5 * self.flat_m)
        depth = 0.5 * self.thickness_m - drop - a
        beyond = self.top_m + _END_CORNER.run_m - y_T[:, 2]  # past where the upper end begins to round
        if not (beyond > 0.0).any():
            zero = np.zeros(len(b))
            return Overlap(depth, -slope * np.sign(b), zero, -bend, zero)
        end = _END_CORNER.drop(beyond)
        return Overlap(depth - end[0], -slope * np.sign(b), end[1], -bend, -end[2])

    def height_above_gel(self, T_S_T: FloatArray, x: FloatArray, y: FloatArray, side: float) -> FloatArray:
        """Height z_S of the tool's surface over points of the gel plane; negative where it presses in, m.

        Args:
            T_S_T: (4, 4) tool in the sensor frame.
            x: x_S, m, any shape.
            y: y_S, m, same shape.
            side: +1 for the left pad, −1 for the right.
        """
        R, t = T_S_T[:3, :3], T_S_T[:3, 3]
        height = np.zeros(np.size(x))
        sides = np.full(np.size(x), side)
        for _ in range(2):  # Newton along z_S: exact where the surface is flat, quadratic elsewhere
            points = np.stack([np.ravel(x), np.ravel(y), height], axis=1)
            o = self.overlap((points - t) @ R, sides)
            along_z = -side * R[2, 0] + o.slope_b * R[2, 1] + o.slope_l * R[2, 2]  # d(depth)/dz_S
            height = height - o.depth / np.where(
                np.abs(along_z) > 0.2, along_z, np.sign(along_z) * 0.2 + 1e-9
            )
        return height.reshape(np.shape(x))


_END_CORNER = Corner(1.5e-3)


def _tool(name: str, section: str, thickness_m: float) -> ToolShape:
    """A tool of the paper at a given thickness."""
    corner = Corner(1.5e-3)
    if section in ("rectangular", "bent"):
        width = 7.5e-3
        tool = ToolShape(name, section, thickness_m, width - 1.2 * corner.run_m, corner, width)
        return replace(tool, bend_deg=-12.0, bend_above_tip_m=30e-3) if section == "bent" else tool
    if section == "hexagonal":  # a flat faces each pad; the neighbouring faces fall away at 60°
        face = thickness_m / np.sqrt(3.0)
        flat = (
            face - corner.run_m
        )  # half a run on either side: the flank's line then meets the flat's at the edge
        return ToolShape(name, section, thickness_m, flat, corner, 2 * face)
    return ToolShape(name, section, thickness_m, 0.0, Round(0.5 * thickness_m), thickness_m)


_SECTIONS = {"O1": "rectangular", "O2": "hexagonal", "O3": "cylindrical", "O4": "bent"}
TOOL_NAMES: tuple[str, ...] = tuple(_SECTIONS)


def make_tool(name: str, thickness_m: float | None = None, length_m: float | None = None) -> ToolShape:
    """A tool by its name (paper: O1 rectangular, O2 hexagonal, O3 cylindrical, O4 bent).

    Raises:
        SimulationError: an unknown name, a thickness outside 5–20 mm, a length that leaves nothing to grasp.
    """
    if name not in _SECTIONS:
        raise SimulationError(f"unknown tool '{name}'; valid tools: {', '.join(TOOL_NAMES)}")
    thickness = THICKNESS_M if thickness_m is None else thickness_m
    low, high = THICKNESS_RANGE_M
    if not low <= thickness <= high:
        raise SimulationError(
            f"tool thickness {thickness * 1e3:.1f} mm is outside the gripper's range of "
            f"{low * 1e3:.0f} to {high * 1e3:.0f} mm"
        )
    tool = _tool(name, _SECTIONS[name], thickness)
    if length_m is None:
        return tool
    if not 0.05 <= length_m <= 0.3:
        raise SimulationError(f"tool length {length_m * 1e3:.0f} mm is outside 50 to 300 mm")
    return replace(tool, length_m=length_m)
