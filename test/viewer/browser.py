"""A browser, and a page that is watched."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlparse

import pytest

CHROMIUM = os.environ.get("CSAS_CHROMIUM", shutil.which("chromium") or "")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-component-update",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


class Watched:
    """A page, with what it said and asked for."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.said: list[str] = []
        self.asked: list[str] = []
        page.on("console", self._on_console)
        page.on("pageerror", lambda e: self.said.append(str(e)))
        page.on("request", lambda r: self.asked.append(r.url))

    def _on_console(self, message: Any) -> None:
        # The tests' own reading of pixels is no fault of the page.
        if message.type in ("error", "warning") and "willReadFrequently" not in message.text:
            self.said.append(message.text)

    def js(self, text: str) -> Any:
        return self.page.evaluate(text)

    def until(self, text: str, timeout_s: float = 60.0) -> Any:
        """Wait until an expression is true (by the debugger: the page itself forbids eval)."""
        end = time.monotonic() + timeout_s
        while not (value := self.js(text)):
            assert time.monotonic() < end, f"not within {timeout_s} s: {text}"
            time.sleep(0.03)
        return value

    def open(self, url: str) -> Watched:
        self.page.goto(url)
        self.until("window.csas && csas.stats.first > 0 && csas.solid")
        return self

    def settle(self) -> None:
        """Wait until both pictures show the wanted view, exactly."""
        self.until(
            "!csas.scrubbing() && !csas.frame && csas.panels.every(p => p.found?.bitmap && p.found.exact)"
        )

    def drawn(self) -> None:
        """Wait until what is pending has been drawn, however slow the machine is."""
        self.js("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")
        self.until("!csas.frame")

    def strangers(self) -> list[str]:
        """Return the addresses asked for that are not of this machine."""
        local = ("localhost", "127.0.0.1", "")
        return [a for a in self.asked if (urlparse(a).hostname or "") not in local]


@contextlib.contextmanager
def launched(*more: str) -> Iterator[Any]:
    """Start Debian's chromium, with more arguments; skip, and say why, where there is none."""
    if not CHROMIUM:
        pytest.skip("no chromium: apt-get install chromium (or name one in CSAS_CHROMIUM)")
    sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    with sync_api.sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=CHROMIUM, args=[*ARGUMENTS, *more])
        try:
            yield made
        finally:
            made.close()
