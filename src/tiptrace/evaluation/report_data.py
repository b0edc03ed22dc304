"""What a trial report shows: plain arrays, filled by whoever ran the trial; what is missing is left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from tiptrace.evaluation.truth import StampArray, Truth
from tiptrace.types import BoolArray, FloatArray, Image, Side, TipTrajectory


@dataclass(frozen=True, slots=True)
class MethodResult:
    """Trajectory of one method, with the name that the tables show."""

    name: str
    trajectory: TipTrajectory


@dataclass(frozen=True, slots=True)
class TactileView:
    """One finger at the first and the last pair.

    Attributes:
        side: Finger.
        first_image: (h, w, 3) BGR at frame 0.
        last_image: (h, w, 3) BGR at the last pair.
        uv_first_px: (n, 2) markers at frame 0.
        uv_last_px: (n, 2) the same markers at the last pair, NaN where lost.
        selected: (n,) markers that the fit uses.
        depth_first_mm: (h, w) indentation at frame 0, positive = pressed in.
        depth_last_mm: (h, w) at the last pair.
    """

    side: Side
    first_image: Image
    last_image: Image
    uv_first_px: FloatArray | None = None
    uv_last_px: FloatArray | None = None
    selected: BoolArray | None = None
    depth_first_mm: FloatArray | None = None
    depth_last_mm: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class AnchoringFit:
    """Stage I of the first method.

    Attributes:
        stamps_ns: (n,) instants of the anchoring frames.
        residual_mm: (n,) ‖(I − R_t) p̂ − d_t‖ with the final p̂.
    """

    stamps_ns: StampArray
    residual_mm: FloatArray


@dataclass(frozen=True, slots=True)
class ReportData:
    """A trial as its report shows it. Only one method's trajectory is required.

    Attributes:
        title: What was traced, in a few words.
        methods: Results, the main one first: events, anchoring and loop times shown are its own.
        truth: True tip.
        tactile: Fingers at the first and last pair.
        anchoring: Residuals of Stage I.
        step_ms: Time of each step in each pair, ms, by the step's name in order of execution.
        settings: What the trial and the methods were set to, as text.
        versions: Version of each library that had a part in it.
        command: Command that reproduces the report.
        source: Recording that it came from.
        notes: Sentences that a reader should know.
    """

    title: str
    methods: tuple[MethodResult, ...]
    truth: Truth | None = None
    tactile: tuple[TactileView, ...] = ()
    anchoring: AnchoringFit | None = None
    step_ms: Mapping[str, FloatArray] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    command: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()

    @property
    def main(self) -> MethodResult:
        """The method that the report is about."""
        return self.methods[0]

    @property
    def start_ns(self) -> int:
        """Instant that time axes count from."""
        return self.main.trajectory.estimates[0].stamp_ns if self.main.trajectory.estimates else 0
