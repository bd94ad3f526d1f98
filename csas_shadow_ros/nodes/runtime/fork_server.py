"""A process that forks nodes, so that common modules load only once.

A node alone imports libraries and loads compiled kernels for one to two seconds of processor time, six
nodes for ten on two cores. Here the first has to, the next have only what is their own left to load, and
a node that is started again begins to work at once.

Arguments name nodes to load at once, before anybody asks for them. Requests come as lines of JSON on
standard input: ``{"node": name, "arguments": [...], "log": path}``. Each is answered on standard output, in
order: ``{"pid": number}``, or ``{"error": text}``. The process ends with its input, or on SIGTERM. A node's
parent is not this process but the nearest ancestor that takes orphans in (``PR_SET_CHILD_SUBREAPER``): its
end can be waited for there, and it lives on if this process dies.

Nothing is computed here by more than one thread. Libraries end their threads before a fork and start them
after it; one that forks again at once can wait for ever for a thread that has just begun (scipy's FFT).

Why not multiprocessing's ``forkserver`` with a preload: an interpreter has one, whose environment and
preload are those of its first start, and two graphs in one process need two: domain, discovery range,
keys and thread counts are environment that middleware and libraries read once. And its children's end is
told by the server alone: if that dies, they count as failed while they live on (exit status 255), where
here they are watched as before.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Iterator
from typing import Any

from msg_adapters.messages import typestore

from .base import CsasNode
from .shared_memory import remove_unmade_ports

#: A node may be killed while it makes a port, and all others wait for that within the middleware. This
#: process opens none: it looks so often (s).
_LOOK_S = 2.0


def load(node: str) -> Any:
    """Import a node's module, load what its first view needs, and return the function that runs it.

    Raises
    ------
    ImportError
        If there is no such node, or a library of it is missing.
    """
    module = importlib.import_module(f"..{node}", __package__)
    for kind in CsasNode.__subclasses__():
        if kind.name == node:
            kind.preload()
    return module.main


def fork(main: Any, node: str, arguments: list[str], log: str, answers: int) -> int:
    """Start a node in its own process, detached from this one; return its id.

    Parameters
    ----------
    main : callable
        Runs the node.
    node, arguments, log : str, list of str, str
        As in a request.
    answers : int
        Descriptor that the node must not hold: whoever reads from it waits for its end.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    # What is loaded stays shared: the collector would write into every page of it.
    gc.freeze()
    reader, writer = os.pipe()
    between = os.fork()
    if between == 0:
        # Whatever happens, this process ends here: there is one server.
        try:
            os.close(answers)  # who reads there waits for the server alone
            pid = os.fork()
            if pid == 0:
                for descriptor in (reader, writer):
                    os.close(descriptor)
                _become(main, node, arguments, log)
            os.write(writer, str(pid).encode())
        finally:
            os._exit(0)
    os.close(writer)
    os.waitpid(between, 0)
    with os.fdopen(reader, "rb") as pipe:
        told = pipe.read()
    if not told:
        raise RuntimeError("no further process could be made")
    return int(told)


def _threads_of_images(count: int) -> None:
    """Say how many threads OpenCV may use; -1: as many as it does by itself."""
    import cv2

    cv2.setNumThreads(count)


def _become(main: Any, node: str, arguments: list[str], log: str) -> None:
    """Be the node from here on; never returns."""
    code = 1
    try:
        # Not in the terminal's group: on Ctrl-C whoever started the graph ends its processes, in order.
        os.setsid()
        gc.enable()
        for number in (signal.SIGINT, signal.SIGTERM):
            # As in `start.run`: nothing has begun that would have to be brought to an end.
            signal.signal(number, lambda *_: os._exit(0))
        output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for source, target in ((nothing, 0), (output, 1), (output, 2)):
            os.dup2(source, target)
        sys.argv = [node, *arguments]
        _threads_of_images(-1)
        parent = int(os.environ.get("CSAS_PARENT_PID", "0"))
        deadline = time.monotonic() + 1.0
        while parent and os.getppid() != parent and time.monotonic() < deadline:
            time.sleep(0.001)  # whoever forked us is about to end; then we are our starter's child
        code = main()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _requests() -> Iterator[str]:
    """Take lines from standard input as they come; remove unmade ports between them."""
    with open(0, "rb", buffering=0, closefd=False) as lines:
        while True:
            ready, _, _ = select.select([lines], [], [], _LOOK_S)
            if not ready:
                remove_unmade_ports()
            elif line := lines.readline():
                yield line.decode()
            else:
                return


def main() -> int:
    """Serve requests until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    forking = told_to_end = False

    def end(*_: object) -> None:
        nonlocal told_to_end
        told_to_end = True
        if not forking:
            os._exit(0)  # while it loads, or waits
        # Otherwise not before the answer has told of the process that is being forked.

    signal.signal(signal.SIGTERM, end)
    parent = os.environ.get("CSAS_PARENT_PID")
    # Answers go to what was standard output; whatever a library prints must not come between them.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.set_inheritable(answers.fileno(), False)
    os.dup2(2, 1)
    # Loading leaves next to no garbage; to look for it among all that is loaded takes a tenth of the time.
    gc.disable()
    _threads_of_images(1)
    # Every node reads raw messages: a fifth of a second of imports, at the first one.
    typestore()
    for node in sys.argv[1:]:
        # What cannot be loaded will be said to who asks for it.
        with contextlib.suppress(Exception):
            load(node)
    for line in _requests():
        if parent and os.getppid() != int(parent):
            break  # whoever asked is gone
        request = json.loads(line)
        try:
            main_of_node = load(request["node"])
            forking = True
            pid = fork(main_of_node, request["node"], request["arguments"], request["log"], answers.fileno())
            answer: dict[str, int | str] = {"pid": pid}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")
        forking = False
        if told_to_end:
            break
    return 0


if __name__ == "__main__":
    sys.exit(main())
