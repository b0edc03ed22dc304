"""``map.yaml``: which topics of somebody else's recording play which part."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tiptrace.errors import ConfigError
from tiptrace.streams.sample_reader import TrialTopics
from tiptrace.types import SIDES, Image, Side

_Positive = Annotated[int, Field(gt=0, le=20_000)]
_NotNegative = Annotated[int, Field(ge=0, le=20_000)]
_FLIP_CODES = {"horizontal": 1, "vertical": 0, "both": -1}


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ImageMap(_Model):
    """One finger's images; they are cropped, then flipped, then resized to what the rig file says.

    Attributes:
        topic: ``CompressedImage`` or ``Image``.
        crop_px: Left, top, width, height in the image as recorded.
        flip: ``horizontal`` exchanges left and right.
        resize_px: Width, height.
    """

    topic: str = Field(min_length=1)
    crop_px: tuple[_NotNegative, _NotNegative, _Positive, _Positive] | None = None
    flip: Literal["none", "horizontal", "vertical", "both"] = "none"
    resize_px: tuple[_Positive, _Positive] | None = None

    def prepare(self, image: Image) -> Image:
        """Crop, flip, resize: (h, w, 3) BGR in, the same out.

        Raises:
            ConfigError: the crop lies outside the image.
        """
        if self.crop_px is not None:
            left, top, width, height = self.crop_px
            if left + width > image.shape[1] or top + height > image.shape[0]:
                raise ConfigError(
                    f"map file: crop_px {list(self.crop_px)} of {self.topic} (left, top, width, height) lies outside "
                    f"the image of {image.shape[1]}x{image.shape[0]} px; correct it"
                )
            image = image[top : top + height, left : left + width]
        if self.flip != "none":
            image = np.asarray(cv2.flip(image, _FLIP_CODES[self.flip]), dtype=np.uint8)
        if self.resize_px is not None and (image.shape[1], image.shape[0]) != self.resize_px:
            image = np.asarray(
                cv2.resize(image, self.resize_px, interpolation=cv2.INTER_AREA), dtype=np.uint8
            )
        return np.ascontiguousarray(image)


class TfChain(_Model):
    """T_B_E from TF: the transform of ``end_effector`` in ``base``, over whatever links lie between."""

    base: str = Field(min_length=1)
    end_effector: str = Field(min_length=1)
    topics: tuple[str, ...] = ("/tf", "/tf_static")


class MapFile(_Model):
    """``map.yaml`` (format tiptrace-map/1)."""

    format: Literal["tiptrace-map/1"] = "tiptrace-map/1"
    left: ImageMap
    right: ImageMap
    pose: str | None = None
    tf: TfChain | None = None
    phase: str | None = None
    opening: str | None = None
    truth: str | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if (self.pose is None) == (self.tf is None):
            raise ValueError("give either pose (a PoseStamped topic) or tf (base and end_effector)")
        if self.left.topic == self.right.topic:
            raise ValueError(f"left and right are the same topic {self.left.topic!r}")
        return self

    def image(self, side: Side) -> ImageMap:
        """One finger."""
        return self.left if side == "left" else self.right

    def topics(self) -> TrialTopics:
        """Which topic plays which part."""
        return TrialTopics(
            images={side: self.image(side).topic for side in SIDES},
            pose=self.pose,
            phase=self.phase,
            opening=self.opening,
            truth=self.truth,
        )


def parse_frame_range(text: str) -> tuple[int, int]:
    """``0:20`` → (0, 20), the first 20 frames.

    Raises:
        ConfigError: not of that form, or empty.
    """
    start, colon, stop = text.partition(":")
    try:
        first, end = int(start or 0), int(stop)
    except ValueError:
        first, end = 0, 0
    if not colon or not 0 <= first < end:
        raise ConfigError(
            f"reference frames {text!r}: expected START:STOP with START < STOP, for example 0:20"
        )
    return first, end
