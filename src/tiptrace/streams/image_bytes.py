"""Encoded pictures from anybody's file: only formats that cameras send, and of a size that memory can hold."""

from __future__ import annotations

import struct

import cv2
import numpy as np

from tiptrace.types import Image

MAX_PIXELS = 32_000_000  # four times a full GelSight Mini frame
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_NO_SIZE = {0xC4, 0xC8, 0xCC}  # markers among the frame headers that are none
_ALONE = {0x01, *range(0xD0, 0xD8)}  # markers without a length


def decode_image(data: bytes | memoryview | np.ndarray) -> Image | None:
    """(height, width, 3) BGR of a png or jpeg; None for anything else, damage, or more than ``MAX_PIXELS``.

    The size is read from the file's header first: a decoder would allocate whatever a few bytes claim.
    """
    content = bytes(data)
    size = image_size(content)
    if size is None or not 0 < size[0] * size[1] <= MAX_PIXELS:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a png or jpeg claims; None where neither is found."""
    if data.startswith(_PNG) and len(data) >= 24 and data[12:16] == b"IHDR":
        width, height = struct.unpack_from(">II", data, 16)
        return width, height
    if data.startswith(_JPEG):
        return _jpeg_size(data)
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """The largest frame that the headers before the first scan claim."""
    at, found = 2, None
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            at += 1
            continue
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        if marker == 0xDA:
            break
        if marker in _ALONE or marker == 0x00:
            at += 2
            continue
        if 0xC0 <= marker <= 0xCF and marker not in _NO_SIZE:
            height, width = struct.unpack_from(">HH", data, at + 5)
            if found is None or width * height > found[0] * found[1]:
                found = (width, height)
        at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return found
