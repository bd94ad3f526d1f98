"""A node that stands still within the middleware ends itself, so that its graph starts another.

A process that is killed may leave a lock, or a port in shared memory, that another's call of the middleware
waits for without end (Fast DDS 2.14.5: a send that makes a dead process' port again, over and over, while it
holds the lock of its writer). rclpy holds the interpreter's lock during such a call: no thread of Python runs
any more, no heartbeat is sent, and the process does not end, so nobody replaces it. `faulthandler` waits in a
thread that needs no interpreter.
"""

from __future__ import annotations

import contextlib
import faulthandler
import threading
from collections.abc import Iterator

#: An interpreter in which no thread has run for so long (s) stands still. In a run of the demo bag no thread
#: waited longer than 0.3 s for it, 0.9 s while kernels were compiled (two cores, load 8). Half of it would do
#: there, but not on a machine that swaps. Double, with a restart, comes near to the 60 s for which a silent
#: source is waited.
STANDS_STILL_S = 20.0
#: What faulthandler writes before the stacks.
_HEADER = "Timeout ("
#: How often in this time a living one says so.
_SIGNS = 10


@contextlib.contextmanager
def ends_if_it_stands_still(stands_still_s: float = STANDS_STILL_S) -> Iterator[None]:
    """End this process (status 1) if no thread of Python runs for so long; the log gets every thread's stack.

    Parameters
    ----------
    stands_still_s : float
        How long, seconds.
    """
    ended = threading.Event()

    def watch() -> None:
        while True:
            # Anew: the time begins again. A standard error without a descriptor has no log to write to.
            with contextlib.suppress(OSError, ValueError, AttributeError, RuntimeError):
                faulthandler.dump_traceback_later(stands_still_s, exit=True)
            if ended.wait(stands_still_s / _SIGNS):
                return

    thread = threading.Thread(target=watch, name="watchdog", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        faulthandler.cancel_dump_traceback_later()


def says_that_it_stood_still(log: str) -> bool:
    """Say whether a log ends with the stacks of a process that ended itself so."""
    _, found, stacks = f"\n{log}".rpartition(f"\n{_HEADER}")
    frames = stacks.splitlines()[1:]
    return bool(found) and all(
        not line or line.startswith(("Thread ", "Current thread ", "  ")) for line in frames
    )
