"""A video file played in real time, in place of a camera."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tiptrace.drivers.camera import RawFrame, SourceEndedError, SourceLostError
from tiptrace.drivers.timeline import NS, Timeline
from tiptrace.errors import DeviceError


class VideoFileSource:
    """Frames of a video file, each at its time.

    Args:
        path: Any video that OpenCV reads.
        timeline: The session's.
    """

    def __init__(self, path: Path, timeline: Timeline) -> None:
        self.name = str(path)
        self._timeline = timeline
        self._capture: Any = None
        self._start_ns = 0
        self._stop = threading.Event()

    def connect(self) -> None:
        """Open.

        Raises:
            DeviceError: not a video.
        """
        capture = cv2.VideoCapture(self.name)
        if not capture.isOpened():
            raise DeviceError(f"{self.name}: is no video that OpenCV can read")
        self._capture = capture
        self._start_ns = self._timeline.now_ns()

    def read(self) -> RawFrame:
        """The next frame, when its time has come.

        Raises:
            SourceEndedError: that was the last one.
        """
        if self._capture is None:
            raise SourceLostError(f"{self.name}: not open")
        ok, image = self._capture.read()
        if not ok:
            raise SourceEndedError(f"{self.name}: the video is over")
        stamp_ns = self._start_ns + round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        wait_s = (stamp_ns - self._timeline.now_ns()) / NS
        if wait_s > 0 and self._stop.wait(wait_s):
            raise SourceEndedError(f"{self.name}: stopped")
        return RawFrame(
            stamp_ns, max(self._timeline.now_ns(), stamp_ns), image=np.asarray(image, dtype=np.uint8)
        )

    def abort(self) -> None:
        """End a wait."""
        self._stop.set()

    def disconnect(self) -> None:
        """Close."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None
