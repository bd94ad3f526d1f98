"""What the page of an archive shows: rows of the catalogue, points of the map, thumbnails."""

from __future__ import annotations

import io
import math
import threading
from collections import OrderedDict
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..archive.catalogue import RUNS
from ..archive.find import Found
from ..archive.layout import Archive, ArchiveError
from ..core.errors import CsasError, ParameterError

#: Columns of a row that the page shows.
COLUMNS = (
    *("time", "name", "number", "status", "verdict", "quality", "reason", "reasons", "why_no_object"),
    *("object", "length_m", "width_m", "height_m", "bearing_deg", "place_latitude_deg"),
    *("place_longitude_deg", "results"),
)
#: Rows of a table that a browser draws at once, and points of a map.
MOST_ROWS, MOST_POINTS = 500, 50_000
#: Columns that a choice is made of, and those that have a least and a most.
CHOICES, RANGES = ("verdict", "quality", "status"), ("length_m", "width_m", "height_m")
#: Thumbnails that are kept, some 5 kB each.
_KEPT = 1000
#: Sides of a thumbnail (px), and what is round the object as a share of it.
_SIDE, _MARGIN = 96, 0.15


class Content:
    """Asks the catalogue of an archive; any thread may.

    Parameters
    ----------
    root : path-like
        The archive.

    Raises
    ------
    CsasError
        If it has no catalogue, or a library is missing.
    """

    def __init__(self, root: str | Path) -> None:
        self.archive = Archive(root)
        self._lock = threading.Lock()
        self._found: Found | None = None
        self._revision = 0
        self._thumbnails: OrderedDict[tuple[str, int], bytes] = OrderedDict()
        with self._lock:
            self._current()

    def _current(self) -> Found:
        """Return the catalogue as it is now: a batch may be writing another one."""
        file = self.archive.catalogue / RUNS
        revision = file.stat().st_mtime_ns if file.exists() else 0
        if self._found is None or revision != self._revision:
            self._found, self._revision = Found(self.archive.root), revision
        return self._found.afresh()

    def _asked(self, asked: Mapping[str, str]) -> Found:
        found = self._current()
        for name in CHOICES:
            if value := asked.get(name, ""):
                found.where(f"{name} = {_text(value)}")
        for name in RANGES:
            for bound, sign in (("least", ">="), ("most", "<=")):
                if text := asked.get(f"{bound}_{name}", ""):
                    found.where(f"{name} {sign} {_number(name, text)!r}")
        if text := asked.get("text", ""):
            found.where(f"contains(lower(concat_ws(' ', name, reason, reasons)), lower({_text(text)}))")
        if where := asked.get("where", ""):
            found.where(where)
        return found

    def answer(self, asked: Mapping[str, str]) -> dict[str, Any]:
        """Return rows, points and choices for what is asked.

        Parameters
        ----------
        asked : mapping
            Text by name: `CHOICES`; ``least_`` and ``most_`` of `RANGES`; ``text``, which name or reasons
            hold; ``where``, an expression as of `find`.

        Raises
        ------
        CsasError
            If something asked for is none.
        """
        with self._lock:
            found = self._asked(asked)
            count, points = found.count(), []
            for row in found.columns(
                ("place_latitude_deg", "place_longitude_deg", "verdict", "results"), MOST_POINTS
            ):
                if row[0] is not None and row[1] is not None:
                    points.append([round(row[0], 8), round(row[1], 8), row[2] or "", row[3] or ""])
            rows = found.rows(MOST_ROWS)
            choices = {name: self._current().values(name) for name in CHOICES}
        return {
            "title": self.archive.root.name,
            "count": count,
            "rows": [{name: _ready(row.get(name)) for name in COLUMNS} for row in rows],
            "points": points,
            "choices": choices,
        }

    def folder_of(self, results: str) -> Path:
        """Return the results folder that a row names.

        Raises
        ------
        ArchiveError
            If no row does, or it is not in the archive.
        """
        with self._lock:
            known = self._current().where(f"results = {_text(results)}").count()
        folder = (self.archive.root / results).resolve()
        if not known or not folder.is_relative_to(self.archive.root.resolve()) or not folder.is_dir():
            raise ArchiveError(f"there are no results {results[:80]!r} in this archive")
        return folder

    def thumbnail(self, results: str) -> bytes:
        """Return a run's thumbnail: the heights of its target's plan, north up, as PNG."""
        folder = self.folder_of(results)
        grid = folder / "grid.npz"
        key = results, grid.stat().st_mtime_ns if grid.exists() else 0
        if (known := self._thumbnails.get(key)) is None:
            known = self._thumbnails[key] = _drawn(grid)
            while len(self._thumbnails) > _KEPT:
                self._thumbnails.popitem(last=False)
        return known


def _text(value: str) -> str:
    return "'" + value.replace("'", "''").replace("\0", "") + "'"


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ParameterError(f"{name} is {text[:40]!r}; expected a number")
    return value


def _ready(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.isoformat(sep=" ", timespec="seconds")
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _drawn(path: Path) -> bytes:
    from PIL import Image

    from ..maps.source import read_grid

    picture: NDArray[np.uint8] = np.full((_SIDE, _SIDE, 3), 24, np.uint8)
    try:
        grid, _ = read_grid(path)
    except CsasError:
        grid = None
    if grid is not None and grid.occupied.any():
        heights = (grid.occupied * (np.arange(grid.volume.shape[0]) + 1.0)[:, None, None]).max(axis=0)[::-1]
        rows, cols = np.nonzero(heights)
        half = (0.5 + _MARGIN) * max(np.ptp(rows) + 1, np.ptp(cols) + 1)
        # Nearest voxel of each pixel of a square round the object.
        at = (np.arange(_SIDE) + 0.5) / _SIDE * 2.0 - 1.0
        v = np.floor((rows.min() + rows.max() + 1) / 2 + half * at).astype(int)
        u = np.floor((cols.min() + cols.max() + 1) / 2 + half * at).astype(int)
        inside = ((v >= 0) & (v < heights.shape[0]))[:, None] & ((u >= 0) & (u < heights.shape[1]))[None]
        level = heights[v.clip(0, heights.shape[0] - 1)][:, u.clip(0, heights.shape[1] - 1)] * inside
        bright = np.where(level > 0, 0.35 + 0.65 * level / heights.max(), 0.0)[..., None]
        picture = np.where(bright > 0, bright * (255, 205, 110), picture).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "PNG")
    return out.getvalue()
