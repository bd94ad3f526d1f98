"""Measure the viewer's page in Debian's chromium: scrubbing, threshold, first picture, memory.

    python benchmarks/viewer.py                          # 360 synthetic views of 800 x 800, two sets
    python benchmarks/viewer.py --results results/demo   # and how fast a finished run opens
    python benchmarks/viewer.py --against ../old/csas_shadow_ros/viewer/static   # and another build's page

Two builds are dragged in turn, so that both meet what else the machine does. Reports; asserts nothing.
Views a second are meant for a machine that is otherwise idle; what a view costs the processor is not.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np
from numpy.typing import NDArray

from csas_shadow_ros.core.geometry import Acoustics, ShadowCamera, ViewInfo, view_ground_to_pixel
from csas_shadow_ros.core.imaging.mask_codes import MASK_SHADOW
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.viewer import server as served
from csas_shadow_ros.viewer.codes import amplitude_codes
from csas_shadow_ros.viewer.server import ViewerServer
from csas_shadow_ros.viewer.store import Entry, ViewStore

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "viewer"))
from browser import ARGUMENTS, CHROMIUM, Watched, launched

#: The tests have pages drawn by an emulated GPU, so that they take the ways that a real one takes. The
#: browser by itself does not: without a GPU it draws pages in main memory, and emulates one for 3-D alone.
ARGUMENTS.remove("--use-angle=swiftshader")

VIEWS, SIDE, SECONDS = 360, 800, 6.0
#: What an ordinary mouse sends.
MOUSE_HZ = 125
DRAGS = 5
#: Times that a finished run is opened, each in a browser of its own.
OPENINGS = 3


def speckle(rng: np.random.Generator) -> NDArray[np.float32]:
    """Return amplitudes with speckle as wide as that of views, whose pixels are closer than they resolve."""
    parts = (cv2.GaussianBlur(rng.normal(size=(SIDE, SIDE)), (0, 0), 1.2) for _ in range(2))
    return np.hypot(*parts).astype(np.float32)


def seen(aspect_rad: float) -> NDArray[np.bool_]:
    """Return where a view knows anything: in the scene's square, which lies turned in the view's."""
    v, u = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    cos, sin = math.cos(aspect_rad), math.sin(aspect_rad)
    return np.asarray(np.maximum(abs(cos * u + sin * v), abs(cos * v - sin * u)) < SIDE / math.sqrt(8))


def told(store: ViewStore) -> None:
    """Put in what the page draws over and round its pictures: contacts, evidence of each view."""
    d = {"length_m": 0.8, "width_m": 0.4, "height_m": 0.4, "volume_m3": 0.13, "heading_rad": 0.4}
    contacts = [
        {"id": f"object-{i}", "name": f"Contact {i}", "kind": "object"}
        | {"position_m": [i - 2.0, 0.5 * i - 1.0]}
        | {"size_m": 0.8, "height_m": 0.4, "dimensions": d, "geographic": None}
        | {"volume": "main" if i == 1 else f"object_{i}"}
        for i in (1, 2, 3)
    ]
    heights = [[i, 0.4 + 0.1 * math.sin(i), 0.3 * (i % 3), 0.0] for i in range(VIEWS)]
    report = {"verdict": "object", "quality": {"verdict": "good", "reasons": []}, "heights": heights}
    report |= {"height_median_m": 0.4, "rejected": [[30.0, "too dark"]], "views": {"in": VIEWS}}
    store.put_part("report", report)
    store.put_part("contacts", contacts)


def synthetic_store() -> ViewStore:
    """Speckle, its own in each of eight pictures, with outlines, and a ball in a volume of 128 x 128 x 64."""
    store, rng = ViewStore(title="benchmark"), np.random.default_rng(1)
    pictures = [amplitude_codes(speckle(rng)) for _ in range(8)]
    # Three shadows with ragged edges.
    ragged = cv2.GaussianBlur(rng.normal(size=(SIDE, SIDE)), (0, 0), 3.0) * 40.0
    v, u = np.indices((SIDE, SIDE))
    dark = [np.maximum(abs(u - x) - 60, abs(v - 420) - 110) + ragged < 0 for x in (200, 400, 600)]
    mask = np.where(np.any(dark, axis=0), MASK_SHADOW, np.uint8(0)).astype(np.uint8)
    for i in range(VIEWS):
        aspect = math.tau * i / VIEWS
        sonar = (75 * math.cos(aspect), 75 * math.sin(aspect), 30.0)
        to_pixel = view_ground_to_pixel(aspect, 0.01, SIDE, SIDE, (0.0, 0.0))
        camera = ShadowCamera.from_ground(to_pixel, sonar, SIDE, SIDE)
        acoustics = Acoustics(120e3, 40e3, 1500.0, 1)
        info = ViewInfo(10**18 + i * 10**9, camera, acoustics, aspect, math.radians(12))
        for k, name in enumerate(("sub_aperture", "shadow")):
            codes = np.where(seen(aspect), np.roll(pictures[(i + k) % 8], 17 * i, axis=1), np.uint8(0))
            store.put_view(name, Entry(info, f"{i}", lambda codes=codes: codes))
        store.put_view("shadow_mask", Entry(info, f"{i}", lambda: mask))
    told(store)
    volume = Volume.around((0.0, 0.0), (2.56, 2.56, 1.28), 0.02)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    likelihood = np.clip(np.sqrt(x**2 + y**2 + (z - 0.5) ** 2) / 3, 0, 1).astype(np.float32)
    views = np.full(volume.shape, VIEWS, np.uint16)
    store.put_grid("main", VoxelGrid(volume, likelihood, views, 0.15, likelihood < 0.15, "soft"))
    return store


def free_port() -> int:
    """Return a port of this machine that nothing listens on."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return int(held.getsockname()[1])


def spread(values: list[float]) -> dict[str, float]:
    """Return median and 95th percentile."""
    if not values:
        return {}
    return {"median": round(float(np.median(values)), 1), "p95": round(float(np.percentile(values, 95)), 1)}


def processes(browser: Any) -> list[dict[str, Any]]:
    """Return the browser's processes."""
    cdp = browser.new_browser_cdp_session()
    return list(cdp.send("SystemInfo.getProcessInfo")["processInfo"])


def processor_s(browser: Any) -> float:
    """Return the processor's time that the browser's processes have had (Linux), s."""
    total = 0
    for process in processes(browser):
        told = Path(f"/proc/{process['id']}/stat").read_text().rsplit(")", 1)[1].split()
        total += int(told[11]) + int(told[12])
    return total / os.sysconf("SC_CLK_TCK")


def memory_mb(browser: Any) -> float:
    """Return the resident memory of the renderer processes (Linux), MB."""
    total = 0
    for process in processes(browser):
        if process["type"] == "renderer":
            status = Path(f"/proc/{process['id']}/status").read_text()
            total += int(status.split("VmRSS:")[1].split()[0])
    return total / 1024


async def _drag(port: int, circle: list[float]) -> None:
    """Send moves once round the circle as a mouse does: `MOUSE_HZ` a second, whatever the page is doing.

    Playwright waits for the page's answer before it sends the next event, so that no more than one comes in a
    frame, always at the same moment of it.
    """
    x0, y0, radius = circle
    async with aiohttp.ClientSession() as client:
        async with client.get(f"http://127.0.0.1:{port}/json") as answer:
            pages = await answer.json(content_type=None)
        address = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
        async with client.ws_connect(address, max_msg_size=0) as line:
            count = round(SECONDS * MOUSE_HZ)
            began = time.perf_counter()
            for i in range(count):
                await asyncio.sleep(max(0.0, began + i / MOUSE_HZ - time.perf_counter()))
                a = math.tau * i / count
                at = {"x": x0 + radius * math.cos(a), "y": y0 - radius * math.sin(a)}
                move = {"type": "mouseMoved", "button": "left", "buttons": 1, "clickCount": 1} | at
                await line.send_json({"id": i + 1, "method": "Input.dispatchMouseEvent", "params": move})


def scrub(watched: Watched, port: int, panel: int = 1) -> dict[str, Any]:
    """Drag the cursor once round a panel's circle in six seconds, `DRAGS` times; return what is typical."""
    return told_of([_scrubbed(watched, port, panel) for _ in range(DRAGS)])


def told_of(drags: list[tuple[float, ...]]) -> dict[str, Any]:
    """Return what is typical of drags, and each of them."""
    rate, median, p95, cost, _ = (round(float(np.median(column)), 1) for column in zip(*drags, strict=True))
    return {
        "views_per_s": rate,
        "event_to_picture_ms": {"median": median, "p95": p95},
        "processor_ms_per_view": cost,
        "of_each_drag": {
            "views_per_s": [drag[0] for drag in drags],
            "p95_ms": [drag[2] for drag in drags],
            "processor_ms_per_view": [drag[3] for drag in drags],
            "machine_load": [drag[4] for drag in drags],
        },
    }


def _scrubbed(watched: Watched, port: int, panel: int) -> tuple[float, float, float, float, float]:
    """Drag once.

    Returns views a second, median and 95th percentile (ms) of event to picture, the browser's processor time
    (ms) a view, and the machine's load (processes that run or wait for a core, over the last minute).
    """
    circle = watched.js(
        f"(() => {{ const s = csas.panels[{panel}].slider, b = s.ring.getBoundingClientRect();"
        " return [b.left + s.side / 2, b.top + s.side / 2, s.radius]; })()"
    )
    mouse = watched.page.mouse
    mouse.move(circle[0] + circle[2], circle[1])
    mouse.down()
    watched.page.wait_for_timeout(800)
    watched.js("csas.stats.drawn = 0, csas.stats.latency = []")
    browser = watched.page.context.browser
    had, began = processor_s(browser), time.perf_counter()
    hand = threading.Thread(target=lambda: asyncio.run(_drag(port, circle)))
    hand.start()
    hand.join()
    took = time.perf_counter() - began
    drawn, latency = watched.js("[csas.stats.drawn, csas.stats.latency]")
    cost = 1e3 * (processor_s(browser) - had) / max(1, drawn)
    mouse.up()
    times = spread(latency)
    rate = round(drawn / took, 1)
    return rate, times["median"], times["p95"], round(cost, 1), round(os.getloadavg()[0], 1)


@contextlib.contextmanager
def page_of(store: ViewStore, static: Path, browser: Any) -> Iterator[tuple[Watched, dict[str, Any]]]:
    """Open a store's page, of the build in a folder; yield it with what its opening took."""
    own, served.STATIC = served.STATIC, static
    try:
        server = ViewerServer(store)
        server.start()
        watched = Watched(browser.new_page(viewport={"width": 1366, "height": 768}))
        watched.open(server.url)
    finally:
        served.STATIC = own
    try:
        out = {"first_picture_ms": round(watched.js("csas.stats.first"))}
        loaded(watched)
        out["memory_mb_all_views_loaded"] = round(memory_mb(browser))
        yield watched, out
    finally:
        server.stop()


def loaded(watched: Watched) -> None:
    """Wait until a page has all views, and, left alone, has decoded what it decodes ahead."""
    watched.until("csas.loader.all.length === 0 && csas.loader.busy.size === 0", 300)
    if watched.js("!!csas.idle"):
        watched.until("csas.idle() && !csas.loader.ahead.length && csas.loader.busy.size === 0", 300)


def compared(store: ViewStore, static: Path) -> dict[str, Any]:
    """Drag the page of this build and that of another in turn: A B A B ..."""
    ports = (free_port(), free_port())
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(launched(f"--remote-debugging-port={ports[0]}"))
        given = [*ARGUMENTS, f"--remote-debugging-port={ports[1]}"]
        second = first.browser_type.launch(executable_path=CHROMIUM, args=given)
        stack.callback(second.close)
        folders = (served.STATIC, static)
        opens = zip(folders, (first, second), strict=True)
        pages = [stack.enter_context(page_of(store, *each))[0] for each in opens]
        drags: list[list[tuple[float, ...]]] = [[], []]
        for _ in range(DRAGS):
            for watched, port, of in zip(pages, ports, drags, strict=True):
                of.append(_scrubbed(watched, port, 1))
    return {"this": told_of(drags[0]), "against": told_of(drags[1])}


def measure(store: ViewStore) -> dict[str, Any]:
    """Open a store's page; scrub, and move the threshold."""
    port = free_port()
    opening = launched(f"--remote-debugging-port={port}")
    with opening as browser, page_of(store, served.STATIC, browser) as (watched, out):
        out["scrub"] = scrub(watched, port)
        # Just zoomed out of: nothing that is decoded covers what is shown.
        watched.js("csas.state.zoom /= 1.5, csas.dirty()")
        out["scrub_just_zoomed_out"] = told_of([_scrubbed(watched, port, 1)])
        watched.js("csas.state.zoom *= 1.5, csas.dirty()")
        loaded(watched)
        watched.js("csas.panels[1].choose('six_shadow')")
        watched.until("csas.panels[1].sixWanted?.every(a => csas.loader.bitmap(a))")
        out["scrub_beside_six_views"] = scrub(watched, port, 0)
        watched.js("csas.panels[1].choose('shadow'), csas.turn()")
        out["scrub_sonar_up"] = scrub(watched, port, 0)
        watched.js("csas.turn()")
        watched.until("!csas.busySurface && csas.stats.surfaces.length > 0", 30)
        watched.js("csas.stats.surfaces = []")
        for step in range(40):
            watched.js(f"csas.threshold('main', {90 + step % 20})")
            watched.page.wait_for_timeout(200)
        out["threshold_to_surface_ms"] = spread(watched.js("csas.stats.surfaces"))
    return out


def opened(results: Path) -> dict[str, Any]:
    """Open a finished run as an operator does: `csas-shadow view` and its page in a browser that is there."""
    out: dict[str, Any] = {}
    with launched() as browser:
        began = time.perf_counter()
        command = [sys.executable, "-m", "csas_shadow_ros.cli", "view", str(results), "--no-browser"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            try:
                assert server.stdout is not None
                url = server.stdout.readline().strip()
                out["command_to_address_ms"] = round(1e3 * (time.perf_counter() - began))
                page = browser.new_page(viewport={"width": 1366, "height": 768})
                watched = Watched(page)
                page.goto(url)
                watched.until("window.csas && csas.stats.first > 0", 60)
                out["command_to_picture_ms"] = round(1e3 * (time.perf_counter() - began))
                out["page_to_picture_ms"] = round(watched.js("csas.stats.first"))
                watched.until("csas.scene.volumes.main", 300)
                loaded(watched)
                out["views"] = watched.js("csas.views('shadow').length")
                out["memory_mb_all_views_loaded"] = round(memory_mb(browser))
            finally:
                server.terminate()
    return out


def main() -> int:
    """Measure and print JSON."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("--results", type=Path, help="a results folder to open as well")
    parser.add_argument("--against", type=Path, help="the folder `static` of another build, dragged in turn")
    arguments = parser.parse_args()
    report: dict[str, Any] = {"cores": os.cpu_count(), "machine_load_before": round(os.getloadavg()[0], 2)}
    store = synthetic_store()
    if arguments.against is not None:
        report["in_turn"] = compared(store, arguments.against.resolve())
    report["synthetic"] = {"mouse_events_per_s": MOUSE_HZ, **measure(store)}
    if arguments.results is not None:
        times = [opened(arguments.results) for _ in range(OPENINGS)]
        report["results"] = {name: round(float(np.median([t[name] for t in times]))) for name in times[0]}
        report["results"]["command_to_picture_ms_each"] = [t["command_to_picture_ms"] for t in times]
    print(json.dumps(report, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
