"""Slopes under the dots, where the network cannot look (paper, Sec. II-B, marker mask)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.errors import PerceptionError
from tiptrace.types import BoolArray

Float32Map = NDArray[np.float32]

_SMALLEST = 4  # pixels of the coarsest level, the shorter way


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
    known = np.where(masked[..., None], np.float32(0), maps)
    planes = np.ascontiguousarray(np.moveaxis(known, -1, 0), dtype=np.float32)
    pull_push(planes, (~masked).astype(np.float32))
    return np.ascontiguousarray(np.moveaxis(planes, 0, -1))


@compiled
def pull_push(planes: Float32Map, weight: Float32Map) -> None:
    """Turn sums (c, H, W) with weights (H, W) in [0, 1] into values, in place; weight 1 keeps a pixel as it is."""
    H, W = weight.shape
    least = np.float32(1.0)
    for v in range(H):
        for u in range(W):
            least = min(least, weight[v, u])
    if least >= 1.0:
        return
    if min(H, W) < _SMALLEST:
        for c in range(planes.shape[0]):
            for v in range(H):
                for u in range(W):
                    planes[c, v, u] /= max(weight[v, u], np.float32(1e-6))
        return
    coarse, confidence = _pull(planes, weight)
    pull_push(coarse, confidence)
    _push(planes, weight, coarse)


@compiled
def _pull(planes: Float32Map, weight: Float32Map) -> tuple[Float32Map, Float32Map]:
    """Next coarser level: sums (c, h, w) and weights (h, w); half a cell of knowledge is enough."""
    C, H, W = planes.shape
    h, w = (H + 1) // 2, (W + 1) // 2
    sums = np.empty((C, h, w), dtype=np.float32)
    confidence = np.empty((h, w), dtype=np.float32)
    _halve(weight, confidence)
    for c in range(C):
        _halve(planes[c], sums[c])
    for v in range(h):
        for u in range(w):
            known = confidence[v, u]
            confidence[v, u] = min(np.float32(2.0) * known, np.float32(1.0))
            scale = confidence[v, u] / max(known, np.float32(1e-6))
            for c in range(C):
                sums[c, v, u] *= scale
    return sums, confidence


@compiled
def _halve(plane: Float32Map, half: Float32Map) -> None:
    """Binomial means (1 4 6 4 1)/16 both ways at every second pixel, mirrored at the border."""
    H, W = plane.shape
    h, w = half.shape
    four, six, scale = np.float32(4.0), np.float32(6.0), np.float32(1.0 / 256.0)
    row = np.empty(W + 4, dtype=np.float32)
    for v in range(h):
        a, b, m = plane[abs(2 * v - 2)], plane[abs(2 * v - 1)], plane[2 * v]
        d, e = plane[H - 1 - abs(H - 2 - 2 * v)], plane[H - 1 - abs(H - 3 - 2 * v)]
        for u in range(W):
            row[u + 2] = (a[u] + e[u]) + four * (b[u] + d[u]) + six * m[u]
        row[0], row[1] = row[4], row[3]
        row[W + 2], row[W + 3] = row[W], row[W - 1]
        for u in range(w):
            k = 2 * u
            half[v, u] = scale * ((row[k] + row[k + 4]) + four * (row[k + 1] + row[k + 3]) + six * row[k + 2])


@compiled
def _push(planes: Float32Map, weight: Float32Map, coarse: Float32Map) -> None:
    """Complete what is not fully known by the coarser level's values (c, h, w), interpolated."""
    C, H, W = planes.shape
    h, w = coarse.shape[1], coarse.shape[2]
    even = (np.float32(0.125), np.float32(0.75), np.float32(0.125))
    odd = (np.float32(0.0), np.float32(0.5), np.float32(0.5))
    for v in range(H):
        k = v // 2
        a, b, d = odd if v % 2 else even
        above, below = max(k - 1, 0), min(k + 1, h - 1)
        for u in range(W):
            if weight[v, u] >= 1.0:
                continue
            m = u // 2
            p, q, r = odd if u % 2 else even
            left, right = max(m - 1, 0), min(m + 1, w - 1)
            share = np.float32(1.0) - weight[v, u]
            for c in range(C):
                s = coarse[c]
                top = p * s[above, left] + q * s[above, m] + r * s[above, right]
                middle = p * s[k, left] + q * s[k, m] + r * s[k, right]
                bottom = p * s[below, left] + q * s[below, m] + r * s[below, right]
                planes[c, v, u] += share * (a * top + b * middle + d * bottom)
