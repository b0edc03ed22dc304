"""The grasp against MuJoCo: a bushing with the same linearised stiffness, dragged along T3 and T4.

    pip install mujoco            # development only
    python benchmarks/mujoco_crosscheck.py

The tool hangs in the hand by six springs at the pads' centre (the pads' stiffness, linearised at the settled
grasp). Its tip slides between upright rails on a floor, with the groove's clearance, under MuJoCo's own contact
model and dynamics. The rails are smooth and the floor has the groove's friction: in the round groove the tip rides
up the wall and there is one normal force, 1 % above the contact force, where a floor and a wall would rub twice.
There is no pit, no Stage I and no creep on either side, and both start from the same contact force. Compared are
the tip and the in-grasp rotation at the same travel of the hand.
"""

from __future__ import annotations

import argparse

import numpy as np

from tiptrace.geometry.transforms import rotation_log, skew
from tiptrace.sim import trial as trial_module
from tiptrace.sim.grasp import World
from tiptrace.sim.groove import Groove, Pit, named_centreline
from tiptrace.sim.pads import GelLaw
from tiptrace.sim.rig import PADS_E
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.trial import PLATE_ORIGIN_B, FrameState, TrialPhysics
from tiptrace.types import FloatArray

TRAVEL_M, START_M = 0.1, 0.03  # the first part, where friction builds up, is left out of the comparison
RAIL_M = 1e-3
DT_S = 5e-4


def our_trial(name: str) -> tuple[TrialPhysics, list[FrameState], FloatArray, tuple[FloatArray, FloatArray]]:
    """The virtual rig's run, the pads' stiffness (6, 6) at their centre, and the unloaded tool in F_E."""
    trial_module.GelLaw = lambda **values: GelLaw(**(values | {"creep": 0.0})) if values else GelLaw()  # type: ignore
    spec = TrialSpec(mode="markers", level="clean", trajectory=name, anchoring_s=0.0, travel_m=TRAVEL_M)
    physics = TrialPhysics(spec, np.zeros(3), Groove(named_centreline(name), Pit(depth_m=0.0)))
    frames = list(physics.frames())
    rest = TrialPhysics(spec, np.zeros(3), Groove(named_centreline(name), Pit(depth_m=0.0)))
    far = rest.hand.pose(0.0)
    far[2, 3] += 0.02
    rest.stepper.rest(World(far, 0.9), 1e-9, "in the air")
    e = rest.stepper.last
    lever = e.p - PADS_E
    T = np.eye(6)
    T[:3, 3:] = -skew(lever)  # tip velocity from the pads' centre's
    return physics, frames, -T.T @ e.pads.stiffness @ T, (e.R, e.p)


def model_xml(K: FloatArray, lever: FloatArray, line, weight_n: float) -> str:  # type: ignore[no-untyped-def]
    """Rails, floor, a hand too heavy to be disturbed (F_E is upside down: x, −y, −z), the tool on six springs.

    The hand moves on joints: friction would not see the speed of a body that is merely placed anew.
    """
    x = np.arange(-0.02, TRAVEL_M + 0.03, RAIL_M)
    rails = []
    for a in x:
        f, slope, _, _ = line.at(float(a))
        v = np.hypot(1, slope)
        for side in (1, -1):
            c = np.array([a, f]) + side * (1.5e-3 + 1e-3) * np.array([-slope, 1]) / v
            rails.append(
                f'<geom type="box" size="{0.55 * RAIL_M * v} 0.001 0.004" pos="{c[0]} {c[1]} 0.001" '
                f'euler="0 0 {np.arctan(slope)}" condim="1" priority="1"/>'
            )
    springs = []
    for i, axis in enumerate(("1 0 0", "0 1 0", "0 0 1")):
        springs.append(
            f'<joint type="slide" axis="{axis}" stiffness="{K[i, i]}" damping="{0.01 * K[i, i]}"/>'
        )
    for i, axis in enumerate(("1 0 0", "0 1 0", "0 0 1")):
        k = K[3 + i, 3 + i]
        springs.append(
            f'<joint type="hinge" axis="{axis}" stiffness="{k}" damping="{0.01 * k}" armature="2e-6"/>'
        )
    return f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{DT_S}" cone="elliptic" impratio="50" integrator="implicitfast" gravity="0 0 -9.81"
          noslip_iterations="5"/>
  <default><geom friction="0.2 0 0" solref="0.002 1" solimp="0.98 0.99 0.0001"/></default>
  <worldbody>
    <geom type="plane" size="1 1 0.1" pos="0 0 -0.0015"/>
    {"".join(rails)}
    <body name="hand" quat="0 1 0 0" gravcomp="1">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 -1 0"/><joint type="slide" axis="0 0 -1"/>
      <inertial mass="1000" pos="0 0 0" diaginertia="1 1 1"/>
      <body name="tool">
        {"".join(springs)}
        <inertial mass="{weight_n / 9.81}" pos="{lever[0]} {lever[1]} {lever[2] - 0.042}" diaginertia="4e-6 4e-6 5e-7"/>
        <geom name="tip" type="sphere" size="0.0014" pos="{lever[0]} {lever[1]} {lever[2]}"/>
        <site name="tip" pos="{lever[0]} {lever[1]} {lever[2]}"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""


def mujoco_trial(name: str, physics: TrialPhysics, frames: list[FrameState], K: FloatArray, p: FloatArray):  # type: ignore[no-untyped-def]
    """Tip in plate coordinates (n, 3), in-grasp rotation vectors (n, 3) at the frames' instants, contact force."""
    import mujoco

    lever = p - PADS_E
    model = mujoco.MjModel.from_xml_string(model_xml(K, lever, named_centreline(name), physics.tool.weight_n))
    data = mujoco.MjData(model)
    pads = np.array([f.T_B_E[:3, :3] @ PADS_E + f.T_B_E[:3, 3] for f in frames]) - PLATE_ORIGIN_B
    times = np.array([f.t_s for f in frames])
    body, site = data.body("tool"), data.site("tip")
    coupling = K - np.diag(np.diag(K))
    wanted, height, floor = frames[0].tip.normal_n, 2e-3, np.zeros(6)

    def place(hand: FloatArray, velocity: FloatArray) -> None:
        data.qpos[:3], data.qvel[:3] = hand, velocity

    def step() -> float:
        """One step with the springs' coupling; returns the normal force under the tip."""
        data.qfrc_applied[3:] = -coupling @ data.qpos[3:]
        mujoco.mj_step(model, data)
        normal = 0.0
        for i in range(data.ncon):
            mujoco.mj_contactForce(model, data, i, floor)
            normal += float(floor[0]) * abs(float(data.contact[i].frame[2]))
        return normal

    for _ in range(int(3.0 / DT_S)):  # press down to the same contact force, then stay at that height
        place(pads[0] + [0, 0, height], np.zeros(3))
        height += 2e-6 * float(np.clip(step() - wanted, -1.0, 1.0))
    force = []
    tips, turns = [], []
    R_hand = np.diag([1.0, -1.0, -1.0])
    next_frame, t = 0, 0.0
    while next_frame < len(times):
        hand, ahead = (np.array([np.interp(u, times, pads[:, i]) for i in range(3)]) for u in (t, t + DT_S))
        place(hand + [0, 0, height], (ahead - hand) / DT_S)
        force.append(step())
        t += DT_S
        if t >= times[next_frame] - 1e-9:
            tips.append(site.xpos.copy())
            turns.append(rotation_log(R_hand.T @ body.xmat.reshape(3, 3)))
            next_frame += 1
    return np.array(tips), np.array(turns), float(np.median(force))


def compare(name: str) -> str:
    physics, frames, K, (R_rest, p_rest) = our_trial(name)
    tips_mj, turns_mj, force_mj = mujoco_trial(name, physics, frames, K, p_rest)
    tips = np.array([f.tip_B for f in frames]) - PLATE_ORIGIN_B
    turns = np.array([rotation_log(f.T_E_T[:3, :3] @ R_rest.T) for f in frames])
    hand = np.array([f.T_B_E[0, 3] for f in frames])
    use = hand - hand[0] > START_M

    def rms(v: FloatArray) -> float:
        return float(np.sqrt(np.mean(v[use] ** 2)))

    unloaded = hand + p_rest[0] - PLATE_ORIGIN_B[0]
    relative, relative_mj = unloaded - tips[:, 0], unloaded - tips_mj[:, 0]  # trailing, along the travel
    force = float(np.median([f.tip.normal_n for f in frames]))
    deg = np.degrees
    return (
        f"| {name} | {1e3 * rms(tips[:, 1]):.3f} / {1e3 * rms(tips_mj[:, 1]):.3f} "
        f"| {100 * rms(tips[:, 1] - tips_mj[:, 1]) / rms(tips[:, 1]):.1f} % "
        f"| {1e3 * rms(relative):.2f} / {1e3 * rms(relative_mj):.2f} "
        f"| {100 * rms(relative - relative_mj) / rms(relative):.1f} % "
        f"| {deg(rms(turns[:, 0])):.2f} / {deg(rms(turns_mj[:, 0])):.2f} "
        f"| {100 * rms(turns[:, 0] - turns_mj[:, 0]) / rms(turns[:, 0]):.1f} % "
        f"| {deg(rms(turns[:, 1])):.2f} / {deg(rms(turns_mj[:, 1])):.2f} "
        f"| {100 * rms(turns[:, 1] - turns_mj[:, 1]) / rms(turns[:, 1]):.1f} % | {force:.2f} / {force_mj:.2f} |"
    )


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(
        "| curve | tip across, rms mm (ours / MuJoCo) | rms difference | tip behind the hand, rms mm | rms difference "
        "| turn about the closing axis, rms ° | rms difference | turn about y_E, rms ° | rms difference "
        "| contact force, median N |\n" + "|---" * 10 + "|"
    )
    for name in ("T3", "T4"):
        print(compare(name), flush=True)


if __name__ == "__main__":
    main()
