"""Sensors that are connected wrongly: swapped, mirrored, turned, inverted."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from tiptrace.types import FloatArray, Image, Side

Fault = Literal[
    "none",
    "swapped",
    "left-mirrored-x",
    "left-mirrored-y",
    "right-mirrored-x",
    "right-mirrored-y",
    "both-mirrored-x",
    "both-mirrored-y",
    "left-turned",
    "both-turned",
    "left-depth-inverted",
    "poses-inverted",
]
FAULTS: tuple[Fault, ...] = get_args(Fault)


def delivered(side: Side, fault: Fault) -> Side:
    """Under which name a sensor's data arrive."""
    if fault != "swapped":
        return side
    return "right" if side == "left" else "left"


def signs(side: Side, fault: Fault) -> FloatArray:
    """(3,) what a fault does to the markers of a side."""
    if not fault.startswith((side, "both")):
        return np.ones(3)
    if fault.endswith("mirrored-x"):
        return np.array([-1.0, 1.0, 1.0])
    if fault.endswith("mirrored-y"):
        return np.array([1.0, -1.0, 1.0])
    return np.array([-1.0, -1.0, 1.0]) if fault.endswith("turned") else np.array([1.0, 1.0, -1.0])


def flipped(image: Image, side: Side, fault: Fault) -> Image:
    """An image as it arrives."""
    x, y, _ = signs(side, fault)
    out = image[:, ::-1] if x < 0 else image
    return np.ascontiguousarray(out[::-1] if y < 0 else out)
