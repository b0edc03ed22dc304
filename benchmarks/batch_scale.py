"""Memory of a batch over thousands of trials: of this process and of its workers, trial by trial.

    python benchmarks/batch_scale.py [--trials 5000] [--distinct 12] [--workers 2] [--method full]

Simulates a few distinct marker-level trials of 60 frames (the rig would take ten times as long for all as
reconstructing them does) and links them under as many names as asked for, each a recording of its own to the batch.
The resident memory of every process is read after each trial; printed is the median over the trials around a tenth of
the run and over its last tenth, so that a leak of any size that matters shows as their difference.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from tiptrace.batch import BatchSettings, run_batch
from tiptrace.batch_plan import NamedPath
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.writer import write_recording

FRAMES = 60
_SETTINGS = {"mode": "markers", "fps": 25.0, "anchoring_s": 1.4, "travel_m": 0.011}


def simulate(folder: Path, distinct: int) -> list[Path]:
    """Distinct short trials, seeds from 1."""
    paths = []
    for seed in range(1, distinct + 1):
        stream = SimulatedStream(make_spec(seed=seed, trajectory=f"T{seed % 5 + 1}", **_SETTINGS))
        paths.append(folder / f"distinct-{seed}.mcap")
        write_recording(paths[-1], stream, trial=stream.trial_metadata)
    return paths


def resident_mb(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return float(line.split()[1]) / 1024
    return float("nan")


def workers_of(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task")
    children = [int(c) for task in tasks.iterdir() for c in (task / "children").read_text().split()]
    return [c for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]


def run(
    paths: list[Path], folder: Path, trials: int, workers: int, method: str
) -> tuple[np.ndarray, float, int]:
    """(n, 2) MB of this process and of the largest worker after each trial; seconds; frames."""
    named = []
    (folder / "recordings").mkdir()
    for k in range(trials):
        link = folder / "recordings" / f"trial-{k:05d}.mcap"
        os.link(paths[k % len(paths)], link)
        named.append(NamedPath(link.stem, link))
    seen: list[tuple[float, float]] = []

    def sample(_: str) -> None:
        own = os.getpid()
        seen.append((resident_mb(own), max((resident_mb(w) for w in workers_of(own)), default=float("nan"))))

        if len(seen) % max(1, trials // 10) == 0:
            own_mb, worker_mb = seen[-1]
            print(
                f"  trial {len(seen)}: {own_mb:.1f} MB here, {worker_mb:.1f} MB in the largest worker",
                flush=True,
            )

    start = time.perf_counter()
    result = run_batch(named, BatchSettings(method), folder / "out", workers=workers, on_done=sample)
    elapsed_s = time.perf_counter() - start
    if result.failures:
        raise SystemExit("; ".join(f"{name}: {reason}" for name, reason in result.failures[:5]))
    frames = sum(r.metrics.frames for r in result.records if r.metrics is not None)
    return np.array(seen), elapsed_s, frames


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=5000)
    parser.add_argument("--distinct", type=int, default=12)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--method", default="full")
    args = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="scale-"))
    try:
        start = time.perf_counter()
        paths = simulate(folder, args.distinct)
        print(f"{args.distinct} distinct trials simulated in {time.perf_counter() - start:.0f} s", flush=True)
        seen, elapsed_s, frames = run(paths, folder, args.trials, args.workers, args.method)
    finally:
        shutil.rmtree(folder)
    n = len(seen)
    print(f"{n} trials, {frames} frames, {args.workers} worker(s), method {args.method}: {elapsed_s:.0f} s")
    tenth = max(1, n // 10)
    early, late = seen[tenth - tenth // 2 : tenth + tenth // 2 + 1], seen[-tenth:]
    for name, column in (("this process", 0), ("largest worker", 1)):
        a, b = np.nanmedian(early[:, column]), np.nanmedian(late[:, column])
        print(
            f"  {name}: {a:.1f} MB around trial {tenth}, {b:.1f} MB at the end: {b - a:+.1f} MB, "
            f"{1024 * (b - a) / max(1, n - tenth):+.2f} kB per trial"
        )


if __name__ == "__main__":
    main()
