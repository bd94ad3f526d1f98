"""Questions to a catalogue, in SQL: what is longer than a metre, what is near, what was seen twice."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..core.errors import CsasError, check_range
from .catalogue import CONTACTS, RUNS, connection
from .extras import need
from .layout import Archive, ArchiveError
from .rows import CONTACT_COLUMNS, RUN_COLUMNS

#: Mean radius of the earth (m): a search radius needs no ellipsoid, which changes it by 0.3 % at most.
_EARTH_M = 6_371_000.0
#: 95 % intervals are compared as they stand. Where a result gives none for its position, it is taken to be so
#: wide (m): the length of a small mine.
_UNKNOWN_HALF_M = 1.0
#: Strips of latitude (m) in which objects are looked for that may be one: a few times an object's length.
_STRIP_M = 20.0
#: Interval columns that must overlap if two objects are to be one.
_COMPARED = (
    ("length_low_m", "length_high_m"),
    ("width_low_m", "width_high_m"),
    ("height_low_m", "height_high_m"),
)


class QueryError(CsasError, ValueError):
    """A question cannot be asked."""


class Found:
    """The catalogue of an archive as one table: a row an object, and a row each run without one.

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
        archive = Archive(root)
        need("pyarrow", "find", "archive")
        self._duckdb = need("duckdb", "find", "archive")
        files = {table: archive.catalogue / table for table in (RUNS, CONTACTS)}
        for file in files.values():
            if not file.exists():
                raise ArchiveError(
                    f"{archive.root} holds no catalogue; expected one by batch, or: csas-shadow catalogue"
                    f" {archive.root}"
                )
        self._db = connection(archive.root)
        for table, file in files.items():
            # Taken into memory, after which the expression of a user reaches no other file.
            self._db.execute(
                f"CREATE TABLE {table.partition('.')[0]} AS SELECT * EXCLUDE (geometry) FROM read_parquet(?)",
                [str(file)],
            )
        self._db.execute("SET enable_external_access = false")
        own = [name for name in CONTACT_COLUMNS if name not in RUN_COLUMNS]
        self._db.execute(
            f"""CREATE VIEW found AS SELECT r.*, {", ".join(f"c.{name}" for name in own)},
                coalesce(c.latitude_deg, r.origin_latitude_deg) AS place_latitude_deg,
                coalesce(c.longitude_deg, r.origin_longitude_deg) AS place_longitude_deg
            FROM runs r LEFT JOIN contacts c USING (task, number)"""
        )
        self._rows = self._db.table("found")

    def afresh(self) -> Found:
        """Take all rows again."""
        self._rows = self._db.table("found")
        return self

    def where(self, expression: str) -> Found:
        """Keep the rows for which an SQL expression over the columns is true.

        Raises
        ------
        QueryError
            If it is none.
        """
        try:
            self._rows = self._rows.filter(expression)
            self._rows.limit(0).fetchall()
        except self._duckdb.Error as error:
            line = " ".join(str(error).split("\n\n")[0].split())
            raise QueryError(f"--where is {expression!r}: {line}") from error
        return self

    def near(self, latitude_deg: float, longitude_deg: float, radius_m: float) -> Found:
        """Keep what lies in a circle: the object's place, or else the scene's."""
        check_range("latitude", latitude_deg, -90.0, 90.0, "deg")
        check_range("longitude", longitude_deg, -180.0, 360.0, "deg")
        check_range("radius", radius_m, 0.0, math.pi * _EARTH_M, "m")
        lat = "radians(place_latitude_deg)"
        half = (
            f"sin(({lat} - radians({latitude_deg!r})) / 2) ** 2 + cos({lat}) * cos(radians({latitude_deg!r}))"
            f" * sin(radians(place_longitude_deg - ({longitude_deg!r})) / 2) ** 2"
        )
        distance = f"{2 * _EARTH_M!r} * asin(sqrt(least(1.0, {half})))"
        self._rows = self._rows.filter(f"{distance} <= {radius_m!r}")
        return self

    def same(self) -> Found:
        """Keep objects that are in several runs, and number them: column ``contact``, one number an object.

        Two are one where their positions' intervals overlap east and north (the scenes' own uncertainty
        included) and so do those of length, width and height, as far as they have them. Who is one with a
        second that is one with a third is one with both. Objects without a place are left out.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        self._db.execute("DROP TABLE IF EXISTS candidates")
        self._rows.filter("object IS NOT NULL AND latitude_deg IS NOT NULL").create("candidates")
        per_degree = math.radians(1.0) * _EARTH_M
        overlap = " AND ".join(
            f"coalesce(a.{low} <= b.{high} AND b.{low} <= a.{high}, true)" for low, high in _COMPARED
        )
        self._db.execute(
            f"""CREATE OR REPLACE TEMP TABLE boxes AS SELECT row_number() OVER () - 1 AS id, *,
                (coalesce(north_half_m, {_UNKNOWN_HALF_M}) + coalesce(2 * position_sigma_m, 0))
                    / {per_degree} AS north_deg,
                (coalesce(east_half_m, {_UNKNOWN_HALF_M}) + coalesce(2 * position_sigma_m, 0))
                    / ({per_degree} * greatest(cos(radians(latitude_deg)), 1e-6)) AS east_deg
            FROM candidates"""
        )
        # Only what lies in a common strip of latitude is compared: no table of all with all.
        self._db.execute(
            f"""CREATE OR REPLACE TEMP TABLE strips AS
            SELECT id, unnest(range(
                floor((latitude_deg - north_deg) * {per_degree / _STRIP_M})::BIGINT,
                floor((latitude_deg + north_deg) * {per_degree / _STRIP_M})::BIGINT + 1)) AS strip
            FROM boxes"""
        )
        pairs = self._db.execute(
            f"""SELECT DISTINCT a.id, b.id FROM strips s JOIN strips t USING (strip)
                JOIN boxes a ON a.id = s.id JOIN boxes b ON b.id = t.id
                WHERE s.id < t.id AND abs(a.latitude_deg - b.latitude_deg) <= a.north_deg + b.north_deg
                AND abs((a.longitude_deg - b.longitude_deg + 540) % 360 - 180) <= a.east_deg + b.east_deg
                AND (a.task, a.number) <> (b.task, b.number) AND {overlap}"""
        ).fetchall()
        count = self._db.execute("SELECT count(*) FROM boxes").fetchone()[0]
        linked = sorted({number for pair in pairs for number in pair})
        self._db.execute("CREATE OR REPLACE TEMP TABLE named (id BIGINT, contact BIGINT)")
        if linked:
            first, second = zip(*pairs, strict=True)
            graph = coo_array(([1] * len(pairs), (first, second)), shape=(count, count))
            _, labels = connected_components(graph, directed=False)
            # Numbered from 1 in the order of their first rows.
            numbers: dict[int, int] = {}
            named = [(n, numbers.setdefault(int(labels[n]), len(numbers) + 1)) for n in linked]
            self._db.executemany("INSERT INTO named VALUES (?, ?)", named)
        self._db.execute(
            """CREATE OR REPLACE TEMP TABLE seen AS SELECT contact, boxes.* EXCLUDE (id, north_deg, east_deg)
                FROM boxes JOIN named USING (id) ORDER BY contact, time"""
        )
        self._rows = self._db.table("seen")
        return self

    def count(self) -> int:
        """Return how many rows there are."""
        return int(self._rows.aggregate("count(*)").fetchall()[0][0])

    def columns(self, names: Sequence[str], limit: int) -> list[tuple[Any, ...]]:
        """Return some columns of the rows, in no order."""
        rows: list[tuple[Any, ...]] = self._rows.project(", ".join(names)).limit(limit).fetchall()
        return rows

    def values(self, name: str) -> list[str]:
        """Return what a column holds, each value once."""
        rows = self._rows.filter(f"{name} IS NOT NULL").project(name).distinct().order(name).fetchall()
        return [str(row[0]) for row in rows]

    def rows(self, limit: int | None = None) -> list[dict[str, Any]]:
        """Return the rows as dictionaries, in time."""
        order = "contact, time" if "contact" in self._rows.columns else "time, task, number, object"
        found = self._rows.order(order)
        if limit is not None:
            found = found.limit(limit)
        names: Sequence[str] = found.columns
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def table_of(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows as a table to read: what tells one from another."""
    if not rows:
        return "nothing found"
    numbered = "contact" in rows[0]
    head = [
        *(["contact"] if numbered else []),
        "time (UTC)",
        "run",
        "found",
        "quality",
        "length",
        "width",
        "height",
    ]
    head += ["place", "results"]
    lines = [head]
    for row in rows:
        name = row["name"] + (f" #{row['number']}" if row["number"] != 1 else "")
        what = row["verdict"] or row["status"]
        if row["object"] is not None:
            what += f" {row['object']}"
        sizes = ["-" if row[n] is None else f"{row[n]:.2f} m" for n in ("length_m", "width_m", "height_m")]
        place = "-"
        if row["place_latitude_deg"] is not None:
            place = f"{row['place_latitude_deg']:.6f} {row['place_longitude_deg']:.6f}"
        elif row["x_m"] is not None:
            place = f"x {row['x_m']:.2f} y {row['y_m']:.2f} m"
        when = row["time"].strftime("%Y-%m-%d %H:%M:%S") if row["time"] else "-"
        results = row["results"] or row["reason"] or "-"
        cells = [when, name, what, row["quality"] or "-", *sizes, place, results]
        lines.append([*([str(row["contact"])] if numbered else []), *cells])
    widths = [max(len(line[n]) for line in lines) for n in range(len(head))]
    return "\n".join(
        "  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in lines
    )
