"""Speed of the virtual rig on one core: frames per second with markers, image pairs per second with images.

    OMP_NUM_THREADS=1 python benchmarks/sim_speed.py [--repeats 3]

CPU time and wall time are both printed: on a shared machine only the former is the program's.
"""

from __future__ import annotations

import argparse
import time

import cv2

from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print("| mode | trial | frames | frames/s (CPU) | frames/s (wall) |\n|---|---|---|---|---|")
    for mode in ("markers", "images"):
        for seed in range(arguments.repeats):
            stream = SimulatedStream(make_spec(mode=mode, seed=seed))
            cpu, wall = time.process_time(), time.perf_counter()
            frames = sum(1 for _ in stream.frames())
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            print(
                f"| {mode} | {stream.spec.name}, seed {seed} | {frames} | {frames / cpu:.0f} | {frames / wall:.0f} |"
            )


if __name__ == "__main__":
    main()
