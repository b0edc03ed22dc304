"""Turns of the loop as snapshots, for viewers of recordings; a live session makes its own."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from tiptrace.pipeline import Step
from tiptrace.snapshot import FingerView, Snapshot
from tiptrace.tracer import TipTracer
from tiptrace.types import SIDES, FloatArray, ImageSample, Side

_RATE_MEMORY_S = 3.0


class SnapshotViewer:
    """A viewer of the loop (``pipeline.Viewer``) that hands snapshots on.

    Args:
        tracer: For its events.
        show: Takes each snapshot.
        pace: Speed of the replay: 1 is real time; None as fast as it goes.
    """

    def __init__(
        self, tracer: TipTracer, show: Callable[[Snapshot], None], pace: float | None = None
    ) -> None:
        self._tracer, self._show, self._pace = tracer, show, pace
        self._uv_start: dict[Side, FloatArray | None] = {}
        self._shown: deque[float] = deque()
        self._began: tuple[float, int] | None = None

    def show(self, step: Step) -> None:
        """Wait until the pair is due, then show it."""
        self._wait(step.estimate.stamp_ns)
        left, right = (self._finger(step, side) for side in SIDES)
        self._show(
            Snapshot(
                estimate=step.estimate,
                left=left,
                right=right,
                T_B_E=step.observation.left.T_B_E,
                rate_hz=self._rate_hz(),
                events=tuple(self._tracer.events[-50:]),
            )
        )

    def _finger(self, step: Step, side: Side) -> FingerView:
        sample, uv_px = step.observation.finger(side).sample, step.sensed.finger(side).markers.uv_px
        start = self._uv_start.setdefault(side, uv_px)
        return FingerView(sample.image if isinstance(sample, ImageSample) else None, uv_px, start)

    def _wait(self, stamp_ns: int) -> None:
        if self._pace is None:
            return
        if self._began is None:
            self._began = (time.monotonic(), stamp_ns)
        due = self._began[0] + (stamp_ns - self._began[1]) * 1e-9 / self._pace
        time.sleep(max(0.0, due - time.monotonic()))

    def _rate_hz(self) -> float | None:
        now = time.monotonic()
        self._shown.append(now)
        while now - self._shown[0] > _RATE_MEMORY_S:
            self._shown.popleft()
        return (len(self._shown) - 1) / (now - self._shown[0]) if len(self._shown) > 2 else None
