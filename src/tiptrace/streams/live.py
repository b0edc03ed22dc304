"""Two cameras and a robot as a stream, like a recording or a simulation."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from types import TracebackType
from typing import Protocol, Self

from tiptrace.config import Frames, Rig, Tool
from tiptrace.drivers.base import Camera, DeviceHealth, DeviceStatus, Frame, PoseFrames, Robot, RobotSample
from tiptrace.drivers.timeline import Timeline
from tiptrace.errors import ConfigError
from tiptrace.streams.synchronise import LIVE, SyncSettings
from tiptrace.types import SIDES, Image, ImageSample, OpeningSample, Phase, PhaseSample, Sample, Side

_IDLE_S = 0.2
_ALIKE = 0.6  # of the rates of two cameras of one kind
_LOOK_S = 0.05  # between two looks at the devices' states
_WARM_UP_S, _WARM_UP_FRAMES = 2.0, 8
_SPACING_SHARE = 0.85  # of the measured period between frames: closer ones do not come
_ARRIVALS = 256
_ENDED_GRACE_S = 0.5
_POSE_WAKE_S = 0.004  # no arm's pose is worth a wake-up of its own …
_AWAITED_S = 0.02  # … but for so long after an image, which may wait for it


@dataclass(frozen=True, slots=True)
class Arrival:
    """How an image came.

    Attributes:
        arrived_ns: When its last byte was here.
        after: As in :class:`~tiptrace.drivers.base.Frame`.
        settled: Likewise.
    """

    arrived_ns: int
    after: str
    settled: bool


class Tap(Protocol):
    """Sees every sample as it arrives, in the device's thread, even those that a busy loop has to skip."""

    def __call__(self, sample: Sample, log_time_ns: int, jpeg: bytes | None) -> None:
        """Take a sample, when it arrived, and an image's bytes."""
        ...


class LiveStream:
    """Implements ``types.Stream``; a context manager that opens and closes the devices.

    Args:
        rig: What the user believes about the rig.
        cameras: One per finger, not yet started.
        robot: Not yet started.
        timeline: The one that the devices stamp by.
        tool: What is known of the tool.
        references: Images of the untouched gels.
        gel_models: ONNX files by the names under which the rig mentions them.
        standby: Deliver nothing before the first phase mark.

    Attributes:
        settings: Limits of synchronisation that suit these cameras; final after entering.
        period_s: Measured time between a camera's frames, the longer of both, after entering; None if it is not known.
        first_images: An image of each finger, after entering.
        tap: Sees every sample as it arrives, as a recorder does, from :meth:`begin` on.
        on_idle: Called several times a second from the loop.
        on_phase: Takes the phase marks that come with the robot's topics; without it they are delivered as they are.
    """

    def __init__(
        self,
        rig: Rig,
        cameras: Mapping[Side, Camera],
        robot: Robot,
        timeline: Timeline,
        *,
        tool: Tool | None = None,
        references: Mapping[Side, Image] | None = None,
        gel_models: Mapping[str, bytes] | None = None,
        standby: bool = False,
    ) -> None:
        self.rig, self.tool, self.timeline = rig, tool, timeline
        self.references: dict[Side, Image] = dict(references or {})
        self.gel_models: dict[str, bytes] = dict(gel_models or {})
        self.settings: SyncSettings = LIVE
        self.period_s: float | None = None
        self.first_images: dict[Side, Image] = {}
        self.standby = standby
        self.tap: Tap | None = None
        self.on_idle: Callable[[], None] | None = None
        self.on_phase: Callable[[Phase], None] | None = None
        self._cameras, self._robot = dict(cameras), robot
        self._wake, self._stop = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self._marks: list[PhaseSample] = []
        self._begin_ns: int | None = None
        self._arrived: OrderedDict[tuple[Side, int], Arrival] = OrderedDict()
        self._devices = ExitStack()
        self._woken_s = self._image_s = 0.0

    # --- opening and closing -------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        """Start the devices and measure the cameras' rate.

        Raises:
            DeviceError: one of them is missing, busy or silent.
            ConfigError: the robot's pose is not what the rig file means.
        """
        with ExitStack() as opened:
            check_frames(self._robot.frames, self.rig.frames)
            opened.callback(self._robot.close)
            self._robot.start(self._robot_came, self._tap_robot)
            for side in SIDES:
                opened.callback(self._cameras[side].close)
                self._cameras[side].start(self._wake.set, partial(self._tap_frame, side))
            self._warm_up()
            check_frames(self._robot.frames, self.rig.frames)
            self._devices = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        self._devices.close()

    def _warm_up(self) -> None:
        """Keep an image of each finger, learn the time between frames, and drop what waited."""
        end = time.monotonic() + _WARM_UP_S
        while time.monotonic() < end:
            for side in SIDES:
                for frame in self._cameras[side].take():
                    self.first_images[side] = frame.image
            if all(self._cameras[side].health().count >= _WARM_UP_FRAMES for side in SIDES):
                break
            time.sleep(0.02)
        rates = [self._cameras[side].health().rate_hz for side in SIDES]
        known = [rate for rate in rates if rate is not None]
        if len(known) == 2:
            alike = min(known) > _ALIKE * max(known)  # else a lost frame made one of them look slower
            self.period_s = 1.0 / (max(known) if alike else min(known))
            self.settings = replace(LIVE, min_frame_spacing_s=_SPACING_SHARE / max(known))

    def forget(self) -> None:
        """Drop the images that wait: while a trial is prepared nobody takes them, and full queues count as faults."""
        for camera in self._cameras.values():
            camera.take()

    def begin(self) -> None:
        """From now on samples count; what was stamped before is neither delivered nor shown to the tap."""
        self._begin_ns = self.timeline.now_ns()

    # --- control, from any thread --------------------------------------------------------------------------

    def stop(self) -> None:
        """End the stream; samples already here are still delivered."""
        self._stop.set()
        self._wake.set()

    def mark(self, phase: Phase) -> None:
        """From now on the trial is in ``phase``."""
        sample = PhaseSample(self.timeline.now_ns(), phase)
        with self._lock:
            self._marks.append(sample)
            if self.standby:
                self.standby, self._begin_ns = False, sample.stamp_ns
        self._tap(sample, sample.stamp_ns, None)
        self._wake.set()

    def health(self) -> dict[str, DeviceHealth]:
        """State of ``left``, ``right`` and ``robot``."""
        found = {str(side): camera.health() for side, camera in self._cameras.items()}
        return {**found, "robot": self._robot.health()}

    def arrival(self, side: Side, stamp_ns: int) -> Arrival | None:
        """How an image came; known for the last few seconds."""
        return self._arrived.get((side, stamp_ns))

    # --- the stream ----------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Sample]:
        """Deliver samples as they come, until :meth:`stop` or the end of a replay.

        Raises:
            DeviceError: a device that is no longer what it was at the start.
            ConfigError: a pose that is no longer what the rig file means.
        """
        if self._begin_ns is None:
            self.begin()
        ended_at: float | None = None
        looked_at = 0.0
        while True:
            stopping = self._stop.is_set()
            if not stopping:
                self._wake.wait(_IDLE_S)
                self._wake.clear()
            for sample in self._gather():
                if self._counts(sample):
                    yield sample
            if stopping:
                return
            now = time.monotonic()
            if now - looked_at < _LOOK_S:
                continue
            looked_at = now
            if self.on_idle is not None:
                self.on_idle()
            if self._ended():
                ended_at = ended_at or now
                if now - ended_at > _ENDED_GRACE_S:
                    return

    def _robot_came(self) -> None:
        """In the robot's thread: wake the loop, if it is worth it."""
        now = time.monotonic()
        if now - self._woken_s > _POSE_WAKE_S or now - self._image_s < _AWAITED_S:
            self._woken_s = now
            self._wake.set()

    def _gather(self) -> list[Sample]:
        """What has come, in the order of arrival, so that a busy loop finds each image among its own poses."""
        found: list[tuple[int, Sample]] = []
        for side in SIDES:
            for frame in self._cameras[side].take():
                self._image_s = time.monotonic()
                self._arrived[side, frame.stamp_ns] = Arrival(frame.arrived_ns, frame.after, frame.settled)
                found.append((frame.arrived_ns, ImageSample(side, frame.stamp_ns, frame.image)))
        for sample in self._robot.take():
            if isinstance(sample, PhaseSample):
                (self.on_phase or self.mark)(sample.phase)
            else:
                found.append((sample.stamp_ns, sample))
        check_frames(self._robot.frames, self.rig.frames)
        with self._lock:
            marks, self._marks = self._marks, []
        while len(self._arrived) > _ARRIVALS:
            self._arrived.popitem(last=False)
        return [*marks, *(sample for _, sample in sorted(found, key=itemgetter(0)))]

    def _counts(self, sample: Sample) -> bool:
        if self.standby:
            return False
        early = self._begin_ns is None or sample.stamp_ns < self._begin_ns
        return isinstance(sample, PhaseSample) or not early  # a mark holds from before the first image

    def _tap(self, sample: Sample, log_time_ns: int, jpeg: bytes | None) -> None:
        if self.tap is not None and self._counts(sample):
            self.tap(sample, log_time_ns, jpeg)

    def _tap_frame(self, side: Side, frame: Frame) -> None:
        """Logged at the image's arrival: a machine that then takes its time with it makes no clocks differ."""
        self._tap(ImageSample(side, frame.stamp_ns, frame.image), frame.arrived_ns, frame.jpeg)

    def _tap_robot(self, sample: RobotSample, arrived_ns: int) -> None:
        """Phase marks come back through :meth:`mark`; openings are dated by their log time, here as offline."""
        if isinstance(sample, PhaseSample | OpeningSample):
            self._woken_s = 0.0  # worth a wake-up
        if not isinstance(sample, PhaseSample):
            self._tap(sample, sample.stamp_ns if isinstance(sample, OpeningSample) else arrived_ns, None)

    def _ended(self) -> bool:
        return any(health.status is DeviceStatus.ENDED for health in self.health().values())


def check_frames(pose: PoseFrames, rig: Frames) -> None:
    """The robot's pose must be the one that the rig file means.

    Raises:
        ConfigError: another base, or the pose of another frame.
    """
    if pose.base is not None and pose.base.strip("/") != rig.base.strip("/"):
        turned = {pose.base.strip("/"), rig.base.strip("/")} == {"base", "base_link"}
        raise ConfigError(
            f"the robot's pose is given in {pose.base!r}, frames.base of the rig file is {rig.base!r}"
            + (", which is turned by 180° about z" if turned else "")
            + ": correct the rig file, or publish the pose that it means"
        )
    if pose.end_effector is not None and pose.end_effector.strip("/") != rig.end_effector.strip("/"):
        raise ConfigError(
            f"the robot's pose is that of {pose.end_effector!r}, frames.end_effector of the rig file is "
            f"{rig.end_effector!r}: T_E_S belongs to one of them; "
            + (
                "make sure that T_E_S is given in the TCP frame that is active on the arm, and write end_effector: tcp"
                if pose.end_effector == "tcp"
                else "correct the rig file, or publish the pose that it means"
            )
        )
