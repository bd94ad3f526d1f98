"""Shared memory and ports of the middleware: owners, and leftovers of killed processes."""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import shutil
import socket
import sys
import time
from pathlib import Path

#: The middleware's segments, and the name of the file that their owner holds locked.
_SEGMENTS, _OWNER = "/dev/shm/fastrtps_", "_el"
#: How Boost's managed files begin, in this machine's order of bytes.
_UNMADE, _IN_MAKING, _CORRUPT = (number.to_bytes(4, sys.byteorder) for number in (0, 1, 3))
#: A file that its maker has not given a length yet.
_EMPTY = b""
#: Who makes a segment holds its lock within milliseconds: one so old that nobody holds is nobody's. Of other
#: graphs' processes, which may be stopped just then, it is taken for certain only much later.
LOCKED_S, LONG_LOCKED_S = 1.0, 60.0


def ports_of(domain_id: int) -> range:
    """Return the UDP ports of a domain (the OMG's DDSI-RTPS, 9.6.1.1)."""
    return range(7400 + 250 * domain_id, 7400 + 250 * (domain_id + 1))


def bound(port: int) -> socket.socket | None:
    """Bind a UDP port exclusively on all addresses; None if it is taken, or there is no such port."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.bind(("", port))
    except (OSError, OverflowError):
        made.close()
        return None
    return made


def unused(domain_id: int) -> bool:
    """Say whether no participant of a domain runs here, by the ports that each one binds."""
    ports = ports_of(domain_id)
    for port in (*ports[:2], *ports[10:]):
        probe = bound(port)
        if probe is None:
            return False
        probe.close()
    return True


def free_shared_memory() -> int:
    """Return the free shared memory in bytes; containers often have 64 MB."""
    try:
        return shutil.disk_usage("/dev/shm").free
    except OSError:
        return 0


def owned_files(pid: int | str) -> set[str]:
    """Return the middleware's files in shared memory that a process owns: segments, and ports."""
    found = set()
    with contextlib.suppress(OSError):  # it has ended
        for entry in os.listdir(f"/proc/{pid}/fd"):
            with contextlib.suppress(OSError):
                path = os.readlink(f"/proc/{pid}/fd/{entry}")
                if path.startswith(_SEGMENTS) and path.endswith(_OWNER):
                    found.add(path.removesuffix(_OWNER))
    return found


def segments_of(pid: int) -> set[Path]:
    """Return the shared memory segments of the middleware that a process owns (not its ports)."""
    return {Path(file) for file in owned_files(pid) if "_port" not in file}


def remove_segment(segment: Path) -> None:
    """Remove a segment left by a killed process, unless it is gone or owned."""
    owner = segment.with_name(segment.name + _OWNER)
    with contextlib.suppress(OSError), owner.open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        segment.unlink(missing_ok=True)
        owner.unlink(missing_ok=True)


def remove_strays(since_s: float = 0.0, until_s: float = math.inf) -> None:
    """Remove this user's segments made in a time span (s since 1970) by processes that died.

    A second old they must be: whoever makes one may not hold its lock yet.
    """
    folder = Path(_SEGMENTS).parent
    for owner in folder.glob(f"{Path(_SEGMENTS).name}*{_OWNER}"):
        with contextlib.suppress(OSError):
            made = owner.stat()
            mine = made.st_uid == os.getuid() and "_port" not in owner.name
            if mine and since_s <= made.st_mtime <= min(until_s, time.time() - LOCKED_S):
                remove_segment(Path(str(owner).removesuffix(_OWNER)))


def remove_ports(domain_id: int) -> None:
    """Remove shared-memory ports left by killed processes in a domain no longer in use."""
    for number in ports_of(domain_id):
        port = Path(f"{_SEGMENTS}port{number}")
        owner = port.with_name(port.name + _OWNER)
        with contextlib.suppress(OSError):
            if owner.exists():
                remove_segment(port)  # not one whose owner lives
            if not owner.exists():
                _remove_if_unmade(port)  # whoever waits for it would never see its end
                port.unlink(missing_ok=True)
                port.with_name(f"sem.{port.name}_mutex").unlink(missing_ok=True)


def remove_unmade_ports() -> list[Path]:
    """Remove ports whose maker was killed before it had made them; return these.

    Whoever opens such a file waits for ever for it to be made, within the middleware. Boost makes it empty,
    gives it its length, begins it with 0 or 1 until it is made, then with 2. At 3 whoever waits goes on, and
    makes it anew.
    """
    ports = Path(_SEGMENTS).parent.glob(f"{Path(_SEGMENTS).name}port*[0-9]")
    return [port for port in ports if _remove_if_unmade(port, LOCKED_S)]


def _remove_if_unmade(port: Path, least_age_s: float = -math.inf) -> bool:
    with contextlib.suppress(OSError), port.open("r+b") as file:
        old = time.time() - os.fstat(file.fileno()).st_mtime > least_age_s
        if old and file.read(4) in (_EMPTY, _UNMADE, _IN_MAKING):
            port.unlink()
            file.seek(0)
            file.write(_CORRUPT)
            return True
    return False


def tidy_up_after_a_killed_graph(domain_id: int, since_s: float) -> None:
    """Remove the shared memory of a graph after its launching process was killed.

    Parameters
    ----------
    domain_id : int
        Its ROS domain.
    since_s : float
        When it began. Every node does this after its own end: the last one finds all the others'.
    """
    remove_strays(since_s)
    if unused(domain_id):
        remove_ports(domain_id)
