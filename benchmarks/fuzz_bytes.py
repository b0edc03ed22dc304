"""Mutants of bytes, settings and pictures, for ``fuzz_inputs.py``: the same seed gives the same mutant."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

Rng = np.random.Generator
LIMITS = (2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


# --- any bytes -----------------------------------------------------------------------------------------------


def flip(data: bytes, rng: Rng) -> bytes:
    broken = bytearray(data)
    for k in rng.integers(0, len(data), int(rng.integers(1, 9))):
        broken[k] ^= 1 << int(rng.integers(8))
    return bytes(broken)


def cut(data: bytes, rng: Rng) -> bytes:
    return data[: int(rng.integers(0, len(data)))]


def overwrite(data: bytes, rng: Rng) -> bytes:
    broken, at = bytearray(data), int(rng.integers(0, len(data)))
    run = bytes(rng.integers(0, 256, int(rng.integers(1, 60)), dtype=np.uint8))
    broken[at : at + len(run)] = run
    return bytes(broken)


def delete(data: bytes, rng: Rng) -> bytes:
    at = int(rng.integers(0, len(data)))
    return data[:at] + data[at + int(rng.integers(1, 600)) :]


def repeat(data: bytes, rng: Rng) -> bytes:
    a, b = sorted(int(k) for k in rng.integers(0, len(data), 2))
    return data[:b] + data[a:]


def inflate(data: bytes, rng: Rng) -> bytes:
    """Something that may be a length becomes enormous."""
    broken = bytearray(data)
    size = int(rng.choice([2, 4, 8]))
    at = int(rng.integers(0, max(1, len(data) - 8)))
    value = LIMITS[int(rng.integers(len(LIMITS)))] & (2 ** (8 * size) - 1)
    broken[at : at + size] = value.to_bytes(size, "little" if rng.integers(2) else "big")
    return bytes(broken)


BYTES = (flip, cut, overwrite, delete, repeat, inflate)


def any_bytes(data: bytes, rng: Rng) -> bytes:
    return BYTES[int(rng.integers(len(BYTES)))](data, rng)


# --- YAML ----------------------------------------------------------------------------------------------------

VALUES = (
    ".nan", ".inf", "-.inf", "1e308", "-1", "0", "1" * 5000, "''", "'x'", "null", "[]", "{}", "[[]]", "true",
    "2001-99-99", "2001-01-01", "!!binary '%%%'", "!!python/object/apply:os.system ['touch pwned']", "!!set {a}",
    "&a [*a]", "*nowhere", "'\\0'", '"\\ud800"', "[1e9, 1e9]", "[1000000000, 1000000000]", "<<", "0x" + "f" * 4000,
    "[" * 5000, "- " * 2000, "60:60:60:60", "'" + "x" * 100000 + "'", "~", "!!float 'abc'", "!!int 'abc'",
    "{a: {b: 1}}",
)  # fmt: skip


def yaml_value(data: bytes, rng: Rng) -> bytes:
    """The value of one key becomes something else."""
    lines = data.decode().splitlines()
    at = int(rng.integers(len(lines)))
    key = lines[at].split(":")[0].split("- ")[0]
    lines[at] = f"{key}: {VALUES[int(rng.integers(len(VALUES)))]}"
    return "\n".join(lines).encode()


def yaml_key(data: bytes, rng: Rng) -> bytes:
    """One key is renamed, lost, doubled or indented."""
    lines = data.decode().splitlines()
    at = int(rng.integers(len(lines)))
    kind = int(rng.integers(4))
    lines[at : at + 1] = [
        [lines[at].replace(":", "x:", 1)],
        [],
        [lines[at], lines[at]],
        ["   " + lines[at]],
    ][kind]
    return "\n".join(lines).encode()


def yaml_number(data: bytes, rng: Rng) -> bytes:
    """One number becomes another."""
    text = data.decode()
    places = [k for k, c in enumerate(text) if c.isdigit()]
    at = places[int(rng.integers(len(places)))]
    value = ("9", "-", "1e300", ".nan", ".inf", "99999999999", "e", "0.0")[int(rng.integers(8))]
    return (text[:at] + value + text[at + 1 :]).encode()


def yaml_bomb(data: bytes, rng: Rng) -> bytes:
    """Few bytes that mean a great many."""
    kind = int(rng.integers(5))
    laughs = ["a0: &a0 [x, x]"] + [f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]" for k in range(1, 40)]
    merges = ["m0: &m0 {x: 1}"] + [f"m{k}: &m{k} {{<<: [*m{k - 1}, *m{k - 1}]}}" for k in range(1, 40)]
    bombs = (
        "\n".join(laughs),
        "\n".join(merges),
        "[" * 100_000,
        "a: {b: " * 20_000,
        "\n".join(f"k{i}: {i}" for i in range(200_000)),
    )
    return data + b"\n" + bombs[kind].encode()


YAMLS = (yaml_value, yaml_value, yaml_key, yaml_number, yaml_number, yaml_bomb, any_bytes)


def any_yaml(data: bytes, rng: Rng) -> bytes:
    return YAMLS[int(rng.integers(len(YAMLS)))](data, rng)


# --- pictures ------------------------------------------------------------------------------------------------


def huge_png(rng: Rng) -> bytes:
    """A png that claims to be enormous."""
    width, height = ((65535, 65535), (30000, 30000), (2**31 - 1, 1), (1_000_000, 900))[int(rng.integers(4))]
    rows = zlib.compress(b"\0" * 1000)
    found = b"\x89PNG\r\n\x1a\n"
    for kind, body in (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", rows),
        (b"IEND", b""),
    ):
        found += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return found


def huge_jpeg(data: bytes, rng: Rng) -> bytes:
    """A jpeg whose frame header claims up to 65535 × 65535."""
    at = next((k for m in (b"\xff\xc0", b"\xff\xc2") if (k := data.find(m)) >= 0), None)
    if at is None:
        return huge_png(rng)
    side = int(rng.choice([20000, 40000, 65535]))
    return data[: at + 5] + struct.pack(">HH", side, side) + data[at + 9 :]


def huge_bmp(rng: Rng) -> bytes:
    side = int(rng.choice([20000, 30000]))
    head = struct.pack("<IiiHHIIiiII", 40, side, side, 1, 24, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + head + b"\0" * 100


def any_image(data: bytes, rng: Rng) -> bytes:
    kind = int(rng.integers(4))
    if kind == 0:
        return huge_png(rng)
    if kind == 1:
        return huge_jpeg(data, rng)
    return huge_bmp(rng) if kind == 2 else any_bytes(data, rng)
