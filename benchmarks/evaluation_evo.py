"""Cross-check of the trajectory RMSE against evo's ATE on the same pair of TUM files.

evo is GPL-3 and no part of this package: install it in an environment of its own and name its command.

    python -m venv evo-env && evo-env/bin/pip install evo
    python benchmarks/evaluation_evo.py --evo-ape evo-env/bin/evo_ape
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from tiptrace.evaluation.metrics import evaluate
from tiptrace.evaluation.quality import assess
from tiptrace.geometry.transforms import rotation_exp
from tiptrace.outputs import TUM, write_results
from tiptrace.types import Anchor, Phase, Status, TipEstimate, TipTrajectory, TruthSample


def make_trial(seed: int, frames: int = 400) -> tuple[TipTrajectory, list[TruthSample]]:
    """A noisy trace of a sine groove, every twentieth row lost."""
    rng = np.random.default_rng(seed)
    x = np.linspace(0, 0.2, frames)
    p = np.stack([0.4 + x, -0.1 + 4e-3 * np.sin(2 * np.pi * x / 0.05), np.full_like(x, 0.02)], axis=1)
    p_hat = p + rng.normal(0, 3e-3, 3) + np.cumsum(rng.normal(0, 2e-4, p.shape), axis=0)
    stamps = [1_700_000_000_000_000_000 + 40_000_000 * k for k in range(frames)]
    rows = [
        TipEstimate(t, Phase.RECONSTRUCTION, Status.OK, p_B=q, R_B_E=rotation_exp(rng.normal(0, 0.1, 3)))
        if k % 20
        else TipEstimate(t, Phase.RECONSTRUCTION, Status.LOST)
        for k, (t, q) in enumerate(zip(stamps, p_hat, strict=True))
    ]
    truth = [TruthSample(t, q) for t, q in zip(stamps, p, strict=True)]
    return TipTrajectory(rows, [], Anchor(p_hat[0], None, 0.0, 1)), truth


def evo_ate_m(evo_ape: str, truth: Path, estimate: Path, folder: Path) -> float:
    """RMSE by evo, no alignment."""
    archive = folder / "result.zip"
    command = [
        evo_ape,
        "tum",
        str(truth),
        str(estimate),
        "--save_results",
        str(archive),
        "--t_max_diff",
        "1e-4",
    ]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    with zipfile.ZipFile(archive) as zipped:
        return float(json.loads(zipped.read("stats.json"))["rmse"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--evo-ape", default="evo_ape")
    parser.add_argument("--trials", type=int, default=3)
    options = parser.parse_args()
    for seed in range(options.trials):
        trajectory, truth = make_trial(seed)
        metrics = evaluate(trajectory, truth)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            write_results(folder, trajectory, "check", metrics, assess(trajectory))
            as_rows = [TipEstimate(s.stamp_ns, None, Status.OK, p_B=s.p_B) for s in truth]
            write_results(folder / "truth", TipTrajectory(as_rows), "truth", metrics, assess(trajectory))
            ours = metrics.trajectory_rmse_mm * 1e-3
            theirs = evo_ate_m(options.evo_ape, folder / "truth" / TUM, folder / TUM, folder)
        print(f"seed {seed}: ours {ours:.12f} m, evo {theirs:.12f} m, difference {abs(ours - theirs):.1e} m")


if __name__ == "__main__":
    main()
