"""The paper's figure of conditions, as the virtual rig has them: trajectories, tools, wrists, grasps.

python benchmarks/sim_conditions_figure.py [--out docs/images/conditions.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from tiptrace.geometry.transforms import invert, transform
from tiptrace.sim.conditions import HOLDS, WRISTS
from tiptrace.sim.groove import TRAJECTORIES
from tiptrace.sim.pads import FACE_M
from tiptrace.sim.rig import Placement, true_rig
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.tools import TOOL_NAMES, ToolShape, make_tool
from tiptrace.types import FloatArray

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#777777"  # Okabe-Ito


def section(tool: ToolShape) -> FloatArray:
    """(n, 2) outline of the gripped section (width, thickness), mm."""
    b = np.linspace(-0.5 * tool.width_m, 0.5 * tool.width_m, 201)
    points = np.column_stack([np.zeros_like(b), b, np.full_like(b, -0.06)])
    points[:, 0] = tool.shank_T[0]
    half = np.maximum(tool.overlap(points, np.ones(len(b))).depth, 0.0)
    return 1e3 * np.concatenate([np.column_stack([b, half]), np.column_stack([b[::-1], -half[::-1]])])


def outline(tool: ToolShape, across: int) -> FloatArray:
    """(n, 2) side view (across, z_T), mm: shank, taper, tip; across 0 is x_T, 1 is y_T."""
    half = 0.5 * (tool.thickness_m if across == 0 else tool.width_m)
    bend, r = tool.bend_above_tip_m, tool.tip_radius_m
    shank = tool.shank_T[across]
    knee = -max(bend, 12e-3)
    axis = shank if bend else 0.0
    side = [(axis + half, tool.top_m), (axis + half, knee), (r, -r)]
    arc = [(r * np.sin(a), r * np.cos(a)) for a in np.linspace(np.pi / 2, -np.pi / 2, 15)]
    other = [(-r, -r), (axis - half, knee), (axis - half, tool.top_m)]
    return 1e3 * np.array(side + arc + other)


def draw_trajectories(axes: Any) -> None:
    x = np.linspace(-0.01, 0.21, 900)
    for k, (name, line) in enumerate(TRAJECTORIES.items()):
        y = line.points(x)[:, 1] * 1e3
        axes.plot(x * 1e3, y - 20 * k, color=GREY, lw=0.8, ls=":")
        inside = (x >= 0) & (x <= 0.2)
        axes.plot(x[inside] * 1e3, y[inside] - 20 * k, color=BLUE, lw=1.8)
        axes.plot(0, -20 * k, "o", color=ORANGE, ms=4)
        axes.text(-14, -20 * k, name, ha="right", va="center")
    axes.set(xlim=(-30, 212), ylim=(-92, 14), xlabel="x, along the travel [mm]", yticks=[], aspect="equal")
    axes.set_title(
        "(a) trajectories: pit (dot), tangents (dotted); 20 mm between rows", loc="left", fontsize=9
    )


def draw_tools(axes: Any) -> None:
    for k, name in enumerate(TOOL_NAMES):
        tool = make_tool(name)
        side, cut = outline(tool, 0), section(tool)
        axes.fill(side[:, 0] + 28 * k, side[:, 1], color=BLUE, alpha=0.35, lw=0)
        axes.fill(cut[:, 0] + 28 * k, cut[:, 1] + 20, color=ORANGE, alpha=0.6, lw=0)
        axes.text(28 * k, 30, f"{name}\n{tool.section}", ha="center", va="top", fontsize=8)
    axes.set(xlim=(-16, 102), ylim=(44, -90), ylabel="z_T, towards the tip [mm]", xticks=[], aspect="equal")
    axes.set_title("(b) tools: side view (x_T right), section at the grasp", loc="left", fontsize=9)


def draw_wrists(axes: Any) -> None:
    """Hand axes seen from the side and from above, the tip at the origin."""
    length = 60.0
    for k, wrist in enumerate(WRISTS.values()):
        R, at = wrist.R_B_E, 70 * k
        for row, (i, j) in enumerate(((0, 2), (1, 2), (0, 1))):
            y0 = -100 * row
            for axis, colour, reach in ((2, GREY, -length), (0, BLUE, 25.0)):
                start = -length * R[:, 2] if axis == 0 else np.zeros(3)
                v = start + reach * R[:, axis]
                axes.annotate(
                    "",
                    (at + v[i], y0 + v[j]),
                    (at + start[i], y0 + start[j]),
                    arrowprops={"arrowstyle": "-|>" if axis == 0 else "-", "color": colour, "lw": 1.8},
                )
            axes.plot(at, y0, "o", color=ORANGE, ms=4)
        a, b, c = wrist.euler_xyz_deg
        axes.text(
            at, 78, f"{wrist.name}\n({a:.0f}°, {b:.0f}°, {c:.0f}°)", ha="center", va="bottom", fontsize=8
        )
    for row, label in enumerate(("x–z\nfrom the side", "y–z\nalong the travel", "x–y\nfrom above")):
        axes.text(-42, -100 * row + (25 if row < 2 else 0), label, ha="right", va="center", fontsize=8)
    axes.set(xlim=(-150, 190), ylim=(-235, 115), xticks=[], yticks=[], aspect="equal")
    axes.set_title("(c) wrists: tool axis (grey), closing axis (blue), tip (dot)", loc="left", fontsize=9)


def draw_grasps(axes: Any) -> None:
    """What the left pad faces: the tool in the plane of y_E and z_E."""
    tool = make_tool("O1")
    T_S_E = invert(true_rig(TrialSpec()).T_E_S("left"))
    for k, hold in enumerate(HOLDS.values()):
        place = Placement.of(hold, tool)
        T = T_S_E @ transform(place.R, place.p)
        shape = outline(tool, 1) * 1e-3
        points = np.column_stack([np.zeros(len(shape)), shape]) @ T[:3, :3].T + T[:3, 3]
        at = 36 * k
        axes.fill(1e3 * points[:, 1] + at, 1e3 * points[:, 0], color=BLUE, alpha=0.35, lw=0)
        w, h = 1e3 * FACE_M[1], 1e3 * FACE_M[0]
        axes.plot(
            at + np.array([-w, w, w, -w, -w]) / 2, np.array([-h, -h, h, h, -h]) / 2, color=ORANGE, lw=1.6
        )
        label = f"{hold.name}\n{hold.above_tip_m * 1e3:.0f} mm\n{hold.angle_deg:+.0f}°, {hold.offset_m * 1e3:.0f} mm"
        axes.text(at, -52, label, ha="center", va="top", fontsize=8)
    axes.set(xlim=(-20, 92), ylim=(74, -54), xticks=[], ylabel="x_S, towards the tip [mm]", aspect="equal")
    axes.set_title("(d) grasps: pad (orange); above the tip, angle, offset", loc="left", fontsize=9)


def main() -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images/conditions.png"))
    arguments = parser.parse_args()
    figure, axes = plt.subplots(2, 2, figsize=(11, 9), layout="constrained")
    draw_trajectories(axes[0, 0])
    draw_tools(axes[0, 1])
    draw_wrists(axes[1, 0])
    draw_grasps(axes[1, 1])
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out, dpi=130)


if __name__ == "__main__":
    main()
