"""Figure of a surface fit: the centreline with its band, and the height about the plane."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tiptrace.evaluation import style
from tiptrace.evaluation.surface import SurfaceFit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def surface_figure(fit: SurfaceFit) -> Figure:
    """Across and height against the way along the travel, with what was fitted."""
    figure = style.new_figure(7.2, 4.4)
    across, height = figure.subplots(2, 1, sharex=True, height_ratios=[1.6, 1.0])
    for k, trace in enumerate(fit.traces):
        u, v, w = (fit.plane.to_plane(trace.p_B) * 1e3).T
        label = f"traces ({len(fit.traces)})" if k == 0 else None
        across.plot(u, v, color=style.SKY, lw=0.9, label=label)
        height.plot(u, w, color=style.SKY, lw=0.9)
    if fit.centreline is not None:
        u = fit.centreline.along_m * 1e3
        low, high = (edge * 1e3 for edge in fit.centreline.band())
        across.fill_between(
            u, low, high, color=style.VERMILLION, alpha=0.25, lw=0, label="95 % band of the shape"
        )
        across.plot(u, fit.centreline.across_m * 1e3, color=style.VERMILLION, label="centreline")
    if fit.periodic is not None:
        p = fit.periodic
        across.set_title(
            f"Across the travel: period {p.period_m * 1e3:.2f} ± {p.period_std_m * 1e3:.2f} mm, "
            f"amplitude {p.amplitude_m * 1e3:.2f} ± {p.amplitude_std_m * 1e3:.2f} mm (1σ)"
        )
    else:
        across.set_title("Across the travel")
    height.axhline(0.0, color=style.BLACK, lw=1.2, label="plane")
    height.axhspan(
        -fit.plane.height_std_m * 1e3, fit.plane.height_std_m * 1e3, color=style.GREY, alpha=0.25, lw=0
    )
    normal = ", ".join(f"{n:g}" for n in np.round(fit.plane.normal_B, 3))
    height.set_title(f"Height about the plane of the tip's centre, normal ({normal})")
    across.set_ylabel("across [mm]")
    height.set(ylabel="height [mm]", xlabel="along the travel [mm]")
    figure.legend(*across.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure
