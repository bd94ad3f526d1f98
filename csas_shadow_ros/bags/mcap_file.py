"""Read one MCAP file as far as it is intact.

The libraries' readers give up on a file at its first damage. This one reads through the index when
there is a sound one, otherwise walks the records from the start and makes its own, checks every checksum that
the writer left, and goes on after a damaged chunk. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, ChunkIndex, Schema, Statistics

from csas_shadow_ros.core.errors import BagError

from .storage import RawMessage, Segment, TopicType, most_unfolded, open_regular, unfold

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
_CHUNK_INDEX, _STATISTICS, _DATA_END = 0x08, 0x0B, 0x0F
#: Types that the format knows; those from 0x80 on are anybody's own.
_KNOWN = range(0x01, 0x10)
_FREE_TYPES = 0x80
_FOOTER_BYTES = 9 + 20 + len(MAGIC)
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
#: A message has a time of its own, which no compression brings below a byte; and room for a few small ones.
_FREE_MESSAGES = 1000
#: All chunks of a file together may unfold to this (bytes), whatever their expansion: seconds of work.
_FREE_TOTAL = 1 << 31
#: As long (bytes) as a record is read that is not looked at.
_PIECE = 1 << 20


@dataclass(frozen=True)
class Place:
    """Position of messages in a file: a chunk, or a message outside chunks.

    Parameters
    ----------
    start_ns, end_ns : int
        When the first and the last of its messages were recorded.
    offset : int
        Byte of the file where its record begins.
    channels : frozenset of int
        Channels of its messages.
    """

    start_ns: int
    end_ns: int
    offset: int
    channels: frozenset[int]


class McapFile:
    """Reads one MCAP file.

    Parameters
    ----------
    path : Path
        The file.
    complain : callable
        Called with one line for each damage, as it is met.
    name : str, optional
        What it is called in messages; the file's name by default.

    Raises
    ------
    BagError
        If it cannot be opened, is empty, or is not an MCAP file.
    """

    def __init__(self, path: Path, complain: Callable[[str], None], name: str | None = None) -> None:
        self.path = path
        self.name = name or path.name
        self._complain = complain
        self.channels: dict[int, TopicType] = {}
        self.counts: dict[int, int] = {}
        self.compressions: set[str] = set()
        #: False if the file ends early or its index is damaged.
        self.complete = True
        #: False if some of the messages read so far are not covered by a checksum.
        self.has_checksums = True
        self._schemas: dict[int, Schema] = {}
        #: Where the messages lie.
        self.places: list[Place] = []
        try:
            with open_regular(path) as file:
                magic = file.read(len(MAGIC))
                if not magic:
                    raise BagError(f"{path} is empty (0 bytes); expected an MCAP file")
                if magic != MAGIC:
                    raise BagError(f"{path} is not an MCAP file (starts with {magic!r}); expected {MAGIC!r}")
                self.size = file.seek(0, io.SEEK_END)
                if not self._read_summary(file):
                    self._scan(file)
        except OSError as error:
            raise BagError(f"cannot read {path}: {error.strerror}") from error

    def _summary_of(self, file: BinaryIO) -> tuple[bytes, int] | None:
        """Return the file's summary and its checksum; None if there is none to be trusted."""
        if self.size < len(MAGIC) + _FOOTER_BYTES:
            self._cut_short("before its first message")
            return None
        file.seek(-_FOOTER_BYTES, io.SEEK_END)
        tail = file.read(_FOOTER_BYTES)
        op, length, start, _, crc = struct.unpack("<BQQQI", tail[:29])
        if tail[29:] != MAGIC or op != _FOOTER or length != 20:
            self._cut_short("its footer is missing: the recording was cut off")
            return None
        if start == 0:
            return None  # written without a summary: not an error, the records are walked
        end = self.size - _FOOTER_BYTES
        if not len(MAGIC) <= start <= end:
            self._cut_short(f"its summary should start at byte {start} of {self.size}")
            return None
        file.seek(start)
        summary = file.read(end - start)
        if crc and zlib.crc32(summary + tail[:25]) != crc:
            self._cut_short("the checksum of its summary is wrong")
            return None
        return summary, crc

    def _read_summary(self, file: BinaryIO) -> bool:
        """Learn channels, counts and places from the file's index; say whether it tells all of them."""
        if (found := self._summary_of(file)) is None:
            return False
        summary, crc = found
        statistics: Statistics | None = None
        chunks: list[ChunkIndex] = []
        try:
            for op, body in _records(memoryview(summary)):
                if op == _STATISTICS:
                    statistics = Statistics.read(_stream(body))
                elif op == _CHUNK_INDEX:
                    chunks.append(ChunkIndex.read(_stream(body)))
                else:
                    self._definition(op, body)
        except (McapError, struct.error, ValueError, _ShortError) as error:
            self._cut_short(f"its summary cannot be parsed ({error})")
            return False
        self.has_checksums &= bool(crc)
        if statistics is None:
            return False
        counts = {c: n for c, n in statistics.channel_message_counts.items() if n}
        # The format lets a writer leave out counts by channel, what a chunk holds, and messages outside of
        # chunks from the index: then only walking finds them all.
        told = sum(counts.values()) == statistics.message_count and set(counts) <= set(self.channels)
        held = frozenset().union(*(c.message_index_offsets for c in chunks))
        empty = [
            c for c in chunks if not c.message_index_offsets and (c.message_start_time or c.message_end_time)
        ]
        if not told or empty or not set(counts) <= held:
            return False
        if statistics.message_count > self._most_messages(self.size):
            return False
        if sum(c.uncompressed_size for c in chunks) > max(_FREE_TOTAL, most_unfolded(self.size)):
            return False
        self.counts = counts
        self.compressions = {c.compression for c in chunks}
        self.places = [
            Place(
                c.message_start_time,
                c.message_end_time,
                c.chunk_start_offset,
                frozenset(c.message_index_offsets),
            )
            for c in chunks
            if c.message_index_offsets
        ]
        return True

    def _cut_short(self, why: str) -> None:
        self.complete = False
        self._complain(f"{self.name}: {why}; reading what remains of it")

    def _definition(self, op: int, body: memoryview) -> None:
        if op == _SCHEMA:
            schema = Schema.read(_stream(body))
            self._schemas[schema.id] = schema
        elif op == _CHANNEL:
            channel = Channel.read(_stream(body))
            found = self._schemas.get(channel.schema_id)
            self.channels[channel.id] = TopicType(
                channel.topic, found.name if found else "", channel.message_encoding
            )

    @staticmethod
    def _most_messages(stored: int) -> int:
        return _FREE_MESSAGES + stored

    def _scan(self, file: BinaryIO) -> None:
        """Learn channels, counts and places of a file without an index by walking it once."""
        self.counts, self.places = {}, []
        for offset, op, body in self._walk(file):
            try:
                records = list(self._messages_in(op, body, learn=True))
            except (_ShortError, McapError, struct.error, ValueError) as error:
                self._damaged(offset, error)
                continue
            held: dict[int, int] = {}
            for channel, _, _ in records:
                held[channel] = held.get(channel, 0) + 1
            for channel in held.keys() - self.channels.keys():
                self._complain(
                    f"{self.name}: a message near byte {offset} belongs to channel {channel},"
                    " which is not defined"
                )
                del held[channel]
            for channel, count in held.items():
                self.counts[channel] = self.counts.get(channel, 0) + count
            if held:
                times = [when for channel, when, _ in records if channel in held]
                self.places.append(Place(min(times), max(times), offset, frozenset(held)))
        if not self.complete:
            self._complain(f"{self.name}: {sum(self.counts.values())} messages recovered")

    def _end_of_data(self, file: BinaryIO, running: int, loose: bool) -> None:
        """Compare the checksum of all data, if the writer made one."""
        (crc,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
        if crc and crc != running:
            self._complain(f"{self.name}: the checksum of its data is wrong: some bits have changed")
        self.has_checksums &= bool(crc) or not loose

    def _walk(self, file: BinaryIO) -> Iterator[tuple[int, int, memoryview]]:
        """Iterate chunks and messages outside of chunks, from the start as far as the records go."""
        file.seek(len(MAGIC))
        running = zlib.crc32(MAGIC)
        loose = False
        total = 0
        while True:
            offset = file.tell()
            try:
                op, length = self._record_head(file)
            except _ShortError as error:
                self.complete = False
                self._complain(f"{self.name}: ends in the middle of a record at byte {offset} ({error})")
                return
            if op == _DATA_END:
                self._end_of_data(file, running, loose)
            if op in (_DATA_END, _FOOTER):
                return
            if op not in _KNOWN and op < _FREE_TYPES:
                self.complete = False
                self._complain(
                    f"{self.name}: damaged at byte {offset}: no record has type {op}; what follows is lost"
                )
                return
            running = zlib.crc32(_RECORD_HEAD.pack(op, length), running)
            if op not in (_CHUNK, _MESSAGE, _SCHEMA, _CHANNEL):
                # An attachment may be of any size, and is not looked at.
                while length:
                    piece = file.read(min(length, _PIECE))
                    running, length = zlib.crc32(piece, running), length - len(piece)
                continue
            body = memoryview(file.read(length))
            running = zlib.crc32(body, running)
            if op in (_SCHEMA, _CHANNEL):
                try:
                    self._definition(op, body)
                except (McapError, struct.error, ValueError) as error:
                    self._damaged(offset, error)
                continue
            loose |= op == _MESSAGE
            if op == _CHUNK and length >= _CHUNK_HEAD.size:
                claimed = _CHUNK_HEAD.unpack_from(body)[2]
                # One that claims too much is refused alone.
                total += claimed if claimed <= most_unfolded(length) else 0
            if total > max(_FREE_TOTAL, most_unfolded(self.size)):
                self.complete = False
                self._complain(
                    f"{self.name}: its {self.size} bytes unfold to {total} and more; the rest is lost"
                )
                return
            yield offset, op, body

    def segments(self, wanted: Callable[[TopicType], bool]) -> list[Segment]:
        """Return the positions of the wanted channels' messages, as views without copies."""
        chosen = {i for i, c in self.channels.items() if wanted(c)}

        def reading(place: Place) -> Callable[[], Iterator[RawMessage]]:
            return lambda: iter(self.messages_of(place, chosen))

        return [(p.start_ns, reading(p)) for p in self.places if p.channels & chosen]

    def messages_of(self, place: Place, channels: set[int]) -> Iterator[RawMessage]:
        """Iterate the messages of one place in time order, without reading others.

        None if it is damaged, which is complained of.
        """
        try:
            with open_regular(self.path) as file:
                file.seek(place.offset)
                op, length = self._record_head(file)
                if op not in (_CHUNK, _MESSAGE):
                    raise _ShortError(f"no chunk where the index says (record type {op})")
                body = memoryview(file.read(length))
            records = [r for r in self._messages_in(op, body) if r[0] in channels]
        except (_ShortError, McapError, OSError, struct.error, ValueError) as error:
            self._damaged(place.offset, error)
            return
        records.sort(key=lambda record: record[1])
        for channel, when, data in records:
            yield RawMessage(channel, when, data)

    def _messages_in(
        self, op: int, body: memoryview, *, learn: bool = False
    ) -> Iterator[tuple[int, int, memoryview]]:
        """Iterate (channel, time, data) of a chunk's or a message's record; learn the definitions in it."""
        left = self._most_messages(len(body))
        for inner, content in self._unpack(body) if op == _CHUNK else [(op, body)]:
            if inner == _MESSAGE:
                left -= 1
                if left < 0:
                    raise ValueError(f"chunk of {len(body)} bytes holds more messages than that")
                channel, _, when, _ = _MESSAGE_HEAD.unpack_from(content)
                yield channel, when, content[_MESSAGE_HEAD.size :]
            elif inner not in (_SCHEMA, _CHANNEL) and inner < _FREE_TYPES:
                raise ValueError(f"chunk holds a record of type {inner}")
            elif learn:
                self._definition(inner, content)

    def _record_head(self, file: BinaryIO) -> tuple[int, int]:
        here = file.tell()
        head = file.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            raise _ShortError(f"{len(head)} of {_RECORD_HEAD.size} bytes of its head")
        op, length = _RECORD_HEAD.unpack(head)
        left = self.size - here - _RECORD_HEAD.size
        if length > left:
            raise _ShortError(f"{left} of {length} bytes")
        return op, length

    def _damaged(self, offset: int, error: Exception) -> None:
        self._complain(f"{self.name}: damaged at byte {offset}: {error}; its messages are lost")

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
        if len(data) != length:
            raise _ShortError(f"chunk of {length} bytes has {len(data)}")
        self.compressions.add(compression)
        data = unfold(data, compression, size)
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
