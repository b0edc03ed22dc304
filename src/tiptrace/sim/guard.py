"""Height of the hand above its plan: a force guard in Stage I, then the height that the travel's preload needs."""

from __future__ import annotations

from dataclasses import dataclass

from tiptrace.sim.protocol import Segment
from tiptrace.sim.spec import TrialSpec

_BAND = (0.8, 1.4)  # of the force aimed at
_GAIN = 0.7 / 3000.0  # m/N per step: a little under the grasp's own compliance along the tool


@dataclass(slots=True)
class Guard:
    """While the hand turns about a tip that it knows badly, it yields along z whenever the contact force leaves its
    band; then it moves to the height of the travel and stays there.

    Attributes:
        spec: The trial.
        pit_depth_m: What the tip has to climb when it leaves the pit.
        stiffness: Of the grasp along z, N/m, as probed by a small lift.
        height_m: Of the hand above its plan.
    """

    spec: TrialSpec
    pit_depth_m: float
    stiffness: float = 4e3
    height_m: float = 0.0
    _planned: bool = False
    _from_m: float = 0.0
    _to_m: float = 0.0

    def update(self, t: float, segment: Segment, force_n: float) -> float:
        """Height at time t, given the segment of the plan and the vertical contact force now."""
        if not segment.anchoring:
            if t > 0.0 and not self._planned:
                self.height_m = self.plan_travel(segment.from_m, force_n)
            return self.height_m
        moving_until = segment.end_s - segment.rest_s
        if t <= moving_until:
            self._planned = False
            if self.spec.anchor_guard:
                aim = self.spec.anchor_force_n if segment.start_s == 0.0 else self.spec.preload_n
                low, high = (b * aim for b in _BAND)
                self.height_m += _GAIN * (max(force_n - high, 0.0) - max(low - force_n, 0.0))
            return self.height_m
        if not self._planned:
            self.plan_travel(segment.from_m, force_n)
        u = (t - moving_until) / segment.rest_s
        self.height_m = self._from_m + (self._to_m - self._from_m) * u * u * (3.0 - 2.0 * u)
        return self.height_m

    def plan_travel(self, travelled_m: float, force_n: float) -> float:
        """Height of the travel: from the force now to the preload, and out of the pit if that is where it starts."""
        self._planned, self._from_m = True, self.height_m
        climb = self.pit_depth_m if travelled_m == 0.0 else 0.0
        self._to_m = self.height_m + climb + (force_n - self.spec.preload_n) / self.stiffness
        return self._to_m
