"""The viewer beside a real graph of processes: it fills, catches up, survives, and holds nobody up."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("aiohttp")

from graph_of_nodes import PARAMETERS, STEP_DEG, VOXEL_M

from csas_shadow_ros.core.pipeline import ProcessedView, Result
from csas_shadow_ros.graph.processes import DomainReservation, Graph, graph_environment
from csas_shadow_ros.graph.replay import replay

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "viewer"))
from browser import Watched, launched

VIEWS = 36


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def plan(bag: Path) -> dict[str, dict[str, Any]]:
    """A graph whose slow pace leaves time to kill somebody in mid-run."""
    return {
        "sub_aperture": {"step_deg": STEP_DEG, "min_sinks": 2, "window": 1},
        "shadow_enhancement": {},
        "shadow_likelihood": {},
        "voxel_carver": {"voxel_size_m": VOXEL_M, "publish_hz": 5.0},
        "composites": {},
        "bag_player": {"bag": str(bag)},
    }


class Viewer:
    """The viewer node as a process of its own."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.port, self.domain, self.folder = free_port(), domain, folder
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        environment = graph_environment(self.domain, self.folder)
        arguments = ["--ros-args", "-p", f"port:={self.port}"]
        command = [sys.executable, "-m", "csas_shadow_ros.nodes.viewer", *arguments]
        with (self.folder / "viewer.log").open("ab") as log:
            self.process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        self.until(lambda: self.scene() is not None, "the page's server")

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def scene(self) -> dict[str, Any] | None:
        try:
            with urllib.request.urlopen(f"{self.url}api/scene", timeout=5) as answer:
                return json.load(answer)
        except OSError:
            return None

    def state(self) -> str:
        """Say how far it is."""
        scene = self.scene() or {"sets": {}}
        return str({k: len(v["views"]) for k, v in scene["sets"].items()} | {"status": scene.get("status")})

    def views(self, name: str = "shadow") -> int:
        scene = self.scene()
        return 0 if scene is None else len(scene["sets"][name]["views"])

    def until(self, condition: Callable[[], Any], what: str, timeout_s: float = 60.0) -> None:
        end = time.monotonic() + timeout_s
        while not condition():
            log = (self.folder / "viewer.log").read_text()
            assert time.monotonic() < end, f"{what}: {self.state()}\n{log}"
            time.sleep(0.1)

    def has_all(self) -> bool:
        scene = self.scene()
        streams = ("sub_aperture", "shadow", "likelihood", "shadow_mask")
        return scene is not None and all(len(scene["sets"][s]["views"]) == VIEWS for s in streams)


@pytest.fixture
def viewer(domain: int, tmp_path: Path) -> Iterator[Viewer]:
    made = Viewer(domain, tmp_path)
    yield made
    made.kill()


@pytest.fixture
def page() -> Iterator[Watched]:
    with launched() as browser:
        yield Watched(browser.new_page(viewport={"width": 1366, "height": 768}))


def test_a_page_fills_from_the_live_graph_and_outlives_the_viewer_and_the_graph(
    viewer: Viewer, page: Watched, run_bag: Path, tmp_path: Path
) -> None:
    viewer.start()
    page.page.goto(viewer.url)
    page.js("window.mark = 1")
    with Graph(plan(run_bag), viewer.domain, tmp_path):
        page.until("window.csas && csas.views('shadow').length > 5", 60)
        viewer.kill()  # in mid-run
        page.until("document.querySelector('#link').textContent.includes('away')", 20)
        viewer.start()
        viewer.until(viewer.has_all, "a viewer that was killed catches up with every view")
        page.until(f"csas.views('shadow').length === {VIEWS} && csas.scene.volumes.main")
        page.until("csas.scene.pictures.color_by_aspect && csas.scene.volumes.other", 60)
        page.until("csas.scene.dimensions", 60)
        page.until("csas.panels.every(p => p.found?.bitmap && p.found.exact)")
        page.until("document.querySelector('#link').textContent === 'finished: 36 of 36 views'")
        page.until("csas.scene.contacts.length && csas.scene.report.verdict === 'object'")
    page.until("document.querySelector('#link').textContent.startsWith('the graph is silent for')")
    # The graph is gone: what is there stays to be looked at. It comes back, with the same run, and goes on.
    page.js("csas.setAspect(90)")
    page.until("csas.current.aspect_deg === 90 && csas.panels.every(p => p.found?.bitmap && !p.found.late)")
    with Graph(plan(run_bag), viewer.domain, tmp_path):
        viewer.until(lambda: "running" in viewer.state(), "the graph that came back is followed")
        viewer.until(lambda: "finished" in viewer.state(), "and its end is seen")
        page.until("csas.scene.status.includes('finished')")
    assert page.js(f"csas.views('shadow').length === {VIEWS}")
    assert page.js("window.mark") == 1, "the page was never loaded again"
    assert page.strangers() == []


def test_a_viewer_that_hangs_changes_neither_the_run_nor_its_grid(
    viewer: Viewer, run_bag: Path, tmp_path: Path, reference: tuple[Result, list[ProcessedView]]
) -> None:
    # A replay reserves the domain that it is given: it must not be the test's own reservation.
    reservation = DomainReservation()
    viewer.domain = reservation.domain_id
    viewer.start()
    assert viewer.process is not None
    os.kill(viewer.process.pid, signal.SIGSTOP)
    reservation.close()
    try:
        replayed = replay(run_bag, None, PARAMETERS, domain_id=viewer.domain, progress=False)
    finally:
        os.kill(viewer.process.pid, signal.SIGCONT)
    expected = reference[0].grid
    assert expected is not None
    assert replayed.grid is not None
    np.testing.assert_array_equal(replayed.grid.likelihood, expected.likelihood)
    assert not replayed.rejected
