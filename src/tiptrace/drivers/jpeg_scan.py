"""Walks through a jpeg's entropy-coded data, which has no checksum but must come out even.

Every code must be one of the file's Huffman codes, every block hold 64 coefficients that some picture of 8-bit pixels
can have, every restart marker stand where it is due, and the data must end with the last block. OpenCV checks none of
it: what is missing becomes grey. ITU-T T.81; baseline and extended sequential files with one scan, as cameras send
them; progressive ones are not walked through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tiptrace.compiled import compiled
from tiptrace.drivers.jpeg_head import SHORT_BITS, ScanError, read_header, scan_begin
from tiptrace.types import FloatArray

_WHY = {
    1: "holds a code that is none",
    2: "holds a block of more than 64 coefficients",
    3: "ends before its last block",
    4: "holds a block that no picture has",
    5: "lacks a restart marker",
    6: "goes on after its last block",
}
_HIGH = 10  # from this coefficient on, in zigzag order
_PADDING = 16  # bytes before the end-of-image marker
_SHORT = 16 - SHORT_BITS
_NONE, _BYTE = np.uint64(0), np.uint64(8)


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


def walk(data: bytes) -> ScanFacts:
    """Walk through a whole file, from its first byte to the end-of-image marker.

    Raises:
        ScanError: damaged.
    """
    begin = scan_begin(data)
    header = read_header(data[:begin])
    if header is None:
        return ScanFacts(None, 0.0, np.empty((0, 64)))
    scan = np.frombuffer(data, dtype=np.uint8)[begin:-2]
    code, sharpest = _walk(
        scan,
        header.mcus,
        header.component,
        header.short,
        header.codes,
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


# --- the walk ----------------------------------------------------------------------------------------------
# State of the reader: place in the data, bits read and not yet used (the last ``held`` of ``buffer``).


@compiled
def _peek(buffer: Any, held: int) -> Any:
    """The next 16 bits; zeros behind the last."""
    if held >= 16:
        return np.int64((buffer >> np.uint64(held - 16)) & np.uint64(0xFFFF))
    return np.int64((buffer << np.uint64(16 - held)) & np.uint64(0xFFFF))


@compiled
def _value(buffer: Any, held: int, size: int) -> Any:
    """The signed number in ``size`` bits before the last ``held``."""
    value = np.int64((buffer >> np.uint64(held)) & ((np.uint64(1) << np.uint64(size)) - np.uint64(1)))
    if size and value < (1 << (size - 1)):
        value -= (1 << size) - 1
    return value


@compiled
def _after_restart(scan: NDArray[np.uint8], at: int, held: int, number: int) -> int:
    """Place after the restart marker that is due; -1 where it is not there."""
    while at < scan.shape[0] - 1 and scan[at] == 0xFF and scan[at + 1] == 0xFF:
        at += 1
    due = held < 8 and at + 1 < scan.shape[0] and scan[at] == 0xFF and scan[at + 1] == 0xD0 + number % 8
    return at + 2 if due else -1


@compiled
def _ends(scan: NDArray[np.uint8], at: int, buffer: Any, held: int) -> bool:
    """Whether nothing is left but the bits of the last byte, and padding."""
    while held >= 8:
        held -= 8
        if (buffer >> np.uint64(held)) & np.uint64(0xFF):
            return False
    for k in range(at, scan.shape[0]):
        if scan[k] != 0 and scan[k] != 0xFF:
            return False
    return bool(scan.shape[0] - at <= _PADDING)


@compiled
def _walk(
    scan: NDArray[np.uint8],
    mcus: int,
    component: NDArray[np.int64],
    short: NDArray[np.int32],
    codes: NDArray[np.int32],
    q: FloatArray,
    limit: FloatArray,
    restart: int,
) -> tuple[int, float]:
    """0 and the largest norm of high frequencies, or why not (``_WHY``).

    One loop: a call per block would pass more arrays about than a block has numbers, and cost as much again.
    """
    n, dc = scan.shape[0], np.zeros(codes.shape[0])
    at, buffer, held = 0, _NONE, 0
    sharpest = 0.0
    for mcu in range(mcus):
        if restart and mcu and mcu % restart == 0:
            at = _after_restart(scan, at, held, mcu // restart - 1)
            if at < 0:
                return 5, 0.0
            buffer, held = _NONE, 0
            dc[:] = 0.0
        for c in component:
            total = high = 0.0
            k = kind = 0
            while k < 64:
                while held <= 48 and at < n:  # a code and its number need 32
                    byte = scan[at]
                    if byte == 0xFF:  # followed by a stuffed zero, or a marker
                        if at + 1 >= n or scan[at + 1] != 0:
                            break
                        at += 1
                    at += 1
                    buffer = (buffer << _BYTE) | np.uint64(byte)
                    held += 8
                peek = _peek(buffer, held)
                entry = short[c, kind, peek >> _SHORT]
                if entry == 0:
                    entry = codes[c, kind, peek]
                if entry == 0:
                    return (1, 0.0) if held >= 16 else (3, 0.0)
                symbol = entry & 0xFF
                size, held = symbol & 15, held - (entry >> 8)
                if k and symbol == 0 and held >= 0:
                    break
                k += symbol >> 4 if k else 0
                held -= size
                if held < 0:
                    return 3, 0.0
                if k > 63 or (k == 0 and symbol > 11):
                    return 2, 0.0
                x = float(_value(buffer, held, size))
                if k == 0:
                    dc[c] += x
                    x, kind = dc[c], 1
                square = (x * q[c, k]) ** 2
                total += square
                if k >= _HIGH:
                    high += square
                k += 1
            if total > limit[c] * limit[c]:
                return 4, 0.0
            sharpest = max(sharpest, high)
    return (0, np.sqrt(sharpest)) if _ends(scan, at, buffer, held) else (6, 0.0)


def warm_up() -> None:
    """Compile the walk, or load it from disk: the first image should not wait for it."""
    import cv2

    walk(cv2.imencode(".jpg", np.zeros((16, 16, 3), dtype=np.uint8))[1].tobytes())
