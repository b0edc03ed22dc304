"""Slopes under the dots, where the network cannot look (paper, Sec. II-B, marker mask)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.errors import PerceptionError
from tiptrace.types import BoolArray

Float32Map = NDArray[np.float32]


def nearest_fill(maps: Float32Map, masked: BoolArray) -> Float32Map:
    """Give each masked pixel the value of the nearest one that is not.

    Args:
        maps: (H, W, c).
        masked: (H, W).

    Raises:
        PerceptionError: every pixel is masked.
    """
    if not masked.any():
        return maps
    if masked.all():
        raise PerceptionError(
            "every pixel of the tactile image counts as marker: marker_threshold does not fit this gel"
        )
    _, labels = cv2.distanceTransformWithLabels(
        masked.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    open_index = np.flatnonzero(~masked)
    source = np.zeros(int(labels.max()) + 1, dtype=np.intp)
    source[labels.ravel()[open_index]] = open_index
    filled: Float32Map = maps.reshape(-1, maps.shape[2])[source[labels]]
    return filled
