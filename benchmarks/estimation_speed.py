"""CPU time of the full estimator per frame and of its Stage I solve.

python benchmarks/estimation_speed.py
"""

from __future__ import annotations

import time

import numpy as np
from estimation_trials import simulate

from tiptrace.estimation.full import FullEstimator
from tiptrace.sim.spec import TrialSpec


def main() -> None:
    t = simulate(TrialSpec(mode="markers", level="nominal", seed=2))
    estimator = FullEstimator(None, t.rig, t.tool)
    spent = []
    for pair in t.pairs:
        start = time.thread_time()
        estimator.update(pair)
        spent.append((time.thread_time() - start) * 1e3)
    ms = np.array(spent)
    k = int(ms.argmax())
    for name, part in (("Stage I frame", ms[6:k]), ("Stage II frame", ms[k + 1 :])):
        print(f"{name}: p50 {np.median(part):.2f} ms, p99 {np.percentile(part, 99):.2f} ms of CPU")
    print(f"Stage I solve: {ms[k]:.0f} ms of CPU ({k} frames)")


if __name__ == "__main__":
    main()
