"""All dots of a gel at the start of a trial: those to track, and those only to be masked.

In the first image the tool is already in the gel; dots on its steep edges may escape detection. The untouched
gel shows every dot plainly, so that the missing ones can be looked for where their neighbours' displacement puts
them. What still cannot be measured (dots cut by the border) is followed by its neighbours, as a ghost, because
the network must not look at it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tiptrace.errors import PerceptionError
from tiptrace.perception.centroid import DotMeter
from tiptrace.perception.markers import Markers, detect_cut_dots, detect_markers
from tiptrace.perception.tracking import grey_image
from tiptrace.types import FloatArray, Image

_STILL = (
    0.25  # of the pitch: displacement since the untouched gel up to which the nearest dot is the right one
)
_MATCH = 0.45  # of the pitch: how differently from its neighbours a marker may have moved
_NEIGHBOURS = 3


@dataclass(frozen=True, slots=True)
class Seeds:
    """Dots at the start.

    Attributes:
        markers: To be tracked, as in the first image.
        rest_px: (n, 2) where these lie on the untouched gel; where unknown, where they are.
        ghosts: Dots that are masked only.
    """

    markers: Markers
    rest_px: FloatArray
    ghosts: Ghosts


class Ghosts:
    """Dots that are not tracked; they move as their nearest markers do."""

    def __init__(self, rest_px: FloatArray, markers_rest_px: FloatArray) -> None:
        """At rest positions (g, 2), beside markers at rest positions (n, 2)."""
        self._rest, self._markers_rest = rest_px.reshape(-1, 2), markers_rest_px
        self._near, self._weight = _nearest(self._rest, markers_rest_px)

    def at(self, uv_px: FloatArray) -> FloatArray:
        """Positions (g, 2) while the markers are at (n, 2)."""
        moved = (uv_px - self._markers_rest)[self._near]  # (g, k, 2)
        return np.asarray(self._rest + np.sum(self._weight[..., None] * moved, axis=1))


def seed(image: Image, reference: Image | None) -> Seeds:
    """Find the dots of the first image with the help of the untouched gel.

    Raises:
        PerceptionError: an unusable image, or fewer than 11 markers.
    """
    markers = detect_markers(image)
    untouched = _untouched_dots(reference)
    if untouched is None:
        return Seeds(markers, markers.uv_px.copy(), Ghosts(detect_cut_dots(image), markers.uv_px))
    whole, cut = untouched
    pitch = _pitch(markers.uv_px)
    rest, partner = _match(markers.uv_px, whole, pitch)
    missing = np.setdiff1d(np.arange(len(whole)), partner)
    found, found_rest = _recover(image, markers, rest, whole[missing], pitch)
    if len(found):
        markers = Markers(
            np.concatenate([markers.uv_px, found.uv_px]),
            np.concatenate([markers.diameter_px, found.diameter_px]),
        )
        rest = np.concatenate([rest, found_rest])
    left = [w for w in whole[missing] if not (found_rest == w).all(axis=1).any()]
    ghosts = np.concatenate([cut, np.asarray(left).reshape(-1, 2)])
    return Seeds(markers, rest, Ghosts(ghosts, rest))


def _untouched_dots(reference: Image | None) -> tuple[FloatArray, FloatArray] | None:
    """Whole and cut dots of the reference; None without one or on a gel that shows none."""
    if reference is None:
        return None
    try:
        return detect_markers(reference).uv_px, detect_cut_dots(reference)
    except PerceptionError:
        return None


def _match(uv: FloatArray, whole: FloatArray, pitch: float) -> tuple[FloatArray, NDArray[np.intp]]:
    """Rest position of each marker (its own where none is near), and the partners taken.

    Friction may carry a whole contact patch by more than half a pitch, where the nearest dot is the wrong one; but
    neighbours move alike. The match grows over the grid from the markers that hardly moved.
    """
    distance = np.linalg.norm(uv[:, None] - whole[None], axis=2)  # (n, m)
    partner = np.full(len(uv), -1, dtype=np.intp)
    sure = distance.min(axis=1) < max(_STILL * pitch, float(distance.min()) + 1e-9)
    partner[sure] = distance[sure].argmin(axis=1)
    between = np.linalg.norm(uv[:, None] - uv[None], axis=2)
    waiting = set(np.flatnonzero(~sure).tolist())
    while waiting:
        known = np.flatnonzero(partner >= 0)
        i = min(waiting, key=lambda k: float(between[k, known].min()))
        waiting.remove(i)
        near = known[np.argsort(between[i, known])[:_NEIGHBOURS]]
        expected = uv[i] - np.mean(uv[near] - whole[partner[near]], axis=0)
        away = np.linalg.norm(whole - expected, axis=1)
        away[partner[known]] = np.inf
        if away.min() < _MATCH * pitch:
            partner[i] = away.argmin()
    matched = partner >= 0
    rest = uv.copy()
    rest[matched] = whole[partner[matched]]
    return rest, partner[matched]


def _recover(
    image: Image, markers: Markers, rest: FloatArray, missing: FloatArray, pitch: float
) -> tuple[Markers, FloatArray]:
    """Measure dots of the reference that detection missed; returns those that are there and their rest."""
    if not len(missing):
        return Markers(np.zeros((0, 2)), np.zeros(0)), missing
    near, weight = _nearest(missing, rest)
    expected = missing + np.sum(weight[..., None] * (markers.uv_px - rest)[near], axis=1)
    diameter = float(np.median(markers.diameter_px))
    meter = DotMeter(diameter, pitch)
    grey = grey_image(image)
    known, dots = meter.measure(grey, markers.uv_px), meter.measure(grey, expected)
    ratio = dots.area_px / np.median(known.area_px)
    size = np.array([grey.shape[1] - 1, grey.shape[0] - 1])
    margin = 0.5 * diameter
    whole = ((dots.uv_px > margin) & (dots.uv_px < size - margin)).all(axis=1)
    apart = np.linalg.norm(dots.uv_px[:, None] - markers.uv_px[None], axis=2).min(axis=1) > 0.5 * pitch
    close = np.linalg.norm(dots.uv_px - expected, axis=1) < 0.3 * pitch
    ok = (dots.ink > 0.5 * np.median(known.ink)) & (ratio > 0.5) & (ratio < 2.0) & whole & apart & close
    return Markers(dots.uv_px[ok], np.full(int(ok.sum()), diameter)), missing[ok]


def _nearest(places: FloatArray, markers: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Indices (g, k) of the nearest markers and their weights, inversely with distance."""
    k = min(_NEIGHBOURS, len(markers))
    distance = np.linalg.norm(places[:, None] - markers[None], axis=2)
    near = np.argsort(distance, axis=1)[:, :k]
    weight = 1.0 / np.maximum(np.take_along_axis(distance, near, axis=1), 1.0) ** 2
    return near, weight / weight.sum(axis=1, keepdims=True)


def _pitch(uv: FloatArray) -> float:
    distance = np.linalg.norm(uv[:, None] - uv[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))
