"""What a camera and a robot are to the rest: small protocols, plain records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from types import TracebackType
from typing import Protocol, Self

from tiptrace.types import Image, OpeningSample, PhaseSample, PoseSample

RobotSample = PoseSample | OpeningSample | PhaseSample
Wake = Callable[[], None]


class DeviceStatus(StrEnum):
    """What a device delivers at this moment."""

    OK = "ok"
    STARTING = "starting"
    STALE = "stale"  # connected, nothing new for longer than its period explains
    REPEATED = "repeated"  # delivers a frame that it has delivered before
    FROZEN = "frozen"  # does so again and again
    LATE = "late"  # frames older than a live estimate can use, or out of order
    GARBLED = "garbled"  # cut off or damaged frames
    LOST = "lost"  # disconnected; being reconnected
    ENDED = "ended"  # a file came to its end


@dataclass(frozen=True, slots=True)
class Frame:
    """A new, whole image of a camera.

    Attributes:
        stamp_ns: Capture, as close to the exposure as the source allows.
        arrived_ns: When its last byte was here.
        image: (height, width, 3) BGR, cropped and resized as the rig says.
        jpeg: The very bytes that decode to ``image``, for a recorder; None if none was asked for.
        after: Why frames between this one and the one before were left out (a :class:`DeviceStatus`); empty where
            none were.
        settled: Whether the camera's clock has been followed for long enough to trust ``stamp_ns`` to a millisecond or
            two; False for a while after a connection or a clock that was set.
    """

    stamp_ns: int
    arrived_ns: int
    image: Image
    jpeg: bytes | None = None
    after: str = ""
    settled: bool = True


@dataclass(frozen=True, slots=True)
class DeviceHealth:
    """State of a device, cheap to ask for at any time from any thread.

    Attributes:
        name: As a user knows it.
        status: At this moment.
        detail: One sentence where the status is not ok, else empty.
        count: New samples delivered.
        rate_hz: Over the last seconds; None before there are two.
        jitter_ms: Standard deviation of the time between samples.
        age_s: Since the last new sample; None before the first.
        faults: How often each fault was seen: ``repeated``, ``late``, ``garbled``, ``lost``, ``dropped`` (the queue
            was full), ``clock-jump``.
    """

    name: str
    status: DeviceStatus
    detail: str = ""
    count: int = 0
    rate_hz: float | None = None
    jitter_ms: float | None = None
    age_s: float | None = None
    faults: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True, slots=True)
class PoseFrames:
    """What a robot's pose means; None where it does not say.

    Attributes:
        base: Frame that the pose is given in.
        end_effector: Frame whose pose it is.
    """

    base: str | None = None
    end_effector: str | None = None


FrameTap = Callable[[Frame], None]
"""Sees each new frame at once, in the camera's thread, however late the loop takes it."""

RobotTap = Callable[[RobotSample, int], None]
"""The same for a robot's samples, with the instant of their arrival, ns."""


class Camera(Protocol):
    """Delivers new frames; what is not new is counted and told, never delivered."""

    def start(self, wake: Wake, tap: FrameTap | None = None) -> None:
        """Connect and begin; returns when the first frame is here. ``wake`` is called when there is something.

        Raises:
            DeviceError: missing, busy, of another size than asked for, silent.
        """
        ...

    def take(self) -> list[Frame]:
        """Frames since the last call, oldest first."""
        ...

    def health(self) -> DeviceHealth:
        """State at this moment."""
        ...

    def close(self) -> None:
        """Stop and release the device."""
        ...


class Robot(Protocol):
    """Delivers poses, and perhaps openings and phase marks."""

    @property
    def frames(self) -> PoseFrames:
        """What the pose means, as far as known by now."""
        ...

    def start(self, wake: Wake, tap: RobotTap | None = None) -> None:
        """Connect and begin; returns when the first pose is here.

        Raises:
            DeviceError: unreachable, or silent.
        """
        ...

    def take(self) -> list[RobotSample]:
        """Samples since the last call, oldest first."""
        ...

    def health(self) -> DeviceHealth:
        """State at this moment; ``ended`` where a replay is over."""
        ...

    def close(self) -> None:
        """Stop and release the device."""
        ...


class Closing:
    """Mix-in: a device is a context manager."""

    def close(self) -> None:
        """Release the device."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
