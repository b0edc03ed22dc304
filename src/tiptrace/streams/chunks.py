"""MCAP chunks unpacked within bounds: a few kilobytes can claim, or become, any number of gigabytes."""

from __future__ import annotations

import struct
from dataclasses import replace

import zstandard
from mcap.records import Chunk

MAX_CHUNK_BYTES = 128 * 2**20  # a hundred times what recorders write; two raw full frames of a camera
_MAX_GROWTH = 2000  # real images and poses shrink to a tenth; constants to a hundredth
_SMALL_BYTES = 8 * 2**20  # that may come of anything
_FREE_RECORDS = 20_000


def unpacked(chunk: Chunk) -> Chunk:
    """The same chunk without compression.

    Raises:
        ValueError: it grows beyond bounds, is not of the size that it claims, or holds more records than its packed
            bytes can stand for.
    """
    size = chunk.uncompressed_size
    if size > min(MAX_CHUNK_BYTES, max(_SMALL_BYTES, _MAX_GROWTH * len(chunk.data))):
        raise ValueError(f"a chunk of {len(chunk.data)} bytes claims to hold {size}")
    data = _decompress(chunk.compression, chunk.data, size)
    if len(data) != size:
        raise ValueError(f"a chunk of {len(data)} bytes claims to hold {size}")
    _check_records(data, _FREE_RECORDS + len(chunk.data))
    return replace(chunk, compression="", data=data)


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    if compression == "":
        return data
    if compression == "zstd":
        claimed = zstandard.frame_content_size(data)
        if claimed not in (-1, size):
            raise ValueError(f"a chunk of {size} bytes is packed as {claimed}")
        return bytes(zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1)))
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

        return bytes(LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    raise ValueError(f"compression {compression!r} is not known")


def _check_records(data: bytes, limit: int) -> None:
    """Count the records by their lengths alone."""
    at, count = 0, 0
    while at + 9 <= len(data):
        at += 9 + int(struct.unpack_from("<Q", data, at + 1)[0])
        count += 1
        if count > limit:
            raise ValueError(f"a chunk holds more than {limit} records")
