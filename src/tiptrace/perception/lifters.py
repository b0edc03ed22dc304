"""The third coordinate of the markers, by each of the chain's ways: network to the letter, network in full, none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tiptrace.errors import PerceptionError
from tiptrace.perception.depth import DepthMap, PaperDepth
from tiptrace.perception.full_depth import FullDepth
from tiptrace.perception.lifting import sample_map
from tiptrace.perception.markers import Markers, detect_cut_dots, detect_markers
from tiptrace.perception.planar import MotionPatch
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.types import BoolArray, FloatArray, Image

_PLANAR_SIGMA = 0.5  # of the assumed indentation
_OPEN = 0.35  # of the pitch: how far the first frame's markers may lie from the reference's


@dataclass(frozen=True, slots=True)
class MarkerDepths:
    """Depth of the markers.

    Attributes:
        depth_m: (n,) positive = pressed in, NaN where lost.
        sigma_m: (n,) its standard deviation; None where the way gives none.
        map: The depth map that it comes from, at image resolution; None without one.
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

    def __init__(self, depth: FullDepth, tracker: RegisteredTracker, first: Image, markers: Markers) -> None:
        """Prepare; dots cut by the border of the first image are masked, too, and move with their neighbours."""
        self._depth, self._tracker = depth, tracker
        cut = detect_cut_dots(first)
        self._cut = cut
        distance = np.linalg.norm(cut[:, None] - markers.uv_px[None], axis=2)  # (c, n)
        self._nearest = distance.argmin(axis=1) if len(cut) else np.zeros(0, dtype=np.intp)
        self._radius = self._tracker.mask_radius_px

    def __call__(self, image: Image, uv_px: FloatArray, tracked: BoolArray) -> MarkerDepths:
        """Depth of markers at uv_px (n, 2) in an image."""
        at = self._tracker.expected_px
        moved = self._cut + (at - self._tracker.start_px)[self._nearest]
        dots = self._tracker.mask(np.concatenate([at, moved]), image.shape[:2])
        depth = self._depth(image, dots)
        h = np.where(tracked, self._depth.at(depth, at), np.nan)
        sigma = np.where(tracked, self._depth.sigma_at(at, self._radius), np.nan)
        return MarkerDepths(h, sigma, self._depth.at_image_size(depth, image.shape[:2]))


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


def rest_positions(markers: Markers, reference: Image | None) -> FloatArray:
    """Where the markers of the first image lie on the untouched gel, (n, 2) px; where unknown, where they are."""
    rest = markers.uv_px.copy()
    if reference is None:
        return rest
    try:
        untouched = detect_markers(reference).uv_px
    except PerceptionError:
        return rest
    distance = np.linalg.norm(rest[:, None] - rest[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    pitch = float(np.median(distance.min(axis=1)))
    to_reference = np.linalg.norm(rest[:, None] - untouched[None], axis=2)
    near = to_reference.min(axis=1) < _OPEN * pitch
    rest[near] = untouched[to_reference.argmin(axis=1)[near]]
    return rest
