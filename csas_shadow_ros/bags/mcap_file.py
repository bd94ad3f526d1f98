"""One MCAP file, read with whatever is left of it.

The libraries' readers give up on a file at its first damage. This one reads through the index when
there is a sound one, otherwise walks the records from the start, checks every checksum that the
writer left, and goes on after a damaged chunk. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import heapq
import io
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, ChunkIndex, Schema, Statistics

from csas_shadow_ros.core.errors import BagError

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
_CHUNK_INDEX, _STATISTICS, _DATA_END = 0x08, 0x0B, 0x0F
_FOOTER_BYTES = 9 + 20 + len(MAGIC)
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_MAX_CHUNK_BYTES = 1 << 33


class RawMessage(NamedTuple):
    """A message as it lies in the file."""

    channel_id: int
    log_time_ns: int
    data: memoryview


@dataclass(frozen=True)
class TopicType:
    """Topic and type of a channel.

    Parameters
    ----------
    topic, type_name : str
        Names; the type as ``package/msg/Name``.
    schema, schema_encoding : str
        The type's definition.
    message_encoding : str
        ``cdr`` for ROS 2.
    qos : str
        ``offered_qos_profiles``, as it was recorded.
    """

    topic: str
    type_name: str
    schema: str
    schema_encoding: str
    message_encoding: str
    qos: str


class McapFile:
    """Reads one MCAP file.

    Parameters
    ----------
    path : Path
        The file.
    complain : callable
        Called with one line for each damage, as it is met.

    Raises
    ------
    BagError
        If it cannot be opened, is empty, or is no MCAP file.
    """

    def __init__(self, path: Path, complain: Callable[[str], None]) -> None:
        self.path = path
        self._complain = complain
        self.channels: dict[int, TopicType] = {}
        self.counts: dict[int, int] | None = None
        self.compressions: set[str] = set()
        #: False if the file ends early or its index is damaged.
        self.complete = True
        #: False if some of the messages read so far are not covered by a checksum.
        self.has_checksums = True
        self._schemas: dict[int, Schema] = {}
        #: Where the chunks lie; empty without an index.
        self.chunks: list[ChunkIndex] = []
        #: Whether every message can be found without reading the others.
        self.indexed = False
        try:
            with path.open("rb") as file:
                magic = file.read(len(MAGIC))
                if not magic:
                    raise BagError(f"{path} is empty (0 bytes); expected an MCAP file")
                if magic != MAGIC:
                    raise BagError(f"{path} is no MCAP file (starts with {magic!r}); expected {MAGIC!r}")
                self.size = file.seek(0, io.SEEK_END)
                self._read_summary(file)
                if not self.indexed:
                    self._scan(file)
        except OSError as error:
            raise BagError(f"cannot read {path}: {error.strerror}") from error

    def _read_summary(self, file: BinaryIO) -> None:
        if self.size < len(MAGIC) + _FOOTER_BYTES:
            self._cut_short("before its first message")
            return
        file.seek(-_FOOTER_BYTES, io.SEEK_END)
        tail = file.read(_FOOTER_BYTES)
        op, length, start, _, crc = struct.unpack("<BQQQI", tail[:29])
        if tail[29:] != MAGIC or op != _FOOTER or length != 20:
            self._cut_short("its footer is missing: the recording was cut off")
            return
        if start == 0:
            return  # written without a summary: not an error, the records are walked
        end = self.size - _FOOTER_BYTES
        if not len(MAGIC) <= start <= end:
            self._cut_short(f"its summary is said to start at byte {start} of {self.size}")
            return
        file.seek(start)
        summary = file.read(end - start)
        if crc and zlib.crc32(summary + tail[:25]) != crc:
            self._cut_short("the checksum of its summary is wrong")
            return
        statistics: Statistics | None = None
        try:
            for op, body in _records(memoryview(summary)):
                if op == _STATISTICS:
                    statistics = Statistics.read(_stream(body))
                elif op == _CHUNK_INDEX:
                    self.chunks.append(ChunkIndex.read(_stream(body)))
                else:
                    self._definition(op, body)
        except (McapError, struct.error, ValueError, _ShortError) as error:
            self._cut_short(f"its summary cannot be parsed ({error})")
            self.chunks.clear()
            return
        if statistics is not None:
            self.counts = {c: n for c, n in statistics.channel_message_counts.items() if n}
            named = set(self.counts) <= set(self.channels)
            # Messages outside chunks are not in the index: then only walking finds them all.
            self.indexed = named and (bool(self.chunks) or statistics.message_count == 0)
            self.compressions = {c.compression for c in self.chunks}

    def _cut_short(self, why: str) -> None:
        self.complete = False
        self._complain(f"{self.path.name}: {why}; reading what is left of it")

    def _definition(self, op: int, body: memoryview) -> None:
        if op == _SCHEMA:
            schema = Schema.read(_stream(body))
            self._schemas[schema.id] = schema
        elif op == _CHANNEL:
            channel = Channel.read(_stream(body))
            found = self._schemas.get(channel.schema_id)
            self.channels[channel.id] = TopicType(
                channel.topic,
                found.name if found else "",
                found.data.decode(errors="replace") if found else "",
                found.encoding if found else "",
                channel.message_encoding,
                channel.metadata.get("offered_qos_profiles", ""),
            )

    def _scan(self, file: BinaryIO) -> None:
        """Learn channels and counts of a file without an index by walking it once."""
        counts: dict[int, int] = {}
        for message in self._walk(file, None, self._complain):
            counts[message.channel_id] = counts.get(message.channel_id, 0) + 1
        self.counts = counts
        if not self.complete:
            self._complain(f"{self.path.name}: {sum(counts.values())} messages recovered")

    def messages(self, wanted: Callable[[TopicType], bool]) -> Iterator[RawMessage]:
        """Iterate messages of the wanted channels: in time order with an index, else as written.

        Data are views of the chunk that holds them; nothing else of the file is kept.
        """
        with self.path.open("rb") as file:
            if self.indexed:
                yield from self._through_index(file, {i for i, c in self.channels.items() if wanted(c)})
            else:
                # Damage was reported by the scan that went before.
                yield from self._walk(file, wanted, lambda _: None)

    def _through_index(self, file: BinaryIO, channels: set[int]) -> Iterator[RawMessage]:
        chunks = [
            c
            for c in self.chunks
            # Without message indexes nobody knows what is in the chunk.
            if not c.message_index_offsets or channels & set(c.message_index_offsets)
        ]
        chunks.sort(key=lambda c: (c.message_start_time, c.chunk_start_offset))
        pending: list[tuple[int, int, RawMessage]] = []
        serial = 0
        for chunk in chunks:
            while pending and pending[0][0] < chunk.message_start_time:
                yield heapq.heappop(pending)[2]
            for message in self._messages_of(file, chunk, channels):
                heapq.heappush(pending, (message.log_time_ns, serial, message))
                serial += 1
        while pending:
            yield heapq.heappop(pending)[2]

    def messages_of(self, chunk: ChunkIndex, channels: set[int]) -> list[RawMessage]:
        """Read one chunk of the index, and none of the others.

        Returns
        -------
        list of RawMessage
            Its messages of these channels; none if the chunk is damaged, which is complained of.
        """
        with self.path.open("rb") as file:
            return self._messages_of(file, chunk, channels)

    def _messages_of(self, file: BinaryIO, chunk: ChunkIndex, channels: set[int]) -> list[RawMessage]:
        file.seek(chunk.chunk_start_offset)
        try:
            op, body = self._read_record(file)
            if op != _CHUNK:
                raise _ShortError(f"no chunk where the index says (record type {op})")
            messages = [_message(record) for op, record in self._unpack(body) if op == _MESSAGE]
        except (_ShortError, struct.error, ValueError) as error:
            self._damaged(chunk.chunk_start_offset, error, self._complain)
            return []
        return [m for m in messages if m.channel_id in channels]

    def _walk(
        self,
        file: BinaryIO,
        wanted: Callable[[TopicType], bool] | None,
        complain: Callable[[str], None],
    ) -> Iterator[RawMessage]:
        file.seek(len(MAGIC))
        loose = False
        checking = wanted is None
        running = zlib.crc32(MAGIC)
        while True:
            offset = file.tell()
            try:
                op, body = self._read_record(file)
            except _ShortError as error:
                self.complete = False
                complain(f"{self.path.name}: ends in the middle of a record at byte {offset} ({error})")
                return
            if op == _DATA_END:
                (crc,) = struct.unpack_from("<I", body)
                if checking and crc and crc != running:
                    complain(f"{self.path.name}: the checksum of its data is wrong: some bits have changed")
                if loose and not crc:
                    self.has_checksums = False
                return
            if op == _FOOTER:
                return
            if checking:
                running = zlib.crc32(body, zlib.crc32(_RECORD_HEAD.pack(op, len(body)), running))
            try:
                if op == _CHUNK:
                    records: Iterable[tuple[int, memoryview]] = list(self._unpack(body))
                elif op == _MESSAGE:
                    loose, records = True, [(op, body)]
                else:
                    records = [(op, body)]
                for inner, content in records:
                    if inner == _MESSAGE:
                        message = _message(content)
                        channel = self.channels.get(message.channel_id)
                        if channel is None:
                            complain(
                                f"{self.path.name}: a message near byte {offset} belongs to channel"
                                f" {message.channel_id}, which is not defined"
                            )
                        elif wanted is None or wanted(channel):
                            yield message
                    else:
                        self._definition(inner, content)
            except (_ShortError, McapError, struct.error, ValueError) as error:
                self._damaged(offset, error, complain)

    def _read_record(self, file: BinaryIO) -> tuple[int, memoryview]:
        here = file.tell()
        head = file.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            raise _ShortError(f"{len(head)} of {_RECORD_HEAD.size} bytes of its head")
        op, length = _RECORD_HEAD.unpack(head)
        left = self.size - here - _RECORD_HEAD.size
        if length > left:
            raise _ShortError(f"{left} of {length} bytes")
        return op, memoryview(file.read(length))

    def _damaged(self, offset: int, error: Exception, complain: Callable[[str], None]) -> None:
        complain(f"{self.path.name}: damaged at byte {offset}: {error}; its messages are lost")

    def _unpack(self, body: memoryview) -> Iterator[tuple[int, memoryview]]:
        """Decompress a chunk's body, check its checksum, and iterate its records."""
        if len(body) < _CHUNK_HEAD.size:
            raise _ShortError("chunk without a head")
        _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
        at = _CHUNK_HEAD.size
        compression = bytes(body[at : at + name_length]).decode()
        at += name_length
        (length,) = struct.unpack_from("<Q", body, at)
        data = body[at + 8 : at + 8 + length]
        if len(data) != length or size > _MAX_CHUNK_BYTES:
            raise _ShortError(f"chunk of {length} bytes has {len(data)}")
        self.compressions.add(compression)
        try:
            if compression == "zstd":
                data = memoryview(zstandard.ZstdDecompressor().decompress(data, max_output_size=size))
            elif compression == "lz4":
                data = memoryview(lz4.frame.decompress(data))
            elif compression:
                raise ValueError(f"chunk compression {compression!r} is unknown; expected zstd, lz4 or none")
        except (zstandard.ZstdError, RuntimeError) as error:
            raise ValueError(f"chunk cannot be decompressed ({error})") from error
        if len(data) != size:
            raise ValueError(f"chunk has {len(data)} bytes; expected {size}")
        if not crc:
            self.has_checksums = False
        elif zlib.crc32(data) != crc:
            raise ValueError("the chunk's checksum is wrong: some bits have changed")
        yield from _records(data)


class _ShortError(Exception):
    """A record reaches beyond the end of what holds it."""


def _stream(body: memoryview) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    at = 0
    while at < len(data):
        if at + 9 > len(data):
            raise _ShortError(f"{len(data) - at} bytes left for a record's head")
        op, length = _RECORD_HEAD.unpack_from(data, at)
        at += 9
        if at + length > len(data):
            raise _ShortError(f"record of {length} bytes has {len(data) - at}")
        yield op, data[at : at + length]
        at += length


def _message(body: memoryview) -> RawMessage:
    channel, _, log_time, _ = _MESSAGE_HEAD.unpack_from(body)
    return RawMessage(channel, log_time, body[_MESSAGE_HEAD.size :])
