"""Random access to single views of a bag."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from msg_adapters.messages import stamp_to_ns
from msg_adapters.topics import absolute_name, stream

from ..core.errors import BagError
from .bag import BagMessage, BagReader
from .mcap_file import McapFile, Place
from .storage import unfold_message


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
        files = reader.indexed_files
        if files is None:
            raise BagError(f"{reader.path} has no index; expected a complete MCAP bag")
        self.files = files

    def places(self, stream_name: str, stamps: set[int]) -> Iterator[tuple[int, Callable[[], Any]]]:
        """Iterate stamps, each once, with a function that reads its image message.

        A chunk whose only message of the stream was logged at its own stamp is found without being read;
        the others, as of a bag that a recorder wrote, are read once, on the way.
        """
        topic = absolute_name(stream(stream_name).image_topic, self.reader.namespace)
        left = set(stamps)
        for file in self.files:
            channels = {i for i, c in file.channels.items() if c.topic == topic}
            for place in file.places:
                if not left:
                    return
                if not channels & place.channels:
                    continue
                alone = place.start_ns == place.end_ns
                if alone and place.start_ns in left:
                    held = [place.start_ns]
                else:
                    held = [stamp for stamp, _ in self._at(file, place, channels, topic)]
                for stamp in held:
                    if stamp in left:
                        left.remove(stamp)
                        yield stamp, self._loader(file, place, channels, topic, stamp)

    def _loader(
        self, file: McapFile, place: Place, channels: set[int], topic: str, stamp: int
    ) -> Callable[[], Any]:
        def load() -> Any:
            for at, message in self._at(file, place, channels, topic):
                if at == stamp:
                    return message
            raise BagError(f"{topic}: the image stamped {stamp} ns is not where the bag's index says")

        return load

    @staticmethod
    def _at(file: McapFile, place: Place, channels: set[int], topic: str) -> list[tuple[int, Any]]:
        kinds = {i: file.channels[i].type_name for i in channels}
        found = []
        for raw in file.messages_of(place, channels):
            try:
                data = unfold_message(raw.data)
            except ValueError as error:
                raise BagError(f"{topic}: {error}") from error
            message = BagMessage(topic, kinds[raw.channel_id], raw.log_time_ns, 0, data).decode()
            found.append((stamp_to_ns(message.header.stamp), message))
        return found
