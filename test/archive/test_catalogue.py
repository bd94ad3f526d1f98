"""The catalogue: what reports say, in tables that other programs read, and questions to them."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("pyarrow", reason="extra archive is not installed")
pytest.importorskip("duckdb", reason="extra archive is not installed")

import pyarrow.parquet as pq

from csas_shadow_ros import parameters, process_bag
from csas_shadow_ros.archive import catalogue as catalogue_module
from csas_shadow_ros.archive.catalogue import Catalogue, connection, rebuild
from csas_shadow_ros.archive.find import Found, QueryError, table_of
from csas_shadow_ros.archive.layout import Archive, ArchiveError
from csas_shadow_ros.archive.rows import CONTACT_COLUMNS, RUN_COLUMNS, Rows
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.core.geometry import Datum
from csas_shadow_ros.results import read_report

BREST = Datum(48.36, -4.55)

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def results(tiny_box_bag, tmp_path_factory):
    """A results folder by `process_bag`, in a folder of its own."""
    out = tmp_path_factory.mktemp("plain") / "box"
    chosen = parameters(step_deg=15.0, voxel_size_m=0.04)
    process_bag(tiny_box_bag.path, out, chosen, write_bag=False, figures=False, durable=False)
    return out


def with_origin(results: Path, to: Path, **origin: float) -> dict:
    """Copy a results folder, with a place of its scene's origin in the report."""
    shutil.copytree(results, to)
    report = read_report(to)
    datum = Datum(**origin)
    report["datum"] = dataclasses.asdict(datum)
    for entry in report["objects"]:
        latitude, longitude = datum.to_latlon(*entry["position_m"])
        bearing = datum.bearing_deg(entry["dimensions"]["heading_rad"])
        entry["place"] = {"latitude_deg": latitude, "longitude_deg": longitude, "bearing_deg": bearing}
    (to / "report.json").write_text(json.dumps(report))
    return report


def contact(name: str, east_m: float, north_m: float, length_m: float = 1.0, **more) -> Rows:
    """Return rows of a run with one object, so far from Brest."""
    latitude, longitude = BREST.to_latlon(east_m, north_m)
    shared = {"task": name, "bag": name, "name": name, "number": 1, "finished": 1, "verdict": "object"}
    half = {"east_half_m": 0.1, "north_half_m": 0.1}
    sizes = {"length_m": length_m, "length_low_m": length_m - 0.1, "length_high_m": length_m + 0.1}
    place = {"latitude_deg": latitude, "longitude_deg": longitude}
    return Rows(
        [{**shared, "status": "done", "quality": "good", "objects": 1}],
        [{**shared, "object": 1, **sizes, **half, **place, **more}],
    )


def archive_of(folder: Path, *rows: Rows) -> Path:
    archive = Archive(folder)
    archive.make()
    made = Catalogue(archive)
    for one in rows:
        made.add(one)
    made.merge()
    return folder


def names(found: Found) -> list[str]:
    return [row["name"] for row in found.rows()]


def test_rows_say_what_the_report_says(results):
    assert rebuild(results.parent) == 1
    report = read_report(results)
    (row,) = Found(results.parent).rows()
    d = report["objects"][0]["dimensions"]
    assert row["results"] == "box"
    assert row["bag"] == report["input"]["path"]
    assert (row["verdict"], row["quality"]) == (report["verdict"], report["quality"]["verdict"])
    assert row["reasons"] == "; ".join(report["quality"]["reasons"])
    assert row["run_ns"] == report["run"]
    assert row["time"].timestamp() != 0
    assert row["length_m"] == d["length_m"]
    assert row["heading_deg"] == pytest.approx(d["heading_deg"])
    for name, (low, high) in d["intervals"].items():
        if name in ("length_m", "width_m", "height_m"):
            assert (row[f"{name[:-2]}_low_m"], row[f"{name[:-2]}_high_m"]) == (low, high)
    assert row["iou_truth"] == report["truth"]["scores"]["iou_truth"]
    assert json.loads(row["versions"]) == report["versions"]
    assert row["latitude_deg"] is None
    assert (results.parent / row["mesh"]).is_file()


def test_an_object_of_a_scene_with_a_place_has_one_too(results, tmp_path):
    report = with_origin(
        results,
        tmp_path / "r",
        latitude_deg=BREST.latitude_deg,
        longitude_deg=BREST.longitude_deg,
        heading_deg=30.0,
        covariance_m2=(4.0, 1.0, 0.0),
    )
    rebuild(tmp_path)
    (row,) = Found(tmp_path).rows()
    for name, value in report["objects"][0]["place"].items():
        assert row[name] == value
    assert row["position_sigma_m"] == 2.0
    assert row["east_half_m"] > 0.0


def test_pandas_and_geopandas_read_the_tables_as_they_are(results, tmp_path):
    import pandas

    with_origin(results, tmp_path / "r", latitude_deg=BREST.latitude_deg, longitude_deg=BREST.longitude_deg)
    shutil.copytree(results, tmp_path / "nowhere")
    rebuild(tmp_path)
    runs = pandas.read_parquet(tmp_path / "catalogue" / "runs.parquet")
    contacts = pandas.read_parquet(tmp_path / "catalogue" / "contacts.parquet")
    assert [*RUN_COLUMNS, "geometry"] == list(runs.columns)
    assert [*CONTACT_COLUMNS, "geometry"] == list(contacts.columns)
    assert sorted(runs.results) == ["nowhere", "r"]
    assert runs.time.dt.year.tolist() == [2023, 2023]
    assert contacts.length_m.gt(0).all()
    # GeoParquet's promise, as its specification has it.
    geo = json.loads(pq.read_schema(tmp_path / "catalogue" / "contacts.parquet").metadata[b"geo"])
    assert geo["primary_column"] == "geometry"
    assert geo["columns"]["geometry"]["encoding"] == "WKB"
    geopandas = pytest.importorskip("geopandas", reason="geopandas is not installed")
    points = geopandas.read_parquet(tmp_path / "catalogue" / "contacts.parquet")
    point = points[points.results == "r"].geometry.iloc[0]
    row = contacts[contacts.results == "r"].iloc[0]
    assert (point.x, point.y) == (row.longitude_deg, row.latitude_deg)
    assert points.crs.to_epsg() in (4326, None)
    assert points[points.results == "nowhere"].geometry.isna().all()


def test_a_task_whose_rows_come_again_has_them_once(tmp_path, monkeypatch):
    monkeypatch.setattr(catalogue_module, "_PART_TASKS", 1)
    old, new = contact("a", 0, 0), contact("a", 50, 0)
    for row in (*new.runs, *new.contacts):
        row["finished"] = 2
    folder = archive_of(tmp_path / "x", new, old, contact("b", 0, 0), new)
    assert names(Found(folder)) == ["a", "b"]
    assert Found(folder).near(*BREST.to_latlon(50, 0), 1.0).rows()[0]["name"] == "a"
    archive_of(folder, new, contact("c", 1, 1))
    assert names(Found(folder)) == ["a", "b", "c"]


def test_rows_that_a_killed_batch_left_as_parts_are_taken_up(tmp_path):
    folder = archive_of(tmp_path / "x", contact("a", 0, 0))
    killed = Catalogue(Archive(folder))
    killed.add(contact("b", 0, 0))
    killed.flush()
    assert names(Found(folder)) == ["a"]
    assert {row[0] for row in Catalogue(Archive(folder)).known()} == {"a", "b"}
    assert Catalogue(Archive(folder)).merge() == 2
    assert names(Found(folder)) == ["a", "b"]
    assert not list((folder / ".parts").rglob("*.parquet"))


def test_parts_that_are_merged_but_not_removed_yet_count_once(tmp_path, monkeypatch):
    folder = archive_of(tmp_path / "x", contact("a", 0, 0))
    writer = Catalogue(Archive(folder))
    writer.add(contact("b", 0, 0))
    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", lambda *_, **__: None)  # as if it had been killed before
        writer.merge()
    assert list((folder / ".parts").rglob("*.parquet"))
    assert Catalogue(Archive(folder)).merge() == 2
    assert names(Found(folder)) == ["a", "b"]


def test_where_takes_sql_over_the_columns_and_nothing_else(tmp_path):
    failed = Rows([{"task": "f", "bag": "f", "name": "f", "number": 1, "finished": 1, "status": "failed",
                    "reason": "it is empty"}])  # fmt: skip
    folder = archive_of(tmp_path / "x", contact("short", 0, 0, 0.5), contact("long", 9, 9, 2.0), failed)
    assert names(Found(folder).where("length_m > 1 and verdict == 'object'")) == ["long"]
    assert names(Found(folder).where("status = 'failed'")) == ["f"]
    assert names(Found(folder).where("object is null or length_m < 1")) == ["f", "short"]
    assert Found(folder).where("length_m > 100").rows() == []
    with pytest.raises(QueryError, match=r'^--where is \'lenght > 1\': .*"lenght" not found'):
        Found(folder).where("lenght > 1")
    for bad in ("1 = 1; DROP TABLE runs", "length_m >", "length_m > 1 UNION SELECT 1"):
        with pytest.raises(QueryError, match="--where is"):
            Found(folder).where(bad)
    secret = tmp_path / "secret.csv"
    secret.write_text("a\n1\n")
    with pytest.raises(QueryError, match=r"(?i)disabled|permission"):
        Found(folder).where(f"exists (select * from read_csv('{secret}'))")


def test_near_is_a_circle_on_the_earth_also_across_the_date_line(tmp_path):
    folder = archive_of(tmp_path / "x", contact("here", 3, 4), contact("there", 60, 80))
    assert names(Found(folder).near(BREST.latitude_deg, BREST.longitude_deg, 5.1)) == ["here"]
    assert names(Found(folder).near(BREST.latitude_deg, BREST.longitude_deg, 4.9)) == []
    assert names(Found(folder).near(BREST.latitude_deg, BREST.longitude_deg, 101)) == ["here", "there"]
    line = contact("line", 0, 0, latitude_deg=0.0, longitude_deg=-179.9999)
    other = archive_of(tmp_path / "y", line)
    assert names(Found(other).near(0.0, 179.9999, 30.0)) == ["line"]
    with pytest.raises(ParameterError, match=r"latitude is 91\.0 deg; expected"):
        Found(folder).near(91.0, 0.0, 1.0)


def test_the_same_contact_is_one_whose_place_and_sizes_overlap(tmp_path):
    folder = archive_of(
        tmp_path / "x",
        contact("first", 0, 0, 1.0),
        contact("again", 0.15, -0.1, 1.1),
        contact("beside", 0.35, 0, 1.0),
        contact("other size", 0, 0, 1.5),
        contact("far", 30, 0, 1.0),
        contact("far again", 31, 0, 1.0, position_sigma_m=0.6),
        contact("no place", 0, 0, latitude_deg=None, longitude_deg=None),
    )
    rows = Found(folder).same().rows()
    groups: dict[int, set[str]] = {}
    for row in rows:
        groups.setdefault(row["contact"], set()).add(row["name"])
    # `beside` is 0.35 m from the first, whose intervals end half-way at 0.2 m, but touches `again`.
    assert list(groups.values()) == [{"first", "again", "beside"}, {"far", "far again"}]
    assert names(Found(folder).where("name <> 'again'").same()) == ["far", "far again"]
    one_run = contact("twice", 0, 0)
    one_run.contacts.append({**one_run.contacts[0], "object": 2})
    assert Found(archive_of(tmp_path / "y", one_run)).same().rows() == []


def test_an_empty_catalogue_can_be_read_and_asked(tmp_path):
    folder = archive_of(tmp_path / "x")
    assert pq.read_table(folder / "catalogue" / "runs.parquet").num_rows == 0
    assert table_of(Found(folder).where("length_m > 1").same().rows()) == "nothing found"
    with pytest.raises(ArchiveError, match="holds no catalogue; expected one by batch"):
        Found(tmp_path)
    with pytest.raises(ArchiveError, match="is not a folder; expected an archive"):
        rebuild(tmp_path / "gone")


def test_the_command_line_finds(results, tmp_path, capsys):
    shutil.copytree(results, tmp_path / "r")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "report.json").write_text("{")
    assert main(["catalogue", str(tmp_path), "--quiet"]) == 0
    assert capsys.readouterr().out == f"catalogue of 2 runs: {tmp_path}\n"
    assert main(["find", str(tmp_path), "--where", "length_m > 0.1", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["results"] == "r"
    assert row["time"].startswith("2023-11-14")
    assert main(["find", str(tmp_path), "--limit", "1"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
    assert main(["find", str(tmp_path), "--where", "nothing"]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_a_question_that_takes_long_puts_no_bar_into_the_answer(tmp_path):
    with connection(tmp_path) as db:
        assert db.execute("SELECT current_setting('enable_progress_bar')").fetchall() == [(False,)]


_MERGE = """
import re, sys
import pyarrow as pa, pyarrow.parquet as pq
from csas_shadow_ros.archive.catalogue import Catalogue, schema_of, TABLES
from csas_shadow_ros.archive.layout import Archive

archive, parts = Archive(sys.argv[1]), int(sys.argv[2])
archive.make()
catalogue = Catalogue(archive)
for part in range(parts):
    numbers = range(part * 5000, (part + 1) * 5000)
    for table in TABLES:
        schema = schema_of(table)
        kinds = {pa.string(): lambda n: f"{n:064d}", pa.timestamp("us"): int, pa.int64(): int}
        columns = {
            field.name: pa.array([kinds[field.type](n) for n in numbers], field.type)
            if field.type in kinds else pa.nulls(5000, field.type)
            for field in schema
        }
        folder = archive.parts / table.partition(".")[0]
        folder.mkdir(parents=True, exist_ok=True)
        data = pa.table(columns, schema=schema)
        pq.write_table(data, folder / f"{part:020d}-1-1.parquet", compression="zstd")
del columns
assert catalogue.merge() == 5000 * parts
print(int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1]) / 1000.0)
"""


@pytest.mark.long
def test_the_memory_of_a_merge_does_not_grow_with_the_catalogue(tmp_path):
    def megabytes(parts: int) -> float:
        command = [sys.executable, "-c", _MERGE, str(tmp_path / str(parts)), str(parts)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
        assert done.returncode == 0, done.stderr
        return float(done.stdout)

    # 90 000 more rows of 2 kB are 180 MB: what is sorted or held whole is at least that.
    assert megabytes(20) - megabytes(2) < 120.0
