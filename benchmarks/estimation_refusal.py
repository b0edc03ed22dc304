"""How often an anchoring motion is accepted or refused: draws of Stage I with known noise and a gel that shows less.

python benchmarks/estimation_refusal.py --draws 2000
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tiptrace.config import Rig, load_yaml
from tiptrace.estimation.motion import MotionConfig, Motions
from tiptrace.estimation.observability import weak_axes
from tiptrace.estimation.planning import CANDIDATES, Task, Wiggle, _motions
from tiptrace.estimation.pose_track import HandStates, smooth_at
from tiptrace.estimation.tip_map import solve_tip_map
from tiptrace.estimation.tip_map_config import P, TipMapConfig
from tiptrace.geometry.transforms import invert, rotation_exp, rotation_log
from tiptrace.sim.rig import true_rig
from tiptrace.sim.spec import TrialSpec


def draw(wiggle: Wiggle, task: Task, rng: np.random.Generator) -> tuple[bool, float]:
    """Whether the anchor of one draw is accepted, and its error in mm."""
    s = np.arange(0.0, wiggle.duration_s, 0.04)
    s_pose = np.arange(-0.3, wiggle.duration_s + 0.3, 0.008)
    track = wiggle.poses(s_pose, task.tip_E, task.pads_E)
    c = task.tip_E + 3e-3 * rng.standard_normal(3)
    T = invert(wiggle.poses(s, task.tip_E, task.pads_E))
    u = T[:, :3, :3] @ c + T[:, :3, 3] - c
    m = _motions(rng.uniform(0.85, 1.0) * u, c, task, MotionConfig())
    noise = np.einsum("tij,tj->ti", np.linalg.cholesky(m.covariance), rng.standard_normal((len(s), 6)))
    E = rotation_exp(noise[:, :3])
    centre = m.centre + noise[:, 3:]
    R = E @ m.R
    t = np.einsum("tij,tj->ti", E, m.t - m.centre) + centre
    assert np.isfinite(rotation_log(R)).all()
    noisy = Motions(R, t, m.covariance, centre, m.residual_m, m.weights, m.chi2, m.sides)

    def hand_at(latency_s: float) -> HandStates:
        return smooth_at(s_pose * 1e9, track, (s - latency_s) * 1e9, 0.05)

    tip_map = solve_tip_map(
        noisy, hand_at, s / wiggle.duration_s - 1, wiggle.duration_s, TipMapConfig(), (0.0, 5e-3)
    )
    accepted = not weak_axes(tip_map.covariance[P, P], 2e-3)
    return accepted, float(np.linalg.norm(tip_map.p - c) * 1e3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--rig", type=Path)
    args = parser.parse_args()
    rig = load_yaml(Rig, args.rig) if args.rig else true_rig(TrialSpec())
    task = Task(rig, np.array([0.0, 0.0, 0.2]))
    for wiggle in CANDIDATES:
        found = [draw(wiggle, task, np.random.default_rng(seed)) for seed in range(args.draws)]
        accepted = np.array([a for a, _ in found])
        error = np.array([e for _, e in found])
        of_accepted = f"error of the accepted {np.mean(error[accepted]):.2f} mm" if accepted.any() else ""
        print(
            f"{wiggle.name:12s} accepted {100 * accepted.mean():5.1f} % of {args.draws}  {of_accepted}",
            flush=True,
        )


if __name__ == "__main__":
    main()
