"""What a report shows of a trial while it runs: step times, first and last pair, Stage I's motions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tiptrace.estimation.full import FullEstimator
from tiptrace.estimation.paper import PaperEstimator
from tiptrace.evaluation.report_data import AnchoringFit, TactileView
from tiptrace.frames import FrameWatch
from tiptrace.pipeline import Step
from tiptrace.tracer import TipTracer
from tiptrace.types import SIDES, BoolArray, FloatArray, ImageSample, IntArray, Phase, SensedPair, Side


@dataclass
class TrialWatch:
    """Watches a trial's loop for its report; see :func:`tiptrace.pipeline.trace`.

    Attributes:
        on_pair: Called with the number of pairs done.
        keep_pairs: Whether further methods will run over the sensed pairs.
        keep_images: Whether the report is to show depth.
        on_step: Called with each turn of the loop.
        tracer: Whose state is looked at; set before the first pair.
        times_ms: A turn's times, as in :data:`tiptrace.pipeline.STEPS`.
        pairs: Sensed pairs, where kept.
        frames: Capture stamps.
        marked: Whether any pair had a phase.
    """

    on_pair: Callable[[int], None] | None
    keep_pairs: bool
    keep_images: bool
    on_step: Callable[[Step], None] | None = None
    tracer: TipTracer | None = None
    times_ms: list[tuple[float, float, float]] = field(default_factory=list)
    pairs: list[SensedPair] = field(default_factory=list)
    frames: FrameWatch = field(default_factory=FrameWatch)
    marked: bool = False
    _first: tuple[Step, dict[Side, FloatArray | None]] | None = None
    _last: Step | None = None
    _motions: list[tuple[int, FloatArray, FloatArray]] = field(default_factory=list)

    def show(self, step: Step) -> None:
        """Keep what the report needs of a pair."""
        self.times_ms.append(step.times_ms)
        self.frames.show(step)
        self.marked |= step.observation.phase is not None
        if self.keep_pairs:
            self.pairs.append(step.sensed)
        if self._first is None and step.estimate.markers:
            self._first = (step, {side: self._depth_mm(side) for side in SIDES})
        self._last = step
        self._keep_motion(step)
        if self.on_pair is not None:
            self.on_pair(len(self.times_ms))
        if self.on_step is not None:
            self.on_step(step)

    def _keep_motion(self, step: Step) -> None:
        assert self.tracer is not None
        estimator = self.tracer.estimator
        if isinstance(estimator, PaperEstimator) and step.estimate.phase is Phase.ANCHORING:
            motion = estimator.motion
            if motion is not None:
                self._motions.append((step.estimate.stamp_ns, motion.R, motion.d))

    def _depth_mm(self, side: Side) -> FloatArray | None:
        assert self.tracer is not None
        finger = self.tracer.sensing.fingers.get(side)
        if not self.keep_images or finger is None or finger.depth_m is None:
            return None
        return finger.depth_m.astype(np.float64) * 1e3

    def tactile(self) -> tuple[TactileView, ...]:
        """Both fingers at the first and last pair; empty for streams without images."""
        if self._first is None or self._last is None:
            return ()
        first, depth_first = self._first
        views = []
        for side in SIDES:
            start, end = first.observation.finger(side).sample, self._last.observation.finger(side).sample
            if not isinstance(start, ImageSample) or not isinstance(end, ImageSample):
                return ()
            uv_first = first.sensed.finger(side).markers.uv_px
            views.append(
                TactileView(
                    side=side,
                    first_image=start.image,
                    last_image=end.image,
                    uv_first_px=uv_first,
                    uv_last_px=self._last.sensed.finger(side).markers.uv_px,
                    selected=self._selected(side, 0 if uv_first is None else len(uv_first)),
                    depth_first_mm=depth_first[side],
                    depth_last_mm=self._depth_mm(side),
                )
            )
        return tuple(views)

    def _selected(self, side: Side, count: int) -> BoolArray | None:
        assert self.tracer is not None
        estimator = self.tracer.estimator
        chosen: dict[Side, IntArray] = {}
        if isinstance(estimator, PaperEstimator):
            chosen = estimator.chosen
        elif isinstance(estimator, FullEstimator) and estimator.anchoring is not None:
            chosen = estimator.anchoring.chosen
        return np.isin(np.arange(count), chosen[side]) if chosen else None

    def anchoring(self) -> AnchoringFit | None:
        """Residuals of Stage I with the final anchor."""
        anchor = self.tracer.anchor if self.tracer else None
        if anchor is None or not self._motions:
            return None
        stamps, R, d = (np.asarray(values) for values in zip(*self._motions, strict=True))
        rows = anchor.p_B - R @ anchor.p_B - d  # (n, 3) (I − R_t) p̂ − d_t
        return AnchoringFit(stamps.astype(np.int64), np.linalg.norm(rows, axis=1) * 1e3)
