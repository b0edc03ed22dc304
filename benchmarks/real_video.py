"""Tracking on a real marker gel against an independent tracker's csv and against each dot's own centroid.

    python benchmarks/real_video.py [--data ../shared/data] [--picture docs/images/real-video.png]

Displacements count since video frame 10. The csv's tracker lags off some dots; its samples that lie more than 1.5 px
from the dot's own displacement are left out of the second column.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from tiptrace.perception.markers import Markers, detect_markers
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.tracking import LucasKanadeTracker

FIRST, LAG_PX = 10, 1.5


def read(folder: Path) -> tuple[list[np.ndarray], np.ndarray]:
    capture = cv2.VideoCapture(str(folder / "mini_example.avi"))
    frames = []
    while (step := capture.read())[0]:
        frames.append(step[1])
    rows = np.loadtxt(folder / "vendor_meanshift_tracks.csv", delimiter=",").reshape(209, 70, 7)
    return frames, rows[:, :, 5:7]


def own_centroids(frames: list[np.ndarray], start: np.ndarray) -> np.ndarray:
    """Where each dot is by detection in its frame alone, (209, 70, 2)."""
    own, last = np.full((209, 70, 2), np.nan), start
    for k, frame in enumerate(frames[FIRST:]):
        found = detect_markers(frame).uv_px
        distance = np.linalg.norm(last[:, None] - found, axis=2)
        near = distance.min(axis=1) < 9.0
        own[k, near] = found[distance.argmin(axis=1)[near]]
        last = np.where(near[:, None], own[k], last)
    return own


def run(tracker, start, frames, indices, hide=None):
    uv, tracked, times = [start], [np.ones(70, bool)], []
    for i in indices:
        image = frames[i].copy()
        if hide is not None and hide[0] <= i < hide[0] + 5:
            image[hide[1] : hide[2], hide[3] : hide[4]] = 90
        begin = time.perf_counter()
        found, alive = tracker.update(image)
        times.append(1e3 * (time.perf_counter() - begin))
        uv.append(found)
        tracked.append(alive)
    return np.array(uv), np.array(tracked), np.median(times)


def swaps(uv, csv) -> int:
    offset, count = uv[0] - csv[0], 0
    for now, then in zip(uv, csv + offset, strict=True):
        seen = np.flatnonzero(np.isfinite(now[:, 0]))
        distance = np.linalg.norm(now[seen][:, None] - then, axis=2)
        count += int((distance.argmin(axis=1) != seen).sum())
    return count


def draw(path: Path, frame: np.ndarray, uv: np.ndarray, start: np.ndarray) -> None:
    zoom = 4
    picture = cv2.resize(frame, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    for a, b in zip(start, uv, strict=True):
        if not np.isfinite(b).all():
            continue
        p, q = (tuple(int(c) for c in ((x + 0.5) * zoom - 0.5) * 16) for x in (a, b))
        cv2.line(picture, p, q, (255, 255, 255), 2, cv2.LINE_AA, 4)
        cv2.circle(picture, q, 6 * 16, (0, 159, 230), 2, cv2.LINE_AA, 4)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture)


HEADS = ("mean px", "p95", "all: mean", "p95", "own rms", "p95", "alive", "swaps", "ms")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data")
    parser.add_argument("--picture", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)  # as in the loop: one thread per sensor
    frames, csv = read(args.data / "gelsight_mini_marker_video")
    found = detect_markers(frames[FIRST])
    order = np.linalg.norm(found.uv_px[:, None] - csv[0], axis=2).argmin(axis=0)
    markers = Markers(found.uv_px[order], found.diameter_px[order])
    own = own_centroids(frames, markers.uv_px)
    moved, own_moved = csv - csv[0], own - own[0]
    lags = np.linalg.norm(moved - own_moved, axis=2) > LAG_PX
    print(f"{len(markers)} markers; {int(lags.sum())} of {lags.size} csv samples lag")
    print(" " * 25 + " ".join(f"{name:>9}" for name in HEADS))
    every = range(FIRST + 1, 219)

    def row(label, tracker, start, indices=every, hide=None):
        uv, tracked, ms = run(tracker, start, frames, indices, hide)
        at = [0, *(i - FIRST for i in indices)]
        error = np.linalg.norm((uv - uv[0]) - moved[at], axis=2)
        own_error = np.linalg.norm((uv - uv[0]) - own_moved[at], axis=2)
        good = tracked & ~lags[at]
        values = (
            f"{error[good].mean():.3f}",
            f"{np.percentile(error[good], 95):.3f}",
            f"{error[tracked].mean():.3f}",
            f"{np.percentile(error[tracked], 95):.3f}",
            f"{np.sqrt(np.nanmean(own_error[good] ** 2)):.3f}",
            f"{np.nanpercentile(own_error[good], 95):.3f}",
            f"{int(tracked[-1].sum())}",
            f"{swaps(uv, csv[at])}",
            f"{ms:.1f}",
        )
        print(f"{label:<24} " + " ".join(f"{value:>9}" for value in values))
        return uv

    def registered():
        return RegisteredTracker(frames[FIRST], markers)

    row("paper", LucasKanadeTracker(frames[FIRST], markers.uv_px), markers.uv_px)
    uv = row("full", registered(), registered().start_px)
    for step in (2, 3):
        row(f"full, every {step}. frame", registered(), registered().start_px, range(FIRST + step, 219, step))
    for hide in ((100, 60, 160, 80, 200), (170, 0, 240, 0, 160)):
        row(f"full, hidden at {hide[0]}–{hide[0] + 4}", registered(), registered().start_px, every, hide)
    if args.picture:
        draw(args.picture, frames[204], uv[204 - FIRST], uv[0])


if __name__ == "__main__":
    main()
