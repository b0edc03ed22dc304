"""One thread per camera: reads, stamps, checks, and hands over what is new."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from tiptrace.drivers.base import Closing, DeviceHealth, DeviceStatus, Frame, FrameTap, Wake
from tiptrace.drivers.jpeg_scan import ScanFacts, warm_up
from tiptrace.drivers.meter import Meter
from tiptrace.drivers.picture import Framing, Novelty, PictureError, decode_jpeg, encode_jpeg, inspect_jpeg
from tiptrace.drivers.timeline import NS, Timeline
from tiptrace.errors import DeviceError
from tiptrace.types import Image

_QUEUE = 20  # frames: 0.8 s, as the end of Stage I may take; the oldest goes first
_LATE_NS = round(0.3 * NS)
_FROZEN = 5  # repeats in a row
_STALE_S = 0.25
_FIRST_FRAME_S = 5.0
_BACK_OFF_S = (0.05, 1.0)  # least and most between two attempts to reconnect


@dataclass(frozen=True, slots=True)
class RawFrame:
    """What a source delivers.

    Attributes:
        stamp_ns: Capture on the session's timeline, as close to the exposure as the source allows.
        arrived_ns: When its last byte was here.
        jpeg: As sent; else ``image``.
        image: (height, width, 3) BGR.
        settled: As in :class:`~tiptrace.drivers.base.Frame`.
    """

    stamp_ns: int
    arrived_ns: int
    jpeg: bytes | None = None
    image: Image | None = None
    settled: bool = True


class SourceLostError(DeviceError):
    """The connection is gone or silent; it may come back."""


class SourceEndedError(DeviceError):
    """A file came to its end."""


class FrameSource(Protocol):
    """Something that gives one frame after the other; used from one thread, except :meth:`abort`."""

    name: str

    def connect(self) -> None:
        """Open.

        Raises:
            DeviceError: cannot be opened.
        """
        ...

    def read(self) -> RawFrame:
        """The next frame.

        Raises:
            SourceLostError: disconnected or silent.
            SourceEndedError: a file came to its end.
        """
        ...

    def abort(self) -> None:
        """End a read that is going on in another thread, if that can be done."""
        ...

    def disconnect(self) -> None:
        """Close."""
        ...


class ThreadedCamera(Closing):
    """A :class:`~tiptrace.drivers.base.Camera` over any source.

    Args:
        source: Where frames come from.
        framing: Crop, flip and size.
        timeline: The session's.
        encode: Whether frames carry the jpeg that a recorder stores; ``image`` is then what that jpeg decodes to.
    """

    def __init__(
        self, source: FrameSource, framing: Framing, timeline: Timeline, *, encode: bool = False
    ) -> None:
        self.name = source.name
        self._source, self._framing, self._timeline, self._encode = source, framing, timeline, encode
        self._meter = Meter(source.name, timeline, _STALE_S)
        self._queue: deque[Frame] = deque()
        self._lock = threading.Lock()
        self._stop, self._first = threading.Event(), threading.Event()
        self._novelty = Novelty()
        self._repeats = 0
        self._last_ns = 0
        self._after = ""
        self._wake: Wake = lambda: None
        self._frame_tap: FrameTap | None = None
        self._error: DeviceError | None = None
        self._thread: threading.Thread | None = None

    def start(self, wake: Wake, tap: FrameTap | None = None) -> None:
        """Connect and wait for the first frame."""
        warm_up()  # the first image should not wait
        self._wake, self._frame_tap = wake, tap
        self._source.connect()
        self._thread = threading.Thread(target=self._run, name=f"camera {self.name}", daemon=True)
        self._thread.start()
        if not self._first.wait(_FIRST_FRAME_S):
            detail = self.health().detail
            self.close()
            raise DeviceError(
                f"{self.name}: no usable image within {_FIRST_FRAME_S:g} s"
                + (f" ({detail})" if detail else "")
                + ": check the cable, and that no other program uses the camera"
            )
        if self._error is not None:
            self.close()
            raise self._error

    def take(self) -> list[Frame]:
        """Frames since the last call, oldest first.

        Raises:
            DeviceError: the camera sends something else than at the start.
        """
        if self._error is not None:
            raise self._error
        with self._lock:
            frames = list(self._queue)
            self._queue.clear()
        return frames

    def health(self) -> DeviceHealth:
        """State at this moment."""
        return self._meter.health()

    def close(self) -> None:
        """Stop the thread and release the device."""
        self._stop.set()
        self._source.abort()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
            self._thread = None

    # --- the thread ----------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    self._take_in(self._source.read())
                except SourceEndedError:
                    self._meter.bad(DeviceStatus.ENDED, "")
                    return
                except SourceLostError as error:
                    self._reconnect(error)
        except DeviceError as error:
            self._error = error
        except Exception as error:  # noqa: BLE001  a thread that dies must not do so silently
            self._error = DeviceError(f"{self.name}: {error}")
        finally:
            self._first.set()
            self._source.disconnect()
            self._wake()

    def _bad(self, status: DeviceStatus, detail: str, count_as: str | None = None) -> None:
        """Tell a fault; the next good frame remembers it."""
        self._after = status.value
        self._meter.bad(status, detail, count_as)

    def _reconnect(self, error: DeviceError) -> None:
        """Try again, less and less often, until it works or the session ends."""
        wait_s, most_s = _BACK_OFF_S
        self._bad(DeviceStatus.LOST, str(error))
        while not self._stop.is_set():
            self._source.disconnect()
            try:
                self._source.connect()
                return
            except DeviceError as failed:
                self._meter.bad(DeviceStatus.LOST, str(failed), "reconnect-failed")
            self._stop.wait(wait_s)
            wait_s = min(2.0 * wait_s, most_s)

    def _take_in(self, raw: RawFrame) -> None:
        """Check a frame; queue it if it is new and whole."""
        if self._is_repeated(raw) or self._is_late(raw):
            return
        try:
            frame = replace(self._finish(raw), after=self._after, settled=raw.settled)
        except PictureError as error:
            self._bad(DeviceStatus.GARBLED, f"{self.name}: an image {error}")
            return
        self._last_ns, self._after = raw.stamp_ns, ""
        if self._frame_tap is not None:
            self._frame_tap(frame)
        with self._lock:
            if len(self._queue) >= _QUEUE:
                self._queue.popleft()
                self._meter.fault("dropped")
            self._queue.append(frame)
        self._meter.good(frame.stamp_ns, frame.arrived_ns)
        self._first.set()
        self._wake()

    def _is_repeated(self, raw: RawFrame) -> bool:
        assert raw.jpeg is not None or raw.image is not None
        data = raw.jpeg if raw.jpeg is not None else np.ascontiguousarray(raw.image).data
        if not self._novelty.repeated(data):
            self._repeats = 0
            return False
        self._repeats += 1
        frozen = self._repeats >= _FROZEN
        status = DeviceStatus.FROZEN if frozen else DeviceStatus.REPEATED
        what = "has stood still" if frozen else "sent the same image again"
        self._bad(status, f"{self.name}: {what} ({self._repeats} times)", "repeated")
        return True

    def _is_late(self, raw: RawFrame) -> bool:
        age_ns = raw.arrived_ns - raw.stamp_ns
        if age_ns <= _LATE_NS and raw.stamp_ns > self._last_ns:
            return False
        how = f"{age_ns / NS:.2f} s old" if age_ns > _LATE_NS else "out of order"
        self._bad(DeviceStatus.LATE, f"{self.name}: an image came {how}")
        return True

    def _finish(self, raw: RawFrame) -> Frame:
        """Decode, check, crop and resize; encode where a recorder wants it.

        Raises:
            PictureError: cut off or damaged.
            DeviceError: another size than the rig says.
        """
        facts, reduction, source = None, 1, raw.image
        if raw.jpeg is not None:
            facts = self._inspect(raw.jpeg)
            reduction = self._framing.reduction(facts.size_px)
            source = decode_jpeg(raw.jpeg, reduction)
        assert source is not None
        self._framing.check(self.name, source, reduction)
        image = self._framing.apply(source, reduction)
        if self._novelty.torn(image, facts):
            raise PictureError("is torn")
        if not self._encode:
            return Frame(raw.stamp_ns, raw.arrived_ns, image)
        if raw.jpeg is not None and reduction == 1 and self._framing.unchanged(source):
            return Frame(raw.stamp_ns, raw.arrived_ns, image, raw.jpeg)
        jpeg = encode_jpeg(image)
        return Frame(raw.stamp_ns, raw.arrived_ns, decode_jpeg(jpeg), jpeg)

    def _inspect(self, jpeg: bytes) -> ScanFacts:
        try:
            return inspect_jpeg(jpeg)
        except PictureError:
            self._novelty.broken()
            raise
