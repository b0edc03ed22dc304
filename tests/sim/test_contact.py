"""Laws of the contacts: forces derive from energy, Jacobians are exact, friction stays in its cone."""

from __future__ import annotations

import numpy as np
import pytest

from tiptrace.geometry.transforms import rotation_exp, transform
from tiptrace.sim.conditions import named_hold
from tiptrace.sim.grasp import Grasp, GraspState, World
from tiptrace.sim.groove import Groove, Pit, named_centreline
from tiptrace.sim.pad_forces import advance_pads, pad_forces
from tiptrace.sim.pads import GelLaw, Pads, PadState
from tiptrace.sim.rig import PADS_E, Placement, true_rig
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.tip import TipLaw, TipState, tip_force
from tiptrace.sim.tools import TOOL_NAMES, ToolShape, make_tool
from tiptrace.types import SIDES, FloatArray

SCALE = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])  # rotations as displacements at 20 mm


def make_pads(law: GelLaw | None = None) -> Pads:
    rig = true_rig(TrialSpec())
    return Pads.at({side: rig.T_E_S(side, None) for side in SIDES}, law or GelLaw())


def held(pads: Pads, tool: ToolShape) -> tuple[PadState, FloatArray, FloatArray]:
    """The pads on a tool, with shear and some relaxation."""
    place = Placement.of(named_hold("G1"), tool)
    state = PadState.fresh(len(pads))
    for _ in range(2):
        forces = pad_forces(pads, tool, state, place.R, place.p, 1.0, pads.law.friction)
        state = advance_pads(pads, state, forces, place.R, place.p, 1.0)
    return state, place.R, place.p


def numeric_derivative(f, R: FloatArray, p: FloatArray, h: float = 1e-8) -> FloatArray:  # type: ignore[no-untyped-def]
    """Derivative of f(R, p) by a translation of the tip and a rotation about it, last axis 6."""
    columns = []
    for e in np.eye(6):
        plus, minus = (f(rotation_exp(s * h * e[3:]) @ R, p + s * h * e[:3]) for s in (1, -1))
        columns.append((np.asarray(plus) - np.asarray(minus)) / (2 * h))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("name", TOOL_NAMES)
@pytest.mark.parametrize("stiffening", [0.0, 0.8])
def test_pad_stiffness_is_the_derivative_of_the_wrench(name: str, stiffening: float) -> None:
    pads, tool = make_pads(GelLaw(stiffening=stiffening)), make_tool(name)
    state, R, p = held(pads, tool)
    rng = np.random.default_rng(3)
    seen_slip = 0
    for size in (0.3, 1.0, 3.0):
        R_t = rotation_exp(size * rng.normal(size=3) * [0.05, 0.02, 0.02]) @ R
        p_t = p + size * rng.normal(size=3) * 3e-4

        def wrench(R: FloatArray, p: FloatArray) -> FloatArray:
            return pad_forces(pads, tool, state, R, p, 0.02, 0.9).wrench

        forces = pad_forces(pads, tool, state, R_t, p_t, 0.02, 0.9)
        seen_slip += int(forces.slipping.sum())
        expected = numeric_derivative(wrench, R_t, p_t) / SCALE / SCALE[:, None]
        got = forces.stiffness / SCALE / SCALE[:, None]
        np.testing.assert_allclose(got, expected, atol=1e-4 * np.abs(expected).max())
    assert seen_slip > 0


@pytest.mark.parametrize("name", TOOL_NAMES)
def test_sticking_wrench_is_minus_the_gradient_of_the_energy(name: str) -> None:
    pads, tool = make_pads(GelLaw(creep=0.0)), make_tool(name)
    state, R, p = held(pads, tool)
    R = rotation_exp([0.04, 0.01, -0.01]) @ R
    p = p + [1e-4, -2e-4, 2e-4]
    friction = 1e6  # nothing slips

    def energy(R: FloatArray, p: FloatArray) -> float:
        return pad_forces(pads, tool, state, R, p, 0.02, friction).stored_j

    wrench = pad_forces(pads, tool, state, R, p, 0.02, friction).wrench
    gradient = numeric_derivative(energy, R, p, h=1e-7)
    np.testing.assert_allclose(wrench / SCALE, -gradient / SCALE, atol=1e-5 * np.abs(gradient / SCALE).max())


def test_friction_stays_in_the_cone_and_slipping_springs_follow() -> None:
    pads, tool = make_pads(), make_tool("O1")
    state, R, p = held(pads, tool)
    turn = rotation_exp([0.3, 0, 0])  # 17° about the pads: beyond what they can hold
    R_t, p = turn @ R, PADS_E + turn @ (p - PADS_E)
    forces = pad_forces(pads, tool, state, R_t, p, 0.02, 0.15)
    size = np.linalg.norm(forces.tangential, axis=1)
    assert np.all(size <= 0.15 * forces.normal_n * (1 + 1e-12) + 1e-15)
    assert forces.slipping.sum() > 100
    after = advance_pads(pads, state, forces, R_t, p, 0.02)
    again = pad_forces(pads, tool, after, R_t, p, 1e-9, 0.15)
    np.testing.assert_allclose(again.tangential[after.anchored], forces.tangential[after.anchored], atol=2e-4)


def test_grip_is_what_the_design_measured() -> None:
    pads, tool = make_pads(), make_tool("O1")
    state, R, p = held(pads, tool)
    grip = pad_forces(pads, tool, state, R, p, 1.0, 0.9).normal_n.sum() / 2
    assert 11.0 < grip < 16.0  # about 13 N at 1.2 mm


@pytest.mark.parametrize("z_mm", [-0.16, 0.6])
@pytest.mark.parametrize("x_mm", [1.5, 21.3])
@pytest.mark.parametrize("lateral_mm", [-0.13, 0.0, 0.11, 0.8])
def test_tip_stiffness_is_the_derivative_of_its_force(x_mm: float, z_mm: float, lateral_mm: float) -> None:
    groove = Groove(named_centreline("T4"))
    line = groove.line.points(np.array([x_mm * 1e-3]))[0]
    p = line + [0.0, lateral_mm * 1e-3, z_mm * 1e-3]
    p[2] += groove.pit.at(x_mm * 1e-3)[0] if z_mm < 0 else 0.0
    law = TipLaw()
    for anchor in (p + [1e-6, -2e-6, 1e-6], p - [4e-4, 1e-4, 0]):  # sticking, slipping
        state = TipState(anchor, 0.3)
        if groove.gap(p).distance_m >= 1.4e-3:
            assert tip_force(groove, 1.4e-3, law, state, p).normal_n == 0.0
            continue
        force = tip_force(groove, 1.4e-3, law, state, p)
        h = 1e-9
        numeric = np.stack(
            [
                (
                    tip_force(groove, 1.4e-3, law, state, p + h * e).force
                    - tip_force(groove, 1.4e-3, law, state, p - h * e).force
                )
                / (2 * h)
                for e in np.eye(3)
            ],
            axis=1,
        )
        np.testing.assert_allclose(force.stiffness, numeric, atol=2e-3 * np.abs(numeric).max())


def test_rest_strengthens_tip_friction_and_motion_weakens_it() -> None:
    groove, law = Groove(named_centreline("T1"), Pit(depth_m=0.0)), TipLaw()
    p = np.array([0.05, 0.0, -0.15e-3])
    far = p - [1e-3, 0, 0]
    fresh = tip_force(groove, 1.4e-3, law, TipState(far, 0.0), p)
    aged = tip_force(groove, 1.4e-3, law, TipState(far, 10.0), p)
    assert np.linalg.norm(fresh.friction) == pytest.approx(law.kinetic * fresh.normal_n, rel=1e-9)
    assert np.linalg.norm(aged.friction) == pytest.approx(
        (law.kinetic + law.ageing) * aged.normal_n, rel=1e-3
    )
    assert fresh.friction @ [1, 0, 0] < 0  # against the motion


def test_equilibrium_is_the_same_from_any_start() -> None:
    pads, tool = make_pads(), make_tool("O1")
    state, R, p = held(pads, tool)
    grasp = Grasp(pads, tool, Groove(named_centreline("T3")), TipLaw(), np.zeros(3))
    hand = transform(np.diag([1.0, -1.0, -1.0]), [0.03, 0.0, 0.2 - 4e-4])
    world = World(hand, 0.9)
    start = GraspState(R, p, state, TipState())
    reference = grasp.solve(start, world, R, p, 0.02)
    assert reference.converged
    rng = np.random.default_rng(0)
    for _ in range(5):
        turn = rotation_exp(0.02 * rng.normal(size=3))
        R_0, p_0 = turn @ R, PADS_E + turn @ (p - PADS_E) + 1e-4 * rng.normal(size=3)
        for solver in (grasp.solve, grasp.relax):
            found = solver(start, world, R_0, p_0, 0.02)
            assert found.converged
            np.testing.assert_allclose(found.p, reference.p, atol=2e-6)
