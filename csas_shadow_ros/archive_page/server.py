"""``csas-shadow view ARCHIVE``: the page's server, by the rules of the viewer's own."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

from aiohttp import web

from ..core.errors import ParameterError
from ..viewer.command import serve_until, set_by_signals
from ..viewer.server import ViewerServer
from ..viewer.source import PathSource
from ..viewer.store import ViewStore
from .content import Content

STATIC = Path(__file__).parent / "static"
#: Runs that are open at once: a viewer of one takes up to some hundred MB. The one opened first is closed.
MOST_OPEN = 4
#: Of a request to open a run: a path.
_MOST_POSTED = 1 << 14


class ArchiveServer(ViewerServer):
    """Serves an archive's page; who may ask is decided as for a run's (`ViewerServer`).

    Parameters
    ----------
    content : Content
        What is shown.
    host, port, token
        As of `ViewerServer`; those of the runs that are opened, but for the port.
    """

    def __init__(
        self, content: Content, host: str = "127.0.0.1", port: int = 0, token: str | None = None
    ) -> None:
        super().__init__(ViewStore(title=content.archive.root.name), host, port, token)
        self.content = content
        self._opened: OrderedDict[Path, ViewerServer] = OrderedDict()
        self._opening = threading.Lock()

    def stop(self) -> None:
        """End, with the viewers of the runs that were opened."""
        super().stop()
        with self._opening:
            for viewer in self._opened.values():
                viewer.stop()
            self._opened.clear()

    def _app(self) -> web.Application:
        app = web.Application(middlewares=[self._guard], client_max_size=_MOST_POSTED)
        app.router.add_get("/", self._page)
        app.router.add_get("/api/rows", self._rows)
        app.router.add_get("/api/thumbnail.png", self._thumbnail)
        app.router.add_post("/api/open", self._open)
        app.router.add_static("/static/", STATIC)
        return app

    async def _page(self, _: web.Request) -> web.StreamResponse:
        return web.FileResponse(STATIC / "archive.html")

    async def _rows(self, request: web.Request) -> web.StreamResponse:
        return web.json_response(await self._in_thread(self.content.answer, dict(request.query)))

    async def _thumbnail(self, request: web.Request) -> web.StreamResponse:
        body = await self._in_thread(self.content.thumbnail, request.query.get("results", ""))
        return web.Response(
            body=body, content_type="image/png", headers={"Cache-Control": "private, max-age=60"}
        )

    async def _open(self, request: web.Request) -> web.StreamResponse:
        try:
            results = (await request.json())["results"]
        except (ValueError, KeyError, TypeError, RecursionError):
            results = None
        if not isinstance(results, str):
            raise ParameterError("expected JSON with results, a folder of the archive")
        return web.json_response({"url": await self._in_thread(self._viewer_of, results)})

    def _viewer_of(self, results: str) -> str:
        """Return the address of a run's own page; its viewer is started if it is not there."""
        folder = self.content.folder_of(results)
        with self._opening:
            viewer = self._opened.get(folder)
            if viewer is None:
                store = ViewStore()
                source = PathSource(store, folder)
                viewer = ViewerServer(store, self.host, 0, self.token)
                viewer.start()
                source.start()
                self._opened[folder] = viewer
            self._opened.move_to_end(folder)
            while len(self._opened) > MOST_OPEN:
                self._opened.popitem(last=False)[1].stop()
            return viewer.url


def view_archive(
    root: str | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str | None = None,
    browser: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Show an archive until SIGINT or SIGTERM.

    Raises
    ------
    CsasError
        If it has no catalogue, a library is missing, or the address cannot be had.
    """
    stop = set_by_signals()
    server = ArchiveServer(Content(root), host, port, token)
    serve_until(stop, server, browser=browser, say=say)
