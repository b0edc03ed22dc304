"""The untouched gel as a network sees it: without dots and without noise."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.errors import PerceptionError
from tiptrace.perception.fill import smooth_fill
from tiptrace.perception.markers import MIN_MARKERS, detect_markers, dot_mask
from tiptrace.types import Image

Float32Map = NDArray[np.float32]


def untouched_background(reference: Image) -> Float32Map:
    """The reference without dots and without noise: what each pixel would show on flat gel, (H, W, 3)."""
    image = reference.astype(np.float32)
    mask = dot_mask(reference, 3) if has_dots(reference) else np.zeros(reference.shape[:2], dtype=np.bool_)
    filled = smooth_fill(image, mask)
    return np.asarray(cv2.GaussianBlur(filled, (0, 0), 2.0 * reference.shape[1] / 320.0), dtype=np.float32)


def has_dots(image: Image) -> bool:
    """Whether it is a marker gel."""
    try:
        return len(detect_markers(image)) >= MIN_MARKERS
    except PerceptionError:
        return False
