"""The catalogue: two Parquet tables, a row a run and a row an object, that any tool reads as they are.

Rows that come are written as small parts and merged into the tables now and then, so that neither memory nor
writing grows with the archive: a merge reads, joins and writes a row group at a time, and sorts nothing.
Nothing is only in here: `rebuild` makes it from the folders.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..durable import Place
from .extras import need
from .layout import FAILED_STATUS, Archive, ArchiveError, replace_text, walk
from .rows import CONTACT_COLUMNS, RUN_COLUMNS, Rows, rows_of

RUNS, CONTACTS = "runs.parquet", "contacts.parquet"
#: Tables, their columns, and where a row's place is (latitude, longitude).
TABLES: dict[str, tuple[dict[str, str], tuple[str, str]]] = {
    RUNS: (RUN_COLUMNS, ("origin_latitude_deg", "origin_longitude_deg")),
    CONTACTS: (CONTACT_COLUMNS, ("latitude_deg", "longitude_deg")),
}
#: GeoParquet 1.1: longitude and latitude of WGS 84, points; null where a row has no place.
_GEO = {
    "version": "1.1.0",
    "primary_column": "geometry",
    "columns": {"geometry": {"encoding": "WKB", "geometry_types": ["Point"]}},
}
_MERGED = b"csas_merged"
#: A part is written when it has so many tasks, or is so old (s): what a killed batch asks the folders for.
_PART_TASKS, _PART_S = 500, 20.0
#: Parts are merged when they hold this share of the table's rows, and so many at least: each row is then
#: written about ten times on its way to a full archive.
_MERGE_SHARE, _MERGE_ROWS = 0.1, 1000
#: Rows of a row group: what a reader takes into memory at once.
_GROUP = 10_000
#: Memory (bytes) of the merge; beyond it, it goes to the disk.
_MERGE_MEMORY = "128MB"


def _arrow() -> tuple[Any, Any]:
    return need("pyarrow", "the catalogue", "archive"), need("pyarrow.parquet", "the catalogue", "archive")


def connection(folder: Path) -> Any:
    """Open DuckDB in memory; what does not fit goes to a folder."""
    duckdb = need("duckdb", "the catalogue", "archive")
    settings = {
        "memory_limit": _MERGE_MEMORY,
        "temp_directory": str(folder / ".spilled"),
        "threads": 1,
        "preserve_insertion_order": False,
    }
    db = duckdb.connect(config=settings)
    # On stdout, where the answer goes: of any question that takes two seconds.
    db.execute("SET enable_progress_bar = false")
    return db


def schema_of(table: str) -> Any:
    """Return the Arrow schema of a table."""
    pa, _ = _arrow()
    kinds = {
        "text": pa.string(),
        "whole": pa.int64(),
        "number": pa.float64(),
        "truth": pa.bool_(),
        "time": pa.timestamp("us"),
    }
    columns, _ = TABLES[table]
    fields = [pa.field(name, kinds[kind]) for name, kind in columns.items()]
    return pa.schema([*fields, pa.field("geometry", pa.binary())], metadata={"geo": json.dumps(_GEO)})


def _points(latitudes: Sequence[Any], longitudes: Sequence[Any]) -> list[bytes | None]:
    return [
        None if lat is None or lon is None else struct.pack("<BIdd", 1, 1, lon, lat)
        for lat, lon in zip(latitudes, longitudes, strict=True)
    ]


def _table(table: str, rows: Sequence[Mapping[str, Any]]) -> Any:
    pa, _ = _arrow()
    schema = schema_of(table)
    columns, (lat, lon) = TABLES[table]
    data = {name: [row.get(name) for row in rows] for name in columns}
    data["geometry"] = _points(data[lat], data[lon])
    return pa.table(data, schema=schema)


class Catalogue:
    """The tables of an archive, for the one process that writes them.

    Parameters
    ----------
    archive : Archive
        What they are of.

    Raises
    ------
    MissingExtraError
        If pyarrow or DuckDB is not installed.
    """

    def __init__(self, archive: Archive) -> None:
        self.archive = archive
        _arrow()
        need("duckdb", "the catalogue", "archive")
        self._waiting = Rows()
        self._tasks, self._since = 0, time.monotonic()
        self._serial = 0
        self._part_rows = sum(self._count(p) for p in self._parts())

    def add(self, rows: Rows) -> None:
        """Take the rows of a task."""
        self._waiting.runs += rows.runs
        self._waiting.contacts += rows.contacts
        self._tasks += 1
        self.tick()

    def tick(self) -> None:
        """Write what has waited for long."""
        if self._tasks >= _PART_TASKS or (self._tasks and time.monotonic() - self._since > _PART_S):
            self.flush()
            main = self.archive.catalogue / RUNS
            there = self._count(main) if main.exists() else 0
            if self._part_rows > max(_MERGE_ROWS, _MERGE_SHARE * there):
                self.merge()

    def flush(self) -> None:
        """Write the rows that wait as a part."""
        if self._tasks:
            _, pq = _arrow()
            name = f"{time.time_ns():020d}-{os.getpid()}-{self._serial}.parquet"
            self._serial += 1
            # The runs' part last: a part is what has one.
            for table, rows in ((CONTACTS, self._waiting.contacts), (RUNS, self._waiting.runs)):
                folder = self.archive.parts / table.partition(".")[0]
                folder.mkdir(parents=True, exist_ok=True)
                part = folder / f".{name}"
                pq.write_table(_table(table, rows), part, compression="zstd")
                part.replace(folder / name)
            self._part_rows += len(self._waiting.runs)
            self._waiting, self._tasks = Rows(), 0
        self._since = time.monotonic()

    def _count(self, file: Path) -> int:
        _, pq = _arrow()
        return int(pq.read_metadata(file).num_rows)

    def _parts(self) -> list[Path]:
        """Return the parts that are not in the tables yet."""
        _, pq = _arrow()
        merged: set[str] = set()
        main = self.archive.catalogue / RUNS
        if main.exists():
            metadata = pq.read_metadata(main).metadata or {}
            merged = set(json.loads(metadata.get(_MERGED, b"[]")))
        found = sorted((self.archive.parts / "runs").glob("[0-9]*.parquet"))
        return [part for part in found if part.name not in merged]

    def known(self) -> Iterator[tuple[str, str, str, str, bool, int]]:
        """Iterate bag, signature, options, version, whether a run of it failed, and its runs; the newest."""
        parts, main = self._parts(), self.archive.catalogue / RUNS
        if not parts and not main.exists():
            return
        with connection(self.archive.root) as db:
            every = _every(main if main.exists() else None, parts)
            found = db.execute(
                f"""WITH every AS ({every}), newest AS ({_NEWEST})
                SELECT task, any_value(signature), any_value(options), any_value(version),
                       bool_or(status = '{FAILED_STATUS}'), count(*)
                FROM every SEMI JOIN newest USING (task, finished, src) GROUP BY task"""
            )
            while rows := found.fetchmany(_GROUP):
                yield from rows

    def merge(self, *, anew: bool = False) -> int:
        """Merge the parts into the tables and write ``failed.txt``; return how many runs there are.

        Parameters
        ----------
        anew : bool
            Of the parts alone: what is in the tables now is left out.
        """
        pa, pq = _arrow()
        self.flush()
        parts, mains = self._parts(), {t: self.archive.catalogue / t for t in TABLES}
        for table in TABLES:  # a first table has its columns even if nothing is in it
            (self.archive.parts / table.partition(".")[0]).mkdir(parents=True, exist_ok=True)
        there = not anew and all(path.exists() for path in mains.values())
        if there and not parts:
            return self._count(mains[RUNS])
        place, total = Place(self.archive.catalogue), 0
        place.clear(lambda _: None)
        work = place.make()
        try:
            with connection(self.archive.root) as db:
                runs = _every(mains[RUNS] if there else None, parts)
                if parts or there:
                    db.execute(
                        f"CREATE TEMP TABLE chosen AS WITH every AS ({runs}), newest AS ({_NEWEST}) {_CHOSEN}"
                    )
                for table, (_, (lat, lon)) in TABLES.items():
                    schema = schema_of(table)
                    metadata = {**schema.metadata, _MERGED: json.dumps([p.name for p in parts]).encode()}
                    schema = schema.with_metadata(metadata)
                    with pq.ParquetWriter(work / table, schema, compression="zstd") as writer:
                        if not parts and not there:
                            continue
                        mine = [p.parents[1] / table.partition(".")[0] / p.name for p in parts]
                        rows = db.sql(
                            f"SELECT * EXCLUDE (src) FROM ({_every(mains[table] if there else None, mine)})"
                            " SEMI JOIN chosen USING (task, finished, src)"
                        )
                        for batch in _batches(rows):
                            total += batch.num_rows if table == RUNS else 0
                            points = _points(batch.column(lat).to_pylist(), batch.column(lon).to_pylist())
                            whole = [
                                batch.column(name).cast(schema.field(name).type) for name in schema.names[:-1]
                            ]
                            whole.append(pa.array(points, pa.binary()))
                            writer.write_batch(pa.record_batch(whole, schema=schema), row_group_size=_GROUP)
                self._list_failures(db, work / RUNS)
            place.put(replace=True, durable=True)
        except BaseException:
            place.abandon()
            raise
        for part in parts:
            for folder in self.archive.parts.iterdir():
                (folder / part.name).unlink(missing_ok=True)
        shutil.rmtree(self.archive.root / ".spilled", ignore_errors=True)
        self._part_rows = 0
        return total

    def _list_failures(self, db: Any, runs: Path) -> None:
        """Write ``failed.txt``: a line a failed run, its bag and the reason."""
        failed = db.execute(
            "SELECT bag, number, reason FROM read_parquet(?)"
            f" WHERE status = '{FAILED_STATUS}' ORDER BY bag, number",
            [str(runs)],
        ).fetchall()
        replace_text(self.archive.failed, "".join(failed_line(*row) for row in failed))


def _batches(rows: Any) -> Iterator[Any]:
    """Iterate the rows of a query, a row group at a time."""
    # DuckDB renamed it, and warns of the old name.
    read = rows.to_arrow_reader if hasattr(rows, "to_arrow_reader") else rows.fetch_arrow_reader
    yield from read(_GROUP)


def failed_line(bag: str, number: int, reason: str) -> str:
    """Return the line of ``failed.txt``: bag, a tab, the reason."""
    return f"{bag}{'' if number == 1 else f' (run {number})'}\t{reason}\n"


#: Of every bag, what ended last; of a task whose rows came twice, the rows of one part.
_NEWEST = """
    SELECT task, k.finished AS finished, k.src AS src FROM (
        SELECT task, max({'finished': finished, 'src': src}) AS k FROM every GROUP BY task)"""
#: Of bags that hold the same and have a result, the one that was seen last: the others were moved.
_CHOSEN = """,
    mine AS (SELECT every.* FROM every SEMI JOIN newest USING (task, finished, src)),
    owner AS (SELECT content, arg_max(task, finished) AS task FROM mine
              WHERE status <> 'copy' AND content <> '' GROUP BY content)
    SELECT DISTINCT mine.task AS task, mine.finished AS finished, mine.src AS src
    FROM mine LEFT JOIN owner ON mine.content = owner.content AND mine.status <> 'copy'
    WHERE owner.task IS NULL OR owner.task = mine.task"""


def _every(main: Path | None, parts: Sequence[Path]) -> str:
    """Return the query of all rows of a table and its parts; `src` is where a row stands."""
    queries = []
    if main is not None:
        queries.append(f"SELECT * EXCLUDE (geometry), '' AS src FROM read_parquet({_quoted(main)})")
    if parts:
        files = ", ".join(map(_quoted, parts))
        queries.append(
            "SELECT * EXCLUDE (geometry, filename), parse_filename(filename) AS src"
            f" FROM read_parquet([{files}], filename = true, union_by_name = true)"
        )
    return " UNION ALL BY NAME ".join(queries)


def _quoted(path: Path) -> str:
    # A name is no pattern here, and a quote in it ends nothing.
    text = "".join(f"[{c}]" if c in "*?[" else c for c in str(path))
    return "'" + text.replace("'", "''") + "'"


def rebuild(root: str | Path, progress: Callable[[int], None] = lambda _: None) -> int:
    """Make the catalogue of a folder anew from the results that lie in it; return how many runs there are.

    Parameters
    ----------
    root : path-like
        An archive, or any folder with results folders below it.
    progress : callable, optional
        Called with the number of tasks read so far.

    Raises
    ------
    CsasError
        If there is no such folder, somebody else is writing it, or a library is missing.
    """
    archive = Archive(root)
    if not archive.root.is_dir():
        raise ArchiveError(f"{archive.root} is not a folder; expected an archive")
    with archive.held():
        catalogue = Catalogue(archive)
        shutil.rmtree(archive.parts, ignore_errors=True)
        catalogue._part_rows = 0
        for number, (folder, record) in enumerate(walk(archive.root), start=1):
            rows = rows_of(folder, record, archive.root)
            catalogue._waiting.runs += rows.runs
            catalogue._waiting.contacts += rows.contacts
            catalogue._tasks += 1
            if catalogue._tasks >= _PART_TASKS:
                catalogue.flush()
            progress(number)
        return catalogue.merge(anew=True)
