"""Depth by the full method: masks from the dots, smooth continuation under them, lamps corrected.

At a coarser step the network sees means over step × step pixels, which costs a quarter at step 2 and less noise.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.errors import PerceptionError
from tiptrace.perception.background import untouched_background
from tiptrace.perception.depth import DepthMap, untouched_of
from tiptrace.perception.dot_fill import DotFill
from tiptrace.perception.fill import pull_push
from tiptrace.perception.gel_model import GelModel
from tiptrace.perception.illumination import LampGain, Level
from tiptrace.perception.lifting import sample_map
from tiptrace.perception.markers import check_image
from tiptrace.perception.poisson import PoissonSolver
from tiptrace.types import BoolArray, FloatArray, Image, IntArray

Float32Map = NDArray[np.float32]

_RING_POINTS = 8
_FILL_MARGIN_PX = 1.5  # around a dot's radius, that is filled along edges
_FILL_OUTSIDE_PX = 2.0  # beyond that, where values are taken
_VISIBLE = 0.1  # of the image that must be untouched to level a map by it
_CALM = 0.02  # slope below which gel may tell about the lamps
_CALM_AROUND_PX = 8.0  # on the mean over so many pixels each way
_FIRST_ROUNDS = 6
_LEANS = 0.06  # slope below which gel, pressed in or not, may tell about a gain common to the lamps
_NOISE_M = 12e-6  # of a marker's depth, wherever it lies
_DEPTH_SHARE = 0.04  # of the depth: what a network errs by in scale on another gel of the same make
_FILL_SHARE = 0.3  # of the slope's variation around a dot times its radius: error of the fill under it


class FullDepth:
    """Depth of one gel against its reference, at every ``step``-th pixel: maps of ``shape`` (h, w)."""

    def __init__(
        self, gel: GelModel, reference: Image, metres_per_px: tuple[float, float], step: int = 2
    ) -> None:
        """Prepare with the image of the untouched gel, (H, W, 3) uint8 BGR.

        Raises:
            PerceptionError: an unusable reference.
        """
        check_image(reference)
        H, W = reference.shape[:2]
        self._gel, self.step = gel, step
        self._s = float(np.mean(metres_per_px))
        self._size = (W // step, H // step)
        self._crop = (self._size[1] * step, self._size[0] * step)
        self.shape = shape = (self._size[1], self._size[0])
        v, u = np.indices(shape, dtype=np.float32) * step + (step - 1) / 2
        self._unit_uv = np.stack([u / W, v / H], axis=-1).reshape(-1, 2)
        self._background = np.maximum(self._shrink(untouched_background(reference)), np.float32(1.0))
        scale = (metres_per_px[0] * step, metres_per_px[1] * step)
        self._solver = PoissonSolver(shape, scale)
        self._level = Level(shape, scale)
        self._dot_fill: DotFill | None = None
        self._lamps = LampGain(shape, lambda ratio: self._network(ratio, np.ones(3)).reshape(*shape, 2))
        # what the network says of untouched gel, (h, w, 2)
        self._flat = self._network(np.ones_like(self._background), np.ones(3)).reshape(*shape, 2)
        self._box = 2 * round(_CALM_AROUND_PX / (2 * step)) + 1  # map px
        self._calm: BoolArray | None = None
        self._lean_little = np.ones(shape, dtype=np.bool_)
        self._slopes: Float32Map = np.zeros((2, *shape), dtype=np.float32)

    def __call__(self, image: Image, mask: BoolArray, uv_px: FloatArray) -> DepthMap:
        """Depth of an image, (h, w).

        Args:
            image: (H, W, 3) uint8 BGR, of the reference's size.
            mask: Map pixels, (h, w) of :attr:`shape`, that the network must not look at.
            uv_px: (n, 2) centres of the dots.
        """
        if mask.all():
            raise PerceptionError("every pixel of the tactile image counts as marker or as unusable")
        image = np.require(image, np.uint8, ["C", "W"])  # one kind of array for the compiled loops
        ratio = _ratio(image, self._background, self.step)
        if self._calm is None:  # first frame: calm gel, gain and tilt are found together
            self._measure(ratio, np.ones(3), mask, uv_px)
            for _ in range(_FIRST_ROUNDS):
                self._lamps.forget()
                self._level.forget()
                self._measure(ratio, self._gain(ratio, mask), mask, uv_px)
        return self._measure(ratio, self._gain(ratio, mask), mask, uv_px)

    def _gain(self, ratio: Float32Map, mask: BoolArray) -> FloatArray:
        """What the lamps have changed by, (3,)."""
        assert self._calm is not None
        return self._lamps.update(ratio, self._calm & ~mask, self._lean_little & ~mask)

    def _measure(self, ratio: Float32Map, gain: FloatArray, mask: BoolArray, uv_px: FloatArray) -> DepthMap:
        """Depth from a ratio image (h, w, 3) and the lamps' gain (3,); remembers slopes and calm gel."""
        seen = np.flatnonzero(~mask)  # (k,)
        slopes, weight = _change_at(seen, self._network(ratio, gain, seen), self._flat)  # (2, h, w), (h, w)
        pull_push(slopes, weight)
        if self._dot_fill is not None:
            self._dot_fill.apply(slopes, (uv_px - (self.step - 1) / 2) / self.step)
        self._slopes = slopes
        h = self._solver.integrate(slopes[0], slopes[1])
        np.negative(h, out=h)
        untouched, _ = untouched_of(h, slopes)
        visible = cv2.countNonZero(untouched.view(np.uint8)) > _VISIBLE * untouched.size
        h = self._level.apply(h, untouched if visible else None)
        steepness = np.asarray(cv2.blur(_steeper(slopes), (self._box, self._box)), dtype=np.float32)
        self._calm, self._lean_little = _calm_gel(steepness, untouched, visible)
        return DepthMap(depth_m=h, untouched=untouched, zero_visible=visible)

    def expect_dots(self, radius_px: float) -> None:
        """Say how large the masked discs of dots are."""
        self._dot_fill = DotFill((radius_px + _FILL_MARGIN_PX) / self.step, _FILL_OUTSIDE_PX / self.step)

    def at(self, depth: DepthMap, uv_px: FloatArray) -> FloatArray:
        """Depth (n,) m at image positions (n, 2)."""
        return sample_map(depth.depth_m, uv_px, self.step)

    def sigma_at(self, uv_px: FloatArray, depth_m: FloatArray, radius_px: float) -> FloatArray:
        """Standard deviation (n,) m of depths (n,) under dots: noise, scale, and what the fill cannot know.

        The fill's error grows with how much the slope varies around the dot.
        """
        variation = _variation(
            self._slopes, (uv_px - (self.step - 1) / 2) / self.step, radius_px / self.step + 1.0
        )
        fill = _FILL_SHARE * variation * radius_px * self._s
        return np.asarray(np.sqrt(_NOISE_M**2 + (_DEPTH_SHARE * depth_m) ** 2 + fill**2))

    def _network(self, ratio: Float32Map, gain: FloatArray, which: IntArray | None = None) -> Float32Map:
        """Slopes (k, 2) of some pixels of a ratio image (h, w, 3) under lamps with a gain (3,)."""
        if self._gel.convention.background == "ratio":
            return self._gel.slopes(ratio.reshape(-1, 3), self._unit_uv, gain, -1.0, which)
        grey_levels = (ratio * self._background).reshape(-1, 3)
        return self._gel.slopes(grey_levels, self._unit_uv, gain, 0.0, which)

    def _shrink(self, image: Float32Map) -> Float32Map:
        """Means over step × step pixels."""
        cropped = image[: self._crop[0], : self._crop[1]]
        if self.step == 1:
            return cropped
        return np.asarray(cv2.resize(cropped, self._size, interpolation=cv2.INTER_AREA), dtype=np.float32)


@compiled
def _ratio(image: Image, background: Float32Map, step: int) -> Float32Map:
    """Means over step × step pixels of an image (H, W, 3) over the background (h, w, 3)."""
    h, w = background.shape[0], background.shape[1]
    ratio = np.empty((h, w, 3), dtype=np.float32)
    share = np.float32(1.0 / (step * step))
    n = 3 * w * step
    line = np.empty(n, dtype=np.int32)
    for v in range(h):
        line[:] = 0
        for j in range(step):
            row = image[v * step + j].ravel()
            for i in range(n):
                line[i] += row[i]
        for u in range(w):
            for c in range(3):
                total = line[3 * step * u + c]
                for i in range(1, step):
                    total += line[3 * (step * u + i) + c]
                ratio[v, u, c] = share * np.float32(total) / background[v, u, c]
    return ratio


@compiled
def _change_at(seen: IntArray, slopes: Float32Map, flat: Float32Map) -> tuple[Float32Map, Float32Map]:
    """Slopes (k, 2) of the seen pixels (k,) less those of flat gel (h, w, 2): (2, h, w), and weights (h, w)."""
    h, w, _ = flat.shape
    change, weight = np.zeros((2, h, w), dtype=np.float32), np.zeros((h, w), dtype=np.float32)
    for k in range(len(seen)):
        v, u = seen[k] // w, seen[k] % w
        weight[v, u] = 1.0
        change[0, v, u] = slopes[k, 0] - flat[v, u, 0]
        change[1, v, u] = slopes[k, 1] - flat[v, u, 1]
    return change, weight


@compiled
def _steeper(slopes: Float32Map) -> Float32Map:
    """The larger of the two slopes' magnitudes, (h, w)."""
    _, h, w = slopes.shape
    steepness = np.empty((h, w), dtype=np.float32)
    for v in range(h):
        for u in range(w):
            steepness[v, u] = max(abs(slopes[0, v, u]), abs(slopes[1, v, u]))
    return steepness


@compiled
def _calm_gel(steepness: Float32Map, untouched: BoolArray, visible: bool) -> tuple[BoolArray, BoolArray]:
    """Gel (h, w) that may tell about the lamps: untouched and flat; leaning little, pressed in or not."""
    h, w = steepness.shape
    calm, lean = np.empty((h, w), dtype=np.bool_), np.empty((h, w), dtype=np.bool_)
    for v in range(h):
        for u in range(w):
            calm[v, u] = visible and untouched[v, u] and steepness[v, u] < _CALM
            lean[v, u] = steepness[v, u] < _LEANS
    return calm, lean


@compiled
def _variation(slopes: Float32Map, uv: FloatArray, radius: float) -> FloatArray:
    """Standard deviation (n,) of slopes (2, h, w) around places (n, 2), on rings of a radius; map pixels."""
    _, h, w = slopes.shape
    variation = np.full(len(uv), np.nan)
    for i in range(len(uv)):
        if np.isnan(uv[i, 0] + uv[i, 1]):
            continue
        variance = 0.0
        for c in range(2):
            total, squares = 0.0, 0.0
            for k in range(_RING_POINTS):
                angle = 2.0 * np.pi * k / _RING_POINTS
                u = min(max(round(uv[i, 0] + radius * np.cos(angle)), 0), w - 1)
                v = min(max(round(uv[i, 1] + radius * np.sin(angle)), 0), h - 1)
                total += slopes[c, v, u]
                squares += slopes[c, v, u] ** 2
            variance += max(squares / _RING_POINTS - (total / _RING_POINTS) ** 2, 0.0)
        variation[i] = np.sqrt(variance)
    return variation
