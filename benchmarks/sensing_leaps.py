"""Patches that leap between two frames, as after a pause: how many the tracker takes for others, mends, tells.

    python benchmarks/sensing_leaps.py

A painted gel of 7 × 10 dots; a band or disc of it moves by 8 to 16 px in five frames, leaps to the other side of its
place of rest in one, and stays there for 85.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.perception.gel_images import H, W, grid, paint_dots, shade, to_uint8

from tiptrace.perception.markers import detect_markers
from tiptrace.perception.registration import RegisteredTracker

LEAPS_PX = ((-14, 14), (-12, 13), (-8, 16), (-15, 9), (-16, 16))
SIZES_PX = (45, 60, 75, 90)
DIAMETER_PX, ANOTHERS_PX = 10.5, 8.0


def swapped(share: np.ndarray, start_px: float, end_px: float) -> tuple[list[int], list[bool]]:
    """Markers on another's dot in every frame, and whether the tracker doubts; share (n,) of each dot's motion."""
    rest = grid()
    first = to_uint8(paint_dots(shade(), rest, DIAMETER_PX), 1.5)
    tracker = RegisteredTracker(first, detect_markers(first))
    order = np.linalg.norm(rest[:, None] - tracker.start_px[None], axis=2).argmin(axis=1)
    counts, doubts = [], []
    for t, x in enumerate(
        [*np.linspace(0, start_px, 6), end_px, *(end_px + 0.5 * np.sin(np.arange(85) / 5))]
    ):
        uv = rest + x * share[:, None] * [1.0, 0.0]
        found, tracked = tracker.update(to_uint8(paint_dots(shade(), uv, DIAMETER_PX), 1.5, t))
        off = np.linalg.norm(found[order] - uv, axis=1)[tracked[order]]
        counts.append(int((off > ANOTHERS_PX).sum()))
        doubts.append(tracker.doubtful)
    return counts, doubts


def main() -> None:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    rest = grid()
    distance = {"band": np.abs(rest[:, 1] - H / 2), "disc": np.linalg.norm(rest - [W / 2, H / 2], axis=1)}
    for name, d in distance.items():
        runs = [swapped(np.exp(-((d / size) ** 4)), *leap_px) for size in SIZES_PX for leap_px in LEAPS_PX]
        wrong = [run for run, _ in runs if run[6]]
        unsaid = [sum(1 for w, d in zip(*run, strict=True) if w and not d) for run in runs]
        doubted = [sum(doubts) for counts, doubts in runs if not any(counts)]
        print(
            f"{name}: {len(runs)} leaps, {len(wrong)} taken wrongly, {sum(run[-1] == 0 for run in wrong)} of these "
            f"mended within {len(runs[0][0]) - 7} frames; swapped at the end, worst: "
            f"{max(run[-1] for run, _ in runs)} markers; wrong and not said: {sum(map(bool, unsaid))} leaps, "
            f"{max(unsaid)} frames at most; right and doubted: {sum(map(bool, doubted))} leaps"
        )


if __name__ == "__main__":
    main()
