"""The layout of the Rerun viewer."""

from __future__ import annotations

from typing import Any

MAGNIFIED = 10.0  # the ellipsoid of 2σ is a fraction of a millimetre: drawn ten times as large


def blueprint() -> Any:
    """Gels on the left, the scene in the middle, plots and events on the right; nothing to click."""
    import rerun.blueprint as rrb

    def gel(side: str, what: str, name: str) -> Any:
        return rrb.Spatial2DView(origin=f"tactile/{side}/{what}", name=f"{side} {name}")

    def plot(what: str, name: str) -> Any:
        return rrb.TimeSeriesView(origin=f"plots/{what}", name=name)

    gels = rrb.Vertical(
        gel("left", "image", "gel, motion × 3"),
        gel("right", "image", "gel, motion × 3"),
        gel("left", "depth", "depth, 0–1.5 mm"),
        gel("right", "depth", "depth, 0–1.5 mm"),
    )
    scene = rrb.Spatial3DView(
        origin="world",
        name=f"base, hand, tool, tip; ellipsoid 2σ × {MAGNIFIED:.0f}",
        background=[250, 250, 250],
    )
    close = rrb.Spatial3DView(
        origin="world",
        contents=["/world/tip/**", "/world/trajectory", "/world/truth"],
        name=f"trajectory; ellipsoid 2σ × {MAGNIFIED:.0f}",
        background=[250, 250, 250],
    )
    plots = rrb.Vertical(
        plot("residual", "residual, mm"),
        plot("sigma", "standard deviation, mm"),
        rrb.TimeSeriesView(
            origin="plots", contents=["/plots/rate/**", "/plots/latency/**"], name="rate, Hz; latency, ms"
        ),
        rrb.TextLogView(origin="events", name="events"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(gels, rrb.Vertical(scene, close, row_shares=[3, 2]), plots, column_shares=[2, 5, 3]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
    )
