"""Everything compiled is made ready before the first image, which would otherwise wait for it."""

from __future__ import annotations

import functools

import numpy as np

from tiptrace.perception.depth import untouched_gel
from tiptrace.perception.full_depth import FullDepth
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.perception.lifters import FullLifter
from tiptrace.perception.planar import MotionPatch
from tiptrace.perception.registration import RegisteredTracker
from tiptrace.perception.seeding import seed
from tiptrace.types import Image

_GEL = "gelsight-mini-virtual"
_SIZE_PX, _PITCH_PX, _RADIUS_PX = (160, 120), 24, 4.0


@functools.cache
def warm_up() -> None:
    """Run the chain once on a made-up gel: compiles what is not yet on disk (half a minute), loads the rest.

    Once per process; calls after the first cost nothing.
    """
    reference, image = _dots(0.0), _dots(0.8)
    depth = FullDepth(load_gel_model(_GEL), reference, (1e-4, 1e-4))
    seeds = seed(image, reference)
    tracker = RegisteredTracker(image, seeds.markers)
    lift = FullLifter(depth, tracker, seeds.ghosts)
    tracker.update(_dots(0.5 * _PITCH_PX))  # a leap
    uv_px, tracked = tracker.update(_dots(1.6))
    patch = MotionPatch(seeds.rest_px)
    for shift_px in (0.0, 1.6):
        patch.update(seeds.rest_px + shift_px, tracked)
    map_ = lift(image, uv_px, tracked).map
    if map_ is not None:
        untouched_gel(map_.depth_m, np.zeros((*map_.depth_m.shape, 2), dtype=np.float32))


def _dots(shift_px: float) -> Image:
    """A grey gel with a grid of dots, moved to the right."""
    W, H = _SIZE_PX
    v, u = np.indices((H, W), dtype=np.float64)
    du, dv = (u - shift_px) % _PITCH_PX - _PITCH_PX / 2, v % _PITCH_PX - _PITCH_PX / 2
    ink = np.clip(_RADIUS_PX + 0.5 - np.hypot(du, dv), 0.0, 1.0)
    slope = 0.2 * np.exp(-0.5 * ((u - W / 2) / 8.0) ** 2)  # something for the fill along edges
    return np.repeat(((140.0 * (1.0 + slope)) * (1.0 - 0.7 * ink))[..., None], 3, axis=2).astype(np.uint8)
