"""Node `bag_player`: plays a run from a bag; raw messages go out as they were recorded."""

from __future__ import annotations

import struct
import sys
import time
from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

from csas_shadow_ros.bags import BagReader, iterate_pairs
from csas_shadow_ros.bags.run import Problem
from csas_shadow_ros.core.errors import BagError, CsasError, ParameterError
from msg_adapters import coherent_image_from_msgs, track_from_msg
from msg_adapters.messages import NANOSECONDS
from msg_adapters.topics import stream as stream_of

from . import qos
from .base import CsasNode, Source, run_node

#: Stages in the order in which a bag is searched for them.
STAGES = ("image", "sector", "sub_aperture", "shadow", "likelihood", "shadow_mask")
_CACHED = 2 * qos.MAX_WINDOW


def header_stamp(cdr: Any, where: str) -> int:
    """Read the stamp (ns) of a serialised message that begins with a header.

    Raises
    ------
    BagError
        If it is too short, no plain CDR, or its stamp is no time.
    """
    if len(cdr) < 12 or cdr[0] != 0 or cdr[1] > 1:
        raise BagError(f"{where}: {bytes(cdr[:4])!r}… ({len(cdr)} bytes) is no CDR message with a header")
    sec, nanosec = struct.unpack_from("<iI" if cdr[1] == 1 else ">iI", cdr, 4)
    if sec < 0 or nanosec >= NANOSECONDS:
        raise BagError(f"{where}: stamp is {sec} s {nanosec} ns; expected sec >= 0 and nanosec in [0, 1e9)")
    return int(sec) * NANOSECONDS + int(nanosec)


class BagViews:
    """The pairs of one stream of a bag, by stamp, at will: raw, and without holding more than a few.

    Parameters
    ----------
    reader : BagReader
        The bag.
    stream : str
        Name of the stream.
    """

    def __init__(self, reader: BagReader, stream: str) -> None:
        self._reader = reader
        self._kind = stream_of(stream)
        #: One line for each message that is not usable.
        self.problems: list[str] = []
        #: Recording time (ns) of each stamp, in the order of recording.
        self.times: dict[int, int] = {}
        self._infos: dict[int, bytes] = {}
        for message in reader.messages([self._kind.info_topic]):
            stamp = self._stamp(message)
            if stamp is not None and stamp not in self._infos:
                self._infos[stamp] = bytes(message.cdr)
                self.times[stamp] = message.log_time_ns
        self._cursor: Iterator[Any] | None = None
        self._recent: OrderedDict[int, bytes] = OrderedDict()

    def _stamp(self, message: Any) -> int | None:
        try:
            return header_stamp(message.cdr, f"{message.topic} message {message.number}")
        except BagError as error:
            if str(error) not in self.problems:
                self.problems.append(str(error))
            return None

    def get(self, stamp: int) -> tuple[bytes, bytes]:
        """Return (image, camera_info) as they were recorded.

        Reading goes on from where it was: views asked for in the order of recording are read once.

        Raises
        ------
        BagError
            If the bag holds no image of that stamp.
        """
        if stamp in self._recent:
            return self._recent[stamp], self._infos[stamp]
        for again in (False, True):
            if self._cursor is None or again:
                self._cursor = self._reader.messages([self._kind.image_topic])
            for message in self._cursor:
                found = self._stamp(message)
                if found is None:
                    continue
                self._recent[found] = bytes(message.cdr)
                while len(self._recent) > _CACHED:
                    self._recent.popitem(last=False)
                if found == stamp:
                    return self._recent[found], self._infos[stamp]
        raise BagError(f"{self._kind.image_topic} in the bag holds no image stamped {stamp} ns")


class BagPlayerNode(CsasNode):
    """Publishes image and track (latched), or the views of one stage (under flow control)."""

    name = "bag_player"

    def setup(self) -> None:
        """Open the bag; begin to serve what is latched."""
        if not self.parameters.bag:
            raise ParameterError("bag is ''; expected the path of a bag")
        self.reader = BagReader(self.parameters.bag)
        self.views: BagViews | None = None
        self._began: tuple[float, int] | None = None
        stage = self.stage()
        self.get_logger().info(f"plays {stage} of {self.parameters.bag}")
        if stage == "image":
            self.latch_image()
        else:
            self.views = BagViews(self.reader, stage)
            self.source = Source(self, stage, self.send_view, self.may_send)
            self.source.flow.offer(self.views.times)
            self.latch("target")
        self.latch_track()
        for line in (*self.reader.problems, *(self.views.problems if self.views else ())):
            self.reject(line)

    def holds(self, relative: str) -> bool:
        """Say whether the bag has messages of a topic."""
        info = self.reader.topic(relative)
        return info is not None and info.count > 0

    def stage(self) -> str:
        """Return what to play: the earliest stage that the bag holds whole, unless one is named.

        Raises
        ------
        BagError
            If the bag does not hold it.
        """
        wanted = self.parameters.stage
        kinds = [stream_of(s) for s in STAGES]
        there = [k.name for k in kinds if self.holds(k.image_topic) and self.holds(k.info_topic)]
        if wanted == "auto":
            whole = [s for s in there if s not in ("image", "sector") or self.holds("track")]
            if not whole:
                topics = ", ".join(sorted(self.reader.topics)) or "none"
                raise BagError(
                    f"{self.parameters.bag} holds no run; expected image or sector with track, or views"
                    f" (its topics: {topics})"
                )
            return whole[0]
        if wanted not in there:
            found = ", ".join(there) or "no stage"
            raise BagError(f"{self.parameters.bag} holds no {wanted}; it holds: {found}")
        return str(wanted)

    # Latched topics

    def latch(self, relative: str, cdr: Any = None) -> None:
        """Publish one message of a topic for whoever comes; the bag's last one by default."""
        if cdr is None:
            for message in self.reader.messages([relative]):
                cdr = message.cdr
        if cdr is not None:
            self.publisher(relative, qos.LATCHED).publish(bytes(cdr))

    def latch_image(self) -> None:
        """Publish the first usable image; an unusable one if there is no other, so that it gets named."""
        chosen: int | None = None
        for pair in iterate_pairs(self.reader, "image", self._problem):
            chosen = pair.stamp_ns
            try:
                coherent_image_from_msgs(pair.image, pair.info)
                break
            except CsasError as error:
                self._problem(Problem(pair.topic, pair.number, pair.stamp_ns, str(error)))
        if chosen is None:
            raise BagError(f"{self.parameters.bag} holds no image with a camera_info of the same stamp")
        for relative in ("camera_info", "image"):
            for message in self.reader.messages([relative]):
                try:
                    found = header_stamp(message.cdr, message.topic)
                except BagError:
                    continue  # named before
                if found == chosen:
                    self.latch(relative, message.cdr)
                    break

    def latch_track(self) -> None:
        """Publish the longest track; of a track that grew during the run it is the whole."""
        best, longest = None, -1
        for message in self.reader.messages(["track"]):
            try:
                length = len(track_from_msg(message.decode()))
            except CsasError as error:
                self._problem(Problem(message.topic, message.number, None, str(error)))
                length = 0
            if length >= longest:
                best, longest = message.cdr, length
        if best is not None:
            self.latch("track", best)

    def _problem(self, problem: Problem) -> None:
        self.reject(str(problem))

    # Views

    def may_send(self, stamp: int) -> bool:
        """Say whether the view's time has come, at the chosen rate."""
        rate = self.parameters.rate
        if rate <= 0 or self.views is None:
            return True
        now, when = time.monotonic(), self.views.times[stamp]
        if self._began is None:
            self._began = (now, when)
        since, first = self._began
        return (when - first) / 1e9 <= (now - since) * rate

    def send_view(self, stamp: int) -> None:
        """Publish a view as it was recorded."""
        if self.views is None:
            raise BagError(f"view {stamp} ns was asked for, but the bag's image is played")
        image, info = self.views.get(stamp)
        self.source.info.publish(info)
        self.source.image.publish(image)


def main() -> int:
    """Run the node."""
    return run_node(BagPlayerNode)


if __name__ == "__main__":
    sys.exit(main())
