"""A participant that nobody can reach at its ports in shared memory hears nobody, unsaid.

Three things leave one so:

- It takes the port of a process that was killed. The middleware replaces the port's file, and whoever has the
  old one open writes to that: for one or two times `healthy_check_timeout_ms`, or for good where the killed
  process had not begun to listen. Such a port is not taken (`avoid_dead_ports`).
- Another process still holds a port's lock, and the middleware goes on without that port: the participant is
  made again (`make_hearing`).
- Another process replaces the port of one that is alive, but had no processor for long, or a process was
  killed while it wrote there. `Reach` looks for it, as for what two processes that begin at once do to one
  another; the node begins anew at other ports. Of a program from outside that does not, `Deaf` tells.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import math
import os
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from textwrap import shorten
from typing import IO, Any, TypeVar

from .shared_memory import bound, owned_files, ports_of, remove_unmade_ports

Made = TypeVar("Made")

#: The middleware's files in shared memory that this process holds locked: a segment's, and its ports'.
_SHARED, _OWNER = "/dev/shm/fastrtps_", "_el"
_FILES = "/proc/self/fd"
#: A port's file; one that is open and has another in its place, as the kernel tells of it.
_PORT = re.compile(rf"{_SHARED}port\d+")
_DELETED = re.compile(rf"({_SHARED}port\d+) \(deleted\)")
#: Who looks whether a port is free holds its lock for less than this.
_PROBE_S = 0.01
#: The first port of domains, whose numbers follow the participant's; those before are taken by their locks.
_OF_DOMAINS = 7400
#: A participant listens at two ports: what it discovers comes by the one, all else by the other.
_PORTS = 2
#: A process that is killed lets go of its ports within milliseconds, on a busy one within seconds.
_PATIENCE_S, _AGAIN_S = 10.0, 0.2
#: When (s after a start) to look for older files of its ports that others have open: they let go of them
#: within twice `healthy_check_timeout_ms` and a second. How often (s) to look whether its own are still those
#: that others find.
_LOOKS_S, _OWN_LOOK_S = (8.0, 11.0), 5.0
#: How often (s) a node that waits looks for others that hear nobody. The graph's own find it out within half
#: of that and begin anew: who is so twice in a row is somebody else.
_DEAF_LOOK_S = 10.0
#: What keeps ports from this process' next participant, for as long as the process lives: port → its holders.
_kept: dict[str, list[Any]] = {}


def _held() -> tuple[int, set[str]]:
    """Return how many segments this process holds, and the files of its ports."""
    files = owned_files("self")
    ports = {file for file in files if "_port" in file}
    return len(files) - len(ports), ports


def _open_in(maps: Path, kind: re.Pattern[str]) -> set[str]:
    """Return the ports of a kind whose files a process has open, as its `maps` tell."""
    with contextlib.suppress(OSError):  # of another user, or gone meanwhile
        return set(kind.findall(maps.read_text(errors="replace")))
    return set()


def _open_anywhere(kind: re.Pattern[str]) -> set[str]:
    """Return the ports of a kind whose files any process has open."""
    return set().union(*(_open_in(maps, kind) for maps in Path("/proc").glob("[0-9]*/maps")))


def _number(port: str) -> int:
    return int(port.rpartition("_port")[2])


class Reach:
    """Whether others reach this process at the ports that it has made; make it once these are there.

    A file that is replaced is let go of when the middleware finds that nobody reads it. It is looked for
    twice, later than that. Another process may also replace the port of one that is alive: it has had no
    processor for as long as the middleware waits for a sign of it (`healthy_check_timeout_ms`), or a process
    was killed while it wrote there.

    Examples
    --------
    >>> import rclpy
    >>> from csas_shadow_ros.client import Reach, create_node
    >>> rclpy.init()
    >>> node = create_node("sonar", namespace="csas")
    >>> reach = Reach()
    >>> reach.is_lost()  # ask now and then, every second or so; if so, end the process and start it again
    False
    >>> node.destroy_node()
    >>> rclpy.shutdown()
    """

    def __init__(self) -> None:
        self._ports = _held()[1] - _kept.keys() if os.path.isdir(_FILES) else set()
        began_s = time.monotonic()
        self._looks_s = [began_s + after_s for after_s in _LOOKS_S] if self._ports else []
        self._own = set(self._ports)
        self._own_look_s = began_s + _OWN_LOOK_S if self._ports else math.inf
        #: Whether it was found that they do not.
        self.is_given_up = False

    def is_lost(self) -> bool:
        """Say whether somebody goes on writing to what this process does not read."""
        now_s = time.monotonic()
        if now_s >= self._own_look_s:
            self._own_look_s = now_s + _OWN_LOOK_S
            remove_unmade_ports()  # another may wait for one
            if lost := self._own & _open_in(Path("/proc/self/maps"), _DELETED):
                self._ports, self._looks_s, self.is_given_up = lost, [], True
                return True
        if not self._looks_s or now_s < self._looks_s[0]:
            return False
        del self._looks_s[0]
        self._ports &= _open_anywhere(_DELETED)  # nobody reads what is written there
        if not self._ports:
            self._looks_s = []
        self.is_given_up = bool(self._ports) and not self._looks_s
        return self.is_given_up

    def take_others(self) -> None:
        """Keep the ports that are written past from this process' next participant: it takes others."""
        for port in sorted(self._ports):
            number, holders = _number(port), _kept.setdefault(port, [])
            # The middleware numbers a participant by the first of its UDP ports that is free, which is even;
            # the port that is not numbered so is the first one whose lock is free.
            if number % 2:
                holders.append(bound(number - 1))
            with contextlib.suppress(OSError):
                holders.append(Path(port + _OWNER).open("ab"))  # noqa: SIM115 (held for good)
                fcntl.flock(holders[-1], fcntl.LOCK_EX | fcntl.LOCK_NB)


class Deaf:
    """Other processes of a domain that hear nobody, as another has replaced the port that they read.

    A program from outside the graph, such as a sonar's, does not find it out: what it latches never reaches a
    node that has begun since, and nothing says why.

    Parameters
    ----------
    domain_id : int
        ROS domain.
    """

    def __init__(self, domain_id: int) -> None:
        self._range = ports_of(domain_id)
        self._look_s = -math.inf
        self._before: set[int] = set()
        self._told = ""

    def look(self) -> str:
        """Name those that were so the last time as well; empty if there are none."""
        now_s = time.monotonic()
        if now_s - self._look_s < _DEAF_LOOK_S:
            return self._told
        self._look_s = now_s
        found = {int(maps.parent.name) for maps in Path("/proc").glob("[0-9]*/maps") if self._is_deaf(maps)}
        named = ", ".join(f"process {pid} ({_command(pid)})" for pid in sorted(found & self._before))
        self._before = found
        self._told = named and (
            f"{named} hears nobody: another process has replaced a port in shared memory that it reads;"
            " start it again"
        )
        return self._told

    def _is_deaf(self, maps: Path) -> bool:
        if not (replaced := _open_in(maps, _DELETED)):
            return False
        own = {file for file in owned_files(maps.parent.name) if "_port" in file}
        return bool(replaced & own) and any(_number(port) in self._range for port in own)


def _command(pid: int) -> str:
    """Return how a process was called, in a few words."""
    with contextlib.suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
        return shorten(" ".join(words), 60, placeholder=" …")
    return "ended"


def _locked(port: str) -> IO[bytes] | None:
    """Lock a port as its reader does; None if it has a reader, or is another user's."""
    with contextlib.ExitStack() as stack, contextlib.suppress(OSError):
        lock = stack.enter_context(Path(port + _OWNER).open("r+b"))
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        stack.pop_all()
        return lock
    return None


@contextlib.contextmanager
def avoid_dead_ports() -> Iterator[list[str]]:
    """Keep this process from the ports of killed processes that others still write to, for a moment.

    Yields
    ------
    list of str
        Their files.
    """
    remove_unmade_ports()
    with contextlib.ExitStack() as stack:
        owners = Path(_SHARED).parent.glob(f"{Path(_SHARED).name}port*{_OWNER}")
        ports = {str(owner).removesuffix(_OWNER) for owner in owners}
        dead: dict[str, IO[bytes]] = {}
        for _ in range(2):
            for port in ports - dead.keys():
                if (lock := _locked(port)) is not None:
                    dead[port] = stack.enter_context(lock)
            time.sleep(_PROBE_S)  # another that looks for a port may hold a dead one's lock for a moment
        for port in dead.keys() - (_open_anywhere(_PORT) if dead else set()):
            dead.pop(port).close()
        for port, lock in dead.items():
            # Participants are numbered by the first of their UDP ports that is free, which is even; the ports
            # of that number need no lock, which would make them look alive to others.
            if (holder := bound(_number(port) & ~1)) is not None:
                stack.enter_context(holder)
                if _number(port) >= _OF_DOMAINS:
                    lock.close()
        yield sorted(dead)


def make_hearing(make: Callable[[], Made], take_back: Callable[[Made], None]) -> Made:
    """Make an object with its own participant, at ports that nobody else has; again if it lacks them.

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
        segments_before, ports_before = _held()
        with avoid_dead_ports():
            made = make()
        segments, ports = _held()
        # Without shared memory there is nothing to miss.
        if segments <= segments_before or len(ports - ports_before) >= _PORTS:
            return made
        take_back(made)
        del made
        gc.collect()  # nodes hold their participant until they are collected
        if time.monotonic() > end:
            raise RuntimeError(
                f"another process has held a shared-memory port of this one for {_PATIENCE_S:g} s;"
                " expected a ROS domain with free ports"
            )
        time.sleep(_AGAIN_S)
