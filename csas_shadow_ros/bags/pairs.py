"""Messages of a bag, checked and paired by stamp; problems carry a place and a reason."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

from csas_shadow_ros.core.errors import CsasError, quoted
from msg_adapters.messages import stamp_to_ns
from msg_adapters.topics import TOPICS, absolute_name, stream

from .bag import BagMessage, BagReader

T = TypeVar("T")


@dataclass(frozen=True)
class Problem:
    """One fault of a bag.

    Parameters
    ----------
    topic : str
        Absolute name; empty if it concerns the bag itself.
    number : int or None
        Which message of that topic, from 0.
    stamp_ns : int or None
        The message's stamp.
    reason : str
        What is wrong.
    """

    topic: str
    number: int | None
    stamp_ns: int | None
    reason: str

    def __str__(self) -> str:
        place = self.topic
        if self.number is not None:
            place += f" message {self.number}"
        if self.stamp_ns is not None:
            place += f" ({self.stamp_ns} ns)"
        return f"{place}: {self.reason}" if place else self.reason


def first_of_alike(items: Iterable[T], kind: Callable[[T], Hashable]) -> list[tuple[T, str]]:
    """Return the first of what is alike, and a note of how many messages are; the note of one is empty."""
    alike: dict[Hashable, list[T]] = {}
    for item in items:
        alike.setdefault(kind(item), []).append(item)
    return [(same[0], f" ({len(same)} messages alike)" if len(same) > 1 else "") for same in alike.values()]


@dataclass(frozen=True, eq=False)
class MessagePair:
    """An image and its camera_info, decoded but not checked, with the recorded bytes of both."""

    topic: str
    number: int
    stamp_ns: int
    image: Any
    info: Any
    image_cdr: memoryview
    info_cdr: memoryview


def checked_messages(
    reader: BagReader, relative: str, report: Callable[[Problem], None], *, repeated: bool = False
) -> Iterator[tuple[BagMessage, Any, int]]:
    """Iterate (message, decoded, stamp) of a topic; skip repeated stamps.

    A latched message may be recorded several times: the same stamp with the same bytes counts once,
    with other bytes it is reported. With `repeated` it is another message: a Path that grows may keep its
    stamp.
    """
    info = reader.topic(relative)
    if info is None:
        return
    expected = TOPICS[relative].type_name
    if info.type_name != expected:
        report(Problem(info.name, None, None, f"its type is {quoted(info.type_name)}; expected {expected}"))
        return
    seen: dict[int, bytes | memoryview] = {}

    def digest(cdr: memoryview) -> bytes:
        return hashlib.blake2b(cdr, digest_size=16).digest()

    for message in reader.messages([info.name]):
        try:
            decoded = message.decode()
            stamp = stamp_to_ns(decoded.header.stamp)
        except CsasError as error:
            report(Problem(info.name, message.number, None, str(error)))
            continue
        if (before := seen.get(stamp)) is not None:
            same = (digest(before) if isinstance(before, memoryview) else before) == digest(message.cdr)
            if repeated and not same:
                seen[stamp] = digest(message.cdr)
                yield message, decoded, stamp
            elif not same:
                reason = "differs from an earlier message of the same stamp"
                report(Problem(info.name, message.number, stamp, reason))
            continue
        # An image that is alone takes a second to digest, and is compared with nothing.
        seen[stamp] = message.cdr if info.count == 1 else digest(message.cdr)
        yield message, decoded, stamp


def iterate_pairs(
    reader: BagReader, stream_name: str, report: Callable[[Problem], None]
) -> Iterator[MessagePair]:
    """Iterate a stream's images with the camera_info of the same stamp, whatever their order.

    Parameters
    ----------
    reader : BagReader
        The bag.
    stream_name : str
        Name of the image stream.
    report : callable
        Called with each `Problem`: other types, undecodable messages, lonely images and infos.
    """
    kind = stream(stream_name)
    info_topic = absolute_name(kind.info_topic, reader.namespace)
    # Camera infos are small: all are read first, so that no image ever waits in memory.
    infos = {s: (m, d) for m, d, s in checked_messages(reader, kind.info_topic, report)}
    used: set[int] = set()
    for message, image, stamp in checked_messages(reader, kind.image_topic, report):
        if stamp not in infos:
            missing = f"has no camera_info of the same stamp on {info_topic}"
            if infos:
                nearest = min(infos, key=lambda s: abs(s - stamp))
                missing += f" (the nearest is {nearest} ns)"
            report(Problem(message.topic, message.number, stamp, missing))
            continue
        used.add(stamp)
        own, info = infos[stamp]
        yield MessagePair(message.topic, message.number, stamp, image, info, message.cdr, own.cdr)
    for stamp, (own, _) in infos.items():
        if stamp not in used:
            report(Problem(info_topic, own.number, stamp, "has no image of the same stamp"))
