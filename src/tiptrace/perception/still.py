"""Depth of a single tactile image, without tracking."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from tiptrace.errors import PerceptionError
from tiptrace.perception.depth import DepthMap, PaperDepth, at_image_size
from tiptrace.perception.full_depth import FullDepth
from tiptrace.perception.gel_model import GelModel
from tiptrace.perception.markers import detect_markers, dot_mask
from tiptrace.types import Image


def read_image(path: Path) -> Image:
    """A colour image from a file, (H, W, 3) uint8 BGR.

    Raises:
        PerceptionError: no such file, or it cannot be read.
    """
    if not path.is_file():  # OpenCV would print a warning of its own
        raise PerceptionError(f"{path}: no such file; is the path right?")
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise PerceptionError(f"{path}: cannot be read as an image; is the file complete?")
    return np.asarray(image, dtype=np.uint8)


def depth_of_image(
    image: Image,
    reference: Image,
    gel: GelModel,
    metres_per_px: tuple[float, float],
    method: Literal["full", "paper"] = "full",
    marker_threshold: tuple[float, float] = (0.0, 70.0),
) -> DepthMap:
    """Depth map against the untouched gel; gels with and without dots.

    Raises:
        PerceptionError: sizes differ, or an image is black or overexposed.
    """
    if image.shape != reference.shape:
        raise PerceptionError(
            f"image ({image.shape[1]}×{image.shape[0]}) and reference ({reference.shape[1]}×{reference.shape[0]}) "
            "differ in size: take both with the same camera settings"
        )
    if method == "paper":
        return PaperDepth(gel, reference, metres_per_px, marker_threshold)(image)
    chain = FullDepth(gel, reference, metres_per_px)
    try:
        uv_px = detect_markers(image).uv_px
    except PerceptionError:  # a gel without dots
        uv_px = np.zeros((0, 2))
    size = (chain.shape[1], chain.shape[0])
    mask = cv2.resize(dot_mask(image).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    height, width = image.shape[:2]
    return at_image_size(chain(image, np.asarray(mask), uv_px), (height, width))
