"""Mutants of sound input files, for ``fuzz_inputs.py``: the same seed gives the same mutant."""

from __future__ import annotations

import contextlib
import io
import pickle
import sqlite3
import struct
import sys
import tempfile
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import zstandard
from mcap.records import Attachment, Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

Rng = np.random.Generator
LIMITS = (2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)

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


# --- recordings: the content changes, the checksums are right --------------------------------------------------


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


# --- gel models ----------------------------------------------------------------------------------------------


def external_data(data: bytes, rng: Rng) -> bytes:
    """Weights said to lie in another file."""
    import onnx

    model = onnx.load_from_string(data)
    tensor = model.graph.initializer[int(rng.integers(len(model.graph.initializer)))]
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    place = ("/etc/passwd", "../secret.bin", "/dev/zero", "weights.bin")[int(rng.integers(4))]
    for key, value in (("location", place), ("offset", "0"), ("length", "640")):
        tensor.external_data.add(key=key, value=value)
    return bytes(model.SerializeToString())


def operator_bomb(data: bytes, rng: Rng) -> bytes:
    """Operators that make much out of little, never end, or are somebody's own."""
    import onnx
    from onnx import helper, numpy_helper

    model = onnx.load_from_string(data)
    graph = model.graph
    kind = int(rng.integers(4))
    if kind == 0:
        graph.initializer.append(numpy_helper.from_array(np.array([200_000, 20_000], np.int64), "shape"))
        graph.node.append(helper.make_node("ConstantOfShape", ["shape"], ["big"]))
        graph.node.append(helper.make_node("ReduceSum", ["big"], ["sum"]))
        graph.node[-3].output[0] = "before"
        graph.node.append(helper.make_node("Add", ["before", "sum"], ["output"]))
    elif kind == 1:
        body = helper.make_graph(
            [helper.make_node("Identity", ["go"], ["go_on"])],
            "body",
            [
                helper.make_tensor_value_info("i", onnx.TensorProto.INT64, []),
                helper.make_tensor_value_info("go", onnx.TensorProto.BOOL, []),
            ],
            [helper.make_tensor_value_info("go_on", onnx.TensorProto.BOOL, [])],
        )
        graph.initializer.append(numpy_helper.from_array(np.array(2**62, np.int64), "trips"))
        graph.initializer.append(numpy_helper.from_array(np.array(True), "true"))
        graph.node.insert(0, helper.make_node("Loop", ["trips", "true"], [], body=body))
    elif kind == 2:
        graph.node[0].op_type, graph.node[0].domain = "SystemCall", "com.example"
    else:
        graph.initializer.append(numpy_helper.from_array(np.zeros((20_000, 1, 2), np.float32), "wide"))
        graph.node[-1].output[0] = "before"
        graph.node.append(helper.make_node("Add", ["before", "wide"], ["output"]))
    return bytes(model.SerializeToString())


def model_metadata(data: bytes, rng: Rng) -> bytes:
    import onnx

    model = onnx.load_from_string(data)
    pair = model.metadata_props[int(rng.integers(len(model.metadata_props)))]
    pair.value = ("", "nan", "0", "inf", "abc", "-1", "1,2,3", "x" * 10000)[int(rng.integers(8))]
    return bytes(model.SerializeToString())


def model_dimensions(data: bytes, rng: Rng) -> bytes:
    import onnx

    model = onnx.load_from_string(data)
    tensor = model.graph.initializer[int(rng.integers(len(model.graph.initializer)))]
    tensor.dims[int(rng.integers(len(tensor.dims)))] = int(rng.choice([-1, 0, 1, 2**31, 2**62]))
    return bytes(model.SerializeToString())


MODELS = (any_bytes, any_bytes, external_data, operator_bomb, model_metadata, model_dimensions)


def any_model(data: bytes, rng: Rng) -> bytes:
    return MODELS[int(rng.integers(len(MODELS)))](data, rng)


def weights_file() -> bytes:
    """A torch file of a 5-8-2 network, as ``torch.save`` would write it."""
    return _torch_zip(
        {"fc1.weight": (8, 5), "fc1.bias": (8,), "fc2.weight": (2, 8), "fc2.bias": (2,)},
    )


def _torch_zip(shapes: dict[str, tuple[int, ...]], strides: bool = True, claim: int = 1) -> bytes:
    stand_ins = {name: ModuleType(name) for name in ("torch", "torch._utils")}

    class FloatStorage:
        pass

    def _rebuild_tensor_v2(*_: Any) -> None: ...

    FloatStorage.__module__, FloatStorage.__qualname__ = "torch", "FloatStorage"
    _rebuild_tensor_v2.__module__, _rebuild_tensor_v2.__qualname__ = "torch._utils", "_rebuild_tensor_v2"
    stand_ins["torch"].FloatStorage = FloatStorage  # type: ignore[attr-defined]
    stand_ins["torch._utils"]._rebuild_tensor_v2 = _rebuild_tensor_v2  # type: ignore[attr-defined]

    class Tensor:
        def __init__(self, key: int, shape: tuple[int, ...]) -> None:
            self.key, self.shape = key, shape

        def __reduce__(self) -> Any:
            step = tuple(int(np.prod(self.shape[k + 1 :])) if strides else 0 for k in range(len(self.shape)))
            shape = (self.shape[0] * claim, *self.shape[1:])
            return _rebuild_tensor_v2, (Storage(self.key, self.shape), 0, shape, step, False, OrderedDict())

    class Storage:
        def __init__(self, key: int, shape: tuple[int, ...]) -> None:
            self.key, self.count = key, int(np.prod(shape))

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj: Any) -> Any:
            return (
                ("storage", FloatStorage, str(obj.key), "cpu", obj.count)
                if isinstance(obj, Storage)
                else None
            )

    kept = {name: sys.modules.get(name) for name in stand_ins}
    sys.modules.update(stand_ins)
    try:
        table = io.BytesIO()
        Pickler(table, protocol=2).dump({name: Tensor(k, s) for k, (name, s) in enumerate(shapes.items())})
    finally:
        for name, module in kept.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("archive/data.pkl", table.getvalue())
        for k, shape in enumerate(shapes.values()):
            values = np.random.default_rng(k).normal(size=shape).astype(np.float32)
            archive.writestr(f"archive/data/{k}", values.tobytes())
    return out.getvalue()


def any_weights(data: bytes, rng: Rng) -> bytes:
    kind = int(rng.integers(5))
    if kind == 0:  # strides of zero make gigabytes out of one number
        return _torch_zip({"fc1.weight": (8, 5), "fc1.bias": (8,)}, strides=False, claim=10**8)
    if kind in (1, 2):
        return _rewrite_zip(data, rng, bomb=kind == 1)
    return any_bytes(data, rng)


def _rewrite_zip(data: bytes, rng: Rng, bomb: bool) -> bytes:
    """A zip bomb in place of a tensor, or a pickle that asks for a command, or is changed."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            content = old.read(name)
            if bomb and name.endswith("data/0"):
                with new.open(name, "w", force_zip64=True) as entry:
                    for _ in range(1200):
                        entry.write(bytes(2**20))
                continue
            if not bomb and name.endswith(".pkl"):
                content = any_bytes(content, rng) if rng.integers(2) else b"cos\nsystem\n(S'touch pwned'\ntR."
            new.writestr(name, content)
    return out.getvalue()


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


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
