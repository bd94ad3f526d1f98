"""The page's server: loopback unless told otherwise, a token where the network can reach it."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import json
import math
import re
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import quote

from aiohttp import WSMsgType, web

from ..core.errors import CsasError, ParameterError
from ..core.parameters import CarvingParameters
from ..core.shape.mesh import measure, mesh_from_grid
from ..core.shape.threshold import thresholded
from .store import ViewerError, ViewStore

STATIC = Path(__file__).parent / "static"
_EVERY_ADDRESS = ("0.0.0.0", "::")
#: With the port: cookies know none, and two viewers on one machine would log each other out.
_COOKIE = "csas_viewer_token_{}"
#: Notices that wait for a slow page; beyond that it is cut off, comes back and gets everything anew.
_QUEUE = 4096
_MESHES = {"stl": "model/stl", "ply": "model/ply", "obj": "model/obj", "glb": "model/gltf-binary"}
#: Whoever tries a token a millisecond finds one of 12 letters and digits in no lifetime (36^12 ms).
_SHORTEST_TOKEN = 12
#: Of a change: an operator's remark has 2000 letters.
_MOST_POSTED = 1 << 18
#: A run that is still being read is waited for so long before a file of it is made (s).
_LOADS_S = 120.0
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; worker-src 'self' blob:;"
    " style-src 'self' 'unsafe-inline'; object-src 'none'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def is_loopback(host: str) -> bool:
    """Say whether a host to bind to can be reached from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


async def _settle() -> None:
    """Let what the loop has begun with a socket end.

    asyncio takes three turns from a connection that it accepts to a protocol that knows its transport,
    and one from a transport that is closed to its socket.
    """
    for _ in range(4):
        await asyncio.sleep(0)


class ViewerServer:
    """Serves a store to browsers, in a thread with an event loop of its own.

    Parameters
    ----------
    store : ViewStore
        What is shown.
    host : str
        Address to listen at. Not a loopback one: a token is asked for.
    port : int
        Port; 0: any free one.
    token : str, optional
        The token; made if one is needed and none is given.
    """

    def __init__(
        self, store: ViewStore, host: str = "127.0.0.1", port: int = 0, token: str | None = None
    ) -> None:
        self.store = store
        self.host, self.port = host, port
        if token is not None and len(token) < _SHORTEST_TOKEN:
            raise ParameterError(
                f"token has {len(token)} letters; expected {_SHORTEST_TOKEN} or more, or none"
            )
        self.token = token or (None if is_loopback(host) else secrets.token_urlsafe(18))
        self._queues: set[asyncio.Queue[str | None]] = set()
        self._pool = ThreadPoolExecutor(2, thread_name_prefix="viewer")
        self._reduced = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None  # once it listens
        self._ready = threading.Event()
        self._failed: BaseException | None = None
        self._stop: asyncio.Event | None = None
        self._thread = threading.Thread(target=self._run, name="viewer-server", daemon=True)

    @property
    def url(self) -> str:
        """Where the page is, with its token."""
        # Nobody else can open "every address of this machine": its name stands for them.
        host = socket.gethostname() if self.host in _EVERY_ADDRESS else self.host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?token={quote(self.token)}" if self.token else "")

    def start(self) -> None:
        """Listen.

        Raises
        ------
        ViewerError
            If the address cannot be had.
        """
        self._thread.start()
        self._ready.wait()
        if self._failed is not None:
            raise ViewerError(f"cannot listen at {self.host}:{self.port}: {self._failed}") from self._failed
        self.store.listeners.append(self._notice)

    def stop(self) -> None:
        """End, and cut the pages off; they come back when there is a server again."""
        if self._notice in self.store.listeners:
            self.store.listeners.remove(self._notice)
        if self._loop is not None and self._stop is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(10.0)
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as error:
            self._failed = error
        finally:
            self._ready.set()

    async def _serve(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        runner = web.AppRunner(self._app(), access_log=None, shutdown_timeout=0.5)
        await runner.setup()
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            listening = socket.create_server((self.host, self.port), family=family)
            try:
                await web.SockSite(runner, listening).start()
                self.port = listening.getsockname()[1]
                self._ready.set()
                await self._stop.wait()
                for queue in self._queues:
                    with contextlib.suppress(asyncio.QueueFull):
                        queue.put_nowait(None)
            finally:
                # A server that closes loses the sockets that it has accepted and not yet attached.
                self._loop.remove_reader(listening)
                await _settle()
        finally:
            served = runner.server
            assert served is not None  # set up above
            open_yet = [c.transport for c in served.connections if c.transport is not None]
            await runner.cleanup()
            # A page that has stopped reading would keep what it was sent, and the socket, for ever.
            for transport in open_yet:
                transport.abort()
            await _settle()

    def _app(self) -> web.Application:
        app = web.Application(middlewares=[self._guard], client_max_size=_MOST_POSTED)
        add = app.router.add_get
        add("/", self._page)
        add("/ws", self._socket)
        add("/api/scene", self._scene)
        add("/api/view/{set}/{stamp:[0-9]{1,20}}/{rev}.{kind:jpg|png}", self._view)
        add("/api/contour/{stamp:[0-9]{1,20}}/{rev}.json", self._contour)
        add("/api/picture/{name}/{rev}.png", self._composite)
        add("/api/volume/{name}/{rev}.bin", self._volume)
        add("/api/surface/{name}.json", self._surface)
        add("/api/mesh/{name}.{kind:stl|ply|obj|glb}", self._mesh)
        add("/api/reduced", self._make_reduced)
        add("/api/export.html", self._export)
        add("/api/circle.gif", self._circle)
        add("/api/report.{kind:pdf|html}", self._report)
        add("/api/surface-of/{name}/{rev}.json", self._other_surface)
        app.router.add_post("/api/desk", self._judge)
        app.router.add_static("/static/", STATIC)
        return app

    # Who may ask

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        # A page elsewhere must not reach us under a name of its own that it points here.
        host = request.host.rpartition(":")[0] if not request.host.endswith("]") else request.host
        if self.token is None and not is_loopback(host.strip("[]") or request.host):
            raise web.HTTPForbidden(text="the viewer answers as localhost alone")
        origin = request.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != request.host:
            raise web.HTTPForbidden(text="the viewer answers its own page alone")
        # A link elsewhere may lead to the page; what a page elsewhere embeds or fetches may start no work.
        if request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin") and not (
            request.path == "/" and request.headers.get("Sec-Fetch-Dest") == "document"
        ):
            raise web.HTTPForbidden(text="the viewer answers its own page alone")
        # Browsers always say where what they post comes from.
        if request.method not in ("GET", "HEAD") and origin is None:
            raise web.HTTPForbidden(text="the viewer takes changes from its own page alone")
        given = request.query.get("token") or request.cookies.get(_COOKIE.format(self.port)) or ""
        if self.token is not None and not hmac.compare_digest(given.encode(), self.token.encode()):
            raise web.HTTPUnauthorized(text="the viewer asks for its token: open the address that it printed")
        try:
            response = await handler(request)
        except ParameterError as error:
            raise web.HTTPBadRequest(text=str(error)) from error
        except CsasError as error:
            raise web.HTTPNotFound(text=str(error)) from error
        if not response.prepared:
            response.headers.update(_HEADERS)
            if self.token is not None and "token" in request.query:
                response.set_cookie(_COOKIE.format(self.port), self.token, httponly=True, samesite="Strict")
        return response

    # What is answered

    async def _in_thread(self, work: Callable[..., Any], *args: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._pool, work, *args)

    async def _page(self, _: web.Request) -> web.StreamResponse:
        return web.FileResponse(STATIC / "index.html")

    async def _scene(self, _: web.Request) -> web.StreamResponse:
        return web.json_response(self.store.scene())

    @staticmethod
    def _kept(body: bytes, kind: str) -> web.Response:
        # The address holds the revision: what it names never changes.
        kept = {"Cache-Control": "private, max-age=31536000, immutable"}
        return web.Response(body=body, content_type=kind, headers=kept)

    async def _view(self, request: web.Request) -> web.StreamResponse:
        about = request.match_info
        body = await self._in_thread(
            self.store.view_picture, about["set"], int(about["stamp"]), about["kind"]
        )
        return self._kept(body, "image/jpeg" if about["kind"] == "jpg" else "image/png")

    async def _contour(self, request: web.Request) -> web.StreamResponse:
        name = request.query.get("set", "shadow_mask")
        lines = await self._in_thread(self.store.contour, int(request.match_info["stamp"]), name)
        return self._kept(json.dumps(lines).encode(), "application/json")

    async def _composite(self, request: web.Request) -> web.StreamResponse:
        body = await self._in_thread(self.store.composite_picture, request.match_info["name"])
        return self._kept(body, "image/png")

    async def _volume(self, request: web.Request) -> web.StreamResponse:
        return self._kept(self.store.volume(request.match_info["name"]), "application/octet-stream")

    def _grid_at(self, request: web.Request) -> Any:
        name = request.match_info["name"]
        with self.store.lock:
            grid = self.store.grids.get(name)
        if grid is None:
            raise ViewerError(f"there is no volume {name!r}")
        text = request.query.get("threshold", "")
        try:
            threshold = float(text) if text else grid.threshold
        except ValueError:
            raise ParameterError(f"threshold is {text!r}; expected a number") from None
        if text and not 0.0 < threshold <= 1.0:
            raise ParameterError(f"threshold is {text}; expected over 0, up to 1")
        if not text or math.isclose(threshold, grid.threshold, rel_tol=1e-6):
            return grid
        p = CarvingParameters.from_mapping({"method": grid.method, "threshold": threshold})
        return thresholded(grid.volume, grid.likelihood, grid.views, p)

    async def _surface(self, request: web.Request) -> web.StreamResponse:
        """Measure the surface at a threshold: the authority beside the page's own mesh."""

        def work() -> dict[str, Any]:
            grid = self._grid_at(request)
            if not grid.occupied.any():
                return {"object": False, "threshold": None, "triangles": 0}
            mesh = mesh_from_grid(grid)
            found = measure(mesh)
            return {
                "object": True,
                "threshold": grid.threshold,
                "triangles": len(mesh.faces),
                "length_m": found.length_m,
                "width_m": found.width_m,
                "height_m": found.height_m,
                "volume_m3": found.volume_m3,
            }

        return web.json_response(await self._in_thread(work))

    async def _mesh(self, request: web.Request) -> web.StreamResponse:
        kind = request.match_info["kind"]

        def work() -> bytes:
            data: Any = mesh_from_grid(self._grid_at(request)).export(file_type=kind)
            return data.encode() if isinstance(data, str) else bytes(data)

        body = await self._in_thread(work)
        return self._to_keep(body, _MESHES[kind], f"{request.match_info['name']}.{kind}")

    async def _make_reduced(self, _: web.Request) -> web.StreamResponse:
        def work() -> bool:
            with self._reduced:
                if self.store.make_reduced is None:
                    return False
                if len(self.store.sets["reduced"]) < len(self.store.sets["sub_aperture"]):
                    self.store.make_reduced()
                return True

        return web.json_response({"made": await self._in_thread(work)})

    async def _export(self, request: web.Request) -> web.StreamResponse:
        from .export import export_html

        step = self._whole_number(request, "step", 5, 1, 360)

        def work() -> bytes:
            if not self.store.live and not self.store.loaded.wait(_LOADS_S):
                raise ViewerError("the run is still being read; try again")
            return export_html(self.store, step)

        body = await self._in_thread(work)
        return self._to_keep(body, "text/html", "view.html")

    @staticmethod
    def _whole_number(request: web.Request, name: str, otherwise: int, low: int, high: int) -> int:
        text = request.query.get(name, str(otherwise))
        # Not isdigit(): it takes signs that int() does not, such as ².
        if not (text.isascii() and text.isdigit() and len(text) < 10 and low <= int(text) <= high):
            raise ParameterError(f"{name} is {text[:40]!r}; expected a whole number, {low} to {high}")
        return int(text)

    def _to_keep(self, body: bytes, kind: str, name: str) -> web.Response:
        """Answer a file to be saved, under the run's name."""
        run = re.sub(r"[^A-Za-z0-9._-]+", "_", self.store.title) or "csas"
        disposition = f'attachment; filename="{run}_{name}"'
        return web.Response(body=body, content_type=kind, headers={"Content-Disposition": disposition})

    async def _circle(self, request: web.Request) -> web.StreamResponse:
        from .crop import moving_picture

        name, contact = request.query.get("set", "shadow"), request.query.get("contact", "")
        body = await self._in_thread(moving_picture, self.store, name, contact)
        return self._to_keep(body, "image/gif", f"{contact or 'circle'}.gif")

    async def _report(self, request: web.Request) -> web.StreamResponse:
        from . import contact_report  # late: matplotlib takes half a second

        contact, kind = request.query.get("contact", ""), request.match_info["kind"]

        def work() -> bytes:
            sheet = contact_report.sheet_of(self.store, contact)
            return contact_report.as_pdf(sheet) if kind == "pdf" else contact_report.as_html(sheet)

        body = await self._in_thread(work)
        types = {"pdf": "application/pdf", "html": "text/html"}
        return self._to_keep(body, types[kind], f"{contact or 'report'}.{kind}")

    async def _other_surface(self, request: web.Request) -> web.StreamResponse:
        return self._kept(self.store.mesh(request.match_info["name"]), "application/json")

    async def _judge(self, request: web.Request) -> web.StreamResponse:
        """Change what has been judged: the only thing that the page writes."""
        if request.content_type != "application/json":
            raise web.HTTPUnsupportedMediaType(text="expected application/json")
        try:
            changes = (await request.json())["items"]
        except (ValueError, KeyError, TypeError, RecursionError):
            changes = None
        if not isinstance(changes, list):
            raise ParameterError("expected JSON with a list of items")
        desk = self.store.desk
        if desk is None:
            raise web.HTTPConflict(text=self.store.scene()["desk"]["why"])
        try:
            document = await self._in_thread(desk.change, changes)
        except ViewerError as error:
            raise web.HTTPConflict(text=str(error)) from error
        self.store.put_desk(document)
        return web.json_response(document)

    # Notices

    def _notice(self, notice: dict[str, Any]) -> None:
        text = json.dumps(notice)
        if self._loop is None:
            return
        with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
            self._loop.call_soon_threadsafe(self._spread, text)

    def _spread(self, text: str) -> None:
        for queue in self._queues:
            try:
                queue.put_nowait(text)
            except asyncio.QueueFull:
                while not queue.empty():
                    queue.get_nowait()
                queue.put_nowait(None)

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        socket_ = web.WebSocketResponse(heartbeat=5.0)
        await socket_.prepare(request)
        queue: asyncio.Queue[str | None] = asyncio.Queue(_QUEUE)
        # First listening, then looking: nothing new falls between the two.
        self._queues.add(queue)
        try:
            await socket_.send_str(json.dumps({"type": "all", "scene": self.store.scene()}))
            reader = asyncio.ensure_future(self._until_closed(socket_, queue))
            while (text := await queue.get()) is not None:
                await socket_.send_str(text)
            reader.cancel()
        except ConnectionError:
            pass  # the page has gone
        finally:
            self._queues.discard(queue)
            await socket_.close()
        return socket_

    @staticmethod
    async def _until_closed(socket_: web.WebSocketResponse, queue: asyncio.Queue[str | None]) -> None:
        async for message in socket_:
            if message.type in (WSMsgType.ERROR, WSMsgType.CLOSE):
                break
        with contextlib.suppress(asyncio.QueueFull):
            queue.put_nowait(None)
