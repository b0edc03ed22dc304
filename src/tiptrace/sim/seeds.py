"""Random streams of a trial: one per purpose, so that switching one disturbance leaves the others' draws alone."""

from __future__ import annotations

from typing import Literal

import numpy as np

Purpose = Literal["nominal-tip", "rig", "gel-left", "gel-right", "markers", "pose", "timing", "opening"]
_ORDER: tuple[Purpose, ...] = (
    "nominal-tip",
    "rig",
    "gel-left",
    "gel-right",
    "markers",
    "pose",
    "timing",
    "opening",
)


def stream(seed: int, purpose: Purpose) -> np.random.Generator:
    """The random stream of a purpose in the trial with this seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_ORDER.index(purpose),)))
