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


def smooth_fill(maps: Float32Map, masked: BoolArray) -> Float32Map:
    """Continue the maps smoothly into the masked pixels: pull-push over a pyramid.

    Each coarser level holds the mean of what is known below it; a hole takes its value from the finest level
    that knows one, interpolated. A plane continues as a plane up to the hole's asymmetry, where the nearest
    value would make a step.

    Args:
        maps: (H, W, c); masked values are not read.
        masked: (H, W).

    Raises:
        PerceptionError: every pixel is masked.
    """
    if not masked.any():
        return maps
    if masked.all():
        raise PerceptionError("every pixel of the tactile image counts as marker or as unusable")
    weight = (~masked).astype(np.float32)
    known = np.where(masked[..., None], np.float32(0), maps)
    return pull_push(known, weight)


def pull_push(weighted: Float32Map, weight: Float32Map) -> Float32Map:
    """Values (H, W, c) from sums ``weighted`` with ``weight`` (H, W) in [0, 1]; weight 1 keeps a pixel as it is."""
    if weight.min() >= 1.0 or min(weight.shape) < 4:
        return np.asarray(weighted / np.maximum(weight, 1e-6)[..., None], dtype=np.float32)
    size = ((weight.shape[1] + 1) // 2, (weight.shape[0] + 1) // 2)
    coarse_sum = cv2.pyrDown(weighted, dstsize=size).reshape(size[1], size[0], -1)
    coarse_weight = cv2.pyrDown(weight, dstsize=size)
    confidence = np.minimum(coarse_weight * 2.0, 1.0)  # half a cell of knowledge is enough
    scale = confidence / np.maximum(coarse_weight, 1e-6)
    coarse = pull_push(coarse_sum * scale[..., None], confidence)
    below = cv2.pyrUp(coarse, dstsize=(weight.shape[1], weight.shape[0]))
    return np.asarray(weighted + (1.0 - weight)[..., None] * below.reshape(weighted.shape), dtype=np.float32)
