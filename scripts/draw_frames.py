"""Draws docs/images/frames.png: the frames of the rig. Usage: python scripts/draw_frames.py"""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
OUT = Path(__file__).resolve().parents[1] / "docs" / "images" / "frames.png"


def arrow(
    ax: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    color: str,
    label: str,
    at: tuple[float, float],
) -> None:
    ax.add_patch(
        FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=12, lw=1.8, color=color, zorder=5)
    )
    ax.text(*at, label, color=color, fontsize=10, ha="center", va="center", zorder=6)


def axis_into_page(ax: Axes, x: float, y: float, color: str, *, out: bool) -> None:
    ax.add_patch(Circle((x, y), 1.3, fill=True, fc="white", ec=color, lw=1.5, zorder=6))
    if out:
        ax.add_patch(Circle((x, y), 0.4, fc=color, ec=color, zorder=7))
    else:
        for s in (-1, 1):
            ax.plot([x - 0.9, x + 0.9], [y - 0.9 * s, y + 0.9 * s], color=color, lw=1.2, zorder=7)


def gripper(ax: Axes) -> None:
    ax.add_patch(Rectangle((-14, 92), 28, 18, fc="#dddddd", ec=GREY))
    for side in (-1, 1):
        ax.add_patch(Rectangle((side * 17 - 4, 48), 8, 44, fc="#dddddd", ec=GREY))
        ax.add_patch(Rectangle((side * 8 - 5, 50), 10, 24, fc="#cfe3f1", ec=BLUE))
    ax.add_patch(
        Polygon(
            [(-4, 88), (4, 88), (4, 12), (0.8, 2), (-0.8, 2), (-4, 12)], fc="#f3ddca", ec=ORANGE, zorder=3
        )
    )
    ax.add_patch(Rectangle((-50, -4), 100, 5, fc="#eeeeee", ec=GREY))
    ax.add_patch(Circle((0, 2.6), 1.4, fc=ORANGE, ec="black", zorder=6))


def main() -> None:
    fig, ax = plt.subplots(figsize=(8.2, 6.4))
    gripper(ax)
    ax.annotate(
        "tip: centre of its sphere, p_B",
        (1.5, 2.2),
        (30, 12),
        fontsize=10,
        ha="center",
        arrowprops={"arrowstyle": "-", "color": "black"},
    )
    arrow(ax, (0, 101), (0, 84), GREEN, "z_E", (4.6, 96))
    arrow(ax, (0, 101), (-24, 101), GREEN, "x_E", (-22, 104))
    axis_into_page(ax, 0, 101, GREEN, out=False)
    ax.text(16, 105.5, "F_E  end effector (y_E into the page)", color=GREEN, fontsize=10)
    for side, name in ((-1, "left"), (1, "right")):
        x = side * 3.2
        arrow(ax, (x + side * 1, 62), (x + side * 1, 47), BLUE, "x_S", (x + side * 5, 46))
        ax.text(
            side * 40,
            64,
            f"F_S {name}\n+z_S out of the gel,\ntowards the tool",
            color=BLUE,
            fontsize=10,
            ha="center",
        )
        arrow(ax, (side * 12, 68), (side * 4.2, 68), BLUE, "z_S", (side * 10, 71))
    arrow(ax, (-42, 6), (-42, 22), "black", "z_B", (-42, 25))
    arrow(ax, (-42, 6), (-58, 6), "black", "x_B", (-61, 6))
    ax.text(-50, -9, "F_B  robot base = world", fontsize=10, ha="center")
    ax.annotate("", (-27, 60), (-27, 2.6), arrowprops={"arrowstyle": "<->", "color": GREY})
    ax.text(-28.5, 32, "about 60 mm", rotation=90, va="center", ha="right", fontsize=9, color=GREY)
    ax.set_xlim(-66, 76), ax.set_ylim(-14, 114)
    ax.set_aspect("equal"), ax.axis("off")
    fig.tight_layout()
    OUT.parent.mkdir(exist_ok=True)
    fig.savefig(OUT, dpi=110)


if __name__ == "__main__":
    main()
