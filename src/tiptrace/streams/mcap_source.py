"""MCAP files read without their index: whole, cut off, or damaged, as far as they go.

The file's own summary is never consulted. One pass over the record frames (opcode, length) finds the chunks;
they are then read in log-time order, each verified by its checksum. Parsing of records is the mcap library's.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any, TypeVar

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk

from tiptrace.errors import RecordingError
from tiptrace.streams.chunks import unpacked
from tiptrace.streams.definitions import is_own_definition
from tiptrace.streams.raw_messages import RawMessage
from tiptrace.streams.topics import NS

T = TypeVar("T")
MAGIC = b"\x89MCAP0\r\n"
_MAX_RECORD = 2**31  # bytes: larger lengths are damage, not data
_MAX_TIME_NS = 2**62  # the year 2116
_KNOWN = {int(opcode) for opcode in Opcode}
_PRIVATE = 0x80  # opcodes from here on belong to applications and are skipped
_LIBRARY_ERRORS: tuple[type[Exception], ...] = (  # what the libraries raise on bytes that are wrong
    McapError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,  # lz4
    ValueError,  # bad UTF-8, checksums
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    MemoryError,
    EOFError,
)
_UNCHUNKED = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


class _DamageError(Exception):
    """Bytes that are no MCAP."""


@dataclass(frozen=True, slots=True)
class _Frame:
    """A chunk, or one record outside any chunk: where it lies and which log times it holds."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    opcode: int


class McapSource:
    """Messages and attachments of one MCAP file.

    Args:
        path: The file.

    Raises:
        RecordingError: no such file, or not an MCAP at all.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.attachments: dict[str, bytes] = {}
        self.whole = False  # the data section is closed
        self.notes: list[str] = []
        self._damage: str | None = None
        self._frames: list[_Frame] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._decoders: dict[int, Callable[[bytes], Any]] = {}
        self._factory: Any = None
        try:
            with path.open("rb") as file:
                self._scan(file)
        except IsADirectoryError:
            raise RecordingError(f"{path}: is a folder, not an MCAP file") from None
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
        self._frames.sort(key=lambda frame: (frame.start_ns, frame.offset))

    @property
    def path(self) -> Path:
        """The file."""
        return self._path

    @property
    def damage(self) -> str | None:
        """Why reading stopped early; complete after a pass over :meth:`messages`."""
        return self._damage

    def messages(self) -> Iterator[RawMessage]:
        """All messages in log-time order, as far as the file is sound."""
        pending: list[tuple[int, int, Schema, Channel, bytes]] = []  # heap: log time, then place in the file
        serial = 0
        with self._path.open("rb") as file:
            self._define_ahead(file)
            for frame in self._frames:
                while pending and pending[0][0] < frame.start_ns:
                    yield _raw(heapq.heappop(pending))
                try:
                    records = self._read_frame(file, frame)
                except _DamageError as error:
                    self._damage = f"damaged at byte {frame.offset} ({error})"
                    break
                for schema, channel, message in records:
                    heapq.heappush(pending, (message.log_time, serial, schema, channel, message.data))
                    serial += 1
        while pending:
            yield _raw(heapq.heappop(pending))

    def decode(self, message: RawMessage) -> Any:
        """The message as an object with ROS field names, by the schema in the file.

        Raises:
            RecordingError: the bytes do not fit the schema.
        """
        schema: Schema = message.schema
        try:
            decoder = self._decoders.get(schema.id)
            if decoder is None:
                decoder = self._decoders[schema.id] = self._decoder_for(schema)
            return decoder(message.data)
        except _LIBRARY_ERRORS as error:
            when = message.log_time_ns / NS
            raise RecordingError(
                f"{self._path}: {message.topic}: the message logged at {when:.3f} s cannot be decoded as "
                f"{message.type} ({_reason(error)})"
            ) from None

    def _decoder_for(self, schema: Schema) -> Callable[[bytes], Any]:
        """By the definition in the file, or where that is none that can be read, by ROS 2's own of that name."""
        from mcap_ros2.decoder import DecoderFactory

        if schema.encoding == "ros2msg" and not is_own_definition(schema.name, schema.data):
            raise ValueError("the file's definition is not ROS 2's")
        if self._factory is None:
            self._factory = DecoderFactory()
        decoder: Callable[[bytes], Any] | None = self._factory.decoder_for("cdr", schema)
        if decoder is None:
            from rosbags.typesys import Stores, get_typestore

            store, name = get_typestore(Stores.ROS2_JAZZY), schema.name
            if name not in store.types:
                raise ValueError(f"definition in {schema.encoding!r}, expected ros2msg")
            return lambda data: store.deserialize_cdr(data, name)
        return decoder

    # --- one pass over the record frames -------------------------------------------------------------------

    def _scan(self, file: IO[bytes]) -> None:
        size = file.seek(0, 2)
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise RecordingError(
                f"{self._path}: is not an MCAP file; for other bags give the rosbag2 folder or .db3 file "
                "with --map and --rig"
            )
        try:
            while not self.whole:
                self._scan_record(file, size)
        except _DamageError as error:
            self._damage = str(error)

    def _scan_record(self, file: IO[bytes], size: int) -> None:
        offset = file.tell()
        head = file.read(9)
        if len(head) < 9:
            raise _DamageError("cut off")
        opcode, length = struct.unpack("<BQ", head)
        if opcode not in _KNOWN and opcode < _PRIVATE:
            raise _DamageError(f"damaged at byte {offset} (no record starts there)")
        body = offset + 9
        if body + length > size:
            raise _DamageError("cut off")
        if length > _MAX_RECORD:
            raise _DamageError(f"damaged at byte {offset} (a record of {length} bytes)")
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            self.whole = True
        elif opcode == Opcode.ATTACHMENT:
            self._add_attachment(file.read(length), offset)
        elif opcode == Opcode.CHUNK:
            if length < 32:
                raise _DamageError(f"damaged at byte {offset} (a chunk without header)")
            start_ns, end_ns = struct.unpack("<QQ", file.read(16))
            self._frames.append(_Frame(start_ns, end_ns, body, length, opcode))
        elif opcode in _UNCHUNKED:
            self._add_loose(file.read(length), body, opcode)
        file.seek(body + length)

    def _add_attachment(self, body: bytes, offset: int) -> None:
        attachment = _parse(Attachment.read, body)
        (crc,) = struct.unpack("<I", body[-4:])
        if crc not in (0, zlib.crc32(body[:-4])):
            raise _DamageError(
                f"damaged at byte {offset} (attachment {attachment.name!r} fails its checksum)"
            )
        self.attachments[attachment.name] = attachment.data

    def _add_loose(self, body: bytes, offset: int, opcode: int) -> None:
        """A record outside any chunk: definitions are kept at once, a message is remembered by its place."""
        if opcode == Opcode.MESSAGE:
            if len(body) < 22:
                raise _DamageError(f"damaged at byte {offset} (a message without header)")
            (log_time_ns,) = struct.unpack_from("<Q", body, 6)
            self._frames.append(_Frame(log_time_ns, log_time_ns, offset, len(body), opcode))
        else:
            self._define(_parse(Schema.read if opcode == Opcode.SCHEMA else Channel.read, body))

    def _define(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record

    # --- one chunk -----------------------------------------------------------------------------------------

    def _define_ahead(self, file: IO[bytes]) -> None:
        """Definitions precede messages in the file; where time order is another, collect them first."""
        offsets = [frame.offset for frame in self._frames]
        if offsets == sorted(offsets):
            return
        for frame in sorted(self._frames, key=lambda frame: frame.offset):
            if frame.opcode == Opcode.CHUNK:
                file.seek(frame.offset)
                try:
                    records = _open_chunk(_parse(Chunk.read, file.read(frame.length)))
                except _DamageError:
                    continue  # told when its turn comes
                for record in records:
                    self._define(record)

    def _read_frame(self, file: IO[bytes], frame: _Frame) -> list[tuple[Schema, Channel, Message]]:
        file.seek(frame.offset)
        body = file.read(frame.length)
        if frame.opcode == Opcode.MESSAGE:
            records: list[McapRecord] = [_parse(lambda stream: Message.read(stream, len(body)), body)]
        else:
            records = _open_chunk(_parse(Chunk.read, body))
        found = []
        for record in records:
            self._define(record)
            if isinstance(record, Message):
                if record.log_time > _MAX_TIME_NS:
                    raise _DamageError(f"a message is dated {record.log_time} ns")
                if not frame.start_ns <= record.log_time <= frame.end_ns:
                    raise _DamageError("a message lies outside its chunk's time range")
                found.append(self._resolve(record))
        return found

    def _resolve(self, message: Message) -> tuple[Schema, Channel, Message]:
        channel = self._channels.get(message.channel_id)
        if channel is None:
            raise _DamageError(f"channel {message.channel_id} is not defined")
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            schema = Schema(id=0, name="", encoding="", data=b"")
        return schema, channel, message


def _raw(item: tuple[int, int, Schema, Channel, bytes]) -> RawMessage:
    log_time_ns, _, schema, channel, data = item
    return RawMessage(channel.topic, schema.name, log_time_ns, data, schema)


def _reason(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0] or type(error).__name__


def _parse(read: Callable[[ReadDataStream], T], body: bytes) -> T:
    try:
        return read(ReadDataStream(BytesIO(body)))
    except _LIBRARY_ERRORS as error:
        raise _DamageError(_reason(error)) from None


def _open_chunk(chunk: Chunk) -> list[McapRecord]:
    try:
        return breakup_chunk(unpacked(chunk), validate_crc=True)
    except _LIBRARY_ERRORS as error:
        raise _DamageError(_reason(error)) from None
