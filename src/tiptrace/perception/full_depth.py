"""Depth by the full method: masks from the dots, smooth continuation under them, lamps corrected.

At a coarser step the network sees means over step × step pixels, which costs a quarter at step 2 and less noise.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.perception.background import untouched_background
from tiptrace.perception.depth import DepthMap, untouched_gel
from tiptrace.perception.dot_fill import DotFill
from tiptrace.perception.fill import smooth_fill
from tiptrace.perception.gel_model import GelModel
from tiptrace.perception.illumination import LampGain, Level
from tiptrace.perception.lifting import sample_map
from tiptrace.perception.markers import check_image
from tiptrace.perception.poisson import PoissonSolver
from tiptrace.types import BoolArray, FloatArray, Image

Float32Map = NDArray[np.float32]

_RING = np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1)  # (8, 2)
_VISIBLE = 0.1  # of the image that must be untouched to level a map by it
_CALM = 0.02  # slope below which gel may tell about the lamps
_FIRST_ROUNDS = 6
_LEANS = 0.06  # slope below which gel, pressed in or not, may tell about a gain common to the lamps
_NOISE_M = 12e-6  # of a marker's depth, wherever it lies
_DEPTH_SHARE = 0.03  # of the depth: what a network errs by in scale on another gel of the same make
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
        self._background = self._shrink(untouched_background(reference))
        self._floor = np.maximum(self._background, np.float32(1.0))
        scale = (metres_per_px[0] * step, metres_per_px[1] * step)
        self._solver = PoissonSolver(shape, scale)
        self._level = Level(shape, scale)
        self._dot_fill: DotFill | None = None
        self._lamps = LampGain(shape, self._network)
        self._flat = self._network(np.ones_like(self._background))  # what the network says of untouched gel
        self._calm: BoolArray | None = None
        self._lean_little = np.ones(shape, dtype=np.bool_)
        self._slopes: Float32Map = np.zeros((*shape, 2), dtype=np.float32)

    def __call__(self, image: Image, mask: BoolArray, uv_px: FloatArray) -> DepthMap:
        """Depth of an image, (h, w).

        Args:
            image: (H, W, 3) uint8 BGR, of the reference's size.
            mask: Map pixels, (h, w) of :attr:`shape`, that the network must not look at.
            uv_px: (n, 2) centres of the dots.
        """
        ratio = np.asarray(self._shrink(image.astype(np.float32)) / self._floor, dtype=np.float32)
        if self._calm is None:  # first frame: calm gel, gain and tilt are found together
            self._measure(ratio, mask, uv_px)
            for _ in range(_FIRST_ROUNDS):
                self._lamps.forget()
                self._level.forget()
                self._measure(self._lit(ratio, mask), mask, uv_px)
        return self._measure(self._lit(ratio, mask), mask, uv_px)

    def _lit(self, ratio: Float32Map, mask: BoolArray) -> Float32Map:
        """A ratio image (h, w, 3) as if the lamps had not changed."""
        assert self._calm is not None
        return self._lamps.correct(ratio, self._calm & ~mask, self._lean_little & ~mask)

    def _measure(self, ratio: Float32Map, mask: BoolArray, uv_px: FloatArray) -> DepthMap:
        """Depth from a ratio image (h, w, 3) that lamps no longer disturb; remembers slopes and calm gel."""
        self._slopes = smooth_fill(self._network(ratio) - self._flat, mask)  # (h, w, 2)
        if self._dot_fill is not None:
            self._dot_fill.apply(self._slopes, (uv_px - (self.step - 1) / 2) / self.step)
        h = -self._solver.integrate(self._slopes[..., 0], self._slopes[..., 1])
        untouched, _ = untouched_gel(h, self._slopes)
        visible = float(untouched.mean()) > _VISIBLE
        h = self._level.apply(h, untouched if visible else None)
        steepness = np.maximum(np.abs(self._slopes[..., 0]), np.abs(self._slopes[..., 1]))
        steepness = cv2.blur(steepness, (5, 5))
        self._calm = untouched & (steepness < _CALM) & visible
        self._lean_little = np.asarray(steepness < _LEANS)
        return DepthMap(depth_m=h, untouched=untouched, zero_visible=visible)

    def expect_dots(self, radius_px: float) -> None:
        """Say how large the masked discs of dots are."""
        self._dot_fill = DotFill(self.shape, (radius_px + 0.75 * self.step) / self.step)

    def at(self, depth: DepthMap, uv_px: FloatArray) -> FloatArray:
        """Depth (n,) m at image positions (n, 2)."""
        return sample_map(depth.depth_m, uv_px, self.step)

    def sigma_at(self, uv_px: FloatArray, depth_m: FloatArray, radius_px: float) -> FloatArray:
        """Standard deviation (n,) m of depths (n,) under dots: noise, scale, and what the fill cannot know.

        The fill's error grows with how much the slope varies around the dot.
        """
        ring = radius_px + self.step
        around = uv_px[:, None] + ring * _RING[None]  # (n, 8, 2)
        flat = around.reshape(-1, 2)
        samples = [sample_map(self._slopes[..., c], flat, self.step).reshape(-1, len(_RING)) for c in (0, 1)]
        variation = np.sqrt(sum(np.var(s, axis=1) for s in samples))  # (n,) m/m
        fill = _FILL_SHARE * variation * radius_px * self._s
        return np.asarray(np.sqrt(_NOISE_M**2 + (_DEPTH_SHARE * depth_m) ** 2 + fill**2))

    def _network(self, ratio: Float32Map) -> Float32Map:
        colours = ratio - 1.0 if self._gel.convention.background == "ratio" else ratio * self._background
        slopes = self._gel.slopes(
            np.ascontiguousarray(colours.reshape(-1, 3), dtype=np.float32), self._unit_uv
        )
        return slopes.reshape(*ratio.shape[:2], 2)

    def _shrink(self, image: Float32Map) -> Float32Map:
        """Means over step × step pixels."""
        cropped = image[: self._crop[0], : self._crop[1]]
        if self.step == 1:
            return cropped
        return np.asarray(cv2.resize(cropped, self._size, interpolation=cv2.INTER_AREA), dtype=np.float32)
