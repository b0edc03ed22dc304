"""Images of a deformed marker gel, as the sensor's camera would give them.

A pixel (u, v) looks at ((u − c_u)·s_x, (v − c_v)·s_y), c the image centre ((w − 1)/2, (h − 1)/2). Height and
slopes of the surface come from a cubic spline over the gel's grid; dots are discs with analytic soft edges,
centred on their true position to far better than 0.02 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import sparse

from tiptrace.sim.dots import DotLayout, DotTruth, dot_transmission, place_dots
from tiptrace.sim.gel import (
    Float32Array,
    GelDeformation,
    GelGrid,
    spline_basis,
    spline_coefficients,
    untouched,
)
from tiptrace.sim.optics import Optics, irradiance, nominal_optics, untouched_colour
from tiptrace.types import FloatArray, Image

JPEG_QUALITY = 95
"""Default quality at which a rendered recording is compressed."""


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """What comes on top of a perfect image.

    Attributes:
        sigma_bgr: Standard deviation per channel, grey levels.
        fixed_pattern: Standard deviation of the coating's grain, the same in every frame, grey levels.
        flicker: Standard deviation of each channel's lamp level from frame to frame, a share.
        drift_per_minute: Slow change of the lamps' level, a share per minute.
        drift_limit: Where the slow change settles, a share.
    """

    sigma_bgr: tuple[float, float, float] = (2.2, 1.3, 1.8)
    fixed_pattern: float = 0.6
    flicker: float = 0.0
    drift_per_minute: float = 0.0
    drift_limit: float = 0.1


NO_NOISE = CameraNoise((0.0, 0.0, 0.0), 0.0)
LIVING_LAMPS = CameraNoise(flicker=0.002, drift_per_minute=0.01)


class TactileRenderer:
    """One sensor's camera: optics, dots, scale and noise are fixed, deformations come and go."""

    def __init__(
        self,
        optics: Optics | None = None,
        layout: DotLayout | None = None,
        noise: CameraNoise | None = None,
        *,
        image_size_px: tuple[int, int] = (320, 240),
        metres_per_px: tuple[float, float] = (0.0625e-3, 0.0625e-3),
        shown_fraction: float = 1.0,
        seed: int = 0,
    ) -> None:
        """Prepare a sensor.

        Args:
            optics: How the gel looks; the fitted gel by default.
            layout: Dots; None renders a gel without markers.
            noise: Camera noise and lamps; sensor noise alone by default.
            image_size_px: Width and height.
            metres_per_px: Scale in x and y.
            shown_fraction: Share of the surface's tangential motion that the dots, which lie deeper, make.
            seed: Noise, grain and the dots' irregularities.
        """
        self.optics = optics or nominal_optics()
        self.layout = layout
        self.noise = noise or CameraNoise()
        self.shown_fraction = shown_fraction
        self.metres_per_px = metres_per_px
        self.seed = seed
        self._grid: GelGrid | None = None
        self._rows: list[sparse.csr_array] = []
        self._columns: list[sparse.csr_array] = []
        width, height = image_size_px
        self.x_m: FloatArray = (np.arange(width, dtype=np.float64) - (width - 1) / 2) * metres_per_px[0]
        self.y_m: FloatArray = (np.arange(height, dtype=np.float64) - (height - 1) / 2) * metres_per_px[1]
        X, Y = np.meshgrid(self.x_m, self.y_m)
        rng = np.random.default_rng([seed, 0xD075])
        self.dots = None if layout is None else layout.draw(rng)
        white = rng.standard_normal((height, width)).astype(np.float32)
        grain: Float32Array = np.asarray(cv2.GaussianBlur(white, (0, 0), 0.8), np.float32)
        grain *= self.noise.fixed_pattern / max(float(grain.std()), 1e-9)
        self._background = untouched_colour(self.optics, X, Y).astype(np.float32) + grain[..., None]
        flat = np.zeros((1, 1), np.float32)
        self._per_irradiance = [
            self._background[..., c] / irradiance(self.optics, c, flat, flat, X, Y) for c in range(3)
        ]

    def render(self, deformation: GelDeformation, frame: int = 0, time_s: float = 0.0) -> Image:
        """Image (height, width, 3), BGR uint8, of a deformed gel.

        Args:
            deformation: The gel.
            frame: Number of the exposure; decides the noise, so that order and repetition do not matter.
            time_s: Time since the lamps were switched on, for their slow drift.
        """
        image = self.render_clean(deformation)
        rng = np.random.default_rng([self.seed, 1, frame])
        image *= self._lamp_level(rng, time_s)
        sigma = np.asarray(self.noise.sigma_bgr, np.float32)
        if sigma.any():
            image += rng.standard_normal(image.shape, dtype=np.float32) * sigma
        return np.asarray(np.clip(image + np.float32(0.5), 0, 255).astype(np.uint8))

    def reference(self, frames: int = 10) -> Image:
        """The untouched gel, averaged over some frames as a user would take it."""
        clean = self.render_clean(untouched())
        rng = np.random.default_rng([self.seed, 2])
        sigma = np.asarray(self.noise.sigma_bgr, np.float32) / np.float32(np.sqrt(frames))
        clean += rng.standard_normal(clean.shape, dtype=np.float32) * sigma
        return np.asarray(np.clip(clean + np.float32(0.5), 0, 255).astype(np.uint8))

    def render_clean(self, deformation: GelDeformation) -> Float32Array:
        """Image (height, width, 3) float32 without noise and before rounding."""
        z_x, z_y = self.slopes(deformation)
        X, Y = self.x_m[None, :], self.y_m[:, None]
        image = np.empty((*z_x.shape, 3), np.float32)
        for c in range(3):
            image[..., c] = self._per_irradiance[c] * irradiance(self.optics, c, z_x, z_y, X, Y)
        self._add_gloss(image, z_x, z_y)
        if self.dots is not None:
            kept, glint = dot_transmission(self.dots, self.dot_truth(deformation), z_x.shape)
            image *= kept[..., None]
            image += glint[..., None]
        return image

    def dot_truth(self, deformation: GelDeformation) -> DotTruth:
        """Where the dots are in the image and in F_S.

        Raises:
            ValueError: the gel has no dots.
        """
        if self.dots is None:
            raise ValueError("this gel has no dots: give the renderer a DotLayout")
        return place_dots(self.dots, deformation, self.shown_fraction, self.metres_per_px, self.size_px)

    def heights(self, deformation: GelDeformation) -> Float32Array:
        """True surface height along +z_S at each pixel, (height, width), m."""
        return self._sample(deformation, 0, 0)

    def slopes(self, deformation: GelDeformation) -> tuple[Float32Array, Float32Array]:
        """∂z/∂x and ∂z/∂y at each pixel, (height, width) each."""
        return self._sample(deformation, 0, 1), self._sample(deformation, 1, 0)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the image."""
        return len(self.x_m), len(self.y_m)

    def _sample(self, deformation: GelDeformation, nu_y: int, nu_x: int) -> Float32Array:
        grid = deformation.grid
        if grid is not self._grid:
            self._grid = grid
            self._rows = [spline_basis(grid.y_m, self.y_m, nu) for nu in (0, 1)]
            self._columns = [spline_basis(grid.x_m, self.x_m, nu) for nu in (0, 1)]
        along_x = self._columns[nu_x] @ spline_coefficients(deformation.height_m).T  # (width, ny)
        return np.asarray(self._rows[nu_y] @ along_x.T, np.float32)

    def _lamp_level(self, rng: np.random.Generator, time_s: float) -> Float32Array:
        rise = self.noise.drift_limit * np.tanh(
            self.noise.drift_per_minute * time_s / 60 / max(self.noise.drift_limit, 1e-9)
        )
        level = (1 + rise) * (1 + self.noise.flicker * rng.standard_normal(3))
        return np.asarray(level, dtype=np.float32)

    def _add_gloss(self, image: Float32Array, z_x: Float32Array, z_y: Float32Array) -> None:
        """A broad highlight of the half-matte coating where it leans away from the flat by some 20°."""
        if self.optics.gloss <= 0:
            return
        lean = 0.4 - self.x_m[None, :].astype(np.float32) / np.float32(0.05)
        off = (z_x + lean * np.float32(0.5)) ** 2 + (z_y - np.float32(0.35)) ** 2
        image += (np.float32(self.optics.gloss) * np.exp(-off / np.float32(0.02)))[..., None]
