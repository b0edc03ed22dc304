"""Pairs per second of a batch with one worker and with two, interleaved.

    python benchmarks/batch_throughput.py RECORDINGS [--method full] [--workers 1 2] [--rounds 3]

Each round reconstructs all recordings once with each number of workers, in an order that turns round every time, so
that what else the machine does falls on all alike. The time of a run is that of the whole command's work: starting the
processes, decoding, reconstructing, writing. Give each worker several recordings, or its start and the wait for the
last one weigh too much. The load average before each run is printed: figures of a busy machine tell nothing about
scaling.
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
from tiptrace.batch_plan import NamedPath, find_recordings


def pairs_per_s(recordings: tuple[NamedPath, ...], method: str, workers: int) -> tuple[float, int]:
    """One run into an empty folder: pairs/s and pairs."""
    out = Path(tempfile.mkdtemp(prefix="batch-"))
    try:
        start = time.perf_counter()
        result = run_batch(recordings, BatchSettings(method), out, workers=workers)
        elapsed_s = time.perf_counter() - start
    finally:
        shutil.rmtree(out)
    if result.failures:
        raise SystemExit("; ".join(f"{name}: {reason}" for name, reason in result.failures))
    pairs = sum(r.metrics.frames for r in result.records if r.metrics is not None)
    return pairs / elapsed_s, pairs


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--method", default="full")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    recordings = find_recordings(args.recordings).recordings
    rates: dict[int, list[float]] = {n: [] for n in args.workers}
    for round_ in range(args.rounds):
        order = args.workers if round_ % 2 == 0 else args.workers[::-1]
        for workers in order:
            load = os.getloadavg()[0]
            rate, pairs = pairs_per_s(recordings, args.method, workers)
            rates[workers].append(rate)
            print(
                f"round {round_ + 1}, {workers} worker(s): {rate:6.1f} pairs/s ({pairs} pairs, load {load:.1f})",
                flush=True,
            )
    print(f"{len(recordings)} recordings, method {args.method}, {os.cpu_count()} cores")
    first = np.array(rates[args.workers[0]])
    for workers, values in rates.items():
        ratio = np.array(values) / first
        print(
            f"  {workers} worker(s): {np.mean(values):6.1f} pairs/s, {min(values):.1f} to {max(values):.1f}; "
            f"x {np.mean(ratio):.2f} of {args.workers[0]} worker(s), {ratio.min():.2f} to {ratio.max():.2f}"
        )


if __name__ == "__main__":
    main()
