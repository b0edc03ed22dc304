"""Marker tracks of a tactile video file, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from tiptrace.errors import PerceptionError
from tiptrace.perception.markers import detect_markers
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.tracking import LucasKanadeTracker, MarkerTracker
from tiptrace.types import BoolArray, FloatArray, Image


@dataclass(frozen=True, slots=True)
class VideoFrame:
    """Markers in one frame of a video.

    Attributes:
        index: Frame number, from 0.
        image: (H, W, 3) uint8 BGR.
        uv_px: (n, 2), NaN where lost; row i is marker i in every frame.
        tracked: (n,).
    """

    index: int
    image: Image
    uv_px: FloatArray
    tracked: BoolArray


class Video:
    """A video file that can be read from its beginning, several times."""

    def __init__(self, path: Path) -> None:
        """Open it.

        Raises:
            PerceptionError: no such file, it cannot be read, or it holds no frame.
        """
        if not path.is_file():  # OpenCV would print a warning of its own
            raise PerceptionError(f"{path}: no such file; is the path right?")
        self.path = path
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        self.fps = float(capture.get(cv2.CAP_PROP_FPS)) or 25.0
        self.frame_count = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        readable = capture.isOpened() and capture.read()[0]
        capture.release()
        if not readable:
            raise PerceptionError(f"{path}: cannot be read as a video; is the file complete?")

    def frames(self) -> Iterator[Image]:
        """Frames in order, (H, W, 3) uint8 BGR."""
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        try:
            while True:
                ok, image = capture.read()
                if not ok:
                    return
                yield np.asarray(image, dtype=np.uint8)
        finally:
            capture.release()

    def track(self, method: Literal["paper", "full"] = "full") -> Iterator[VideoFrame]:
        """Find the markers in the first frame and follow them.

        Args:
            method: ``paper``: plain Lucas–Kanade; ``full``: tracking that cannot drift.

        Raises:
            PerceptionError: no markers in the first frame.
        """
        tracker: MarkerTracker | None = None
        for index, image in enumerate(self.frames()):
            if tracker is None:
                tracker, uv_px = self._start(image, method)
                tracked = np.ones(len(uv_px), dtype=np.bool_)
            else:
                uv_px, tracked = tracker.update(image)
            yield VideoFrame(index, image, uv_px, tracked)

    def _start(self, image: Image, method: Literal["paper", "full"]) -> tuple[MarkerTracker, FloatArray]:
        try:
            markers = detect_markers(image)
        except PerceptionError as error:
            raise PerceptionError(f"{self.path}: first frame: {error}") from None
        if method == "paper":
            return LucasKanadeTracker(image, markers.uv_px), markers.uv_px
        tracker = RegisteredTracker(image, markers)
        return tracker, tracker.start_px
