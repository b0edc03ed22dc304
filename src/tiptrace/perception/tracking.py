"""Frame-to-frame tracking by pyramidal Lucas–Kanade with the paper's parameters (Sec. II-B)."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.types import BoolArray, FloatArray, Image

Grey = NDArray[np.uint8]

WINDOW_PX = (15, 15)
MAX_LEVEL = 2
CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)


class MarkerTracker(Protocol):
    """Follows a fixed set of markers; row i is marker i for ever."""

    def update(self, image: Image) -> tuple[FloatArray, BoolArray]:
        """Track into the next image: uv_px (n, 2), NaN where lost, and tracked (n,)."""
        ...


class LucasKanadeTracker:
    """The paper's tracker: each frame starts where the last one ended, errors add up, a loss is final."""

    def __init__(self, image: Image, uv_px: FloatArray) -> None:
        """Start on the image in which the markers (n, 2) px were detected."""
        self._grey = grey_image(image)
        self._uv_px = np.array(uv_px, dtype=np.float64)
        self._tracked = np.ones(len(uv_px), dtype=np.bool_)

    def update(self, image: Image) -> tuple[FloatArray, BoolArray]:
        """Track into the next image: uv_px (n, 2), NaN where lost, and tracked (n,)."""
        grey = grey_image(image)
        alive = np.flatnonzero(self._tracked)
        if alive.size:
            moved, found = lucas_kanade(self._grey, grey, self._uv_px[alive])
            self._uv_px[alive] = moved
            self._tracked[alive] = found & inside(moved, grey.shape)
            self._uv_px[~self._tracked] = np.nan
        self._grey = grey
        return self._uv_px.copy(), self._tracked.copy()


def grey_image(image: Image) -> Grey:
    """(H, W) grey levels of a BGR image."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def lucas_kanade(
    previous: Grey,
    current: Grey,
    uv_px: FloatArray,
    guess_px: FloatArray | None = None,
    max_level: int = MAX_LEVEL,
) -> tuple[FloatArray, BoolArray]:
    """Pyramidal Lucas–Kanade from one grey image to the next.

    Args:
        previous: (H, W).
        current: (H, W).
        uv_px: (n, 2) positions in ``previous``.
        guess_px: (n, 2) where to start looking in ``current``; None: at ``uv_px``.
        max_level: Coarsest level of the pyramid.

    Returns:
        (n, 2) positions in ``current`` and (n,) whether each was found.
    """
    points = np.ascontiguousarray(uv_px, dtype=np.float32).reshape(-1, 1, 2)
    start = points.copy() if guess_px is None else np.asarray(guess_px, np.float32).reshape(-1, 1, 2).copy()
    flags = 0 if guess_px is None else cv2.OPTFLOW_USE_INITIAL_FLOW
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        points,
        start,
        winSize=WINDOW_PX,
        maxLevel=max_level,
        criteria=CRITERIA,
        flags=flags,
    )
    return moved.reshape(-1, 2).astype(np.float64), found.reshape(-1).astype(np.bool_)


def inside(uv_px: FloatArray, shape: tuple[int, ...]) -> BoolArray:
    """(n,) whether positions (n, 2) px lie in an image of shape (H, W, ...)."""
    H, W = shape[:2]
    ok = (uv_px[:, 0] >= 0) & (uv_px[:, 0] <= W - 1) & (uv_px[:, 1] >= 0) & (uv_px[:, 1] <= H - 1)
    return np.asarray(ok, dtype=np.bool_)
