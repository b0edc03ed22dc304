"""Train the packaged network gelsight-mini-virtual on rendered ball presses, as a user would train one on real ones.

    python scripts/train_virtual_gel.py [--out src/tiptrace/models/gelsight-mini-virtual.onnx] [--keep FOLDER]

No trial, tool or marker is involved: bearing balls are pressed all over gels without dots, whose lamps are drawn
from seeds that no trial uses. Presses of several gels go into one folder: each image is divided by its own gel's
reference and multiplied by the first gel's, which is what a network fed with image / reference sees anyway.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from tiptrace.calibration.gel_family import train_family
from tiptrace.sim.presses import PressPlan, write_press_folder

GEL_SEEDS = tuple(range(9001, 9050))
"""Set aside for this: trials draw their gels from 31-bit seeds. Gels take turns; 49 of them, so that with 48 presses
a round each gel is pressed everywhere in time."""


def main() -> None:
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=root / "src/tiptrace/models/gelsight-mini-virtual.onnx")
    parser.add_argument(
        "--keep", type=Path, help="where to leave the presses; by default they are thrown away"
    )
    parser.add_argument(
        "--rounds", type=int, default=24, help="how often the whole gel is covered (48 presses)"
    )
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.keep or Path(scratch)
        write_press_folder(folder, PressPlan(gel_seeds=GEL_SEEDS, rounds=args.rounds, seed=args.seed))
        args.out.parent.mkdir(parents=True, exist_ok=True)
        report = train_family(folder, args.out, len(GEL_SEEDS), mm_per_px=(0.0625, 0.0625), seed=args.seed)
    normal = np.median([s.normal_error_deg for s in report.held_out])
    depth = np.sqrt(np.mean([s.depth_rms_m**2 for s in report.held_out]))
    radius = np.median([abs(s.radius_error) for s in report.held_out])
    print(
        f"{args.out}: {report.gels} gels, {report.trained_on} presses, {len(report.held_out)} held out, "
        f"{report.seconds:.0f} s\n"
        f"normal error {normal:.2f}°, depth rms {depth * 1e6:.0f} µm, ball radius "
        f"{100 * radius:.1f} % off, steepest slope seen {report.max_slope:.2f}"
    )


if __name__ == "__main__":
    main()
