"""Figures of the Monte Carlo: contact error against the error of the tool's file, and NEES against χ²(3).

    python benchmarks/estimation_montecarlo.py --level nominal --methods full,full+prior --json nominal.json …
    python benchmarks/estimation_montecarlo.py --level hard --methods full,full+prior --json hard.json …
    python benchmarks/estimation_figures.py nominal.json hard.json --out docs/images

Writes ``prior_error.png`` and ``nees.png``; a panel for each file, named as it is.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from estimation_montecarlo import NEES_EDGES
from scipy.stats import chi2

BLUE, ORANGE, BLACK = "#0072B2", "#D55E00", "#000000"  # Okabe-Ito
Rows = dict[str, list[dict[str, Any]]]


def draw_prior(found: dict[str, Rows], path: Path) -> None:
    """Initial contact error of each trial over how far off the nominal tip was."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(found), figsize=(4.2 * len(found), 3.4), squeeze=False)
    for ax, (name, rows) in zip(axes[0], found.items(), strict=True):
        for method, colour, marker, label in (
            ("full", BLUE, "o", "without the prior"),
            ("full+prior", ORANGE, "x", "with the prior"),
        ):
            own = rows.get(method, [])
            at = [float(r["prior_mm"]) for r in own]
            ax.scatter(
                at,
                [float(r["initial_contact_error_mm"]) for r in own],
                18,
                colour,
                marker=marker,
                label=label,
            )
        ax.set(
            title=name, xlabel="nominal tip off by [mm]", ylabel="initial contact error [mm]", ylim=(0, None)
        )
        ax.set_xlim(0, None)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0, -1].legend(loc="upper left")
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def draw_nees(found: dict[str, Rows], path: Path) -> None:
    """Share of frames by NEES beside the density that an honest covariance gives."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(found), figsize=(4.2 * len(found), 3.4), squeeze=False, sharey=True)
    edges = np.array(NEES_EDGES)
    x = np.linspace(0.0, edges[-1], 300)
    for ax, (name, rows) in zip(axes[0], found.items(), strict=True):
        counts = np.sum([r["nees_counts"] for r in rows["full"]], axis=0)
        density = counts[:-1] / counts.sum() / np.diff(edges)
        ax.stairs(density, edges, fill=True, color=BLUE, alpha=0.5, label="full")
        ax.plot(x, chi2.pdf(x, 3), color=BLACK, lw=1.5, label="χ²(3)")
        ax.axvline(chi2.ppf(0.95, 3), color=ORANGE, ls="--", lw=1.2, label="95 %")
        beyond = 100.0 * counts[-1] / counts.sum()
        ax.set(title=f"{name} ({beyond:.1f} % beyond {edges[-1]:.0f})", xlabel="NEES", xlim=(0, edges[-1]))
        ax.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_ylabel("density of frames")
    axes[0, 0].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("json", type=Path, nargs="+", help="rows of estimation_montecarlo.py")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    found: dict[str, Rows] = {path.stem: json.loads(path.read_text()) for path in args.json}
    args.out.mkdir(parents=True, exist_ok=True)
    for draw, name in ((draw_prior, "prior_error.png"), (draw_nees, "nees.png")):
        draw(found, args.out / name)
        print(args.out / name)


if __name__ == "__main__":
    main()
