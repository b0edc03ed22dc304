"""Sensing without a network (``--depth none``) on rendered grasps: in plane, and the patch found against the true one.

    python benchmarks/sensing_planar.py [--frames 20] [--seeds 6]

The grasps of ``sensing_accuracy.py``: a rectangular tool in a marker gel that is sheared by up to 0.4 mm, sensor noise
on. A marker belongs to the true patch if the gel is pressed in there by more than 70 % of the deepest point. The patch
is told from the markers' motion, so that it is unknown (every marker counts) until the tool has moved the gel.
"px inside": markers on flat gel inside the patch throughout; "px all": all, those on the tool's steep edges included.
The patch is judged over the second half of the frames, and its precision also over the first quarter.
"""

from __future__ import annotations

import argparse

import numpy as np
from sensing_accuracy import SENSOR, grasp, in_patch

from tiptrace.perception.finger import Finger
from tiptrace.perception.lifting import sample_map
from tiptrace.perception.settings import SensingConfig
from tiptrace.sim.dots import DotLayout
from tiptrace.sim.optics import gel_optics
from tiptrace.sim.render import TactileRenderer

INDENTATION_M = 1.0e-3


def run(seed: int, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """In-plane errors (f, n, 2) px, NaN where lost; patch found, true patch, and its flat inside, (f, n)."""
    renderer = TactileRenderer(gel_optics(20 + seed), DotLayout(), seed=seed)
    config = SensingConfig(depth="none", indentation_m=INDENTATION_M)
    finger = Finger(SENSOR, None, renderer.reference(), config)
    error, found, true, flat = [], [], [], []
    for k in range(frames):
        gel = grasp(k / frames, seed)
        markers = finger.sense(renderer.render(gel, k))
        truth = renderer.dot_truth(gel).uv_px
        if k == 0:
            own = np.linalg.norm(markers.uv_px[:, None] - truth, axis=2).argmin(axis=1)
        depth = -renderer.heights(gel)
        error.append(markers.uv_px - truth[own])
        found.append(-markers.x_S[:, 2] > 0.5 * INDENTATION_M)
        flat.append(in_patch(renderer.slopes(gel), -depth, truth[own]))
        true.append(sample_map(depth, truth[own]) > 0.7 * depth.max())
    return np.array(error), np.array(found), np.array(true), np.array(flat)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=6)
    args = parser.parse_args()
    heads = ("seed", "px inside", "px all", "patch", "precision", "recall", "first frames: precision")
    print("{:<8} {:>9} {:>7} {:>6} {:>10} {:>7} {:>24}".format(*heads))
    form = "{:<8} {:>9.3f} {:>7.3f} {:>6.0f} {:>10.2f} {:>7.2f} {:>24.2f}"
    table = []
    for seed in range(1, 1 + args.seeds):
        error, found, true, flat = run(seed, args.frames)
        late, early = slice(args.frames // 2, None), slice(0, args.frames // 4)
        inside = flat.all(axis=0)
        row = (
            np.sqrt(np.nanmean(error[:, inside] ** 2)),
            np.sqrt(np.nanmean(error**2)),
            true[late].mean() * true.shape[1],
            (found & true)[late].sum() / max(found[late].sum(), 1),
            (found & true)[late].sum() / max(true[late].sum(), 1),
            (found & true)[early].sum() / max(found[early].sum(), 1),
        )
        table.append(row)
        print(form.format(seed, *row), flush=True)
    print(form.format("mean", *np.mean(table, axis=0)))


if __name__ == "__main__":
    main()
