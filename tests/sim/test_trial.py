"""Laws of whole trials: balance, cones, energy, symmetry, refinement, the tip in its groove, slip and lift-off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.sim.helpers import run, short_spec
from tiptrace.errors import SimulationError
from tiptrace.geometry.transforms import rotation_log
from tiptrace.sim.conditions import CONDITIONS, paper_trials
from tiptrace.sim.grasp import FORCE_TOLERANCE_N, MOMENT_TOLERANCE_NM, World
from tiptrace.sim.groove import Groove, named_centreline
from tiptrace.sim.pads import GelLaw
from tiptrace.sim.spec import Dwell, FrictionDrop, Lift
from tiptrace.sim.tip import TipLaw
from tiptrace.sim.trial import PLATE_ORIGIN_B, FrameState, TrialPhysics


def tips(frames: list[FrameState]) -> np.ndarray:
    return np.array([f.tip_B for f in frames])


@pytest.fixture(scope="module")
def t3() -> tuple[TrialPhysics, list[FrameState]]:
    return run(short_spec(level="nominal"), (2e-3, -2e-3, 3e-3))


def test_every_frame_is_in_balance(t3: tuple[TrialPhysics, list[FrameState]]) -> None:
    """Pads, groove and weight, added up from the frame's own forces."""
    physics, frames = t3
    weight = np.array([0.0, 0.0, -physics.tool.weight_n])
    for f in frames:
        R_B_E, R_E_T = f.T_B_E[:3, :3], f.T_E_T[:3, :3]
        pads_B, moment_B = R_B_E @ f.pads.wrench[:3], R_B_E @ f.pads.wrench[3:]
        arm_B = R_B_E @ R_E_T @ physics.tool.centre_of_mass_T
        assert np.linalg.norm(pads_B + f.tip.force + weight) <= FORCE_TOLERANCE_N
        assert np.linalg.norm(moment_B + np.cross(arm_B, weight)) <= MOMENT_TOLERANCE_NM
        assert f.force_residual_n <= FORCE_TOLERANCE_N
        assert f.moment_residual_nm <= MOMENT_TOLERANCE_NM
        assert not f.retried


def test_no_contact_leaves_its_friction_cone(t3: tuple[TrialPhysics, list[FrameState]]) -> None:
    _, frames = t3
    gel, tip = GelLaw(), TipLaw()
    for f in frames:
        tangential = np.linalg.norm(f.pads.tangential, axis=1)
        assert np.all(tangential <= gel.friction * f.pads.normal_n * (1 + 1e-9) + 1e-12)
        assert np.linalg.norm(f.tip.friction) <= (tip.kinetic + tip.ageing) * f.tip.normal_n * (1 + 1e-9)
        assert np.all(f.pads.normal_n >= 0)
        assert f.tip.normal_n >= 0


def test_tip_rests_in_the_pit_during_stage_one_and_follows_the_groove_after(
    t3: tuple[TrialPhysics, list[FrameState]],
) -> None:
    physics, frames = t3
    assert physics.groove is not None
    p = tips(frames) - PLATE_ORIGIN_B
    stage_one = np.array([f.t_s < physics.spec.anchoring_s for f in frames])
    assert np.ptp(p[stage_one], axis=0).max() < 0.2e-3
    assert p[-1, 0] > 0.03
    for f, point in zip(frames, p, strict=True):
        gap = physics.groove.gap(point)
        if f.in_contact and gap.along_m > physics.groove.pit.ahead_m:
            height = point[2]
            assert np.hypot(gap.lateral_m, height) <= 0.2e-3
            assert f.tip.penetration_m <= 0.1e-3


def test_hand_moves_straight_along_x_in_stage_two(t3: tuple[TrialPhysics, list[FrameState]]) -> None:
    physics, frames = t3
    hand = np.array([f.T_B_E for f in frames if f.t_s >= physics.spec.anchoring_s])
    assert hand[-1, 0, 3] - hand[0, 0, 3] == pytest.approx(physics.spec.travel_m, abs=1e-9)
    assert np.ptp(hand[:, 1:3, 3], axis=0).max() < 1e-9
    assert np.abs(hand[:, :3, :3] - hand[0, :3, :3]).max() < 1e-12
    assert np.max(np.diff(hand[:, 0, 3])) * physics.spec.fps == pytest.approx(0.02, rel=1e-6)


def test_friction_makes_the_tip_trail(t3: tuple[TrialPhysics, list[FrameState]]) -> None:
    _, frames = t3
    hand = frames[-1].T_B_E[0, 3] - frames[0].T_B_E[0, 3]
    tip = frames[-1].tip_B[0] - frames[0].tip_B[0]
    assert 1e-3 < hand - tip < 9e-3


def test_a_closed_loop_creates_no_energy() -> None:
    """The hand moves in a closed loop with the tip in the pit: its work, less what is stored, is friction's."""
    physics = TrialPhysics(short_spec(), np.zeros(3))
    stepper = physics.stepper
    stepper.grasp = replace(stepper.grasp, pads=replace(stepper.grasp.pads, law=GelLaw(creep=0.0)))
    start = physics.hand.pose(0.0)
    weight = np.array([0, 0, -physics.tool.weight_n])

    def loop(radius_m: float, steps: int) -> tuple[float, float]:
        work, stored, last = 0.0, [], None
        for k in range(steps + 1):
            a = 2 * np.pi * k / steps
            T = start.copy()
            T[:3, 3] += radius_m * np.array([np.cos(a) - 1, np.sin(a), 0.1 * np.sin(2 * a)])
            stepper.rest(World(T, 0.9), 1e-9, "loop")
            e = stepper.last
            force = -(e.tip.force + weight)  # of the hand on tool and pads
            if last is not None:
                work += float(0.5 * (force + last[0]) @ (T[:3, 3] - last[1]))
            last = (force, T[:3, 3])
            stored.append(e.pads.stored_j + e.tip.stored_j)
        return work - (stored[-1] - stored[0]), float(np.ptp(stored))

    loop(0.3e-3, 40)  # settle the outermost springs
    small, scale = loop(0.3e-3, 60)
    assert abs(small) < 2e-3 * scale  # nothing but the springs at the patch's rim slips
    assert small > -1e-4 * scale
    large, _ = loop(2e-3, 120)
    assert large > 10 * abs(small)  # springs slip, the tip slides: the loop takes energy


def test_mirrored_groove_gives_the_mirrored_trial() -> None:
    spec = short_spec(anchoring_s=0.0, travel_m=0.05)
    line = named_centreline("T3")
    _, straight = run(spec, groove=Groove(line))
    _, mirrored = run(spec, groove=Groove(line.mirrored()))
    a, b = tips(straight) - PLATE_ORIGIN_B, tips(mirrored) - PLATE_ORIGIN_B
    assert np.ptp(a[:, 1]) > 5e-3
    np.testing.assert_allclose(a, b * [1, -1, 1], atol=0.03e-3)


def test_twice_the_frame_rate_gives_the_same_trial() -> None:
    spec = short_spec(level="nominal", trajectory="T4")
    offset = (3e-3, -2e-3, 4e-3)
    _, coarse = run(spec, offset)
    _, fine = run(spec.model_copy(update={"fps": 50.0}), offset)
    np.testing.assert_allclose(tips(coarse), tips(fine[::2]), atol=0.05e-3)
    for c, f in zip(coarse[::10], fine[::20], strict=False):
        motion = c.T_E_T[:3, :3].T @ f.T_E_T[:3, :3]
        assert np.degrees(np.linalg.norm(rotation_log(motion))) < 0.1


def test_same_seed_same_numbers() -> None:
    a, b = (run(short_spec(travel_m=0.01, level="hard"), (5e-3, 5e-3, -5e-3))[1] for _ in range(2))
    assert all(
        np.array_equal(x.T_E_T, y.T_E_T) and np.array_equal(x.tip_B, y.tip_B)
        for x, y in zip(a, b, strict=True)
    )


def test_dry_gel_holds_and_wet_gel_slips() -> None:
    wet = FrictionDrop(start_s=3.0, duration_s=0.8, factor=0.05)
    _, dry_frames = run(short_spec())
    _, wet_frames = run(short_spec(friction_drops=(wet,)))
    assert not any(f.creeping for f in dry_frames)
    assert abs(dry_frames[-1].slip_deg) < 0.1
    slipping = [f.t_s for f in wet_frames if f.creeping]
    assert slipping
    assert min(slipping) > 3.0
    assert max(slipping) < 4.4
    assert max(abs(f.slip_deg) for f in wet_frames) > 0.5 or wet_frames[-1].slip_m > 0.3e-3


def test_lifted_tip_leaves_the_groove_and_lands_elsewhere() -> None:
    lift = Lift(start_s=2.6, duration_s=1.0, height_m=4e-3)
    physics, frames = run(short_spec(lifts=(lift,)))
    free = [f.t_s for f in frames if not f.in_contact]
    assert free
    assert 2.6 < min(free) < max(free) < 3.6
    assert frames[-1].in_contact
    before = next(f for f in reversed(frames) if f.t_s < min(free))
    after = next(f for f in frames if f.t_s > max(free))
    assert np.linalg.norm(after.tip_B - before.tip_B) > 5e-3
    assert physics.frame_count == len(frames)


def test_slow_grasp_drift_turns_the_tool_against_the_pads() -> None:
    d = short_spec().disturbed_by.model_copy(update={"grasp_drift_deg": 3.0})
    _, frames = run(short_spec(travel_m=0.02, disturbances=d))
    assert abs(frames[-1].slip_deg) == pytest.approx(3.0, abs=0.3)
    assert np.all(np.abs(np.diff([f.slip_deg for f in frames])) < 0.2)


def test_second_anchoring_rests_where_it_stops() -> None:
    spec = short_spec(dwells=(Dwell(at_m=0.02, duration_s=3.0, anchoring=True),))
    physics, frames = run(spec)
    rest = [f for f in frames if physics.hand.segment(f.t_s).anchoring and f.t_s > spec.anchoring_s]
    assert len(rest) > 50
    assert np.ptp(tips(rest), axis=0).max() < 0.5e-3
    turned = [np.linalg.norm(rotation_log(f.T_B_E[:3, :3] @ rest[0].T_B_E[:3, :3].T)) for f in rest]
    assert np.degrees(max(turned)) > 4.5


def test_pads_motion_turns_the_hand_but_hardly_the_tool() -> None:
    """Why that motion is unobservable: the soft grasp takes the rotation."""
    _physics, frames = run(short_spec(anchor_motion="pads", travel_m=0.0))
    tool = [f.T_B_E[:3, :3] @ f.T_E_T[:3, :3] for f in frames]
    hand = [f.T_B_E[:3, :3] for f in frames]

    def largest(R: list[np.ndarray]) -> float:
        return float(np.degrees(max(np.linalg.norm(rotation_log(r @ R[0].T)) for r in R)))

    assert largest(hand) > 4.9
    assert largest(tool) < 0.6 * largest(hand)


def test_thickness_opens_the_gripper() -> None:
    from tiptrace.sim.rig import true_opening_m

    for thickness in (5e-3, 20e-3):
        spec = short_spec(thickness_m=thickness, travel_m=0.01)
        physics, frames = run(spec)
        left, right = (physics.T_E_S[s][:3, 3] for s in ("left", "right"))
        assert left[0] - right[0] == pytest.approx(thickness - 2.4e-3)
        assert true_opening_m(spec, physics.tool) == pytest.approx(thickness - 2.4e-3)
        assert frames[-1].in_contact


def test_conditions_are_the_papers() -> None:
    assert len(CONDITIONS) == 12
    assert len(paper_trials()) == 51


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trajectory": "T8"}, "T1, T2"),
        ({"tool": "spoon"}, "O1, O2"),
        ({"wrist": "W9"}, "W1, W2, W3"),
        ({"grasp": "G0"}, "G1, G2, G3"),
        ({"thickness_m": 0.004}, "5 to 20 mm"),
        ({"tool_length_m": 0.06}, "do not reach"),
        ({"indentation_m": 0.05e-3, "anchor_force_n": 14.0}, "does not hold"),
        ({"thickness_m": 0.005, "indentation_m": 2.6e-3}, "closes the gripper"),
    ],
)
def test_impossible_trials_are_refused_with_a_sentence(settings: dict[str, object], message: str) -> None:
    with pytest.raises(SimulationError, match=message):
        run(short_spec(**settings))


def test_a_torn_grasp_names_the_frame() -> None:
    spec = short_spec(lifts=(Lift(start_s=2.5, duration_s=1.0, height_m=60e-3),), friction_drops=())
    physics = TrialPhysics(spec.model_copy(update={"pushes": (_hammer(),)}), np.zeros(3))
    with pytest.raises(SimulationError, match=r"frame \d+"):
        list(physics.frames())


def _hammer():  # type: ignore[no-untyped-def]
    from tiptrace.sim.spec import Push

    return Push(start_s=2.2, duration_s=1.5, force_n=(0.0, 60.0, -200.0))
