"""The baseline that the paper left out: no tactile sensing in Stage II, the tip constant in F_E."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

from tiptrace.geometry.transforms import apply, invert
from tiptrace.types import Anchor, Event, FloatArray, Phase, SensedPair, Status, TipEstimate


class Estimator(Protocol):
    """Marker pairs in, tip estimates out: one pass, constant cost, causal."""

    events: list[Event]

    @property
    def anchor(self) -> Anchor | None:
        """Stage I result, None before there is one."""
        ...

    def update(self, pair: SensedPair) -> TipEstimate:
        """Process the next pair."""
        ...


class EeOnlyEstimator:
    """End-effector pose with the tip constant in F_E, from another estimator's anchor (``--method ee-only``).

    The constant is fixed where Stage I ends: ``c = T_B_E(τ_cal)⁻¹ p̂_B(0)``, so that the trace starts at the
    anchor; then ``p_B(t) = T_B_E(t) c``.
    """

    def __init__(self, anchoring: Estimator) -> None:
        self._anchoring = anchoring
        self._c_E: FloatArray | None = None
        self._T_B_E_cal: FloatArray | None = None

    @property
    def anchor(self) -> Anchor | None:
        """The other estimator's anchor."""
        return self._anchoring.anchor

    @property
    def events(self) -> list[Event]:
        """The other estimator's events."""
        return self._anchoring.events

    @events.setter
    def events(self, events: list[Event]) -> None:
        self._anchoring.events = events

    def update(self, pair: SensedPair) -> TipEstimate:
        """Anchor as the other estimator does, then follow the end effector."""
        if pair.phase in (None, Phase.ANCHORING):
            self._T_B_E_cal = pair.left.T_B_E
            return self._anchoring.update(pair)
        if self._c_E is None:
            first = self._anchoring.update(pair)
            if self.anchor is None or self._T_B_E_cal is None:
                return first
            self._c_E = apply(invert(self._T_B_E_cal), self.anchor.p_B)
        estimate = TipEstimate(pair.stamp_ns, pair.phase, Status.OK)
        return replace(estimate, p_B=apply(pair.left.T_B_E, self._c_E), R_B_E=pair.left.T_B_E[:3, :3])
