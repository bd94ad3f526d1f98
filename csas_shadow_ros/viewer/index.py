"""Random access to the views of a bag: one is read without the others."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.records import ChunkIndex

from msg_adapters.messages import stamp_to_ns
from msg_adapters.topics import absolute_name, stream

from ..bags import BagReader
from ..bags.bag import BagMessage
from ..bags.mcap_file import McapFile
from ..core.errors import BagError

_MESSAGE = 0x05
_HEAD = struct.Struct("<HIQQ")


class BagIndex:
    """Finds a stream's images by stamp in the chunks of a bag's MCAP files.

    Parameters
    ----------
    reader : BagReader
        The bag.

    Raises
    ------
    BagError
        If it cannot be indexed (cut off, or no MCAP): such a bag is read from end to end instead.
    """

    def __init__(self, reader: BagReader) -> None:
        self.reader = reader
        if reader._foreign is not None or not all(f._indexed for f in reader._files):
            raise BagError(f"{reader.path} has no index; expected a complete MCAP bag")

    def places(self, stream_name: str, stamps: set[int]) -> dict[int, Callable[[], Any]]:
        """Return a function for each stamp that reads its image message.

        A chunk whose only message of the stream was logged at its own stamp is found without being read;
        the others are read once.
        """
        topic = absolute_name(stream(stream_name).image_topic, self.reader.namespace)
        found: dict[int, Callable[[], Any]] = {}
        for file in self.reader._files:
            channels = {i for i, c in file.channels.items() if c.topic == topic}
            for chunk in file._chunks:
                if not channels & set(chunk.message_index_offsets):
                    continue
                alone = chunk.message_start_time == chunk.message_end_time
                if alone and chunk.message_start_time in stamps:
                    held = [chunk.message_start_time]
                else:
                    held = [stamp for stamp, _ in self._in_chunk(file, chunk, channels, topic)]
                for stamp in held:
                    if stamp in stamps:
                        found.setdefault(stamp, self._loader(file, chunk, channels, topic, stamp))
        return found

    def _loader(
        self, file: McapFile, chunk: ChunkIndex, channels: set[int], topic: str, stamp: int
    ) -> Callable[[], Any]:
        def load() -> Any:
            for at, message in self._in_chunk(file, chunk, channels, topic):
                if at == stamp:
                    return message
            raise BagError(f"{topic}: the image stamped {stamp} ns is not where the bag's index says")

        return load

    @staticmethod
    def _in_chunk(file: McapFile, chunk: ChunkIndex, channels: set[int], topic: str) -> list[tuple[int, Any]]:
        path: Path = file.path
        with path.open("rb") as opened:
            opened.seek(chunk.chunk_start_offset)
            _, body = file._read_record(opened)
        found = []
        try:
            for op, record in file._unpack(body):
                if op == _MESSAGE and _HEAD.unpack_from(record)[0] in channels:
                    channel, _, when, _ = _HEAD.unpack_from(record)
                    kind = file.channels[channel].type_name
                    message = BagMessage(topic, kind, when, 0, record[_HEAD.size :]).decode()
                    found.append((stamp_to_ns(message.header.stamp), message))
        except (ValueError, struct.error) as error:
            raise BagError(f"{path.name}: the chunk at byte {chunk.chunk_start_offset}: {error}") from error
        return found
