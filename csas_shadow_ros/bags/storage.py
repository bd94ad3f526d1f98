"""Bounds of storage files, checked before memory is taken, and merging of several files."""

from __future__ import annotations

import heapq
import os
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

import lz4.frame
import zstandard

from csas_shadow_ros.core.errors import BagError

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
LZ4_MAGIC = b"\x04\x22\x4d\x18"
#: Stored data may unfold to as many times their size. Sonar images shrink to a half, masks and grids that are
#: mostly empty to a twentieth; lz4 of zeros reaches 255, zstd 30 000.
MOST_EXPANSION = 50
#: As much (bytes) is unfolded whatever its expansion: a small view may be one single value.
_FREE_BYTES = 1 << 26
#: Length fields of CDR have 32 bits: no message is larger.
_MOST_BYTES = 1 << 32
#: Sliding window (bytes) of zstd that is accepted in files: what the zstd command takes without options.
_MOST_WINDOW = 1 << 27
_PIECE = 1 << 20


class RawMessage(NamedTuple):
    """A message as stored in the file."""

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
    message_encoding : str
        ``cdr`` for ROS 2.
    """

    topic: str
    type_name: str
    message_encoding: str


#: Where messages lie together: when the first of them was recorded (ns), and how to read them, in time order.
Segment = tuple[int, Callable[[], Iterator[RawMessage]]]


class StorageFile(Protocol):
    """One file of a bag, MCAP or sqlite3."""

    channels: dict[int, TopicType]
    counts: dict[int, int]
    compressions: set[str]
    #: False if the file ends early or is damaged.
    complete: bool
    #: False if some of the messages read so far are not covered by a checksum.
    has_checksums: bool

    def segments(self, wanted: Callable[[TopicType], bool]) -> list[Segment]:
        """Return the positions of the wanted channels' messages."""
        ...


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading; refuse devices and pipes instead of waiting for them.

    Raises
    ------
    BagError
        If it is a pipe, a device or a directory, or cannot be opened.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise BagError(f"cannot read {path}: {error.strerror}") from error
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    kinds = {stat.S_IFIFO: "a named pipe", stat.S_IFDIR: "a directory"}
    raise BagError(f"{path} is {kinds.get(stat.S_IFMT(mode), 'a device')}; expected a file")


def most_unfolded(stored: int) -> int:
    """Return the largest size, in bytes, to which stored data may unfold."""
    return min(max(_FREE_BYTES, MOST_EXPANSION * stored), _MOST_BYTES)


def refuse_expansion(size: int, stored: int) -> None:
    """Refuse data that unfold to more than any recording would.

    Raises
    ------
    ValueError
        If they would.
    """
    if size > (most := most_unfolded(stored)):
        raise ValueError(f"{stored} bytes unfold to {size}; expected {most} at most")


def unfold(data: memoryview, compression: str, size: int) -> memoryview:
    """Decompress data of a declared size, never using more memory than that.

    Raises
    ------
    ValueError
        If they do not, or the size is beyond what recordings unfold to.
    """
    if not compression:
        return data
    refuse_expansion(size, len(data))
    try:
        if compression == "zstd":
            # The frame's own word for its size is what the library would allocate.
            if (own := zstandard.frame_content_size(data)) not in (size, -1):
                raise ValueError(f"chunk declares {size} bytes unfolded, its frame {own}")
            return memoryview(zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1)))
        if compression == "lz4":
            stream = lz4.frame.LZ4FrameDecompressor()
            out = stream.decompress(data, max_length=size)
            if not stream.eof and len(out) == size:
                out += stream.decompress(b"", max_length=1)
            if len(out) > size or not stream.eof:
                raise ValueError(f"chunk does not unfold to the {size} bytes that it declares")
            return memoryview(out)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise ValueError(f"chunk cannot be decompressed ({error})") from error
    raise ValueError(f"chunk compression {compression!r} is unknown; expected zstd, lz4 or none")


def unfold_message(data: memoryview) -> memoryview:
    """Decompress a message of rosbag2's compression mode MESSAGE; return others unchanged.

    The data tell: CDR begins with a zero, zstd never does. metadata.yaml may have been lost or edited.

    Raises
    ------
    ValueError
        If it is damaged or unfolds to more than recordings do.
    """
    if data[:4] != ZSTD_MAGIC:
        return data
    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError as error:
        raise ValueError(f"message cannot be decompressed ({error})") from error
    if size >= 0:
        return unfold(data, "zstd", size)
    try:
        whole = zstandard.ZstdDecompressor().decompress(data, max_output_size=most_unfolded(len(data)))
    except (zstandard.ZstdError, MemoryError) as error:
        raise ValueError(f"message cannot be decompressed ({error})") from error
    return memoryview(whole)


def unfold_file(path: Path, compression: str, into: Path, complain: Callable[[str], None]) -> bool:
    """Decompress a file of rosbag2's compression mode FILE as far as possible; say whether it is complete.

    Raises
    ------
    BagError
        If the disk refuses, or the file unfolds to more than recordings do.
    """
    with open_regular(path) as source:
        most = most_unfolded(os.fstat(source.fileno()).st_size)
        pieces = _zstd_pieces(source) if compression == "zstd" else _lz4_pieces(source)
        written = 0
        try:
            with into.open("wb") as target:
                for piece in pieces:
                    written += len(piece)
                    if written > most:
                        raise BagError(f"{path} unfolds to more than {most} bytes; expected a recording")
                    target.write(piece)
        except OSError as error:
            raise BagError(f"cannot decompress {path} to {into.parent}: {error.strerror}") from error
        except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
            complain(f"{path.name}: cannot be decompressed to its end ({error}); reading what remains of it")
            return False
    return True


def _zstd_pieces(source: BinaryIO) -> Iterator[bytes]:
    decompressor = zstandard.ZstdDecompressor(max_window_size=_MOST_WINDOW)
    with decompressor.stream_reader(source, read_across_frames=True, closefd=False) as reader:
        while piece := reader.read(_PIECE):
            yield piece


def _lz4_pieces(source: BinaryIO) -> Iterator[bytes]:
    stream = lz4.frame.LZ4FrameDecompressor()
    while not stream.eof:
        stored = source.read(_PIECE) if stream.needs_input else b""
        if stream.needs_input and not stored:
            raise EOFError("it ends in the middle of a frame")
        yield stream.decompress(stored, max_length=_PIECE)


def merged(files: list[StorageFile], wanted: Callable[[TopicType], bool]) -> Iterator[tuple[int, RawMessage]]:
    """Iterate (file number, message) in time order, for any order of files and of their parts.

    A segment is read when its time has come: only those that overlap in time are in memory together.
    """
    segments = [(start, n, load) for n, file in enumerate(files) for start, load in file.segments(wanted)]
    segments.sort(key=lambda segment: segment[0])
    waiting: list[tuple[int, int, int, RawMessage, Iterator[RawMessage]]] = []

    def push(serial: int, number: int, messages: Iterator[RawMessage]) -> None:
        if (message := next(messages, None)) is not None:
            heapq.heappush(waiting, (message.log_time_ns, serial, number, message, messages))

    for serial, (start, number, load) in enumerate(segments):
        while waiting and waiting[0][0] < start:
            _, before, n, message, messages = heapq.heappop(waiting)
            yield n, message
            push(before, n, messages)
        push(serial, number, load())
    while waiting:
        _, before, n, message, messages = heapq.heappop(waiting)
        yield n, message
        push(before, n, messages)
