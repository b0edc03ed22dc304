"""Walks through a jpeg's entropy-coded data, which has no checksum but must come out even.

Every code must be one of the file's Huffman codes, every block hold 64 coefficients that some picture of 8-bit pixels
can have, every restart marker stand where it is due, and the data must end with the last block. OpenCV checks none of
it: what is missing becomes grey. ITU-T T.81; baseline and extended sequential files with one scan, as cameras send
them; progressive ones are not walked through.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.types import FloatArray

_SOF_SEQUENTIAL, _SOF_OTHER = (
    (0xC0, 0xC1),
    (0xC2, 0xC3, *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0)),
)
_DHT, _SOS, _DQT, _DRI = 0xC4, 0xDA, 0xDB, 0xDD
_WHY = {
    1: "holds a code that is none",
    2: "holds a block of more than 64 coefficients",
    3: "ends before its last block",
    4: "holds a block that no picture has",
    5: "lacks a restart marker",
    6: "goes on after its last block",
}
_SHORT_BITS = 9
_PADDING = 16  # bytes before the end-of-image marker
_SLACK = 24.0  # of a block's norm, beyond the rounding of its coefficients: cameras' transforms are inexact


class ScanError(ValueError):
    """Damaged; the text says how."""


@dataclass(frozen=True, slots=True)
class ScanFacts:
    """What a walk tells of the picture, to compare with the one before.

    Attributes:
        size_px: Width and height; None where the file was not walked through.
        sharpest: Largest norm of a block's high frequencies, grey levels times 8.
        quantisation: (m, 64) tables in the components' order; empty where the file was not walked through.
    """

    size_px: tuple[int, int] | None
    sharpest: float
    quantisation: FloatArray


@dataclass(frozen=True, slots=True)
class _Header:
    """Tables of a file; ``tables`` holds per code length's first bits (length << 8 | symbol), 0 where there is none."""

    size_px: tuple[int, int]
    mcus: int
    component: NDArray[np.int64]  # (blocks per MCU,)
    short: NDArray[np.int32]  # (components, 2, 512) DC and AC by 9 bits, which nearly all codes fit into
    tables: NDArray[np.int32]  # (components, 2, 65536) by 16 bits
    quantisation: FloatArray  # (components, 64), zigzag
    limit: FloatArray  # (components,) largest norm of a block
    restart: int


def walk(data: bytes) -> ScanFacts:
    """Walk through a whole file, from its first byte to the end-of-image marker.

    Raises:
        ScanError: damaged.
    """
    begin = _scan_begin(data)
    header = _header(data[:begin])
    if header is None:
        return ScanFacts(None, 0.0, np.empty((0, 64)))
    scan = np.frombuffer(data, dtype=np.uint8)[begin:-2]
    code, sharpest = _walk(
        scan,
        header.mcus,
        header.component,
        header.short,
        header.tables,
        header.quantisation,
        header.limit,
        header.restart,
    )
    if code:
        raise ScanError(_WHY[code])
    return ScanFacts(header.size_px, float(sharpest), header.quantisation)


def same_camera(before: FloatArray, now: FloatArray) -> bool:
    """Whether quantisation tables are those of the picture before, or those scaled, as a rate control does."""
    if before.shape != now.shape or not before.size or np.array_equal(before, now):
        return before.shape == now.shape or not (before.size and now.size)
    least_old, most_old = (
        np.where(before > 1, before - 0.5, 1e-3),
        np.where(before < 255, before + 0.5, np.inf),
    )
    least_new, most_new = np.where(now > 1, now - 0.5, 0.0), np.where(now < 255, now + 0.5, np.inf)
    return bool((least_new / most_old).max() <= (most_new / least_old).min())


# --- headers -----------------------------------------------------------------------------------------------


def _scan_begin(data: bytes) -> int:
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
def _header(head: bytes) -> _Header | None:
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
) -> _Header | None:
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
    short = tables[:, :, :: 1 << (16 - _SHORT_BITS)]
    short = np.ascontiguousarray(np.where(short >> 8 <= _SHORT_BITS, short, 0), dtype=np.int32)
    limit = 1024.0 + 0.5 * np.sqrt((q**2).sum(axis=1)) + _SLACK
    mcus = -(-width // (8 * across)) * -(-height // (8 * down))
    return _Header((width, height), mcus, np.array(component), short, tables, q, limit, restart)


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
    for kind, payload in _segments(head[: _scan_begin(head)]):
        if kind == _DHT:
            found.update(_codes(payload))
    return found


# --- the walk ----------------------------------------------------------------------------------------------


@compiled
def _walk(
    scan: NDArray[np.uint8],
    mcus: int,
    component: NDArray[np.int64],
    short: NDArray[np.int32],
    tables: NDArray[np.int32],
    q: FloatArray,
    limit: FloatArray,
    restart: int,
) -> tuple[int, float]:
    """0 and the largest norm of high frequencies, or why not (``_WHY``)."""
    n = scan.shape[0]
    dc = np.zeros(tables.shape[0])
    at, buffer, held = 0, np.uint64(0), 0
    sharpest = 0.0
    blocks = component.shape[0]
    for mcu in range(mcus):
        if restart and mcu and mcu % restart == 0:
            while at < n - 1 and scan[at] == 0xFF and scan[at + 1] == 0xFF:
                at += 1
            if (
                held >= 8
                or at + 1 >= n
                or scan[at] != 0xFF
                or scan[at + 1] != 0xD0 + (mcu // restart - 1) % 8
            ):
                return 5, 0.0
            at += 2
            buffer, held = np.uint64(0), 0
            dc[:] = 0.0
        for b in range(blocks):
            c = component[b]
            total = high = 0.0
            k = 0
            while k < 64:
                while held <= 48 and at < n:  # a code and its bits need 32
                    byte = scan[at]
                    if byte == 0xFF:
                        if at + 1 >= n or scan[at + 1] != 0:
                            break
                        at += 1
                    at += 1
                    buffer = (buffer << np.uint64(8)) | np.uint64(byte)
                    held += 8
                if held >= 16:
                    peek = (buffer >> np.uint64(held - 16)) & np.uint64(0xFFFF)
                else:
                    peek = (buffer << np.uint64(16 - held)) & np.uint64(0xFFFF)
                kind = 0 if k == 0 else 1
                entry = short[c, kind, np.int64(peek >> np.uint64(16 - _SHORT_BITS))]
                if entry == 0:
                    entry = tables[c, kind, np.int64(peek)]
                if entry == 0:
                    return (1, 0.0) if held >= 16 else (3, 0.0)
                held -= entry >> 8
                symbol = entry & 0xFF
                size = symbol & 15
                if k > 0:
                    if size == 0:
                        if held < 0:
                            return 3, 0.0
                        if symbol == 0xF0:
                            k += 16
                            if k > 63:
                                return 2, 0.0
                            continue
                        break
                    k += symbol >> 4
                    if k > 63:
                        return 2, 0.0
                elif symbol > 11:
                    return 4, 0.0
                held -= size
                if held < 0:
                    return 3, 0.0
                value = np.int64(
                    (buffer >> np.uint64(held)) & ((np.uint64(1) << np.uint64(size)) - np.uint64(1))
                )
                if size and value < (1 << (size - 1)):
                    value -= (1 << size) - 1
                if k == 0:
                    dc[c] += value
                    level = dc[c] * q[c, 0]
                    total = level * level
                else:
                    x = value * q[c, k]
                    total += x * x
                    if k >= 10:
                        high += x * x
                k += 1
            if total > limit[c] * limit[c]:
                return 4, 0.0
            sharpest = max(sharpest, high)
    while held >= 8:  # cameras pad
        held -= 8
        if (buffer >> np.uint64(held)) & np.uint64(0xFF):
            return 6, 0.0
    for k in range(at, n):
        if scan[k] != 0 and scan[k] != 0xFF:
            return 6, 0.0
    return (6, 0.0) if n - at > _PADDING else (0, np.sqrt(sharpest))


def warm_up() -> None:
    """Compile the walk, or load it from disk: the first image should not wait for it."""
    import cv2

    walk(cv2.imencode(".jpg", np.zeros((16, 16, 3), dtype=np.uint8))[1].tobytes())
