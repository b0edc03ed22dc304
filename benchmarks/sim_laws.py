"""The virtual rig's laws over all twelve conditions and all levels: one line per condition and level.

    python benchmarks/sim_laws.py [--seeds 1] [--levels clean,nominal,hard,unseen] [--markdown]

Runs the physics alone (no images, no markers), and counts what a user of the rig relies on.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np

from tiptrace.geometry.transforms import rotation_log
from tiptrace.sim.conditions import CONDITIONS, Condition
from tiptrace.sim.seeds import stream
from tiptrace.sim.spec import make_spec
from tiptrace.sim.trial import PLATE_ORIGIN_B, FrameState, TrialPhysics


@dataclass(frozen=True)
class Row:
    condition: str
    level: str
    frames: int
    first_try: int
    force_n: float
    moment_nmm: float
    yaw_jump_deg: float
    stage_one_mm: float
    off_groove_mm: float
    penetration_mm: float
    out_of_groove: int
    no_contact: int
    slipping: int
    contact_n: tuple[float, float]
    trail_mm: float
    turn_deg: float
    cpu_s: float


def yaw_deg(frame: FrameState) -> float:
    """Heading of the tool's width axis about the vertical."""
    axis = (frame.T_B_E @ frame.T_E_T)[:3, 1]
    return float(np.degrees(np.arctan2(axis[1], axis[0])))


def examine(condition: Condition, level: str, seed: int) -> Row:
    spec = make_spec(
        trajectory=condition.trajectory,
        tool=condition.tool,
        wrist=condition.wrist,
        grasp=condition.grasp,
        level=level,
        mode="markers",
        seed=seed,
    )
    start = time.process_time()
    offset = spec.disturbed_by.nominal_tip_m * stream(seed, "nominal-tip").normal(size=3)
    physics = TrialPhysics(spec, offset)
    frames = list(physics.frames())
    cpu = time.process_time() - start
    assert physics.groove is not None
    tips = np.array([f.tip_B for f in frames]) - PLATE_ORIGIN_B
    gaps = [physics.groove.gap(p) for p in tips]
    one = np.array([f.t_s < spec.anchoring_s for f in frames])
    touching = np.array([f.in_contact for f in frames])
    free_of_pit = np.array([g.along_m > physics.groove.pit.ahead_m for g in gaps]) & ~one & touching
    off = np.array([np.hypot(g.lateral_m, p[2]) for g, p in zip(gaps, tips, strict=True)])
    yaw = np.unwrap(np.radians([yaw_deg(f) for f in frames]))
    calm = ~np.array([f.creeping for f in frames])
    jumps = np.abs(np.degrees(np.diff(yaw)))[calm[1:] & calm[:-1]]
    normal = np.array([f.tip.normal_n for f in frames])
    hand = np.array([f.T_B_E[0, 3] for f in frames])
    trail = (hand - hand[0]) - (tips[:, 0] - tips[0, 0])
    turned = [np.linalg.norm(rotation_log(f.T_E_T[:3, :3] @ frames[0].T_E_T[:3, :3].T)) for f in frames]
    return Row(
        condition.name,
        level,
        len(frames),
        sum(not f.retried for f in frames),
        max(f.force_residual_n for f in frames),
        1e3 * max(f.moment_residual_nm for f in frames),
        float(jumps.max()),
        1e3 * float(np.ptp(tips[one], axis=0).max()),
        1e3 * float(off[free_of_pit].max()),
        1e3 * max(f.tip.penetration_m for f, k in zip(frames, free_of_pit, strict=True) if k),
        sum(f.tip.where in ("edge", "plate") for f in frames),
        int((~touching).sum()),
        int((~calm).sum()),
        (float(normal[~one].min()), float(normal[~one].max())),
        1e3 * float(trail[~one].max()),
        float(np.degrees(max(turned))),
        cpu,
    )


def line(r: Row) -> str:
    return (
        f"| {r.condition} | {r.level} | {r.first_try}/{r.frames} | {r.force_n:.0e} | {r.moment_nmm:.0e} "
        f"| {r.yaw_jump_deg:.2f} | {r.stage_one_mm:.2f} | {r.off_groove_mm:.2f} | {r.penetration_mm:.3f} "
        f"| {r.out_of_groove} | {r.no_contact} | {r.slipping} | {r.contact_n[0]:.1f}–{r.contact_n[1]:.1f} "
        f"| {r.trail_mm:.1f} | {r.turn_deg:.1f} | {r.cpu_s:.1f} |"
    )


HEAD = (
    "| condition | level | first try | force residual N | moment residual N·mm | yaw jump ° | tip in Stage I mm "
    "| off the centreline mm | penetration mm | frames out of groove | without contact | slipping "
    "| contact force N | trail mm | in-grasp turn ° | CPU s |\n" + "|---" * 16 + "|"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--levels", default="clean,nominal,hard,unseen")
    arguments = parser.parse_args()
    print(HEAD)
    rows = []
    for level in arguments.levels.split(","):
        for condition in CONDITIONS:
            for seed in range(arguments.seeds):
                rows.append(examine(condition, level, seed))
                print(line(rows[-1]), flush=True)
    frames, first = sum(r.frames for r in rows), sum(r.first_try for r in rows)
    print(
        f"\n{len(rows)} trials, {frames} frames, {100 * first / frames:.3f} % at the first try; worst residuals "
        f"{max(r.force_n for r in rows):.1e} N, {max(r.moment_nmm for r in rows):.1e} N·mm; worst yaw jump "
        f"{max(r.yaw_jump_deg for r in rows):.2f}°; worst distance from the centreline "
        f"{max(r.off_groove_mm for r in rows):.2f} mm; worst penetration {max(r.penetration_mm for r in rows):.3f} mm"
    )


if __name__ == "__main__":
    main()
