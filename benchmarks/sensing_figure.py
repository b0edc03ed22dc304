"""Picture of the sensing chain's steps on one rendered frame: docs/images/sensing_steps.png.

python benchmarks/sensing_figure.py [--out docs/images/sensing_steps.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from sensing_accuracy import SENSOR, grasp
from small_png import save_small

from tiptrace.calibration.gel_evaluation import measured_slopes
from tiptrace.evaluation import style
from tiptrace.perception.background import untouched_background
from tiptrace.perception.finger import Finger
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.sim.dots import DotLayout
from tiptrace.sim.optics import gel_optics
from tiptrace.sim.render import TactileRenderer

SEED = 2


def main() -> None:
    from matplotlib.patches import Circle

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    root = Path(__file__).resolve().parents[1]
    parser.add_argument("--out", type=Path, default=root / "docs" / "images" / "sensing_steps.png")
    args = parser.parse_args()
    renderer = TactileRenderer(gel_optics(11), DotLayout(), seed=SEED)
    gel, reference = load_gel_model("gelsight-mini-virtual"), renderer.reference()
    finger = Finger(SENSOR, gel, reference)
    for k in range(4):
        now = grasp(k / 20, SEED)
        image = renderer.render(now, k)
        markers = finger.sense(image)
    depth, true = finger.depth_m, -renderer.heights(now)
    assert depth is not None
    assert finger.markers is not None
    nothing = np.zeros(true.shape, dtype=np.bool_)
    raw = measured_slopes(gel, image, untouched_background(reference), nothing)[..., 0]
    radius = 0.5 * float(np.median(finger.markers.diameter_px)) + 2.0
    with style.figure_style():
        figure = style.new_figure(9.0, 6.0)
        (seen, slopes), (map_, error) = figure.subplots(2, 2, sharex=True, sharey=True)
        seen.imshow(image[..., ::-1])
        for u, v in markers.uv_px[markers.tracked]:
            seen.add_patch(Circle((u, v), radius, fill=False, color="white", linewidth=0.8))
        seen.set(title="Image; masks are discs at the tracked dots")
        shown = slopes.imshow(raw, cmap="PuOr", vmin=-1, vmax=1)
        slopes.set(title="∂z/∂x from the network, had nothing been masked")
        figure.colorbar(shown, ax=slopes, label="[m/m]")
        shown = map_.imshow(depth * 1e3, cmap="cividis")
        map_.set(title="Depth of the chain")
        figure.colorbar(shown, ax=map_, label="[mm]")
        shown = error.imshow((depth - true) * 1e6, cmap="PuOr", vmin=-150, vmax=150)
        error.plot(*markers.uv_px[markers.tracked].T, ".", color="black", markersize=2.5)
        rms = 1e6 * float(np.sqrt(np.mean((depth - true) ** 2)))
        error.set(title=f"Its error, {rms:.0f} µm rms; points: markers")
        figure.colorbar(shown, ax=error, label="[µm]")
        for axes in (seen, slopes, map_, error):
            axes.grid(False)
            axes.set(xlim=(-0.5, 319.5), ylim=(239.5, -0.5))
        for axes in (map_, error):
            axes.set(xlabel="u [px]")
        for axes in (seen, map_):
            axes.set(ylabel="v [px]")
        save_small(figure, args.out, dpi=80)


if __name__ == "__main__":
    main()
