"""Records that cross module borders: what streams deliver, what the tracer returns.

Units are SI, times integer nanoseconds. Frames are named by suffix: ``x_S`` in the sensor frame, ``p_B`` in
the robot base; ``T_B_E`` maps E coordinates to B. See ``docs/conventions.md``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from tiptrace.config import Rig, Tool

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]
Image = NDArray[np.uint8]  # (height, width, 3), BGR as OpenCV has it

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")


class Phase(StrEnum):
    """Segment of a trial (paper: A, R)."""

    ANCHORING = "anchoring"
    RECONSTRUCTION = "reconstruction"
    END = "end"


class Status(StrEnum):
    """What an estimate is worth; see the recording format in ``docs/data.md``."""

    ANCHORING = "anchoring"
    OK = "ok"
    DEGRADED = "degraded"
    NO_CONTACT = "no-contact"
    LOST = "lost"
    RELATIVE = "relative"
    UNOBSERVABLE = "unobservable"


# --- samples: what a stream delivers, in any order ---------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ImageSample:
    """One tactile image as captured."""

    side: Side
    stamp_ns: int
    image: Image


@dataclass(frozen=True, slots=True)
class MarkerSample:
    """Markers of one finger measured in 3-D, in place of an image (Monte Carlo, other sensors).

    Attributes:
        side: Finger.
        stamp_ns: Capture time.
        x_S: (n, 3) positions in F_S, m; row = marker identity, NaN where the marker was not seen.
    """

    side: Side
    stamp_ns: int
    x_S: FloatArray


@dataclass(frozen=True, slots=True)
class PoseSample:
    """End-effector pose T_B_E, (4, 4)."""

    stamp_ns: int
    T_B_E: FloatArray


@dataclass(frozen=True, slots=True)
class PhaseSample:
    """From this instant on the trial is in ``phase``."""

    stamp_ns: int
    phase: Phase


@dataclass(frozen=True, slots=True)
class OpeningSample:
    """Distance between the two undeformed gel surfaces, m."""

    stamp_ns: int
    opening_m: float


@dataclass(frozen=True, slots=True)
class TruthSample:
    """True tip (centre of its sphere) in the base frame, (3,) m."""

    stamp_ns: int
    p_B: FloatArray


TactileSample = ImageSample | MarkerSample
Sample = TactileSample | PoseSample | PhaseSample | OpeningSample | TruthSample


class Stream(Protocol):
    """A trial as it comes in: recording, simulation or hardware.

    Samples of one kind may be out of order by a bounded delay; kinds interleave freely.
    """

    @property
    def rig(self) -> Rig:
        """What the user believes about the rig."""
        ...

    @property
    def tool(self) -> Tool | None:
        """What is known of the tool, if anything."""
        ...

    @property
    def references(self) -> dict[Side, Image]:
        """Images of the untouched gels; a side without one is missing."""
        ...

    @property
    def gel_models(self) -> dict[str, bytes]:
        """ONNX files that travel with the stream, by the name under which the rig mentions them."""
        ...

    def __iter__(self) -> Iterator[Sample]:
        """Deliver the samples."""
        ...


# --- observations: what the tracer consumes ----------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FingerObservation:
    """One side of a pair: the sample and T_B_E interpolated at its own exposure, (4, 4)."""

    sample: TactileSample
    T_B_E: FloatArray


@dataclass(frozen=True, slots=True)
class Observation:
    """A synchronised pair.

    Attributes:
        stamp_ns: Mean of the two capture stamps.
        left: Left finger.
        right: Right finger.
        phase: Segment that the pair belongs to; None where the stream has no phase marks.
        opening_m: Gripper opening, where a topic tells it.
        poses: Pose samples since the previous pair, in order, for estimators that model latency.
    """

    stamp_ns: int
    left: FingerObservation
    right: FingerObservation
    phase: Phase | None = None
    opening_m: float | None = None
    poses: tuple[PoseSample, ...] = ()

    def finger(self, side: Side) -> FingerObservation:
        """One side."""
        return self.left if side == "left" else self.right


# --- estimates: what the tracer returns --------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FingerMarkers:
    """Markers of one finger lifted to 3-D.

    Attributes:
        x_S: (n, 3) in F_S, m; rows keep their identity for the whole trial.
        tracked: (n,) False where the marker is lost in this frame (its row is then NaN).
        uv_px: (n, 2) image position, NaN where lost; None where there is no image.
        depth_sigma_m: (n,) standard deviation of the depth, where the chain gives one.
        doubtful: Whether markers leapt, as in a pause, and it is not certain which is which since.
    """

    x_S: FloatArray
    tracked: BoolArray
    uv_px: FloatArray | None = None
    depth_sigma_m: FloatArray | None = None
    doubtful: bool = False


@dataclass(frozen=True, slots=True)
class SensedFinger:
    """Markers of one finger and where its sensor was at the exposure.

    Attributes:
        markers: Lifted markers.
        T_B_E: (4, 4) end-effector pose at this side's exposure.
        T_E_S: (4, 4) sensor pose in F_E at the current gripper opening.
    """

    markers: FingerMarkers
    T_B_E: FloatArray
    T_E_S: FloatArray


@dataclass(frozen=True, slots=True)
class SensedPair:
    """What an estimator sees of a pair: markers and poses, no images.

    Attributes:
        stamp_ns: Mean of the two capture stamps.
        phase: Segment, None where unknown.
        left: Left finger.
        right: Right finger.
        poses: Pose samples since the previous pair, in order.
    """

    stamp_ns: int
    phase: Phase | None
    left: SensedFinger
    right: SensedFinger
    poses: tuple[PoseSample, ...] = ()

    def finger(self, side: Side) -> SensedFinger:
        """One side."""
        return self.left if side == "left" else self.right


@dataclass(frozen=True, slots=True)
class AnchorChecks:
    """What a trial says of its own anchor, without any ground truth.

    Attributes:
        residual_m: Root mean square residual of Stage I.
        held_out_m: The same in frames predicted from the others.
        halves_m: Distance between the anchors of Stage I's two halves.
        halves_sigma: The same over what their covariances predict, root mean square per axis.
        prior_sigma: The anchor against the tip of the tool's file, likewise; None without one.
        in_grasp_m: Root mean square distance of the trace from the end effector's with a constant tip.
        closure_m: How far off the trace was where the tip was anchored anew; None where it never was.
    """

    residual_m: float
    held_out_m: float
    halves_m: float
    halves_sigma: float
    prior_sigma: float | None = None
    in_grasp_m: float | None = None
    closure_m: float | None = None


@dataclass(frozen=True, slots=True)
class Anchor:
    """Stage I: where the resting tip is.

    Attributes:
        p_B: (3,) tip in the base frame, m.
        covariance: (3, 3) m², None where the method gives none.
        residual_m: Root mean square of the fixed-point residuals.
        frames: Anchoring frames used.
        weak_axes: Unit directions in which the data do not determine the tip, (3,) each.
        checks: What the trial says of the anchor; None where the method does not look.
    """

    p_B: FloatArray
    covariance: FloatArray | None
    residual_m: float
    frames: int
    weak_axes: tuple[FloatArray, ...] = ()
    checks: AnchorChecks | None = None


@dataclass(frozen=True, slots=True)
class TipEstimate:
    """The tip at one pair. ``p_B`` is None where no position can be claimed, never stale.

    Attributes:
        stamp_ns: Instant that the position belongs to (capture minus the latency in use).
        phase: Segment.
        status: What the estimate is worth.
        p_B: (3,) tip in the base frame, m.
        R_B_E: (3, 3) tool orientation, R_t R_B_E(0), as in the TUM file.
        covariance: (3, 3) m² of p_B.
        residual_m: Root mean square residual of the rigid fit.
        markers: Markers used in the fit, both fingers.
        loop_ms: Time spent on this pair, acquisition or decoding included; filled in by the pipeline.
    """

    stamp_ns: int
    phase: Phase | None
    status: Status
    p_B: FloatArray | None = None
    R_B_E: FloatArray | None = None
    covariance: FloatArray | None = None
    residual_m: float | None = None
    markers: int = 0
    loop_ms: float | None = None


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a user should know about an interval of the trial."""

    kind: str
    start_ns: int
    end_ns: int
    detail: str


@dataclass(slots=True)
class TipTrajectory:
    """Estimates in order, with the events and the anchor."""

    estimates: list[TipEstimate] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    anchor: Anchor | None = None

    def append(self, estimate: TipEstimate) -> None:
        """Add the next estimate."""
        self.estimates.append(estimate)

    def __len__(self) -> int:
        return len(self.estimates)
