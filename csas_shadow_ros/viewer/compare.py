"""Two runs of one contact: the second one's views, shape and dimensions in the first one's page."""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import Any

from .source import PathSource
from .store import SECOND, ViewStore

#: Views that nobody compares.
_LEFT_OUT = ("reduced",)


class Second:
    """Puts a second run into the store of a first one, as sets whose names begin with ``b.``.

    Its scene is moved so that its contact lies where the first one's does: two runs of one contact seldom
    have one origin.

    Parameters
    ----------
    store : ViewStore
        Of the first run, which has been read, or is being read.
    path : path-like
        The second one: a results folder or a bag.
    namespace : str, optional
        Of a bag's topics; found by itself if not given.

    Raises
    ------
    ViewerError, BagError
        If there is nothing to see.
    """

    def __init__(self, store: ViewStore, path: str | Path, namespace: str | None = None) -> None:
        self.store, self.own = store, ViewStore()
        self.source = PathSource(self.own, path, namespace)
        self.done = threading.Event()
        self._passed: dict[str, str] = {}
        self.own.listeners.append(self._pass_on)
        self._part()

    def start(self) -> None:
        """Read it, in a thread."""
        self.source.start()
        threading.Thread(target=self._finish, name="viewer-second", daemon=True).start()

    def _finish(self) -> None:
        self.source.done.wait()
        self.store.loaded.wait()
        self._part()
        self.done.set()

    def _pass_on(self, notice: dict[str, Any]) -> None:
        if notice["type"] == "view" and notice["set"] not in _LEFT_OUT:
            stamp = int(notice["view"]["stamp"])
            self.store.put_view(SECOND + notice["set"], self.own.entry(notice["set"], stamp))
        elif notice["type"] == "part" and notice["part"] in ("dimensions", "contacts", "damage"):
            self._part()
        elif notice["type"] == "part" and notice["part"] == "volumes":
            fraction = self.source.parameters.carving.min_views_fraction
            for name, about in notice["value"].items():
                if name != "other" and self._passed.get(name) != about["rev"]:
                    self._passed[name] = about["rev"]
                    self.store.put_grid(
                        "b" if name == "main" else f"b_{name}", self.own.grids[name], fraction
                    )

    def _part(self) -> None:
        scene, first = self.own.scene(), self.store.scene()
        here, there = first["dimensions"] or {}, scene["dimensions"] or {}
        offset = [0.0, 0.0]
        if here.get("position_m") and there.get("position_m"):
            offset = [
                float(a) - float(b)
                for a, b in zip(here["position_m"][:2], there["position_m"][:2], strict=True)
            ]
        self.store.put_part(
            "other",
            {
                "title": scene["title"],
                "dimensions": scene["dimensions"],
                "contacts": [
                    {
                        "name": c["name"],
                        "position_m": [a + b for a, b in zip(c["position_m"], offset, strict=True)],
                        "dimensions": c["dimensions"],
                    }
                    for c in scene["contacts"]
                    if c["kind"] == "object"
                ],
                "damage": scene["damage"],
                "offset_m": offset,
                "moved_m": math.hypot(*offset),
            },
        )


__all__ = ["Second"]
