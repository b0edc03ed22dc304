"""Head of a jpeg: sizes, tables of quantisation and of codes. ITU-T T.81."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tiptrace.types import FloatArray

_SOF_SEQUENTIAL, _SOF_OTHER = (
    (0xC0, 0xC1),
    (0xC2, 0xC3, *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0)),
)
_DHT, _SOS, _DQT, _DRI = 0xC4, 0xDA, 0xDB, 0xDD
SHORT_BITS = 9
_SLACK = 24.0  # of a block's norm, beyond the rounding of its coefficients: cameras' transforms are inexact


class ScanError(ValueError):
    """Damaged; the text says how."""


@dataclass(frozen=True, slots=True)
class Header:
    """Tables of a file.

    ``short`` and ``codes`` hold length << 8 | symbol of the code that some bits begin with, 0 where it is none.
    """

    size_px: tuple[int, int]
    mcus: int
    component: NDArray[np.int64]  # (blocks per MCU,)
    short: NDArray[np.int32]  # (components, 2, 512) DC and AC by 9 bits, which nearly all codes fit into
    codes: NDArray[np.int32]  # (components, 2, 65536) by 16 bits
    quantisation: FloatArray  # (components, 64), zigzag
    limit: FloatArray  # (components,) largest norm of a block
    restart: int


def scan_begin(data: bytes) -> int:
    """Where the entropy-coded data begin: segments are skipped by their lengths."""
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            raise ScanError("holds bytes between its segments")
        kind = data[at + 1]
        if kind == 0xFF:  # fill
            at += 1
            continue
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if kind < 0xC0 or 0xD0 <= kind <= 0xD9 or length < 2:
            raise ScanError("holds a segment that is none")
        at += 2 + length
        if kind == _SOS and at <= len(data) - 2:
            return at
    raise ScanError("has no picture in it")


@lru_cache(maxsize=4)
def read_header(head: bytes) -> Header | None:
    """Tables of a file's head; None for kinds that are not walked through.

    Raises:
        ScanError: no head of a jpeg.
    """
    quantisation: dict[int, FloatArray] = {}
    codes: dict[int, NDArray[np.int32]] = {}
    frame = scan = b""
    restart = 0
    for kind, payload in _segments(head):
        if kind in _SOF_OTHER:
            return None
        if kind == _DQT:
            quantisation.update(_quantisation(payload))
        elif kind == _DHT:
            codes.update(_codes(payload))
        elif kind == _DRI:
            restart = int.from_bytes(payload[:2], "big")
        elif kind in _SOF_SEQUENTIAL:
            frame = payload
        elif kind == _SOS:
            scan = payload
    try:
        return _plan(frame, scan, quantisation, codes or _standard_codes(), restart)
    except (KeyError, IndexError, struct.error, ZeroDivisionError):
        raise ScanError("has a head that is none") from None


def _segments(head: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 2
    while at + 4 <= len(head):
        if head[at + 1] == 0xFF:
            at += 1
            continue
        length = int.from_bytes(head[at + 2 : at + 4], "big")
        found.append((head[at + 1], head[at + 4 : at + 2 + length]))
        at += 2 + length
    return found


def _plan(
    frame: bytes,
    scan: bytes,
    quantisation: dict[int, FloatArray],
    codes: dict[int, NDArray[np.int32]],
    restart: int,
) -> Header | None:
    bits, height, width, count = struct.unpack_from(">BHHB", frame)
    parts = [
        (frame[k], frame[k + 1] >> 4, frame[k + 1] & 15, frame[k + 2]) for k in range(6, 6 + 3 * count, 3)
    ]
    if bits == 12 or 1 <= scan[0] < count:
        return None
    whole = bits == 8 and scan[0] == count and 1 <= count <= 4 and height and width
    if not (whole and all(1 <= p[1] <= 4 and 1 <= p[2] <= 4 for p in parts)):
        raise ScanError("has a head that is none")
    chosen = {scan[k]: scan[k + 1] for k in range(1, 1 + 2 * count, 2)}
    if count == 1:
        parts = [(parts[0][0], 1, 1, parts[0][3])]
    across, down = max(p[1] for p in parts), max(p[2] for p in parts)
    component = [i for i, (_, h, v, _) in enumerate(parts) for _ in range(h * v)]
    q = np.stack([quantisation[p[3]] for p in parts])
    q.flags.writeable = False  # all pictures of a camera share it
    tables = np.stack([(codes[chosen[p[0]] >> 4], codes[16 | (chosen[p[0]] & 15)]) for p in parts])
    short = tables[:, :, :: 1 << (16 - SHORT_BITS)]
    short = np.ascontiguousarray(np.where(short >> 8 <= SHORT_BITS, short, 0), dtype=np.int32)
    limit = 1024.0 + 0.5 * np.sqrt((q**2).sum(axis=1)) + _SLACK
    mcus = -(-width // (8 * across)) * -(-height // (8 * down))
    return Header((width, height), mcus, np.array(component), short, tables, q, limit, restart)


def _quantisation(payload: bytes) -> dict[int, FloatArray]:
    found, at = {}, 0
    while at < len(payload):
        wide, number = payload[at] >> 4, payload[at] & 15
        size = 128 if wide else 64
        table = np.frombuffer(payload[at + 1 : at + 1 + size], dtype=">u2" if wide else np.uint8).astype(
            np.float64
        )
        if wide > 1 or number > 3 or len(table) != 64 or not table.all():
            raise ScanError("has a quantisation table that is none")
        found[number] = table
        at += 1 + size
    return found


@lru_cache(maxsize=8)
def _codes(payload: bytes) -> dict[int, NDArray[np.int32]]:
    """Class << 4 | number → (65536,) length << 8 | symbol of the code that 16 bits begin with."""
    found, at = {}, 0
    while at < len(payload):
        counts = payload[at + 1 : at + 17]
        symbols = payload[at + 17 : at + 17 + sum(counts)]
        if len(counts) < 16 or len(symbols) < sum(counts) or payload[at] & 0xEC:
            raise ScanError("has a table of codes that is none")
        table, place, k = np.zeros(1 << 16, dtype=np.int32), 0, 0
        for length, n in enumerate(counts, 1):
            for symbol in symbols[k : k + n]:
                span = 1 << (16 - length)
                table[place : place + span] = length << 8 | symbol
                place += span
            k += n
        if place > 1 << 16:
            raise ScanError("has a table of codes that is none")
        found[payload[at]] = table
        at += 17 + k
    return found


@lru_cache(maxsize=1)
def _standard_codes() -> dict[int, NDArray[np.int32]]:
    """Those that a file without tables means, as many USB cameras send them (T.81 K.3): libjpeg writes them."""
    import cv2

    head = cv2.imencode(".jpg", np.zeros((8, 8, 3), dtype=np.uint8))[1].tobytes()
    found: dict[int, NDArray[np.int32]] = {}
    for kind, payload in _segments(head[: scan_begin(head)]):
        if kind == _DHT:
            found.update(_codes(payload))
    return found
