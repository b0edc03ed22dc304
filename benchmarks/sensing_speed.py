"""How long the sensing chain takes, step by step and as a stereo loop, beside the reference SDK's way of doing it.

    OMP_NUM_THREADS=1 python benchmarks/sensing_speed.py trial.mcap [--part loop] [--depth none] [--pairs 300]

Parts: ``steps``, ``loop``, ``resolution``, ``growth`` and, only when asked for, ``endless`` (memory over 20 000 pairs).
The recording comes from ``tiptrace simulate --out trial.mcap``. Loop and reference path take turns within the run, so
that a busy machine slows both; the reference path has a process of its own, so that its memory is not counted. It is
a plain reimplementation of that SDK's steps: a dense 5-64-64-64-2 network in double precision, ``scipy.griddata``
under the dots, a double-precision cosine transform, Lucas–Kanade. One thread per finger, in both.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice, pairwise
from multiprocessing.connection import Connection
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
from tiptrace.perception.settings import SensingConfig
from tiptrace.perception.tracking import LucasKanadeTracker
from tiptrace.streams.recording import Recording
from tiptrace.streams.synchronise import synchronise
from tiptrace.tracer import Map, Sensing, TipTracer, make_estimator, sensing_of
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


def images(observation: Observation) -> dict[str, np.ndarray]:
    samples = {side: observation.finger(side).sample for side in SIDES}
    return {side: s.image for side, s in samples.items() if isinstance(s, ImageSample)}


def with_images(observation: Observation, pictures: list[np.ndarray]) -> Observation:
    left, right = (
        replace(f, sample=replace(f.sample, image=im))
        for f, im in zip((observation.left, observation.right), pictures, strict=True)
    )
    return replace(observation, left=left, right=right)


def tracer_of(recording: Recording, method: str, depth: str, both: Map = map) -> TipTracer:
    config = SensingConfig(method=sensing_of(method), depth=depth)
    return TipTracer(Sensing(recording, config, both), make_estimator(method, recording))


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
    fill = DotFill((tracker.mask_radius_px + 1.5) / 2)
    planes = np.ascontiguousarray(np.moveaxis(maps[2], -1, 0))
    rows: list[tuple[str, Callable[[], object]]] = [
        ("jpeg decode", lambda: cv2.imdecode(jpeg, cv2.IMREAD_COLOR)),
        ("detection (first image only)", lambda: detect_markers(frames[0])),
        ("Lucas–Kanade (paper)", lambda: plain.update(next_image())),
        ("tracking without drift (full)", lambda: tracker.update(next_image())),
        ("network, full resolution", lambda: gel.slopes(colours, place)),
        ("network, half resolution", lambda: gel.slopes(colours[: H * W // 4], place[: H * W // 4])),
        ("fill: nearest, full resolution", lambda: nearest_fill(maps[1], full_mask)),
        ("fill: smooth, half resolution", lambda: smooth_fill(maps[2], mask)),
        ("fill: along edges, half resolution", lambda: fill.apply(planes.copy(), uv / 2)),
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


def serve_reference(first: dict[str, np.ndarray], line: Connection) -> None:
    """Child process: the reference path on pairs sent, answered with its time in ms."""
    cv2.setNumThreads(1)
    theirs = {side: ReferencePath(first[side]) for side in SIDES}
    with ThreadPoolExecutor(2) as pool:
        while (pair := line.recv()) is not None:
            start = time.perf_counter()
            list(pool.map(lambda s, pair=pair: theirs[s](pair[s]), SIDES))
            line.send(1e3 * (time.perf_counter() - start))


def loop(recording: Recording, pairs: int, method: str, depth: str, every_reference: int) -> None:
    """The stereo loop, with the reference path in between."""
    stream = islice(synchronise(recording), pairs)
    ours, decoded, reference = [], [], []
    line, theirs = multiprocessing.Pipe()
    with ThreadPoolExecutor(2) as pool:
        tracer = tracer_of(recording, method, depth, pool.map)
        cpu = 0.0
        for k, o in enumerate(stream):
            pictures = images(o)
            if k == 0:
                context = multiprocessing.get_context("spawn")
                child = context.Process(target=serve_reference, args=(pictures, theirs), daemon=True)
                child.start()
            jpegs = [cv2.imencode(".jpg", pictures[s], [cv2.IMWRITE_JPEG_QUALITY, 95])[1] for s in SIDES]
            start, cpu_start = time.perf_counter(), time.process_time()
            again = list(pool.map(lambda jpeg: cv2.imdecode(jpeg, cv2.IMREAD_COLOR), jpegs))
            middle = time.perf_counter()
            tracer.update(with_images(o, again))
            end = time.perf_counter()
            if k >= 5:
                ours.append(1e3 * (end - middle))
                decoded.append(1e3 * (end - start))
                cpu += time.process_time() - cpu_start
            if k % every_reference == every_reference - 1:
                line.send(pictures)
                reference.append(line.recv())
    line.send(None)
    print(f"\nstereo loop, method {method}, depth {depth}, {len(ours)} pairs: images in, tip estimate out")
    for name, ms in (
        ("decoded images", ours),
        ("with jpeg decoding", decoded),
        ("reference path", reference[1:]),
    ):
        p50, p99 = np.percentile(ms, (50, 99))
        print(f"  {name:<22} p50 {p50:7.2f} ms = {1e3 / p50:6.1f} pairs/s   p99 {p99:7.2f} ms")
    print(f"  reference path / loop: {np.median(reference[1:]) / np.median(ours):.1f} ×")
    print(f"  processor time with decoding {1e3 * cpu / len(ours):.1f} ms per pair")
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


def there_and_back(recording: Recording, length: int) -> Iterator[Observation]:
    """Pairs forwards and backwards for ever, as jpeg in memory."""
    kept = []
    for o in islice(synchronise(recording), length):
        pictures = images(o)
        jpegs = [cv2.imencode(".jpg", pictures[s], [cv2.IMWRITE_JPEG_QUALITY, 95])[1] for s in SIDES]
        kept.append((with_images(o, [np.zeros((1, 1, 3), np.uint8)] * 2), jpegs))
    while True:
        for o, jpegs in [*kept, *kept[-2:0:-1]]:
            yield with_images(o, [cv2.imdecode(jpeg, cv2.IMREAD_COLOR) for jpeg in jpegs])


def endless(recording: Recording, pairs: int, method: str, depth: str, count: int) -> None:
    """Memory of the sensing over many pairs, one thread per finger."""
    marks = {count // 20: 0.0, count // 2: 0.0, count - 1: 0.0}
    with ThreadPoolExecutor(2) as pool:
        tracer = tracer_of(recording, method, depth, pool.map)
        for k, o in enumerate(islice(there_and_back(recording, pairs), count)):
            tracer.sensing(o)
            if k in marks:
                marks[k] = rss_mb()
    told = ", ".join(f"{mb:.1f} MB after {k + 1}" for k, mb in marks.items())
    print(f"\nmemory over {count} pairs (the benchmark keeps {pairs} as jpeg): {told}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--method", default="full")
    parser.add_argument("--depth", default="network", choices=("network", "none"))
    parser.add_argument(
        "--part", action="append", choices=("steps", "loop", "resolution", "growth", "endless")
    )
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--reference-every", type=int, default=20)
    parser.add_argument("--count", type=int, default=20000, help="pairs of the endless part")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    parts = args.part or ["loop", "steps", "resolution", "growth"]
    recording = Recording(args.recording)
    load = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} CPUs"
    print(f"{args.recording.name}: {args.pairs} pairs; {load}")
    if "loop" in parts:
        loop(recording, args.pairs, args.method, args.depth, args.reference_every)
    left = [images(o)["left"] for o in islice(synchronise(recording), 40)]
    reference = recording.references["left"]
    if "steps" in parts:
        steps(left, reference)
    if "resolution" in parts:
        resolution(left, reference)
    if "growth" in parts:
        growth(reference, left[0])
    if "endless" in parts:
        endless(recording, args.pairs, args.method, args.depth, args.count)


if __name__ == "__main__":
    main()
