"""Short trials for the tests of the virtual rig."""

from __future__ import annotations

from typing import Any

import numpy as np

from tiptrace.sim.groove import Groove
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.trial import FrameState, TrialPhysics


def short_spec(**settings: Any) -> TrialSpec:
    """Two seconds of a slow two-axis Stage I, 40 mm of travel, no images."""
    return TrialSpec(
        **(
            {
                "mode": "markers",
                "level": "clean",
                "anchor_motion": "two-axis",
                "anchoring_s": 2.0,
                "travel_m": 0.04,
            }
            | settings
        )
    )


def run(
    spec: TrialSpec, nominal_offset_E: tuple[float, float, float] = (0, 0, 0), groove: Groove | None = None
) -> tuple[TrialPhysics, list[FrameState]]:
    """The physics of a trial and all its frames."""
    physics = TrialPhysics(spec, np.array(nominal_offset_E, dtype=float), groove)
    return physics, list(physics.frames())
