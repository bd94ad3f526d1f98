"""Fixtures of the viewer's tests: a browser, a page that is watched, and a finished run."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import Watched, launched

from csas_shadow_ros.cli import main
from csas_shadow_ros.viewer.server import ViewerServer
from csas_shadow_ros.viewer.source import PathSource
from csas_shadow_ros.viewer.store import ViewStore


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    with launched() as made:
        yield made


@pytest.fixture
def watched(browser: Any, serve: Any) -> Iterator[Watched]:  # serve: its servers end after the page
    context = browser.new_context(viewport={"width": 1366, "height": 768}, accept_downloads=True)
    page = Watched(context.new_page())
    yield page
    context.close()
    assert page.said == [], "the console is clean"
    assert page.strangers() == [], "no request leaves the machine"


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory, tiny_box_bag: Any) -> Path:
    """A finished run with 72 views, as `csas-shadow run` leaves it; for screenshots, that of CSAS_VIEWED."""
    if viewed := os.environ.get("CSAS_VIEWED"):
        return Path(viewed)
    out = tmp_path_factory.mktemp("viewed") / "run"
    given = [str(tiny_box_bag.path), "--out", str(out), "--step-deg", "5", "--no-figures", "-q"]
    assert main(["run", *given, "--voxel-size-m", "0.04"]) == 0
    return out


@pytest.fixture
def serve() -> Iterator[Callable[[ViewStore], str]]:
    servers: list[ViewerServer] = []

    def start(store: ViewStore, **options: Any) -> str:
        server = ViewerServer(store, **options)
        server.start()
        servers.append(server)
        return server.url

    yield start
    for server in servers:
        server.stop()


@pytest.fixture(scope="session")
def run_store(results: Path) -> ViewStore:
    store = ViewStore()
    source = PathSource(store, results)
    source.start()
    assert source.done.wait(60)
    return store
