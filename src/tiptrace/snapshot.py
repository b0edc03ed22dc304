"""What a viewer is shown of a running trial."""

from __future__ import annotations

from dataclasses import dataclass

from tiptrace.types import Event, FloatArray, Image, Side, TipEstimate


@dataclass(frozen=True, slots=True)
class FingerView:
    """One finger as a viewer shows it.

    Attributes:
        image: (height, width, 3) BGR; None where the stream has no images.
        uv_px: (n, 2) markers now, NaN where lost.
        uv_start_px: (n, 2) the same markers in the first pair, for the arrows.
    """

    image: Image | None = None
    uv_px: FloatArray | None = None
    uv_start_px: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of a trial at one pair, for whoever watches: plain, immutable, safe to hand to another thread.

    Attributes:
        estimate: Tip, covariance, status, phase, residual, stamp.
        left: Left finger.
        right: Right finger.
        T_B_E: (4, 4) end-effector pose.
        rate_hz: Pairs per second, over the last seconds.
        latency_ms: From the later image's arrival to the estimate; None where nothing arrives live.
        events: Of the trial so far, or the latest of them, in order.
        advice: What the user should do now: which motion Stage I still needs, or that it is enough.
        notes: What is wrong with the sources at this moment, a sentence each.
    """

    estimate: TipEstimate
    left: FingerView = FingerView()
    right: FingerView = FingerView()
    T_B_E: FloatArray | None = None
    rate_hz: float | None = None
    latency_ms: float | None = None
    events: tuple[Event, ...] = ()
    advice: str = ""
    notes: tuple[str, ...] = ()

    def finger(self, side: Side) -> FingerView:
        """One side."""
        return self.left if side == "left" else self.right
