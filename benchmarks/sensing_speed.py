"""How long the sensing chain takes, step by step and as a stereo loop, beside the reference SDK's way of doing it.

    OMP_NUM_THREADS=1 python benchmarks/sensing_speed.py trial.mcap [--pairs 300] [--endless 20000]

The recording comes from ``tiptrace simulate --out trial.mcap``. Loop and reference path take turns within the run, so
that a busy machine slows both. The reference path is a plain reimplementation of that SDK's steps: a dense
5-64-64-64-2 network in double precision, ``scipy.griddata`` under the dots, a double-precision cosine transform,
Lucas–Kanade. One thread per finger.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import scipy.fft
from scipy.interpolate import griddata

from tiptrace.perception.depth import untouched_gel
from tiptrace.perception.dot_fill import DotFill
from tiptrace.perception.fill import nearest_fill, smooth_fill
from tiptrace.perception.full_depth import FullDepth
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.perception.lifting import sample_map
from tiptrace.perception.markers import detect_markers
from tiptrace.perception.poisson import PoissonSolver
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.seeding import seed
from tiptrace.perception.tracking import LucasKanadeTracker
from tiptrace.streams.recording import Recording
from tiptrace.streams.synchronise import synchronise
from tiptrace.tracer import make_tracer
from tiptrace.types import SIDES, ImageSample, Observation

S = 62.5e-6
GEL = "gelsight-mini-virtual"


def rss_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def milliseconds(call: Callable[[], object], repeats: int = 40) -> tuple[float, float]:
    """Median and 99th percentile."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times)), float(np.percentile(times, 99))


class ReferencePath:
    """The reference SDK's steps for one finger."""

    def __init__(self, first: np.ndarray) -> None:
        rng = np.random.default_rng(0)
        sizes = (5, 64, 64, 64, 2)
        self.layers = [(rng.normal(0, np.sqrt(2 / a), (a, b)), np.zeros(b)) for a, b in pairwise(sizes)]
        self.tracker = LucasKanadeTracker(first, detect_markers(first).uv_px)
        H, W = first.shape[:2]
        self.v, self.u = np.mgrid[:H, :W]
        k_v, k_u = np.mgrid[:H, :W]
        self.weight = 4 * (np.sin(0.5 * np.pi * k_u / W) ** 2 + np.sin(0.5 * np.pi * k_v / H) ** 2)
        self.weight[0, 0] = np.inf

    def __call__(self, image: np.ndarray) -> np.ndarray:
        uv, _ = self.tracker.update(image)
        H, W = image.shape[:2]
        masked = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) <= 50
        x = np.column_stack([image.reshape(-1, 3) / 255.0, self.v.ravel() / H, self.u.ravel() / W])
        for i, (A, b) in enumerate(self.layers):
            x = x @ A + b
            if i < len(self.layers) - 1:
                x = np.maximum(x, 0)
        n = np.clip(0.1 * x.reshape(H, W, 2), -0.5, 0.5)
        slopes = -n / np.sqrt(1 - np.sum(n * n, axis=2, keepdims=True))
        known = np.column_stack([self.v[~masked], self.u[~masked]])
        for c in (0, 1):
            values = griddata(
                known, slopes[..., c][~masked], (self.v[masked], self.u[masked]), method="nearest"
            )
            slopes[..., c][masked] = values
        f = np.zeros((H, W))
        f[:, 1:] -= slopes[:, :-1, 0]
        f[:, :-1] += slopes[:, :-1, 0]
        f[1:] -= slopes[:-1, :, 1]
        f[:-1] += slopes[:-1, :, 1]
        depth = scipy.fft.idctn(-scipy.fft.dctn(f, norm="ortho") / self.weight, norm="ortho")
        return sample_map(depth.astype(np.float32), uv)


def images(observations: list[Observation]) -> list[dict[str, np.ndarray]]:
    out = []
    for o in observations:
        samples = {side: o.finger(side).sample for side in SIDES}
        out.append({side: s.image for side, s in samples.items() if isinstance(s, ImageSample)})
    return out


def steps(frames: list[np.ndarray], reference: np.ndarray) -> None:
    """Times of each step for one 320 × 240 image."""
    gel = load_gel_model(GEL)
    seeds = seed(frames[0], reference)
    tracker, plain = (
        RegisteredTracker(frames[0], seeds.markers),
        LucasKanadeTracker(frames[0], seeds.markers.uv_px),
    )
    chain = FullDepth(gel, reference, (S, S))
    chain.expect_dots(tracker.mask_radius_px)
    turn = iter(range(10**9))

    def next_image() -> np.ndarray:
        return frames[next(turn) % len(frames)]

    uv = tracker.start_px
    H, W = reference.shape[:2]
    full_mask, mask = tracker.mask(uv, (H, W)), tracker.mask(uv, chain.shape, 2)
    rng = np.random.default_rng(0)
    maps = {s: rng.normal(0, 0.1, (H // s, W // s, 2)).astype(np.float32) for s in (1, 2)}
    colours = rng.normal(0, 0.1, (H * W, 3)).astype(np.float32)
    place = rng.uniform(0, 1, (H * W, 2)).astype(np.float32)
    solvers = {s: PoissonSolver((H // s, W // s), (S * s, S * s)) for s in (1, 2)}
    fill = DotFill(chain.shape, (tracker.mask_radius_px + 1.5) / 2)
    rows: list[tuple[str, Callable[[], object]]] = [
        ("jpeg decode", lambda: cv2.imdecode(jpeg, cv2.IMREAD_COLOR)),
        ("detection (first image only)", lambda: detect_markers(frames[0])),
        ("Lucas–Kanade (paper)", lambda: plain.update(next_image())),
        ("tracking without drift (full)", lambda: tracker.update(next_image())),
        ("network, full resolution", lambda: gel.slopes(colours, place)),
        ("network, half resolution", lambda: gel.slopes(colours[: H * W // 4], place[: H * W // 4])),
        ("fill: nearest, full resolution", lambda: nearest_fill(maps[1], full_mask)),
        ("fill: smooth, half resolution", lambda: smooth_fill(maps[2], mask)),
        ("fill: along edges, half resolution", lambda: fill.apply(maps[2].copy(), uv / 2)),
        ("Poisson, full resolution", lambda: solvers[1].integrate(maps[1][..., 0], maps[1][..., 1])),
        ("Poisson, half resolution", lambda: solvers[2].integrate(maps[2][..., 0], maps[2][..., 1])),
        ("untouched gel, half resolution", lambda: untouched_gel(maps[2][..., 0] * 1e-3, maps[2])),
        ("whole depth chain, full method", lambda: chain(next_image(), mask, uv)),
    ]
    jpeg = cv2.imencode(".jpg", frames[0], [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    print(f"\n{'one 320×240 image, ' + str(len(uv)) + ' markers':<44} {'p50 ms':>8} {'p99':>8}")
    for name, call in rows:
        p50, p99 = milliseconds(call)
        print(f"{name:<44} {p50:>8.2f} {p99:>8.2f}")


def loop(recording: Recording, observations: list[Observation], method: str, every_reference: int) -> None:
    """The stereo loop, with the reference path in between."""
    pictures = images(observations)
    jpegs = [
        {s: cv2.imencode(".jpg", im[s], [cv2.IMWRITE_JPEG_QUALITY, 95])[1] for s in SIDES}
        for im in pictures[:20]
    ]
    theirs = {side: ReferencePath(pictures[0][side]) for side in SIDES}
    ours, decode, reference = [], [], []
    with ThreadPoolExecutor(2) as pool:
        tracer = make_tracer(recording, method, pool.map)
        for k, o in enumerate(observations):
            start = time.perf_counter()
            tracer.update(o)
            ours.append(1e3 * (time.perf_counter() - start))
            start = time.perf_counter()
            list(pool.map(lambda s, k=k: cv2.imdecode(jpegs[k % len(jpegs)][s], cv2.IMREAD_COLOR), SIDES))
            decode.append(1e3 * (time.perf_counter() - start))
            if k % every_reference == every_reference - 1:
                start = time.perf_counter()
                list(pool.map(lambda s, k=k: theirs[s](pictures[k][s]), SIDES))
                reference.append(1e3 * (time.perf_counter() - start))
    ours, decode = np.array(ours[5:]), np.array(decode[5:])
    print(f"\nstereo loop, method {method}, {len(ours)} pairs: images in, tip estimate out")
    for name, ms in (
        ("decoded images", ours),
        ("with jpeg decoding", ours + decode),
        ("reference path", np.array(reference)),
    ):
        p50, p99 = np.percentile(ms, (50, 99))
        print(f"  {name:<22} p50 {p50:7.2f} ms = {1e3 / p50:6.1f} pairs/s   p99 {p99:7.2f} ms")
    print(f"  reference path / loop: {np.median(reference) / np.median(ours):.1f} ×")
    print(f"  peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def resolution(frames: list[np.ndarray], reference: np.ndarray) -> None:
    """Marker depths at half resolution and single precision against full resolution and double."""
    gel = load_gel_model(GEL)
    tracker = RegisteredTracker(frames[0], seed(frames[0], reference).markers)
    chains = {step: FullDepth(gel, reference, (S, S), step) for step in (1, 2)}
    for chain in chains.values():
        chain.expect_dots(tracker.mask_radius_px)
    differences = []
    for k, frame in enumerate(frames[:30]):
        uv = tracker.start_px if k == 0 else tracker.update(frame)[0]
        at = tracker.expected_px
        depth = {s: c.at(c(frame, tracker.mask(at, c.shape, s), at), uv) for s, c in chains.items()}
        differences.append(depth[2] - depth[1])
    d = np.array(differences)
    p = np.random.default_rng(0).normal(0, 0.2, (2, *reference.shape[:2]))
    single = PoissonSolver(reference.shape[:2], (S, S)).integrate(*p.astype(np.float32))
    print(
        f"\nhalf against full resolution, same fill: marker depths differ by {rms_um(d):.1f} µm rms "
        f"({rms_um(d - np.nanmean(d, axis=1, keepdims=True)):.1f} within a frame); "
        f"single against double precision: {1e6 * np.abs(single - integrate_double(*p)).max():.4f} µm at most"
    )


def rms_um(x: np.ndarray) -> float:
    return 1e6 * float(np.sqrt(np.nanmean(x**2)))


def integrate_double(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The same least squares in double precision."""

    def means(x: np.ndarray) -> np.ndarray:
        m = 0.5 * (x[1:] + x[:-1])
        m[1:-1] += (x[1:-2] + x[2:-1] - x[:-3] - x[3:]) / 24
        return m

    H, W = p.shape
    f = np.zeros((H, W))
    a, b = means(p.T).T / S, means(q) / S
    f[:, :-1] += a
    f[:, 1:] -= a
    f[:-1] += b
    f[1:] -= b
    k = (
        (2 * np.cos(np.pi * np.arange(W) / W) - 2)[None] + (2 * np.cos(np.pi * np.arange(H) / H) - 2)[:, None]
    ) / S**2
    k[0, 0] = np.inf
    return scipy.fft.idctn(scipy.fft.dctn(f, norm="ortho") / k, norm="ortho")


def growth(reference: np.ndarray, frame: np.ndarray) -> None:
    """Time of the depth chain with image size, of tracking with the number of markers."""
    gel = load_gel_model(GEL)
    print(f"\n{'growth':<44} {'p50 ms':>8} {'p99':>8}")
    for scale in (0.5, 1, 2):
        size = (int(320 * scale), int(240 * scale))
        ref, now = (cv2.resize(im, size, interpolation=cv2.INTER_AREA) for im in (reference, frame))
        chain = FullDepth(gel, ref, (S / scale, S / scale))
        none, mask = np.zeros((0, 2)), np.zeros(chain.shape, bool)
        p50, p99 = milliseconds(lambda c=chain, n=now, m=mask, uv=none: c(n, m, uv), 20)
        print(f"{'depth chain, ' + f'{size[0]}×{size[1]} px':<44} {p50:>8.2f} {p99:>8.2f}")
    seeds = seed(frame, reference)
    for share in (0.25, 0.5, 1.0):
        keep = slice(0, int(len(seeds.markers) * share))
        some = type(seeds.markers)(seeds.markers.uv_px[keep], seeds.markers.diameter_px[keep])
        tracker = RegisteredTracker(frame, some)
        p50, p99 = milliseconds(lambda t=tracker: t.update(frame), 20)
        print(f"{'tracking, ' + f'{len(some)} markers':<44} {p50:>8.2f} {p99:>8.2f}")


def endless(recording: Recording, observations: list[Observation], method: str, count: int) -> None:
    """Memory over many frames."""
    tracer = make_tracer(recording, method)
    marks = {count // 20: 0.0, count - 1: 0.0}
    there_and_back = [*range(len(observations)), *range(len(observations) - 2, 0, -1)]
    for k in range(count):
        tracer.sensing(observations[there_and_back[k % len(there_and_back)]])
        if k in marks:
            marks[k] = rss_mb()
    first, last = marks.values()
    print(f"\nmemory over {count} pairs: {first:.0f} MB after {count // 20}, {last:.0f} MB at the end")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--method", default="full")
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--reference-every", type=int, default=20)
    parser.add_argument(
        "--endless", type=int, default=0, help="pairs to run for memory growth; 20000 takes minutes"
    )
    args = parser.parse_args()
    cv2.setNumThreads(1)
    recording = Recording(args.recording)
    observations = []
    for o in synchronise(recording):
        observations.append(o)
        if len(observations) == args.pairs:
            break
    left, reference = [im["left"] for im in images(observations)], recording.references["left"]
    load = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} CPUs"
    print(f"{args.recording.name}: {len(observations)} pairs; {load}")
    steps(left, reference)
    loop(recording, observations, args.method, args.reference_every)
    resolution(left, reference)
    growth(reference, left[0])
    if args.endless:
        endless(recording, observations, args.method, args.endless)


if __name__ == "__main__":
    main()
