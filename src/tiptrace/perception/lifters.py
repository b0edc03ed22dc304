"""The third coordinate of the markers, by each of the chain's ways: network to the letter, network in full, none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tiptrace.perception.depth import DepthMap, PaperDepth
from tiptrace.perception.full_depth import FullDepth
from tiptrace.perception.lifting import sample_map
from tiptrace.perception.planar import MotionPatch
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.seeding import Ghosts
from tiptrace.types import BoolArray, FloatArray, Image

_PLANAR_SIGMA = 0.5  # of the assumed indentation


@dataclass(frozen=True, slots=True)
class MarkerDepths:
    """Depth of the markers.

    Attributes:
        depth_m: (n,) positive = pressed in, NaN where lost.
        sigma_m: (n,) its standard deviation; None where the way gives none.
        map: The depth map that it comes from, at the step of the chain; None without one.
    """

    depth_m: FloatArray
    sigma_m: FloatArray | None
    map: DepthMap | None


class Lifter(Protocol):
    """Depth of tracked markers."""

    def __call__(self, image: Image, uv_px: FloatArray, tracked: BoolArray) -> MarkerDepths:
        """Depth of markers at uv_px (n, 2) in an image."""
        ...


class PaperLifter:
    """Sampled from the paper's depth map."""

    def __init__(self, depth: PaperDepth) -> None:
        self._depth = depth

    def __call__(self, image: Image, uv_px: FloatArray, tracked: BoolArray) -> MarkerDepths:
        """Depth of markers at uv_px (n, 2) in an image."""
        depth = self._depth(image)
        return MarkerDepths(sample_map(depth.depth_m, uv_px), None, depth)


class FullLifter:
    """Depth under the dots by the full method, with its standard deviation."""

    def __init__(self, depth: FullDepth, tracker: RegisteredTracker, ghosts: Ghosts) -> None:
        """Prepare; ghosts are masked, too."""
        self._depth, self._tracker, self._ghosts = depth, tracker, ghosts
        self._radius = tracker.mask_radius_px
        depth.expect_dots(self._radius)

    def __call__(self, image: Image, uv_px: FloatArray, tracked: BoolArray) -> MarkerDepths:
        """Depth of markers at uv_px (n, 2) in an image."""
        at = self._tracker.expected_px
        everywhere = np.concatenate([at, self._ghosts.at(at)])
        mask = self._tracker.mask(everywhere, self._depth.shape, self._depth.step)
        depth = self._depth(image, mask, everywhere)
        h = np.where(tracked, self._depth.at(depth, at), np.nan)
        sigma = np.where(tracked, self._depth.sigma_at(at, h, self._radius), np.nan)
        return MarkerDepths(h, sigma, depth)


class PlanarLifter:
    """No depth map: the patch found from the markers' motion, pressed in by what the tool's thickness implies."""

    def __init__(self, rest_px: FloatArray, indentation_m: float) -> None:
        self._patch = MotionPatch(rest_px)
        self._indentation_m = indentation_m

    def __call__(self, image: Image, uv_px: FloatArray, tracked: BoolArray) -> MarkerDepths:
        """Depth of markers at uv_px (n, 2) in an image."""
        patch = self._patch.update(uv_px, tracked)
        h = np.where(tracked, np.where(patch, self._indentation_m, 0.0), np.nan)
        sigma = np.where(tracked, _PLANAR_SIGMA * self._indentation_m, np.nan)
        return MarkerDepths(h, sigma, None)
