"""The walk through a jpeg: whole files of every kind pass, damaged ones do not."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from tests.streams.helpers import texture
from tiptrace.drivers.jpeg_scan import ScanError, same_camera, walk
from tiptrace.drivers.picture import Novelty, PictureError, decode_jpeg, inspect_jpeg
from tiptrace.types import FloatArray, Image

KINDS: dict[str, list[int]] = {
    "usual": [],
    "quality 40": [cv2.IMWRITE_JPEG_QUALITY, 40],
    "quality 100": [cv2.IMWRITE_JPEG_QUALITY, 100],
    "own codes": [cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    "restarts": [cv2.IMWRITE_JPEG_RST_INTERVAL, 7],
    "4:4:4": [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444],
    "4:2:2": [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422],
    "4:4:0": [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_440],
    "progressive": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
}


def pictures() -> list[Image]:
    """A gel, odd sizes, and what is hardest to code."""
    rng = np.random.default_rng(0)
    checks = (np.indices((64, 72)).sum(axis=0) % 2 * 255).astype(np.uint8)
    noise = rng.integers(0, 256, (51, 70, 3)).astype(np.uint8)
    return [texture(3, (320, 240)), texture(2, (323, 237)), checks, noise, np.zeros((8, 8, 3), np.uint8)]


def jpeg(image: Image, *options: int) -> bytes:
    data: bytes = cv2.imencode(".jpg", image, list(options))[1].tobytes()
    return data


@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
def test_whole_files_of_every_kind_pass(options: list[int]) -> None:
    for image in pictures():
        facts = walk(jpeg(image, *options))
        if options != KINDS["progressive"]:
            assert facts.size_px == (image.shape[1], image.shape[0])


def test_a_file_without_tables_of_codes_means_the_standard_ones() -> None:
    """As many USB cameras send them."""
    data = jpeg(texture(3, (320, 240)))
    while (at := data.find(b"\xff\xc4")) >= 0:
        data = data[:at] + data[at + 2 + int.from_bytes(data[at + 2 : at + 4], "big") :]
    assert walk(data).size_px == (320, 240)
    assert decode_jpeg(data).shape == (240, 320, 3)


@pytest.mark.parametrize("padding", [b"\x00" * 300, b""])
def test_padding_after_the_end_passes(padding: bytes) -> None:
    inspect_jpeg(jpeg(texture(3, (320, 240))) + padding)


def hole(data: bytes, at: int) -> bytes:
    return data[:at] + data[at + 512 :]


def zeros(data: bytes, at: int) -> bytes:
    return data[:at] + bytes(512) + data[at + 512 :]


def twice(data: bytes, at: int) -> bytes:
    return data[: at + 512] + data[at:]


def cut_and_ended(data: bytes, at: int) -> bytes:
    return data[:at] + b"\xff\xd9"


def no_restarts(data: bytes, at: int) -> bytes:
    return data[:at] + b"\xff\xd0" + data[at:]


@pytest.mark.parametrize("damage", [hole, zeros, twice, cut_and_ended, no_restarts])
def test_what_a_cable_does_to_a_file_is_seen(damage: Callable[[bytes, int], bytes]) -> None:
    data = jpeg(texture(3, (320, 240)), *KINDS["usual"])
    begin = data.find(b"\xff\xda") + 14
    for at in np.random.default_rng(1).integers(begin, len(data) - 1200, 40):
        with pytest.raises(PictureError):
            inspect_jpeg(damage(data, int(at)))


def test_heads_that_are_none_are_refused_without_another_error() -> None:
    data, rng = jpeg(texture(3, (64, 48))), np.random.default_rng(2)
    head = data.find(b"\xff\xda") + 14
    for _ in range(400):
        damaged = bytearray(data)
        for at in rng.integers(2, head, 3):
            damaged[at] = int(rng.integers(256))
        try:
            inspect_jpeg(bytes(damaged))
        except PictureError:
            continue
    for length in range(2, head + 20):
        with pytest.raises(ScanError):
            walk(data[:length] + b"\xff\xd9")


def quantised(quality: int) -> FloatArray:
    return walk(jpeg(texture(3, (64, 48)), cv2.IMWRITE_JPEG_QUALITY, quality)).quantisation


def test_a_rate_control_scales_its_tables_and_damage_does_not() -> None:
    for before in (30, 50, 75, 90, 100):
        for now in (35, 60, 80, 95):
            assert same_camera(quantised(before), quantised(now))
    damaged = quantised(75).copy()
    damaged[0, 5] = 200.0
    assert not same_camera(quantised(75), damaged)


def test_damage_that_comes_out_even_is_seen_by_its_sharpness() -> None:
    """A block's amplitude bits changed: every code is one, every count right."""
    image = texture(3, (320, 240))
    novelty, calm = Novelty(), cv2.GaussianBlur(image, (0, 0), 3.0)
    sharp = calm.copy()
    sharp[100:108, 96:104] = (np.indices((8, 8)).sum(axis=0) % 2 * 200)[..., None]
    for picture, torn in ((calm, False), (sharp, True), (sharp, False)):
        data = jpeg(picture)
        assert novelty.torn(decode_jpeg(data), inspect_jpeg(data)) is torn
