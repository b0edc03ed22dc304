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

_TOUCHED = 0.065


def untouched_background(reference: Image) -> Float32Map:
    """The reference without dots and without noise: what each pixel would show on flat gel, (H, W, 3)."""
    image = reference.astype(np.float32)
    mask = dot_mask(reference, 3) if has_dots(reference) else np.zeros(reference.shape[:2], dtype=np.bool_)
    filled = smooth_fill(image, mask)
    return np.asarray(cv2.GaussianBlur(filled, (0, 0), 2.0 * reference.shape[1] / 320.0), dtype=np.float32)


def check_untouched(reference: Image) -> None:
    """Refuse a reference on which something presses into the gel: an edge that neither lamps nor dots make.

    Between two scales, untouched gels differ by up to 4 % of their brightness (0.5 % of the pixels), a fingertip
    makes 8 %, a tool 11 % and more.

    Raises:
        PerceptionError: such an edge.
    """
    image = reference.astype(np.float32)
    scale = reference.shape[1] / 320.0
    filled = smooth_fill(image, dot_mask(reference, 4)) if has_dots(reference) else image
    fine, coarse = (cv2.GaussianBlur(filled, (0, 0), sigma * scale) for sigma in (3.0, 12.0))
    change = np.abs(fine - coarse).max(axis=2) / np.maximum(coarse.mean(axis=2), 10.0)
    rim = round(12 * scale)
    edge = float(np.percentile(change[rim:-rim, rim:-rim], 99.5))
    if edge > _TOUCHED:
        raise PerceptionError(
            f"the gel looks touched or dirty in its reference image (an edge of {edge:.0%} of the brightness): take "
            "the reference with nothing on the gel"
        )


def has_dots(image: Image) -> bool:
    """Whether it is a marker gel."""
    try:
        return len(detect_markers(image)) >= MIN_MARKERS
    except PerceptionError:
        return False
