"""What goes on a chart lies where it is, and programs that do not know us read it."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyproj
import pytest

import csas_shadow_ros as csas
from csas_shadow_ros.bags import BagReader, iterate_pairs
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.errors import MissingExtraError, ParameterError
from csas_shadow_ros.core.geometry import GroundGrid
from csas_shadow_ros.core.parameters import PlaceParameters
from csas_shadow_ros.maps import export_result
from csas_shadow_ros.maps.crs import affine_of, chart_wkt
from csas_shadow_ros.maps.source import MapError, MapSource
from csas_shadow_ros.results import ResultsError

READER = Path(__file__).with_name("reading.py")
ORIGIN = 48.3829, -4.4953
TRUTH = 0.1, -0.15
HEADING_DEG = 20.0
#: What acceptance asks for.
NEAR_M = 0.05


def read(folder: Path, origin: tuple[float, float] | None) -> dict[str, dict]:
    """Read a folder in a process that knows nothing of this package."""
    command = [sys.executable, "-I", str(READER), str(folder), *map(str, origin or ())]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def apart(one, other=TRUTH) -> float:
    return math.hypot(one[0] - other[0], one[1] - other[1])


@pytest.fixture(scope="session")
def results(tmp_path_factory) -> Path:
    """Results of a box of 0.8 m × 0.4 m with a datum."""
    folder = tmp_path_factory.mktemp("maps")
    csas.simulate_bag(
        folder / "bag",
        "tiny",
        "box",
        seed=5,
        heading_deg=HEADING_DEG,
        position_m=TRUTH,
        datum=csas.Datum(*ORIGIN, covariance_m2=(1.0, 4.0, 0.0)),
    )
    coarse = csas.parameters(step_deg=15.0, voxel_size_m=0.04)
    csas.process_bag(folder / "bag", folder / "results", coarse, figures=False, durable=False)
    return folder / "results"


@pytest.fixture(scope="session")
def read_back(results, tmp_path_factory) -> dict[str, dict]:
    out = tmp_path_factory.mktemp("out") / "maps"
    done = export_result(results, out)
    told = read(out, ORIGIN)
    assert set(done.files) == set(told)
    assert not done.left_out
    return told


@pytest.fixture
def changed(results, tmp_path):
    """Give what makes a copy of the results whose report is another."""

    def make(**values) -> Path:
        folder = tmp_path / "changed"
        shutil.copytree(results, folder)
        report = json.loads((folder / "report.json").read_text())
        (folder / "report.json").write_text(json.dumps(report | values))
        return folder

    return make


def test_contacts_lie_within_5_cm_of_the_truth(read_back):
    for name in ("contacts.geojson", "contacts.gpkg", "contacts.kml"):
        told = read_back[name]
        assert told["count"] == 1
        assert "WGS 84" in told["crs"]
        assert apart(told["metres"][0]) < NEAR_M
        assert told["lengths"][0] == pytest.approx(0.8, abs=0.1)
        assert {"verdict", "quality", "bearing_deg", "length_low_m", "sigma_north_m"} <= set(told["columns"])
    assert read_back["contacts.gpkg"]["layers"] == ["contacts", "outlines"]
    assert read_back["contacts.gpkg"]["areas"][0] == pytest.approx(0.8 * 0.4, rel=0.2)


def test_the_height_lies_within_5_cm_of_the_truth_and_is_turned_as_it_is(read_back):
    told = read_back["height.tif"]
    assert told["projected"]
    assert told["unit"] == "m"
    plan = np.array(told["plan_m"])
    assert apart(plan.mean(axis=0)) < NEAR_M
    values, vectors = np.linalg.eigh(np.cov(plan.T))
    along = vectors[:, values.argmax()]
    turned = math.degrees(math.atan2(along[1], along[0]) - math.radians(HEADING_DEG))
    assert abs((turned + 90.0) % 180.0 - 90.0) < 6.0  # a mirrored one is 40 degrees off
    assert 0.3 < told["max"] < 0.6


def test_pixels_of_pictures_lie_where_the_scene_has_them(read_back, results):
    pair = list(iterate_pairs(BagReader(results / "result.mcap"), "multilook", print))[-1]
    p = np.asarray(pair.info.p).reshape(3, 4)
    rows, cols = int(pair.info.height), int(pair.info.width)
    corners = [((u - p[0, 3]) / p[0, 0], (v - p[1, 3]) / p[1, 1]) for u, v in ((0, 0), (cols - 1, rows - 1))]
    for name, bands in (("multilook.tif", 1), ("color_by_aspect.tif", 3), ("shadow_free.tif", 1)):
        told = read_back[name]
        assert (told["shape"], told["bands"], told["layout"]) == ([rows, cols], bands, "COG")
        for found, true in zip(told["corners_m"], corners, strict=True):
            assert apart(found, true) < 1e-4


def test_shadow_free_is_the_multilook_where_no_shadow_fell_and_lighter_behind_the_target(results):
    rasters = {one.name: one for one in MapSource(results).rasters}
    grid = rasters["multilook"].grid
    ratio = rasters["shadow_free"].pixels / rasters["multilook"].pixels
    x, y = np.meshgrid(grid.x_of_columns() - TRUTH[0], grid.y_of_rows() - TRUTH[1])
    away = np.hypot(x, y)
    assert np.nanmax(abs(ratio[away > 1.6] - 1.0)) < 1e-5
    assert np.nanmedian(ratio[(away > 0.5) & (away < 0.8)]) > 1.05


def test_netcdf_and_zarr_hold_the_grid_on_the_chart(read_back, results):
    grid = np.load(results / "grid.npz")
    for name in ("grid.nc", "grid.zarr"):
        told = read_back[name]
        assert told["conventions"] == "CF-1.11"
        assert told["occupied"] == np.count_nonzero(grid["occupied"])
        assert told["sum"] == pytest.approx(np.nansum(grid["likelihood"], dtype=float), rel=1e-5)
        assert told["mapping"] == "transverse_mercator"
        assert told["names"] == {"z": "height"} | {axis: f"projection_{axis}_coordinate" for axis in "xy"}
        assert np.abs(told["apart_deg"]).max() < 1e-10
        assert apart(told["middle_m"]) < NEAR_M
        assert {"multilook", "shadow_free", "matter", "views"} <= set(told["variables"])


@pytest.mark.parametrize("place", [(48.3829, -4.4953), (-33.86, 151.21), (0.0, 0.0), (-77.8, -179.9999)])
@pytest.mark.parametrize(("heading_deg", "altitude_m"), [(0.0, 0.0), (37.0, 120.0), (-120.0, -5000.0)])
def test_the_chart_is_the_plane_of_the_scene(place, heading_deg, altitude_m):
    datum = csas.Datum(*place, heading_deg, altitude_m)
    to_earth = pyproj.Transformer.from_crs(chart_wkt(datum), "EPSG:4326", always_xy=True)
    grid = GroundGrid(2001, 3001, 1.0, -1500.0, 1000.0)
    a, b, c, d, e, f = affine_of(grid, datum)
    geod = pyproj.Geod(ellps="WGS84")
    for col, row in ((0, 0), (3000, 0), (1500, 1000), (2000, 2000)):
        u, v = col + 0.5, row + 0.5
        longitude, latitude = to_earth.transform(a * u + b * v + c, d * u + e * v + f)
        true = datum.to_latlon(grid.x_min_m + col, grid.y_max_m - row)
        _, _, metres = geod.inv(longitude, latitude, true[1], true[0])
        # 1.8 km away; at 5 km of depth one scale for both axes costs 5e-6 of that.
        assert metres < (0.001 if altitude_m > -1000 else 0.01)


@pytest.mark.long  # its numbers are held by the test before
def test_a_scene_that_is_turned_is_turned_on_the_chart(results, tmp_path):
    place = PlaceParameters(origin_lat_deg=10.0, origin_lon_deg=20.0, origin_heading_deg=90.0)
    done = export_result(results, tmp_path / "maps", ["geotiff", "geojson", "gpkg", "netcdf"], place=place)
    assert not done.left_out
    told = read(tmp_path / "maps", (10.0, 20.0))
    # Scene y points east: x points south.
    there = TRUTH[1], -TRUTH[0]
    assert apart(told["contacts.geojson"]["metres"][0], there) < NEAR_M
    assert apart(np.mean(told["height.tif"]["plan_m"], axis=0), there) < NEAR_M
    assert apart(told["grid.nc"]["middle_m"], there) < NEAR_M
    assert told["grid.nc"]["mapping"] is None
    assert told["contacts.gpkg"]["areas"][0] == pytest.approx(0.32, rel=0.2)


def test_without_a_datum_there_are_local_metres_and_no_places(changed, tmp_path, capsys):
    folder, out = changed(datum=None), tmp_path / "maps"
    assert main(["export", str(folder), "--out", str(out), "--json"]) == 0
    said = capsys.readouterr()
    assert set(json.loads(said.out)["left_out"]) == {"geojson", "kml"}
    assert "left out: kml" in said.err
    told = read(out, None)
    assert not told["multilook.tif"]["projected"]
    assert not told["multilook.tif"]["geographic"]
    assert "without a datum" in told["multilook.tif"]["wkt"]
    assert apart(told["contacts.gpkg"]["points"][0]) < NEAR_M
    assert "without a datum" in told["contacts.gpkg"]["crs"]
    assert told["grid.nc"]["mapping"] is None
    assert "latitude" not in told["grid.nc"]["variables"]
    assert main(["export", str(folder), "--out", str(tmp_path / "no"), "--format", "gpkg,kml"]) == 1
    assert capsys.readouterr().err == (
        f"csas-shadow: error: {folder} has no datum, and kml holds longitude and latitude alone; expected"
        " one, as --origin-lat-deg and --origin-lon-deg give it\n"
    )
    assert not (tmp_path / "no").exists()
    given = ["--origin-lat-deg", "1", "--origin-lon-deg", "2", "--format", "kml"]
    assert main(["export", str(folder), "--out", str(out), "--overwrite", *given]) == 0
    assert [p.name for p in sorted(out.iterdir())] == ["contacts.kml", "maps.json"]


def test_what_the_results_lack_is_told(changed, tmp_path, capsys):
    folder, out = changed(objects=[]), tmp_path / "maps"
    (folder / "result.mcap").unlink()
    (folder / "grid.npz").write_bytes(b"PK\x03\x04 cut off")
    assert main(["export", str(folder), "--out", str(out), "--format", "geotiff,geojson"]) == 3
    errors = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[2] for line in errors] == ["multilook", "color_by_aspect", "shadow_free"]
    assert all("has no result.mcap that can be read" in line for line in errors)
    assert json.loads((out / "contacts.geojson").read_text())["features"] == []
    with pytest.raises(MapError, match=r"grid\.npz cannot be read"):
        export_result(folder, tmp_path / "cube", ["zarr"])
    assert not (tmp_path / "cube").exists()


def test_slips_are_one_line(results, tmp_path, monkeypatch):
    with pytest.raises(ParameterError, match="format is 'shp'; expected one of: geotiff, geojson"):
        export_result(results, tmp_path / "maps", ["shp"])
    with pytest.raises(ResultsError, match="is not a results folder"):
        export_result(tmp_path, tmp_path / "maps")
    with pytest.raises(MapError, match="exists already"):
        export_result(results, results, ["kml"])
    with pytest.raises(MapError, match="is not a folder of maps: not replaced"):
        export_result(results, results, ["kml"], overwrite=True)
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(MissingExtraError, match=r"needs rasterio.*csas_shadow_ros\[maps\]"):
        export_result(results, tmp_path / "maps", ["geotiff"])
    assert not list(tmp_path.iterdir())
