"""Read bags for playing: which stage, and its raw pairs by stamp. No ROS needed."""

from __future__ import annotations

import contextlib
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from statistics import median
from typing import Any

from csas_shadow_ros.bags import BagReader
from csas_shadow_ros.bags.run import odd_sectors
from csas_shadow_ros.core.errors import BagError, CsasError, ParameterError
from msg_adapters import TOPICS, VIEW_STREAMS
from msg_adapters.camera_info import sector_info_from_msg
from msg_adapters.messages import NANOSECONDS
from msg_adapters.topics import DISPLAYS, MARKERS
from msg_adapters.topics import stream as stream_of
from msg_adapters.topics import topic as topic_of

#: Stages in the order in which a bag is searched for them.
STAGES = ("image", "sector", "sub_aperture", "shadow", "likelihood", "shadow_mask")
#: Images kept in memory: twice the largest window.
_CACHED = 16
#: A longer step between two views is no pause but a clock that was set: circles take minutes.
_LONGEST_PAUSE_S = 3600.0


def header_stamp(cdr: Any, where: str) -> int:
    """Read the stamp (ns) of a serialised message that begins with a header.

    Raises
    ------
    BagError
        If it is too short, no plain CDR, or its stamp is no time.
    """
    if len(cdr) < 12 or cdr[0] != 0 or cdr[1] > 1:
        raise BagError(f"{where}: {bytes(cdr[:4])!r}… ({len(cdr)} bytes) is not a CDR message with a header")
    sec, nanosec = struct.unpack_from("<iI" if cdr[1] == 1 else ">iI", cdr, 4)
    if sec < 0 or nanosec >= NANOSECONDS:
        raise BagError(f"{where}: stamp is {sec} s {nanosec} ns; expected sec >= 0 and nanosec in [0, 1e9)")
    return int(sec) * NANOSECONDS + int(nanosec)


def message_stamp(cdr: Any, topic: str) -> int | None:
    """Read the stamp (ns) of a serialised message of the contract; None of an empty array of markers.

    Raises
    ------
    BagError
        See `header_stamp`.
    """
    if topic_of(topic).type_name != MARKERS:
        return header_stamp(cdr, topic)
    if len(cdr) < 8 or cdr[0] != 0 or cdr[1] > 1:
        raise BagError(f"{topic}: {bytes(cdr[:4])!r}… ({len(cdr)} bytes) is not a CDR message")
    (count,) = struct.unpack_from("<I" if cdr[1] == 1 else ">I", cdr, 4)
    # An array has no header of its own: its markers have.
    return header_stamp(bytes(cdr[:4]) + bytes(cdr[8:20]), topic) if count else None


def holds(reader: BagReader, relative: str) -> bool:
    """Say whether a bag has messages of a topic."""
    info = reader.topic(relative)
    return info is not None and info.count > 0


def topics_to_record(topics: str) -> list[str]:
    """Return the topics named by the recorder's parameter.

    Raises
    ------
    ParameterError
        If one is not in the contract.
    """
    everything = [name for name in TOPICS if name not in DISPLAYS]
    names = everything if topics == "all" else [t.strip() for t in topics.split(",") if t.strip()]
    if unknown := [n for n in names if n not in TOPICS]:
        raise ParameterError(f"topics names {unknown[0]!r}; expected some of: {', '.join(TOPICS)}")
    return names


def recorded_streams(topics: str) -> list[str]:
    """Return the streams with both image and camera_info among these topics."""
    names = set(topics_to_record(topics))
    flowing = [stream_of(name) for name in (*VIEW_STREAMS, "sector")]
    return [s.name for s in flowing if {s.image_topic, s.info_topic} <= names]


def stage_of_bag(reader: BagReader, wanted: str = "auto") -> str:
    """Return the stage to play: the named one, or the earliest that is complete in the bag.

    Raises
    ------
    BagError
        If the bag does not hold it.
    """
    kinds = [stream_of(s) for s in STAGES]
    there = [k.name for k in kinds if holds(reader, k.image_topic) and holds(reader, k.info_topic)]
    if wanted == "auto":
        whole = [s for s in there if s not in ("image", "sector") or holds(reader, "track")]
        if not whole:
            topics = ", ".join(sorted(reader.topics)) or "none"
            raise BagError(
                f"{reader.path} holds no run; expected image or sector with track, or views"
                f" (its topics: {topics})"
            )
        return whole[0]
    if wanted not in there:
        raise BagError(f"{reader.path} holds no {wanted}; it holds: {', '.join(there) or 'no stage'}")
    return wanted


def schedule(times: Mapping[int, int]) -> tuple[dict[int, float], list[str]]:
    """Schedule views at the recorded speed, and list the clock steps that are not followed.

    Parameters
    ----------
    times : mapping of int to int
        Recording time (ns) of each stamp, in the order of playing.

    Returns
    -------
    dict of int to float
        Seconds from the first view, never falling.
    list of str
        One line for each step that was taken as long as most are: back, or longer than an hour.

    Examples
    --------
    >>> seconds, notes = schedule({1: 0, 2: 10**9, 3: 2 * 10**9, 4: 9000 * 10**9})
    >>> seconds
    {1: 0.0, 2: 1.0, 3: 2.0, 4: 3.0}
    >>> notes[0]
    'the recorder set its clock by 8998 s before the view stamped 4 ns: played 1 s later'
    """
    stamps = list(times)
    steps = [(times[b] - times[a]) / 1e9 for a, b in pairwise(stamps)]
    sound = [step for step in steps if 0.0 <= step <= _LONGEST_PAUSE_S]
    usual = median(sound) if sound else 0.0
    at, notes = 0.0, []
    found = {stamps[0]: 0.0} if stamps else {}
    for stamp, step in zip(stamps[1:], steps, strict=True):
        if not 0.0 <= step <= _LONGEST_PAUSE_S:
            notes.append(
                f"the recorder set its clock by {step:.6g} s before the view stamped {stamp} ns:"
                f" played {usual:.3g} s later"
            )
            step = usual
        at += step
        found[stamp] = at
    return found, notes


class BagViews:
    """Random access by stamp to the raw pairs of one stream of a bag, with only a few in memory.

    Parameters
    ----------
    reader : BagReader
        The bag.
    stream : str
        Name of the stream.
    covers : callable, optional
        Says of a stamp whether it is of the run that is played.
    """

    def __init__(
        self, reader: BagReader, stream: str, covers: Callable[[int], bool] = lambda _: True
    ) -> None:
        self._reader = reader
        self._kind = stream_of(stream)
        #: One line for each message that is not usable.
        self.problems: list[str] = []
        #: Recording time (ns) of each stamp, in the order of recording.
        self.times: dict[int, int] = {}
        self._infos: dict[int, bytes] = {}
        sectors = []
        for message in reader.messages([self._kind.info_topic]):
            stamp = self._stamp(message)
            if stamp is not None and stamp not in self._infos and covers(stamp):
                self._infos[stamp] = bytes(message.cdr)
                self.times[stamp] = message.log_time_ns
                if stream == "sector":
                    with contextlib.suppress(CsasError):  # whoever takes it names what is not legible
                        sectors.append(sector_info_from_msg(message.decode()))
        # The graph takes the first for right; of a bag it is known what most are like.
        for stamp, reason in odd_sectors(sectors).items():
            self.problems.append(f"{self._kind.image_topic} ({stamp} ns): {reason}")
            del self._infos[stamp], self.times[stamp]
        self._cursor: Iterator[Any] | None = None
        self._recent: OrderedDict[int, bytes] = OrderedDict()
        #: Stamps of the images that the cursor has passed.
        self._passed: set[int] = set()

    def _stamp(self, message: Any) -> int | None:
        try:
            return header_stamp(message.cdr, f"{message.topic} message {message.number}")
        except BagError as error:
            if str(error) not in self.problems:
                self.problems.append(str(error))
            return None

    def get(self, stamp: int) -> tuple[bytes, bytes]:
        """Return the recorded (image, camera_info).

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
                self._passed.clear()
            for message in self._cursor:
                found = self._stamp(message)
                if found is None or found in self._passed:
                    continue  # of a stamp that comes again the first image counts, as everywhere
                self._passed.add(found)
                self._recent[found] = bytes(message.cdr)
                while len(self._recent) > _CACHED:
                    self._recent.popitem(last=False)
                if found == stamp:
                    return self._recent[found], self._infos[stamp]
        raise BagError(f"{self._kind.image_topic} in the bag holds no image stamped {stamp} ns")
