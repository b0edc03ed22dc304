"""What a viewer is shown of a turn of the loop."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from tiptrace.pipeline import Step
from tiptrace.snapshot import FingerView, Snapshot
from tiptrace.types import SIDES, Event, FloatArray, ImageSample, Side

_RATE_WINDOW = 64
_RATE_MEMORY_S = 3.0


class Views:
    """Makes a snapshot of a turn of the loop."""

    def __init__(self) -> None:
        self._start: dict[Side, FloatArray | None] = {}
        self._times: deque[float] = deque(maxlen=_RATE_WINDOW)

    def snapshot(
        self,
        step: Step,
        latency_ms: float | None,
        events: tuple[Event, ...],
        advice: str,
        notes: tuple[str, ...],
    ) -> Snapshot:
        """What a viewer is shown of it."""
        fingers: dict[str, Any] = {side: self._finger(step, side) for side in SIDES}
        return Snapshot(
            estimate=step.estimate,
            T_B_E=step.observation.left.T_B_E,
            rate_hz=self._rate_hz(),
            latency_ms=latency_ms,
            events=events,
            advice=advice,
            notes=notes,
            **fingers,
        )

    def _finger(self, step: Step, side: Side) -> FingerView:
        sample, uv_px = step.observation.finger(side).sample, step.sensed.finger(side).markers.uv_px
        start = self._start.setdefault(side, uv_px)
        image = sample.image if isinstance(sample, ImageSample) else None
        return FingerView(image, uv_px, start)

    def _rate_hz(self) -> float | None:
        now = time.monotonic()
        self._times.append(now)
        while now - self._times[0] > _RATE_MEMORY_S:
            self._times.popleft()
        if len(self._times) < 2:
            return None
        return (len(self._times) - 1) / (self._times[-1] - self._times[0])
