"""A participant that lacks a port in shared memory hears nobody, and nobody says so: it is made again."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable
from typing import TypeVar

Made = TypeVar("Made")

#: The middleware's files in shared memory that this process holds locked: a segment's, and its ports'.
_SHARED, _OWNER = "/dev/shm/fastrtps_", "_el"
_FILES = "/proc/self/fd"
#: A participant listens at two ports: what it discovers comes by the one, all else by the other.
_PORTS = 2
#: A process that is killed lets go of its ports within milliseconds, on a busy one within seconds.
_PATIENCE_S, _AGAIN_S = 10.0, 0.2


def _held() -> tuple[int, int]:
    """Return how many segments and how many ports this process holds."""
    segments = ports = 0
    for entry in os.listdir(_FILES):
        try:
            path = os.readlink(f"{_FILES}/{entry}")
        except OSError:
            continue  # of the listing itself
        if path.startswith(_SHARED) and path.endswith(_OWNER):
            if "_port" in path:
                ports += 1
            else:
                segments += 1
    return segments, ports


def make_hearing(make: Callable[[], Made], take_back: Callable[[Made], None]) -> Made:
    """Make something that has a participant of its own, again if that has not got its ports.

    Two processes that are killed at once do not let go of all they hold at once. A third that begins just
    then may find one's socket free and its lock taken; the middleware goes on without that port, and others
    send to it what nobody reads.

    Parameters
    ----------
    make : callable
        Makes it.
    take_back : callable
        Takes one back that does not hear.

    Raises
    ------
    RuntimeError
        If it has not got its ports after ten seconds.
    """
    if not os.path.isdir(_FILES):
        return make()
    end = time.monotonic() + _PATIENCE_S
    while True:
        before = _held()
        made = make()
        segments, ports = (now - then for now, then in zip(_held(), before, strict=True))
        if segments <= 0 or ports >= _PORTS:  # without shared memory there is nothing to miss
            return made
        take_back(made)
        del made
        gc.collect()  # nodes hold their participant until they are collected
        if time.monotonic() > end:
            raise RuntimeError(
                f"another process holds a port of this one in shared memory since {_PATIENCE_S:g} s;"
                " expected a ROS domain whose ports are free"
            )
        time.sleep(_AGAIN_S)
