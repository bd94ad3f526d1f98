"""``csas-shadow view``: a results folder or a bag in a browser."""

from __future__ import annotations

import signal
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path

from .export import export_html
from .server import ViewerServer
from .source import PathSource
from .store import ViewerError, ViewStore


def view(
    path: str | Path,
    *,
    namespace: str | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str | None = None,
    browser: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Show a results folder or a bag until SIGINT or SIGTERM.

    Raises
    ------
    ViewerError, BagError
        If there is nothing to see, or the address cannot be had.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    store = ViewStore()
    source = PathSource(store, path, namespace)
    server = ViewerServer(store, host, port, token)
    server.start()
    say(server.url)
    source.start()
    if browser:
        webbrowser.open(server.url)
    stop.wait()
    server.stop()


def save_html(path: str | Path, out: str | Path, step: int, namespace: str | None = None) -> int:
    """Write the page of a results folder or a bag as one HTML file; return its size in bytes.

    Raises
    ------
    ViewerError, BagError
        If there is nothing to see, what there is cannot be read, or the file cannot be written.
    """
    store = ViewStore()
    source = PathSource(store, path, namespace)
    file = Path(out)
    new = not file.exists()
    try:
        # Before the work, which may take a while.
        with file.open("ab"):
            pass
    except OSError as error:
        raise ViewerError(f"cannot write {out}: {error.strerror}") from error
    source.start()
    source.done.wait()
    if source.failed:
        if new:
            file.unlink()
        raise ViewerError(source.failed)
    return file.write_bytes(export_html(store, step))
