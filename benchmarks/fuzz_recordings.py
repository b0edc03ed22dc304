"""Mutants of recordings and bags: their content changes and the checksums are right, or bytes of the file do."""

from __future__ import annotations

import contextlib
import io
import sqlite3
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import zstandard
from fuzz_bytes import LIMITS, Rng, any_bytes, any_image, any_yaml, cut, flip, inflate, overwrite, write
from fuzz_models import any_model
from mcap.records import Attachment, Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer


@dataclass
class Parts:
    """A recording taken apart."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    messages: list[Message]
    attachments: list[Attachment]


def take_apart(data: bytes) -> Parts:
    parts = Parts({}, {}, [], [])
    for record in StreamReader(io.BytesIO(data)).records:
        if isinstance(record, Schema):
            parts.schemas[record.id] = record
        elif isinstance(record, Channel):
            parts.channels[record.id] = record
        elif isinstance(record, Message):
            parts.messages.append(record)
        elif isinstance(record, Attachment):
            parts.attachments.append(record)
    return parts


def put_together(parts: Parts, compression: CompressionType = CompressionType.ZSTD) -> bytes:
    out = io.BytesIO()
    writer = Writer(out, chunk_size=64 * 1024, compression=compression)
    writer.start(profile="ros2")
    for a in parts.attachments:
        writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
    schemas = {
        key: writer.register_schema(s.name, s.encoding, s.data) for key, s in sorted(parts.schemas.items())
    }
    channels = {
        key: writer.register_channel(c.topic, c.message_encoding, schemas.get(c.schema_id, 0), c.metadata)
        for key, c in sorted(parts.channels.items())
    }
    for m in parts.messages:
        writer.add_message(channels[m.channel_id], m.log_time, m.data, m.publish_time, m.sequence)
    writer.finish()
    return out.getvalue()


def change_message(parts: Parts, rng: Rng) -> None:
    """The bytes of some messages."""
    for k in rng.integers(0, len(parts.messages), int(rng.integers(1, 4))):
        message = parts.messages[int(k)]
        # the first bytes hold the encapsulation, the header and the lengths
        edge = min(len(message.data), 80)
        change = (flip, cut, overwrite, inflate)[int(rng.integers(4))]
        message.data = change(message.data[:edge], rng) + message.data[edge:]


def change_numbers(parts: Parts, rng: Rng) -> None:
    """Doubles at the end of small messages become nan, inf, enormous."""
    small = [m for m in parts.messages if 12 <= len(m.data) < 200]
    for k in rng.integers(0, len(small), 3):
        message = small[int(k)]
        value = (float("nan"), float("inf"), 1e300, -1e-300, 0.0)[int(rng.integers(5))]
        at = len(message.data) - 8 * int(rng.integers(1, 1 + min(7, (len(message.data) - 4) // 8)))
        message.data = message.data[:at] + struct.pack("<d", value) + message.data[at + 8 :]


def change_times(parts: Parts, rng: Rng) -> None:
    """Log times at the limits of their type."""
    for k in rng.integers(0, len(parts.messages), int(rng.integers(1, 4))):
        parts.messages[int(k)].log_time = (0, *LIMITS)[int(rng.integers(1 + len(LIMITS)))]


def change_schema(parts: Parts, rng: Rng) -> None:
    """Definitions with enormous arrays, of empty things, cut, renamed."""
    keys = sorted(parts.schemas)
    schema = parts.schemas[keys[int(rng.integers(len(keys)))]]
    kind = int(rng.integers(5))
    if kind == 0:
        schema.data = schema.data.replace(b"uint8[] data", b"uint8[4000000000] data").replace(
            b"float64 x", b"float64[400000000] x"
        )
    elif kind == 1:
        schema.data = b"E[] stamp\nE[] data\n" + b"=" * 80 + b"\nMSG: x/E\n"
    elif kind == 2:
        schema.data = any_bytes(schema.data, rng)
    elif kind == 3:
        schema.name = any_bytes(schema.name.encode(), rng).decode(errors="replace")
    else:
        schema.data = b"A a\n" + b"=" * 80 + b"\nMSG: x/A\nA a\n"


def change_topics(parts: Parts, rng: Rng) -> None:
    """Topics exchanged, renamed, given another type."""
    keys = sorted(parts.channels)
    a, b = (parts.channels[keys[int(k)]] for k in rng.integers(0, len(keys), 2))
    if rng.integers(2):
        a.topic, b.topic = b.topic, a.topic
    else:
        a.schema_id, b.schema_id = b.schema_id, a.schema_id


def change_attachment(parts: Parts, rng: Rng) -> None:
    """Settings, references and models within the file."""
    attachment = parts.attachments[int(rng.integers(len(parts.attachments)))]
    if attachment.name.endswith(".yaml"):
        attachment.data = any_yaml(attachment.data, rng)
    elif attachment.name.endswith(".png"):
        attachment.data = any_image(attachment.data, rng)
    else:
        attachment.data = any_model(attachment.data, rng)


def change_images(parts: Parts, rng: Rng) -> None:
    """Pictures that claim to be enormous, or are broken, with everything around them sound."""
    pictures = [m for m in parts.messages if len(m.data) > 1000]
    for k in rng.integers(0, len(pictures), int(rng.integers(1, 5))):
        message = pictures[int(k)]
        at = message.data.find(b"\xff\xd8")
        if at < 4:
            continue
        new = any_image(message.data[at:], rng)
        message.data = message.data[: at - 4] + struct.pack("<I", len(new)) + new


CONTENT: tuple[Callable[[Parts, Rng], None], ...] = (
    change_message,
    change_numbers,
    change_times,
    change_schema,
    change_topics,
    change_attachment,
    change_attachment,
    change_images,
)


def chunk_bomb(data: bytes, rng: Rng) -> bytes:
    """Chunks that grow: zeros, a great many tiny messages, claims that are not true."""
    kind = int(rng.integers(4))
    if kind == 0:  # a gigabyte of zeros in some kilobytes
        size = 2**30
        packed = _packed_zeros(size)
    elif kind == 1:  # small, says that it is enormous
        size, packed = 2**38, zstandard.compress(b"\0" * 1000)
    elif kind == 2:  # a frame header that says it is enormous
        size, packed = 1000, b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**36) + b"\x01\x00\x00"
    else:  # two million messages
        record = struct.pack("<BQHIQQ", 5, 22, 1, 0, 5, 5)
        whole = record * 2_000_000
        size, packed = len(whole), zstandard.compress(whole)
    body = struct.pack("<QQQI", 0, 2**62, size, 0) + struct.pack("<I", 4) + b"zstd"
    body += struct.pack("<Q", len(packed)) + packed
    record = struct.pack("<BQ", 6, len(body)) + body
    parts = put_together(take_apart(data))
    at = parts.rfind(struct.pack("<BQ", 15, 4))  # before DataEnd
    return parts[:at] + record + parts[at:]


def _packed_zeros(size: int) -> bytes:
    out = io.BytesIO()
    with zstandard.ZstdCompressor(level=3).stream_writer(out, closefd=False, size=size) as packer:
        block = bytes(2**20)
        for _ in range(size // len(block)):
            packer.write(block)
    return out.getvalue()


def any_recording(data: bytes, rng: Rng) -> bytes:
    kind = rng.random()
    if kind < 0.35:
        return any_bytes(data, rng)
    if kind < 0.39:
        return chunk_bomb(data, rng)
    parts = take_apart(data)
    CONTENT[int(rng.integers(len(CONTENT)))](parts, rng)
    kinds = (CompressionType.ZSTD, CompressionType.NONE, CompressionType.LZ4)
    return put_together(parts, kinds[int(rng.integers(3))])


def any_bag_file(data: bytes, rng: Rng) -> bytes:
    """A file of a rosbag2 folder; an SQLite one may get a view that never ends in place of its table."""
    if data.startswith(b"SQLite") and rng.random() < 0.3:
        return _endless_view(data, rng)
    if data.startswith(b"\x89MCAP") and rng.random() < 0.2:
        return chunk_bomb(data, rng)
    return any_bytes(data, rng)


def _endless_view(data: bytes, rng: Rng) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        path = write(Path(name) / "bag.db3", data)
        with contextlib.closing(sqlite3.connect(path)) as base:
            base.execute("ALTER TABLE messages RENAME TO old")
            rows = ("1, 1, n, zeroblob(8)", "1, 1, n, zeroblob(900000000)")[int(rng.integers(2))]
            base.execute(
                "CREATE VIEW messages (id, topic_id, timestamp, data) AS WITH RECURSIVE c(n) AS "
                f"(SELECT 1 UNION ALL SELECT n + 1 FROM c) SELECT {rows} FROM c"
            )
            base.commit()
        return path.read_bytes()
