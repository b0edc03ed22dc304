"""Depth map of one image by the paper's chain: normals, mask, nearest fill, Poisson, baseline (Sec. II-B)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.perception.background import untouched_background
from tiptrace.perception.fill import nearest_fill
from tiptrace.perception.gel_model import GelModel
from tiptrace.perception.markers import check_image
from tiptrace.perception.poisson import PoissonSolver
from tiptrace.types import BoolArray, Image

Float32Map = NDArray[np.float32]

_RIM_PX = (
    2  # a dot's blurred rim is brighter than the marker range, yet no gel: its slopes are not the surface's
)
_FLAT = 0.03  # change of slope below which gel counts as flat, m/m
_SHALLOW = 0.25  # of the depth range: flat gel above this level is touched
_SHALLOW_M = 60e-6  # … but never closer to the lowest gel than its noise
_THIN = 4  # every so many pixels tell about the depth range
_VISIBLE = 0.01  # of the image that must be untouched for its median to be the zero level


@dataclass(frozen=True, slots=True)
class DepthMap:
    """Indentation of the gel.

    Attributes:
        depth_m: (H, W) float32, positive = pressed in.
        untouched: (H, W) where the gel counts as untouched.
        zero_visible: False if too little untouched gel was seen and the border stood in for the zero level.
    """

    depth_m: Float32Map
    untouched: BoolArray
    zero_visible: bool


def at_image_size(depth: DepthMap, shape: tuple[int, int]) -> DepthMap:
    """A map made at a coarser step, enlarged to image resolution (H, W)."""
    h, w = depth.depth_m.shape
    H, W = shape
    step = H // h
    if step == 1:
        return depth
    size, border = (w * step, h * step), (0, H - h * step, 0, W - w * step)
    fine = cv2.resize(depth.depth_m, size, interpolation=cv2.INTER_LINEAR)
    untouched = cv2.resize(depth.untouched.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    fine, untouched = (
        cv2.copyMakeBorder(m, *border, borderType=cv2.BORDER_REPLICATE) for m in (fine, untouched)
    )
    return DepthMap(
        np.asarray(fine, dtype=np.float32), np.asarray(untouched, dtype=np.bool_), depth.zero_visible
    )


class PaperDepth:
    """The paper's depth chain at full resolution, against one reference image."""

    def __init__(
        self,
        gel: GelModel,
        reference: Image,
        metres_per_px: tuple[float, float],
        marker_threshold: tuple[float, float],
    ) -> None:
        """Prepare, and integrate the baseline from the image of the untouched gel, (H, W, 3) uint8 BGR.

        Raises:
            PerceptionError: an unusable reference.
        """
        check_image(reference)
        H, W = reference.shape[:2]
        self._gel, self._threshold = gel, marker_threshold
        self._rim = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _RIM_PX + 1, 2 * _RIM_PX + 1))
        v, u = np.indices((H, W), dtype=np.float32)
        self._unit_uv = np.stack([u / W, v / H], axis=-1).reshape(-1, 2)  # (HW, 2)
        self._background = untouched_background(reference)
        self._solver = PoissonSolver((H, W), metres_per_px)
        self._slopes_0 = self._slopes(reference)  # (H, W, 2)
        self._z_0 = self._integrate(self._slopes_0)

    def __call__(self, image: Image) -> DepthMap:
        """Depth of an image of the same size, (H, W, 3) uint8 BGR.

        Raises:
            PerceptionError: another size, black, overexposed, or all of it masked.
        """
        H, W = self._z_0.shape
        check_image(image, (W, H))
        slopes = self._slopes(image)
        h = self._z_0 - self._integrate(slopes)  # h = −(z − z_baseline)
        untouched, visible = untouched_gel(h, slopes - self._slopes_0)
        h -= zero_level(h, untouched, visible)
        return DepthMap(depth_m=h, untouched=untouched, zero_visible=visible)

    def _slopes(self, image: Image) -> Float32Map:
        """Slopes (H, W, 2): network off the markers (grey range, and their rims), nearest value on them."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        masked = cv2.dilate(cv2.inRange(grey, *self._threshold), self._rim) > 0  # (H, W)
        colours = image.astype(np.float32)
        colours = self._gel.convention.colours(colours, self._background)
        seen = ~masked.ravel()
        slopes = np.zeros((seen.size, 2), dtype=np.float32)
        slopes[seen] = self._gel.slopes(colours.reshape(-1, 3)[seen], self._unit_uv[seen])
        return nearest_fill(slopes.reshape(*grey.shape, 2), np.asarray(masked, dtype=np.bool_))

    def _integrate(self, slopes: Float32Map) -> Float32Map:
        return self._solver.integrate(slopes[..., 0], slopes[..., 1])


def untouched_gel(h: Float32Map, slope_change: Float32Map) -> tuple[BoolArray, bool]:
    """Where the gel is untouched: flat as in the reference, and among the least deep.

    Args:
        h: (H, W) depth up to a constant, m.
        slope_change: (H, W, 2) slopes minus those of the reference.

    Returns:
        (H, W) mask, and whether it is large enough to define the zero level.
    """
    return untouched_of(h, np.ascontiguousarray(np.moveaxis(slope_change, -1, 0)))


def untouched_of(h: Float32Map, slope_change: Float32Map) -> tuple[BoolArray, bool]:
    """The same with the slopes as two maps, (2, H, W)."""
    sigma = max(h.shape[1] / 160.0, 1.0)
    p, q = (np.asarray(cv2.GaussianBlur(s, (0, 0), sigma), dtype=np.float32) for s in slope_change)
    untouched, share = _flat_and_low(np.ascontiguousarray(h, dtype=np.float32), p, q)
    return untouched, share >= _VISIBLE


@compiled
def _flat_and_low(h: Float32Map, p: Float32Map, q: Float32Map) -> tuple[BoolArray, float]:
    """Mask (H, W) of gel that is flat and among the least deep, and its share of the image."""
    H, W = h.shape
    sample = np.sort(np.ascontiguousarray(h[::_THIN, ::_THIN]).ravel())
    last = len(sample) - 1
    lowest, deepest = sample[round(0.05 * last)], sample[round(0.99 * last)]
    shallow = lowest + max(_SHALLOW * (deepest - lowest), _SHALLOW_M)
    untouched = np.empty((H, W), dtype=np.bool_)
    count = 0
    for v in range(H):
        for u in range(W):
            untouched[v, u] = h[v, u] < shallow and p[v, u] ** 2 + q[v, u] ** 2 < _FLAT**2
            count += untouched[v, u]
    return untouched, count / (H * W)


def zero_level(h: Float32Map, untouched: BoolArray, visible: bool) -> np.float32:
    """Level that becomes depth 0: median over untouched gel, else the lowest decile of the image's border."""
    if visible:
        return np.float32(np.median(h[untouched]))
    border = np.concatenate([h[0], h[-1], h[:, 0], h[:, -1]])
    return np.float32(np.percentile(border, 10))
