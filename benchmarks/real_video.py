"""Tracking on a real marker gel against an independent tracker's csv and against each dot's own centroid.

    python benchmarks/real_video.py [--data ../shared/data] [--picture docs/images/sensing_real_video.png]

Displacements count since video frame 10. Two truths, neither of which knows the tracker under test:

- the csv. Its tracker lags off some dots: samples more than 1.5 px from the dot's own displacement are left out
  of the first pair of columns and kept in the second.
- each dot's own centroid in the frame alone, computed here (``own_centroids``): a plane through the gel on a ring
  around the dot, then ink weights cut at half contrast. No package code takes part. It starts from the csv's position.

Rows: the paper's tracker, the full one, frames dropped, and occlusions of five frames painted in (grey, dark, bright,
noisy) at twelve places and times. A swap is a marker nearer to another marker's csv track than to its own.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tiptrace.perception.markers import Markers, detect_markers
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.tracking import LucasKanadeTracker, MarkerTracker

FIRST, LAST, LAG_PX = 10, 219, 1.5
DOT_PX, DISC_PX, RING_PX = 5.5, 8.0, (8.0, 11.0)  # around a dot of 10.5 px, 31 px from the next
Edit = Callable[[int, np.ndarray], np.ndarray]


def read(folder: Path) -> tuple[list[np.ndarray], np.ndarray]:
    """All frames, and the csv's tracks (209, 70, 2) px from video frame 10 on."""
    capture = cv2.VideoCapture(str(folder / "mini_example.avi"))
    frames = []
    while (step := capture.read())[0]:
        frames.append(step[1])
    rows = np.loadtxt(folder / "vendor_meanshift_tracks.csv", delimiter=",").reshape(209, 70, 7)
    return frames, rows[:, :, 5:7]


def own_centroid(grey: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Centroid of one dot, px; NaN where the border cuts the dot or there is none."""
    H, W = grey.shape
    centre = place
    for _ in range(4):
        u0, v0 = np.maximum(np.round(centre).astype(int) - 12, 0)
        u1, v1 = np.minimum(np.round(centre).astype(int) + 13, (W, H))
        if (centre < DOT_PX).any() or (centre > np.array([W, H]) - 1 - DOT_PX).any():
            return np.full(2, np.nan)
        window = grey[v0:v1, u0:u1].astype(float)
        dv, du = np.mgrid[v0:v1, u0:u1].astype(float)
        du, dv = du - centre[0], dv - centre[1]
        rho = np.hypot(du, dv)
        ring = (rho > RING_PX[0]) & (rho < RING_PX[1])
        plane = np.linalg.lstsq(np.c_[np.ones(ring.sum()), du[ring], dv[ring]], window[ring], rcond=None)[0]
        contrast = 1.0 - window / np.maximum(plane[0] + plane[1] * du + plane[2] * dv, 1.0)
        ink = np.median(contrast[rho < 2.5])
        if ink < 0.2:
            return np.full(2, np.nan)
        weight = np.clip(contrast / ink * 2.0 - 0.5, 0.0, 1.0) * (rho < DISC_PX)
        step = np.array([(weight * du).sum(), (weight * dv).sum()]) / weight.sum()
        centre = centre + step
        if np.hypot(*step) < 0.01:
            break
    return centre if np.hypot(*(centre - place)) < 9.0 else np.full(2, np.nan)


def own_centroids(frames: Sequence[np.ndarray], csv: np.ndarray) -> np.ndarray:
    """(209, 70, 2) px, NaN where a dot cannot be measured; each frame for itself, from the csv's position on."""
    greys = [cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in frames[FIRST:]]
    return np.array([[own_centroid(g, p) for p in places] for g, places in zip(greys, csv, strict=True)])


@dataclass(frozen=True)
class Run:
    """Positions (f, 70, 2), tracked (f, 70), frames of the csv that they belong to, and ms per frame."""

    uv: np.ndarray
    tracked: np.ndarray
    at: np.ndarray
    ms: float


def run(
    tracker: MarkerTracker,
    start: np.ndarray,
    frames: Sequence[np.ndarray],
    every: int = 1,
    edit: Edit | None = None,
) -> Run:
    uv, tracked, times = [start], [np.ones(len(start), bool)], []
    indices = range(FIRST + every, LAST, every)
    for i in indices:
        image = frames[i] if edit is None else edit(i, frames[i].copy())
        begin = time.perf_counter()
        found, alive = tracker.update(image)
        times.append(1e3 * (time.perf_counter() - begin))
        uv.append(found)
        tracked.append(alive)
    at = np.array([0, *(i - FIRST for i in indices)])
    return Run(np.array(uv), np.array(tracked), at, float(np.median(times)))


def swaps(result: Run, csv: np.ndarray) -> int:
    """Samples that lie nearer to another marker's track than to their own."""
    offset, count = result.uv[0] - csv[0], 0
    for now, then in zip(result.uv, csv[result.at] + offset, strict=True):
        seen = np.flatnonzero(np.isfinite(now[:, 0]))
        distance = np.linalg.norm(now[seen][:, None] - then, axis=2)
        count += int((distance.argmin(axis=1) != seen).sum())
    return count


def occlusions() -> list[tuple[int, Edit]]:
    """Twelve occlusions of five frames: first frame, and what paints it."""
    rng = np.random.default_rng(0)
    fills = ("grey", "dark", "bright", "noise")
    result = []
    for k in range(12):
        first, (u, v) = int(rng.integers(60, 205)), rng.integers(0, (200, 140))
        w, h = rng.integers(60, 140, 2)

        def paint(
            i: int, image: np.ndarray, first=first, u=u, v=v, w=w, h=h, fill=fills[k % 4]
        ) -> np.ndarray:
            if first <= i < first + 5:
                part = image[v : v + h, u : u + w]
                level = {"grey": 90, "dark": 25, "bright": 230}.get(fill)
                noise = np.random.default_rng(i).integers(0, 255, part.shape)
                part[:] = noise if level is None else level
            return image

        result.append((first, paint))
    return result


def draw(path: Path, frames: Sequence[np.ndarray], result: Run) -> None:
    """Paths of all markers over the whole video on one of its frames, and two coordinates over time."""
    from small_png import save_small

    from tiptrace.evaluation import style

    shown = 196 - FIRST  # where dots are furthest from their start
    with style.figure_style():
        figure = style.new_figure(9.0, 4.0)
        left, right = figure.subplots(1, 2, width_ratios=(1.6, 1.0))
        left.imshow(frames[FIRST + shown][..., ::-1])
        left.plot(result.uv[..., 0], result.uv[..., 1], color="white", linewidth=0.6)
        left.plot(*result.uv[0].T, ".", color="black", markersize=3, label="start (frame 10)")
        left.plot(
            *result.uv[shown].T, "o", color=style.ORANGE, markersize=8, fillstyle="none", label="frame 196"
        )
        left.grid(False)
        left.set(
            title="70 tracks over 209 frames", xlabel="u [px]", ylabel="v [px]", xlim=(0, 319), ylim=(239, 0)
        )
        left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, frameon=True)
        moved = np.linalg.norm(result.uv - result.uv[0], axis=2)
        frame = FIRST + result.at
        right.fill_between(
            frame, np.nanmin(moved, axis=1), np.nanmax(moved, axis=1), color=style.SKY, alpha=0.5
        )
        right.plot(frame, np.nanmedian(moved, axis=1), color=style.BLUE, label="median; band: all 70")
        right.set(title="Displacement since frame 10", xlabel="video frame", ylabel="[px]")
        right.legend(loc="upper left")
        save_small(figure, path, dpi=95)


HEADS = ("mean px", "p95", "all: mean", "p95", "own rms", "p95", "seen %", "alive", "swaps", "ms")


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
    own = own_centroids(frames, csv)
    moved, own_moved = csv - csv[0], own - own[0]
    lags = np.linalg.norm(moved - own_moved, axis=2) > LAG_PX
    print(f"{len(markers)} markers; {int(lags.sum())} of {lags.size} csv samples lag; ", end="")
    print(f"own centroid measured in {np.isfinite(own[..., 0]).mean():.1%}")
    print(" " * 25 + " ".join(f"{name:>9}" for name in HEADS))

    def row(label: str, result: Run) -> Run:
        error = np.linalg.norm((result.uv - result.uv[0]) - moved[result.at], axis=2)
        own_error = np.linalg.norm((result.uv - result.uv[0]) - own_moved[result.at], axis=2)
        good = result.tracked & ~lags[result.at]
        values = (
            f"{error[good].mean():.3f}",
            f"{np.percentile(error[good], 95):.3f}",
            f"{error[result.tracked].mean():.3f}",
            f"{np.percentile(error[result.tracked], 95):.3f}",
            f"{np.sqrt(np.nanmean(own_error[result.tracked] ** 2)):.3f}",
            f"{np.nanpercentile(own_error[result.tracked], 95):.3f}",
            f"{100 * result.tracked.mean():.2f}",
            f"{int(result.tracked[-1].sum())}",
            f"{swaps(result, csv)}",
            f"{result.ms:.1f}",
        )
        print(f"{label:<24} " + " ".join(f"{value:>9}" for value in values), flush=True)
        return result

    def full(every: int = 1, edit: Edit | None = None) -> Run:
        tracker = RegisteredTracker(frames[FIRST], markers)
        return run(tracker, tracker.start_px, frames, every, edit)

    row("paper", run(LucasKanadeTracker(frames[FIRST], markers.uv_px), markers.uv_px, frames))
    whole = row("full", full())
    for step in (2, 3):
        row(f"full, every {step}. frame", full(step))
    hidden = [(first, full(1, paint)) for first, paint in occlusions()]
    alive = [int(result.tracked[-1].sum()) for _, result in hidden]
    missed = [(~r.tracked[f - FIRST : f - FIRST + 5]).any(axis=0).sum() for f, r in hidden]
    print(
        f"{len(hidden)} occlusions of 5 frames, hiding {min(missed)} to {max(missed)} dots: "
        f"{sum(swaps(r, csv) for _, r in hidden)} swaps, at least {min(alive)} alive at the end"
    )
    if args.picture:
        draw(args.picture, frames, whole)


if __name__ == "__main__":
    main()
