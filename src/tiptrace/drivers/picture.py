"""From what a camera sends to the image that the rig means; damaged pictures are refused."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tiptrace.config import Sensor
from tiptrace.drivers.jpeg_head import ScanError
from tiptrace.drivers.jpeg_scan import ScanFacts, same_camera, walk
from tiptrace.errors import DeviceError
from tiptrace.types import Image

JPEG_QUALITY = 95
_FLIP = {"horizontal": 1, "vertical": 0, "both": -1}
_MOST_PX = 32_000_000
_BLOCKS = (16, 12)  # of which the picture's means are compared, x and y
_BLOCK_STEP = 40.0  # grey levels by which no gel changes the means …
_MANY_BLOCKS = 6  # … of so many blocks
_SHIFT = 5.0  # grey levels; a real camera's pictures shift by 2.6
_SAME_STEP, _SAME_BLOCKS = 20.0, 3  # the same between two pictures of one thing
_SHARPER, _SHARPNESS = 2.0, 16.0  # times the picture before, and grey levels times 8 more
_ALIKE = 0.1  # of the sharpness of two pictures of the same thing
_REDUCED = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}


class PictureError(ValueError):
    """A picture that is cut off or damaged; the text says how."""


def inspect_jpeg(data: bytes) -> ScanFacts:
    """Make sure that a jpeg is whole; what it tells of itself.

    OpenCV fills what is missing with grey and says nothing, so the file is walked through first.

    Raises:
        PictureError: cut off, damaged, or no jpeg.
    """
    if data[:2] != b"\xff\xd8":
        raise PictureError("does not begin as a jpeg")
    end = data.rstrip(b"\x00")  # cameras pad
    if end[-2:] != b"\xff\xd9":
        raise PictureError("is cut off")
    try:
        facts = walk(end)
    except ScanError as error:
        raise PictureError(str(error)) from None
    if facts.size_px is not None and facts.size_px[0] * facts.size_px[1] > _MOST_PX:
        raise PictureError(f"claims {facts.size_px[0]}x{facts.size_px[1]} px")
    return facts


def decode_jpeg(data: bytes, reduction: int = 1) -> Image:
    """A jpeg that is whole → (height / reduction, width / reduction, 3) BGR.

    Raises:
        PictureError: OpenCV cannot decode it.
    """
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _REDUCED[reduction])
    except cv2.error:
        image = None
    if image is None:
        raise PictureError("cannot be decoded")
    return np.asarray(image, dtype=np.uint8)


def encode_jpeg(image: Image) -> bytes:
    """(height, width, 3) BGR → jpeg, as recordings hold it."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()


class Framing:
    """Crop, flip and size of one finger's images.

    Args:
        sensor: What the rig says; ``camera`` may be absent.
    """

    def __init__(self, sensor: Sensor) -> None:
        camera = sensor.camera
        self.size_px = tuple(sensor.image_size_px)
        self.source_px = tuple(camera.size_px) if camera and camera.size_px else None
        self._crop_px = camera.crop_px if camera else None
        self._flip = _FLIP.get((camera.flip if camera else None) or "none")

    def unchanged(self, image: Image) -> bool:
        """Whether an image is already what the rig means."""
        return self._crop_px is None and self._flip is None and _size(image) == self.size_px

    def reduction(self, size_px: tuple[int, int] | None) -> int:
        """By how much a decoder may shrink a jpeg of this size on its way: no more than the rig does anyway."""
        if size_px is None:
            return 1
        crop = self._crop_px or (0, 0, *size_px)
        for factor in (8, 4, 2):
            whole = all(n % factor == 0 for n in (*size_px, *crop))
            if whole and crop[2] // factor >= self.size_px[0] and crop[3] // factor >= self.size_px[1]:
                return factor
        return 1

    def check(self, name: str, image: Image, reduction: int = 1) -> None:
        """The camera must send the size that was asked for, and the crop must lie in it.

        Raises:
            DeviceError: another size.
        """
        W, H = (n * reduction for n in _size(image))
        if self.source_px is not None and self.source_px != (W, H):
            raise DeviceError(
                f"{name}: sends {W}x{H} px, the rig file asks for {self.source_px[0]}x{self.source_px[1]}: set "
                "camera.size_px to a size that the camera has (crop_px and mm_per_px belong to it)"
            )
        if self._crop_px is not None:
            left, top, width, height = self._crop_px
            if min(left, top) < 0 or min(width, height) < 1 or left + width > W or top + height > H:
                raise DeviceError(
                    f"{name}: camera.crop_px {list(self._crop_px)} (left, top, width, height) lies outside the "
                    f"image of {W}x{H} px: correct the rig file"
                )

    def apply(self, image: Image, reduction: int = 1) -> Image:
        """Crop, flip, resize: (h, w, 3) BGR in, (height, width, 3) as the rig means out."""
        if self._crop_px is not None:
            left, top, width, height = (n // reduction for n in self._crop_px)
            image = image[top : top + height, left : left + width]
        if self._flip is not None:
            image = np.asarray(cv2.flip(image, self._flip), dtype=np.uint8)
        if _size(image) != self.size_px:
            image = np.asarray(cv2.resize(image, self.size_px, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        return np.ascontiguousarray(image)


@dataclass(frozen=True, slots=True)
class _Look:
    """What two pictures are compared by: (12, 16, 3) means of their blocks, and what the file told."""

    blocks: NDArray[np.float32]
    facts: ScanFacts | None

    def jumps_from(self, last: _Look, step: float = _BLOCK_STEP, many: int = _MANY_BLOCKS) -> bool:
        """Whether parts became brighter or darker, a block much sharper than any, or the tables others."""
        if self.facts is not None and last.facts is not None:
            sharper = self.facts.sharpest > _SHARPER * last.facts.sharpest + _SHARPNESS
            if sharper or not same_camera(last.facts.quantisation, self.facts.quantisation):
                return True
        change = self.blocks - last.blocks
        if int((np.abs(change).max(axis=2) > step).sum()) >= many:
            return True
        return _shift_below_a_row(change) > _SHIFT

    def agrees_with(self, held: _Look) -> bool:
        """Whether the jump that a picture was held back for has stayed: two damaged ones never look alike."""
        a, b = self.facts, held.facts
        if a is not None and b is not None and abs(a.sharpest - b.sharpest) > _ALIKE * b.sharpest + 2.0:
            return False
        return not (self.jumps_from(held, _SAME_STEP, _SAME_BLOCKS) or held.jumps_from(self))


def _shift_below_a_row(change: NDArray[np.float32]) -> float:
    """By how much more the picture changed below some row than above it, levels.

    A damaged number shifts the brightness or colour of all that comes after it; motion and lamps do not.
    """
    rows = np.median(change, axis=1)  # (12, 3)
    total, n = np.cumsum(rows, axis=0), np.arange(1, len(rows))[:, None]
    above, below = total[:-1] / n, (total[-1] - total[:-1]) / (len(rows) - n)
    return float(np.abs(below - above)[1:-1].max())


class Novelty:
    """Tells whether a picture is new, and whether it can follow the last one that could."""

    def __init__(self) -> None:
        self._print: int | None = None
        self._last: _Look | None = None
        self._held: _Look | None = None

    def repeated(self, data: bytes | memoryview) -> bool:
        """Whether these bytes or pixels are those of the picture before; a sensor's noise never repeats."""
        mark = zlib.crc32(data)
        same = mark == self._print
        self._print = mark
        return same

    def broken(self) -> None:
        """A picture came that is damaged: what was held back before it may be so too."""
        self._held = None

    def torn(self, image: Image, facts: ScanFacts | None = None) -> bool:
        """Whether the picture jumped, as after a damaged byte, where a gel deforms gradually.

        A jump that stays is taken at its second frame: lamps may be switched.
        """
        blocks = cv2.resize(image, _BLOCKS, interpolation=cv2.INTER_AREA).astype(np.float32)
        now = _Look(blocks, facts)
        held, self._held = self._held, None
        if (
            self._last is None
            or not now.jumps_from(self._last)
            or (held is not None and now.agrees_with(held))
        ):
            self._last = now
            return False
        self._held = now
        return True


def _size(image: Image) -> tuple[int, int]:
    return image.shape[1], image.shape[0]
