"""The two gels of a trial: from the tool's pose to images, true dots and noisy 3-D markers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tiptrace.geometry.transforms import invert
from tiptrace.sim.disturbances import MarkerNoise
from tiptrace.sim.dots import DotLayout
from tiptrace.sim.gel import (
    GEL_GRID,
    GelDeformation,
    GelGrid,
    GelParameters,
    PadContact,
    deform,
    grid_over,
    unseen_gel,
)
from tiptrace.sim.optics import Optics, gel_optics, unseen_optics
from tiptrace.sim.pads import node_grid
from tiptrace.sim.render import CameraNoise, TactileRenderer
from tiptrace.sim.rig import IMAGE_SIZE_PX, MM_PER_PX, SIGN
from tiptrace.sim.seeds import stream
from tiptrace.sim.spec import TrialSpec
from tiptrace.sim.tools import ToolShape
from tiptrace.sim.trial import FrameState
from tiptrace.types import SIDES, FloatArray, Image, Side

_MARKER_GRID = grid_over(20e-3, 15e-3, pitch_m=0.5e-3)  # without images the fine grid buys nothing
_NODES = node_grid()


@dataclass(frozen=True, slots=True)
class Gel:
    """One finger's gel.

    Attributes:
        side: Finger.
        T_E_S: (4, 4) true sensor pose in F_E.
        tool: What presses into it.
        grid: Where its surface is sampled.
        renderer: Its camera, and its dots.
        parameters: How it deforms.
    """

    side: Side
    T_E_S: FloatArray
    tool: ToolShape
    grid: GelGrid
    renderer: TactileRenderer
    parameters: GelParameters

    def deformation(self, frame: FrameState) -> GelDeformation:
        """The gel's surface in a frame."""
        T_S_T = invert(self.T_E_S) @ frame.T_E_T
        X, Y = self.grid.mesh()
        penetration = -self.tool.height_above_gel(T_S_T, X, Y, SIGN[self.side])
        k = len(_NODES)
        mine = slice(0, k) if self.side == "left" else slice(k, 2 * k)
        pressed = frame.pads.normal_n[mine] > 0.0
        contact = PadContact(penetration, _NODES[pressed], frame.pads.shear[mine][pressed])
        return deform(contact, self.grid, self.parameters)

    def image(self, deformation: GelDeformation, frame: FrameState) -> Image:
        """What its camera sees."""
        return self.renderer.render(deformation, frame.index, frame.t_s)

    def true_dots(self, deformation: GelDeformation) -> FloatArray:
        """(n, 3) where the dots are in F_S: what a perfect perception of the image would find."""
        dots = self.renderer.dots
        assert dots is not None
        return deformation.dots(dots.rest_xy, self.renderer.shown_fraction)


def make_gels(spec: TrialSpec, T_E_S: dict[str, FloatArray], tool: ToolShape) -> dict[Side, Gel]:
    """Both gels of a trial; optics, dots and camera noise follow the seed."""
    d = spec.disturbed_by
    layout = DotLayout(
        rows=spec.marker_grid[0],
        columns=spec.marker_grid[1],
        pitch_m=(spec.marker_pitch_m, spec.marker_pitch_m),
    )
    grid = GEL_GRID if spec.mode == "images" else _MARKER_GRID

    def gel(side: Side) -> Gel:
        rng = stream(spec.seed, "gel-left" if side == "left" else "gel-right")
        unit = int(rng.integers(2**31))
        drift = d.illumination_drift * float(rng.normal())
        noise = _camera_noise(
            d.camera_noise, flicker=0.5 * d.illumination_drift, drift_per_minute=4.0 * drift
        )
        renderer = TactileRenderer(
            _optics(d.optics, unit),
            layout,
            noise,
            image_size_px=IMAGE_SIZE_PX,
            metres_per_px=(MM_PER_PX * 1e-3, MM_PER_PX * 1e-3),
            shown_fraction=d.shown_shear,
            seed=unit,
        )
        parameters = unseen_gel(unit) if d.gel_law == "unseen" else GelParameters()
        return Gel(side, T_E_S[side], tool, grid, renderer, parameters)

    return {side: gel(side) for side in SIDES}


def _optics(kind: str, unit: int) -> Optics:
    return unseen_optics(unit) if kind == "unseen" else gel_optics(unit if kind == "standard" else None)


def _camera_noise(share: float, flicker: float, drift_per_minute: float) -> CameraNoise:
    full = CameraNoise()
    b, g, r = (share * sigma for sigma in full.sigma_bgr)
    return CameraNoise((b, g, r), share * full.fixed_pattern, flicker, drift_per_minute)


@dataclass(slots=True)
class MarkerSensor:
    """A pad's 3-D markers with the errors of mode ``markers``.

    Attributes:
        noise: How large they are.
        scale: (2,) believed over true metres-per-pixel.
        rng: Its random stream.
    """

    noise: MarkerNoise
    scale: FloatArray
    rng: np.random.Generator
    _tilt: FloatArray | None = field(default=None)
    _bias: FloatArray | None = field(default=None)
    _t_s: float = field(default=0.0)

    def measure(self, x_S: FloatArray, t_s: float) -> FloatArray:
        """(n, 3) measured markers from the true ones, m."""
        n = self.noise
        if self._tilt is None or self._bias is None:
            self._tilt = n.tilt_rad * self.rng.normal(size=2)
            self._bias = n.bias_m * self.rng.normal(size=len(x_S))
        else:  # Ornstein–Uhlenbeck, exact over any step
            keep = float(np.exp(-(t_s - self._t_s) / n.tilt_s))
            self._tilt = keep * self._tilt + n.tilt_rad * np.sqrt(1.0 - keep * keep) * self.rng.normal(size=2)
        self._t_s = t_s
        white = self.rng.normal(size=x_S.shape) * [n.in_plane_m, n.in_plane_m, n.depth_m]
        measured = x_S * [self.scale[0], self.scale[1], n.shown_depth]
        measured = measured + white
        measured[:, 2] += self._bias + x_S[:, :2] @ self._tilt
        return np.asarray(measured)
