"""Tactile images of an episode, compressed as they come in, with what a dataset says of their colours."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from tiptrace.errors import OutputError
from tiptrace.types import Image

_QUALITY = 95
_STATS_EVERY = 10


class EncodedImages:
    """Images of one camera: JPEG each (depth comes from shading, which a video codec smooths away).

    Attributes:
        shape: Height, width, channels.
        encoded: One file content per frame.
    """

    def __init__(self) -> None:
        self.shape: tuple[int, int, int] = (0, 0, 3)
        self.encoded: list[bytes] = []
        self._sampled: list[
            tuple[Any, Any, Any, Any]
        ] = []  # per sampled frame, (3,) each: min, max, mean, mean square

    def append(self, image: Image) -> None:
        """Compress the next image, (h, w, 3) BGR.

        Raises:
            OutputError: its size differs from the first one's.
        """
        if self.encoded and image.shape != self.shape:
            raise OutputError(f"image {len(self.encoded)} is {image.shape}, the first one {self.shape}")
        self.shape = (image.shape[0], image.shape[1], 3)
        if len(self.encoded) % _STATS_EVERY == 0:
            rgb = image[..., ::-1].reshape(-1, 3) / 255.0
            self._sampled.append((rgb.min(axis=0), rgb.max(axis=0), rgb.mean(axis=0), (rgb**2).mean(axis=0)))
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        if not done:
            raise OutputError(f"image {len(self.encoded)} cannot be compressed")
        self.encoded.append(data.tobytes())

    def __len__(self) -> int:
        return len(self.encoded)

    def stats(self) -> dict[str, list[Any]]:
        """Of every tenth image, RGB from 0 to 1, in LeRobot's shape (3, 1, 1)."""
        least, most, mean, square = (np.array(v) for v in zip(*self._sampled, strict=True))  # (n, 3) each
        centre = mean.mean(axis=0)
        deviation = np.sqrt(np.maximum(square.mean(axis=0) - centre**2, 0.0))
        kinds = {"min": least.min(axis=0), "max": most.max(axis=0), "mean": centre, "std": deviation}
        return {**{k: v.reshape(3, 1, 1).tolist() for k, v in kinds.items()}, "count": [len(self._sampled)]}
