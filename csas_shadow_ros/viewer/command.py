"""``csas-shadow view``: a results folder or a bag in a browser."""

from __future__ import annotations

import signal
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path

from .compare import Second
from .server import ViewerServer
from .source import PathSource
from .store import ViewerError, ViewStore


def view(
    path: str | Path,
    *,
    second: str | Path | None = None,
    namespace: str | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str | None = None,
    browser: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Show a results folder or a bag until SIGINT or SIGTERM, with a `second` one to compare it with.

    Raises
    ------
    ViewerError, BagError
        If there is nothing to see, or the address cannot be had.
    """
    stop = set_by_signals()
    store = ViewStore()
    source = PathSource(store, path, namespace)
    other = None if second is None else Second(store, second, namespace)
    server = ViewerServer(store, host, port, token)

    def read() -> None:
        source.start()
        if other is not None:
            other.start()

    serve_until(stop, server, browser=browser, say=say, then=read)


def set_by_signals() -> threading.Event:
    """Return an event that SIGINT and SIGTERM set from now on."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def serve_until(
    stop: threading.Event,
    server: ViewerServer,
    *,
    browser: bool,
    say: Callable[[str], None],
    then: Callable[[], None] = lambda: None,
) -> None:
    """Serve a page, say where, do what is to be done `then`, and open a browser; until `stop` is set."""
    server.start()
    say(server.url)
    then()
    if browser:
        webbrowser.open(server.url)
    stop.wait()
    server.stop()


def read_whole(
    path: str | Path, namespace: str | None = None, second: str | Path | None = None
) -> PathSource:
    """Read a results folder or a bag to its end, and a second one to compare it with.

    Raises
    ------
    ViewerError, BagError
        If there is nothing to see, or what there is cannot be read.
    """
    store = ViewStore()
    source = PathSource(store, path, namespace)
    other = None if second is None else Second(store, second, namespace)
    source.start()
    source.done.wait()
    if other is not None:
        other.start()
        other.done.wait()
        source.problems += [f"{second}: {line}" for line in other.source.problems]
    failed = source.failed or (other.source.failed if other is not None else "")
    if failed:
        raise ViewerError(failed)
    return source


def save(
    out: str | Path,
    make: Callable[[ViewStore], bytes],
    path: str | Path,
    namespace: str | None = None,
    second: str | Path | None = None,
) -> tuple[int, list[str]]:
    """Make a file of a results folder or a bag: a page, a report or a moving picture.

    Returns
    -------
    int
        Its size in bytes.
    list of str
        What of the run could not be read, a line each.

    Raises
    ------
    ViewerError, BagError
        If there is nothing to see, what there is cannot be read, or the file cannot be written.
    """
    file = Path(out)
    new = not file.exists()
    try:
        # Before the work, which may take a while.
        with file.open("ab"):
            pass
    except OSError as error:
        raise ViewerError(f"cannot write {out}: {error.strerror}") from error
    try:
        source = read_whole(path, namespace, second)
        return file.write_bytes(make(source.store)), source.problems
    except BaseException:
        if new:
            file.unlink()
        raise
