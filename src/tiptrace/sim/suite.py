"""Suites of trials: the paper's 51, and a quick look at the twelve conditions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tiptrace.errors import SimulationError
from tiptrace.sim.conditions import CONDITIONS, paper_trials
from tiptrace.sim.disturbances import LevelName
from tiptrace.sim.spec import Mode, TrialSpec, make_spec

SUITES: tuple[str, ...] = ("paper", "quick")
_SEEDS_PER_SUITE = 100


@dataclass(frozen=True, slots=True)
class SuiteTrial:
    """One trial of a suite.

    Attributes:
        name: File name without extension, for example ``T3-O1-W1-G1-r0``.
        spec: What to simulate.
    """

    name: str
    spec: TrialSpec


def suite_trials(
    suite: str,
    level: LevelName | str = "nominal",
    mode: Mode | Literal["default"] = "default",
    seed: int = 0,
    **settings: object,
) -> tuple[SuiteTrial, ...]:
    """Trials of a suite: ``paper`` 51 with images, ``quick`` the 12 conditions once with markers.

    Trial k of the suite with seed s has the seed 100 s + k, so suite seeds from 10 on share no trial with
    single trials of seeds below 1000.

    Raises:
        SimulationError: an unknown suite or setting.
    """
    if suite not in SUITES:
        raise SimulationError(f"unknown suite '{suite}'; valid suites: {', '.join(SUITES)}")
    plan = paper_trials() if suite == "paper" else tuple((c, 0) for c in CONDITIONS)
    if mode == "default":
        mode = "images" if suite == "paper" else "markers"
    return tuple(
        SuiteTrial(
            f"{c.name}-r{repeat}",
            make_spec(
                trajectory=c.trajectory,
                tool=c.tool,
                wrist=c.wrist,
                grasp=c.grasp,
                level=level,
                mode=mode,
                seed=seed * _SEEDS_PER_SUITE + k,
                **settings,
            ),
        )
        for k, (c, repeat) in enumerate(plan)
    )
