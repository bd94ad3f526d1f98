"""Measure the viewer's page in Debian's chromium: scrubbing, threshold, first picture, memory.

    python benchmarks/viewer.py                          # 360 synthetic views of 800 x 800, two sets
    python benchmarks/viewer.py --results results/demo   # and how fast a finished run opens

Reports; asserts nothing. Meant for a machine that is otherwise idle.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from csas_shadow_ros.core.geometry import Acoustics, ShadowCamera, ViewInfo, view_ground_to_pixel
from csas_shadow_ros.core.volume import Volume, VoxelGrid
from csas_shadow_ros.viewer.codes import amplitude_codes
from csas_shadow_ros.viewer.server import ViewerServer
from csas_shadow_ros.viewer.source import PathSource
from csas_shadow_ros.viewer.store import Entry, ViewStore

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "viewer"))
from browser import Watched, launched

VIEWS, SIDE, SECONDS = 360, 800, 6.0


def synthetic_store() -> ViewStore:
    """Speckle, its own in each of eight pictures, and a ball in a volume of 128 x 128 x 64."""
    store, rng = ViewStore(title="benchmark"), np.random.default_rng(1)
    speckle = [amplitude_codes(rng.rayleigh(size=(SIDE, SIDE)).astype(np.float32)) for _ in range(8)]
    for i in range(VIEWS):
        aspect = math.tau * i / VIEWS
        sonar = (75 * math.cos(aspect), 75 * math.sin(aspect), 30.0)
        to_pixel = view_ground_to_pixel(aspect, 0.01, SIDE, SIDE, (0.0, 0.0))
        camera = ShadowCamera.from_ground(to_pixel, sonar, SIDE, SIDE)
        acoustics = Acoustics(120e3, 40e3, 1500.0, 1)
        info = ViewInfo(10**18 + i * 10**9, camera, acoustics, aspect, math.radians(12))
        for k, name in enumerate(("sub_aperture", "shadow")):
            codes = np.roll(speckle[(i + k) % 8], 17 * i, axis=1)
            store.put_view(name, Entry(info, f"{i}", lambda codes=codes: codes))
    volume = Volume.around((0.0, 0.0), (2.56, 2.56, 1.28), 0.02)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    likelihood = np.clip(np.sqrt(x**2 + y**2 + (z - 0.5) ** 2) / 3, 0, 1).astype(np.float32)
    views = np.full(volume.shape, VIEWS, np.uint16)
    store.put_grid("main", VoxelGrid(volume, likelihood, views, 0.15, likelihood < 0.15, "soft"))
    return store


def spread(values: list[float]) -> dict[str, float]:
    """Return median and 95th percentile."""
    if not values:
        return {}
    return {"median": round(float(np.median(values)), 1), "p95": round(float(np.percentile(values, 95)), 1)}


def memory_mb(browser: Any, page: Any) -> float:
    """Return the resident memory of the renderer processes (Linux), MB."""
    cdp = browser.new_browser_cdp_session()
    processes = cdp.send("SystemInfo.getProcessInfo")["processInfo"]
    total = 0
    for process in processes:
        if process["type"] == "renderer":
            status = Path(f"/proc/{process['id']}/status").read_text()
            total += int(status.split("VmRSS:")[1].split()[0])
    return total / 1024


def scrub(watched: Watched) -> dict[str, Any]:
    """Drag the cursor once round the circle in six seconds, an event a view."""
    cdp = watched.page.context.new_cdp_session(watched.page)
    box = watched.js(
        "(() => { const s = csas.panels[1].slider, b = s.ring.getBoundingClientRect();"
        " return [b.left + s.side / 2, b.top + s.side / 2, s.radius]; })()"
    )

    def send(kind: str, degrees: float) -> None:
        a = math.radians(degrees)
        at = {"x": box[0] + box[2] * math.cos(a), "y": box[1] - box[2] * math.sin(a)}
        about = {"type": kind, "button": "left", "buttons": 1, "clickCount": 1}
        cdp.send("Input.dispatchMouseEvent", about | at)

    send("mousePressed", 0)
    watched.page.wait_for_timeout(800)
    watched.js("csas.stats.drawn = 0, csas.stats.latency = []")
    began = time.perf_counter()
    for i in range(VIEWS):
        while time.perf_counter() < began + i * SECONDS / VIEWS:
            time.sleep(0.001)
        send("mouseMoved", 360 * i / VIEWS)
    took = time.perf_counter() - began
    drawn, latency = watched.js("[csas.stats.drawn, csas.stats.latency]")
    send("mouseReleased", 359)
    return {
        "seconds": round(took, 2),
        "views_per_s": round(drawn / took, 1),
        "event_to_picture_ms": spread(latency),
    }


def measure(store: ViewStore, *, threshold: bool) -> dict[str, Any]:
    """Open a store's page and measure it."""
    server = ViewerServer(store)
    server.start()
    out: dict[str, Any] = {}
    try:
        with launched() as browser:
            watched = Watched(browser.new_page(viewport={"width": 1366, "height": 768}))
            watched.open(server.url)
            out["first_picture_ms"] = round(watched.js("csas.stats.first"))
            watched.until("csas.loader.all.length === 0 && csas.loader.busy.size === 0", 300)
            out["memory_mb_all_views_loaded"] = round(memory_mb(browser, watched.page))
            if threshold:
                out["scrub"] = scrub(watched)
                watched.until("!csas.busySurface && csas.stats.surfaces.length > 0", 30)
                watched.js("csas.stats.surfaces = []")
                for step in range(40):
                    watched.js(f"csas.threshold('main', {90 + step % 20})")
                    watched.page.wait_for_timeout(200)
                out["threshold_to_surface_ms"] = spread(watched.js("csas.stats.surfaces"))
    finally:
        server.stop()
    return out


def main() -> int:
    """Measure and print JSON."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("--results", type=Path, help="a results folder to open as well")
    arguments = parser.parse_args()
    report: dict[str, Any] = {"cores": os.cpu_count(), "load": round(os.getloadavg()[0], 2)}
    report["synthetic"] = measure(synthetic_store(), threshold=True)
    if arguments.results is not None:
        store = ViewStore()
        began = time.perf_counter()
        source = PathSource(store, arguments.results)
        source.start()
        report["results"] = {"server_ready_ms": round(1e3 * (time.perf_counter() - began))}
        report["results"] |= measure(store, threshold=False)
    print(json.dumps(report, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
