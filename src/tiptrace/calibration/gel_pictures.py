"""A picture of each held-out press: what was seen, what was measured, and how far it is from the ball."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tiptrace.calibration.gel_circles import ball_radius_px
from tiptrace.calibration.gel_data import Press, PressFolder
from tiptrace.calibration.gel_evaluation import PressScore

_BALL, _MEASURED = "#000000", "#D55E00"  # Okabe-Ito


def draw_press(score: PressScore, press: Press, folder: PressFolder, path: Path) -> None:
    """Write a PNG: the press with its contact circle, the depth map, and a cut through the ball's centre."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle as Disc

    c = score.circle
    half = int(2.2 * c.radius)
    u0, v0 = max(int(c.u) - half, 0), max(int(c.v) - half, 0)
    window = np.s_[v0 : v0 + 2 * half + 1, u0 : u0 + 2 * half + 1]
    depth_mm = score.depth_m[window] * 1e3
    scale = float(np.mean(folder.mm_per_px))
    h, w = depth_mm.shape
    x0, y0 = (u0 - c.u) * scale, (v0 - c.v) * scale
    extent = (x0, x0 + w * scale, y0 + h * scale, y0)
    figure = Figure(figsize=(10.2, 3.1), layout="constrained")
    FigureCanvasAgg(figure)
    seen, measured, cut = figure.subplots(1, 3)
    seen.imshow(press.image[window][..., ::-1], extent=extent)
    seen.add_patch(Disc((0, 0), c.radius * scale, fill=False, color="white", linewidth=1.2))
    seen.set(title=f"{press.name}, {press.ball_diameter_mm:g} mm ball", xlabel="x [mm]", ylabel="y [mm]")
    shown = measured.imshow(depth_mm, extent=extent, cmap="cividis")
    measured.set(title="Measured depth", xlabel="x [mm]")
    figure.colorbar(shown, ax=measured, label="depth [mm]")
    row = min(max(round(c.v) - v0, 0), h - 1)
    x_mm = (np.arange(w) + u0 - c.u) * scale
    cut.plot(x_mm, -depth_mm[row], color=_MEASURED, label="measured")
    R = ball_radius_px(press, folder) * scale
    inside = np.abs(x_mm) < min(c.radius * scale * 1.3, 0.95 * R)
    ball = R - np.sqrt(R**2 - x_mm[inside] ** 2)
    near = np.abs(x_mm) < c.radius * scale * 0.9
    offset = np.median(-depth_mm[row][near] - (R - np.sqrt(R**2 - x_mm[near] ** 2)))
    cut.plot(x_mm[inside], ball + offset, color=_BALL, linestyle="--", label="ball")
    cut.set(
        title=f"Cut: normal error {score.normal_error_deg:.1f}°",
        xlabel="x [mm]",
        ylabel="height [mm]",
    )
    cut.legend(frameon=False)
    figure.savefig(path, dpi=110)
