"""Whole-loop rate of a method on a recording, jpeg decoding included.

    python benchmarks/loop_rate.py trial.mcap [--method paper] [--runs 5]

Prints the rate as the paper reports it (mean ± std over trials, here over runs; slowest and fastest pair) and the
median time of each step. One thread per finger; set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tiptrace.evaluation.metrics import loop_rate
from tiptrace.pipeline import STEPS, Step, open_tracer, trace
from tiptrace.streams.recording import Recording


class Times:
    def __init__(self) -> None:
        self.ms: list[tuple[float, float, float]] = []

    def show(self, step: Step) -> None:
        self.ms.append(step.times_ms)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--method", default="paper")
    parser.add_argument("--runs", type=int, default=5)
    args = parser.parse_args()
    recording, times, rates = Recording(args.recording), Times(), []
    for _ in range(args.runs):
        with open_tracer(recording, args.method) as tracer:
            rates.append(loop_rate(trace(recording, tracer, times).estimates))
    means = [rate.mean for rate in rates]
    print(
        f"{args.recording.name}, method {args.method}, {args.runs} runs of {len(times.ms) // args.runs} pairs"
    )
    print(
        f"loop rate {np.mean(means):.1f} ± {np.std(means):.1f} Hz, median run {np.median(means):.1f} Hz, "
        f"slowest pair {min(r.min for r in rates):.1f} Hz, fastest {max(r.max for r in rates):.1f} Hz"
    )
    ms = np.asarray(times.ms)
    for name, values in zip((*STEPS, "all"), [*ms.T, ms.sum(axis=1)], strict=True):
        print(f"  {name:9s} p50 {np.median(values):6.2f} ms   p99 {np.percentile(values, 99):6.2f} ms")


if __name__ == "__main__":
    main()
