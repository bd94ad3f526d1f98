"""A run that other programs wrote is the run that a bag of our own holds."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from routes import (
    IMAGES,
    NAVIGATION,
    ORIGIN,
    csv_scene,
    npy,
    odometry,
    poses,
    sicd,
    tiff,
    transforms,
    write_csv,
)

import csas_shadow_ros as csas
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.sectors.sector import same_grid
from csas_shadow_ros.importing import ImportSettingsError, Settings, import_run
from csas_shadow_ros.importing.settings import KEYS

BAND = {"centre_frequency_hz": 60e3, "bandwidth_hz": 24e3, "sound_speed_mps": 1500.0, "spectrum_sign": 1}
COARSE = csas.parameters(step_deg=30.0, voxel_size_m=0.04)


def write_page(folder: Path, *parts: dict[str, dict[str, Any]], **more: Any) -> Path:
    page: dict[str, Any] = {"acoustics": BAND}
    for part in parts:
        for name, values in part.items():
            page[name] = {**page.get(name, {}), **values}
    (folder / "geometry.yaml").write_text(yaml.safe_dump({**page, **more}))
    return folder / "geometry.yaml"


def imported(run, folder: Path, image_route, track_route) -> csas.Run:
    source, of_image = image_route(run.image, folder)
    track, of_track = track_route(run.track, folder)
    bag = import_run(source, folder / "bag", write_page(folder, of_image, of_track), track=track)
    return csas.read_run(bag)


def check_same(one: csas.Run, run, position_m: float) -> None:
    assert not one.problems
    assert same_grid(one.image.grid, run.image.grid)
    assert one.image.acoustics == run.image.acoustics
    assert one.image.pixels.dtype == np.complex64
    assert np.array_equal(one.image.pixels, run.image.pixels)
    assert np.array_equal(one.track.stamps_ns, run.track.stamps_ns)
    assert np.abs(one.track.positions_m - run.track.positions_m).max() <= position_m
    assert one.image.stamp_ns == run.track.stamps_ns[-1]


@pytest.fixture(scope="module")
def run(tiny_box_bag):
    return tiny_box_bag.run


@pytest.mark.parametrize("name", IMAGES)
def test_an_image_of_any_format_is_the_image_of_the_run(name, run, tmp_path):
    if name == "sicd" and sys.version_info < (3, 11):
        pytest.skip("sarkit is made for Python 3.11 and later")
    one = imported(run, tmp_path, IMAGES[name], csv_scene)
    check_same(one, run, 1e-12)
    assert (one.datum is not None) == (name in ("geotiff_on_a_chart", "sicd"))


@pytest.mark.parametrize("name", NAVIGATION)
def test_navigation_of_any_format_is_the_track_of_the_run(name, run, tmp_path):
    one = imported(run, tmp_path, npy, NAVIGATION[name])
    # Eleven decimals of a degree are 1 µm; orientations that are put together round.
    check_same(one, run, 1e-5 if name in ("csv_geographic", "fixes") else 1e-9)
    if name in ("csv_geographic", "fixes"):
        assert one.datum.latitude_deg == ORIGIN["latitude_deg"]


def test_an_imported_run_gives_the_grid_of_the_bag(tiny_box_bag, tmp_path):
    one = imported(tiny_box_bag.run, tmp_path, IMAGES["hdf5"], NAVIGATION["csv_ned"])
    own = csas.reconstruct(csas.read_run(tiny_box_bag.path), COARSE, progress=False)
    other = csas.reconstruct(one, COARSE, progress=False)
    assert own.verdict == other.verdict == "object"
    assert own.grid.volume == other.grid.volume
    assert np.array_equal(own.grid.likelihood, other.grid.likelihood, equal_nan=True)
    assert np.array_equal(own.matter, other.matter)


@pytest.mark.long  # the track itself is held by the tests before
def test_positions_that_round_leave_the_grid_what_it_is(tiny_box_bag, tmp_path):
    one = imported(tiny_box_bag.run, tmp_path, IMAGES["geotiff_on_a_chart"], NAVIGATION["csv_geographic"])
    # The search weighs bodies against thresholds: where it ends may turn on the last bit of a position.
    given = csas.parameters(step_deg=30.0, voxel_size_m=0.04, position_m=(0.0, 0.0), size_m=(1.4, 1.4, 0.8))
    own = csas.reconstruct(csas.read_run(tiny_box_bag.path), given, progress=False)
    other = csas.reconstruct(one, given, progress=False)
    assert own.grid.volume == other.grid.volume
    same = np.isclose(own.grid.likelihood, other.grid.likelihood, atol=1e-6, equal_nan=True)
    assert same.mean() > 0.999
    assert np.count_nonzero(own.grid.occupied != other.grid.occupied) <= 5


def test_the_command_says_what_it_made(run, tmp_path, capsys):
    source, of_image = npy(run.image, tmp_path)
    track, of_track = csv_scene(run.track, tmp_path)
    of_track["track"]["file"] = track.name
    page = write_page(tmp_path, of_image, of_track, {"image": {"stamp_ns": 5 * 10**17}}, frame="auv_1/scene")
    out = tmp_path / "bag"
    assert main(["import", str(source), "--out", str(out), "--geometry", str(page), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    # The stamp is years off the track: the reader of the bag says so.
    assert "covers" in " ".join(said["problems"])
    assert main(["import", str(source), "--out", str(out), "--geometry", str(page)]) == 1
    assert "exists already" in capsys.readouterr().err
    page = write_page(tmp_path, of_image, of_track, frame="auv_1/scene")
    assert main(["import", str(source), "--out", str(out), "--geometry", str(page), "--overwrite"]) == 0
    assert csas.read_run(out).frame == "auv_1/scene"


LACKS = {
    "acoustics.bandwidth_hz; expected the bandwidth": {"acoustics": {**BAND, "bandwidth_hz": None}},
    "acoustics.spectrum_sign; expected the phase": {"acoustics": {**BAND, "spectrum_sign": None}},
    "image.spacing_m; expected the pixel": {"image": {"centre_m": [0, 0]}},
    "track.axes; expected the one of scene": {"track": {}},
}


@pytest.mark.parametrize("lack", LACKS)
def test_the_error_names_what_the_page_lacks(lack, run, tmp_path):
    source, of_image = npy(run.image, tmp_path)
    track, of_track = csv_scene(run.track, tmp_path)
    page = write_page(tmp_path, of_image, of_track, **LACKS[lack])
    with pytest.raises(ImportSettingsError) as raised:
        import_run(source, tmp_path / "bag", page, track=track)
    assert str(raised.value).startswith(f"geometry.yaml lacks {lack}")
    assert not (tmp_path / "bag").exists()


WRONG = {
    "unknown part 'acustics'; expected 'acoustics'": {"acustics": {}},
    "unknown key of image 'spacing'; expected 'spacing_m'": {"image": {"spacing": 1}},
    "acoustics.spectrum_sign is 1.5; expected a whole number": {"acoustics": {**BAND, "spectrum_sign": 1.5}},
    "spectrum_sign is 2; expected +1 or -1": {"acoustics": {**BAND, "spectrum_sign": 2}},
    "image.spacing_m is 'wide'; expected a number": {"image": {"spacing_m": "wide"}},
    "image.rows is 'left'; expected one of: south, north, east": {"image": {"spacing_m": 1, "rows": "left"}},
    "track.axes is 'esd'; expected one of: scene": {"track": {"axes": "esd"}},
    "has no column 'east' (track.columns.east names no other); its columns are: time_ns, x, y, z": {
        "track": {"axes": "enu"}
    },
    "has no column 'E' (track.columns says so)": {"track": {"axes": "scene", "columns": {"x": "E"}}},
    "holds latitudes and longitudes; expected origin.latitude_deg": {
        "track": {"axes": "geographic", "columns": dict(latitude="x", longitude="y", altitude="z")}
    },
    "holds no orientations; expected none of track.lever_arm_m": {
        "track": {"axes": "scene", "lever_arm_m": [1, 2, 3]}
    },
    "is at z = -12 m; expected above the seabed (z > 0); geometry.yaml lacks track.origin_m, the ned": {
        "track": {"axes": "ned", "columns": dict(north="y", east="x", down="z")}
    },
    "geometry.yaml: track.origin_m is [0, 0]; expected 3 numbers": {
        "track": {"axes": "scene", "origin_m": [0, 0]}
    },
}


@pytest.mark.parametrize("fault", WRONG)
def test_the_error_names_what_is_wrong(fault, run, tmp_path):
    source, of_image = npy(run.image, tmp_path)
    track, of_track = csv_scene(run.track, tmp_path)
    page = write_page(tmp_path, of_image, of_track, **WRONG[fault])
    with pytest.raises(csas.CsasError) as raised:
        import_run(source, tmp_path / "bag", page, track=track)
    assert fault in str(raised.value)
    assert "\n" not in str(raised.value)


def test_files_that_hold_no_image_or_several_are_told(run, tmp_path):
    track, of_track = csv_scene(run.track, tmp_path)
    page = write_page(tmp_path, {"image": {"spacing_m": 0.005}}, of_track)

    def refused(name: str, why: str, page: Path = page) -> None:
        with pytest.raises(ImportSettingsError, match=why):
            import_run(tmp_path / name, tmp_path / "bag", page, track=track)

    refused("image.png", r"ends with '\.png'; expected an image, one of: \.npy \.npz \.mat")
    refused("image.npy", "there is no file")
    np.save(tmp_path / "image.npy", np.ones((4, 4)))
    refused("image.npy", r"holds an array \(4, 4\) of float64; expected a complex image")
    for name in ("a.npy", "a.npz", "a.mat", "a.h5", "a.tif", "a.ntf"):
        if name == "a.ntf" and sys.version_info < (3, 11):
            continue
        (tmp_path / name).write_bytes(b"no such thing, and longer than a header of any of them" * 40)
        refused(name, "cannot be read: .*; expected")
    np.savez(tmp_path / "two.npz", a=np.ones((3, 3), complex), b=np.ones((3, 3), complex))
    refused("two.npz", r"lacks image\.variable, and complex images in .* are: a, b")
    named = write_page(tmp_path, {"image": {"spacing_m": 0.005, "variable": "c"}}, of_track)
    refused("two.npz", "has no 'c'; expected one of: a, b", named)


def test_lattices_that_are_none_of_ours_are_refused(run, tmp_path):
    track, of_track = csv_scene(run.track, tmp_path)

    def refused(source: Path, why: str, *parts: dict) -> None:
        with pytest.raises(ImportSettingsError, match=why):
            import_run(source, tmp_path / "bag", write_page(tmp_path, of_track, *parts), track=track)

    utm = tiff(run.image, tmp_path, "EPSG:32630", (389_000.0, 5_360_000.0))
    refused(utm, r"is on a chart \(EPSG:32630\); expected origin\.latitude_deg")
    # 1.5 degrees from the zone's middle: grid north is 1.1 degrees off, and the scale 2e-4.
    refused(utm, "axes of its chart are .* m off east and north", {"origin": ORIGIN})
    refused(tiff(run.image, tmp_path, "EPSG:4326"), "is in degrees; expected a chart in metres")
    refused(
        tiff(run.image, tmp_path),
        r"image\.centre_m is \[0, 0\]; expected none",
        {"image": {"centre_m": [0, 0]}},
    )
    if sys.version_info >= (3, 11):
        refused(
            sicd(run.image, tmp_path, "SLANT")[0], "has its image in the SLANT plane; expected the GROUND"
        )
        turned = sicd(run.image, tmp_path, turn_rad=0.1)[0]
        refused(
            turned, r"rows lead to \[0\.995, 0\.0998, .*\]; expected|rows lead to .* expected one along east"
        )


def test_bags_without_one_navigation_are_told(run, tmp_path):
    source, of_image = npy(run.image, tmp_path)

    def refused(route, why: str, of_track: dict) -> None:
        folder = tmp_path / route.__name__
        if not folder.exists():
            folder.mkdir()
            route(run.track, folder)
        page = write_page(tmp_path, of_image, {"track": of_track})
        with pytest.raises(ImportSettingsError, match=why):
            import_run(source, tmp_path / "bag", page, track=folder / "nav")

    refused(odometry, r"lacks track\.topic; navigation in .* is: /odom.*, /odom", {})
    refused(odometry, r"has no topic /gps; expected one of: /odom", {"topic": "/gps"})
    refused(
        transforms,
        r"lacks track\.topic \(or track\.frames, of its transforms\); navigation in .* is: none",
        {},
    )
    refused(
        transforms,
        "lead from 'sonar' to 'map', not to 'earth'; its frames are: base_link, map, odom, sonar",
        {"frames": ["earth", "sonar"]},
    )
    refused(transforms, "'sonar' stands still in 'base_link'", {"frames": ["base_link", "sonar"]})
    refused(poses, r"track\.origin_m is 'far'; expected 3 numbers", {"origin_m": "far"})


def test_a_line_that_is_no_pose_is_told_by_its_number(run, tmp_path):
    source, of_image = npy(run.image, tmp_path)
    for cell, why in (
        ("", "line 3: y is ''; expected a number"),
        ("12:00", "line 3: time is '12:00'; expected ns"),
    ):
        rows = [["1", "2", "3", "4"], ["12:00" if cell else "2", "2", cell and "3", "4"]]
        write_csv(tmp_path / "nav.csv", ["time_ns", "x", "y", "z"], rows)
        page = write_page(tmp_path, of_image, {"track": {"axes": "scene"}})
        with pytest.raises(ImportSettingsError, match=why):
            import_run(source, tmp_path / "bag", page, track=tmp_path / "nav.csv")


@pytest.mark.skipif(sys.version_info < (3, 11), reason="sarkit is made for Python 3.11 and later")
def test_a_sicd_says_itself_where_its_reference_point_is(run, tmp_path):
    source, _ = sicd(run.image, tmp_path)
    track, of_track = csv_scene(run.track, tmp_path)
    one = csas.read_run(import_run(source, tmp_path / "bag", write_page(tmp_path, of_track), track=track))
    grid = one.image.grid
    assert (grid.x_of_columns()[200], grid.y_of_rows()[300]) == pytest.approx((0.0, 0.0), abs=1e-12)
    # Of the reference point, as the scene of the run has it.
    x, y = csas.Datum(*list(ORIGIN.values())[:2], altitude_m=ORIGIN["altitude_m"]).to_scene(
        one.datum.latitude_deg, one.datum.longitude_deg
    )
    there = run.image.grid.x_of_columns()[200], run.image.grid.y_of_rows()[300]
    assert (x, y) == pytest.approx(there, abs=1e-6)


def test_the_page_in_the_documents_is_one_and_every_key_is_told_of():
    text = (Path(__file__).resolve().parents[2] / "docs" / "import.md").read_text(encoding="utf-8")
    (page,) = re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    settings = Settings(yaml.safe_load(page))
    assert settings.number("acoustics", "centre_frequency_hz") == 60e3
    assert settings.mapping("track", "columns")["down"] == "depth"
    untold = [key for keys in KEYS.values() for key in keys if not re.search(rf"\b{key}\b", text)]
    assert not untold


def test_places_that_are_none_and_libraries_that_are_not_there_are_told(run, tmp_path, monkeypatch):
    source, of_image = npy(run.image, tmp_path)
    track = tmp_path / "nav.csv"
    page = write_page(tmp_path, of_image, {"track": {"axes": "geographic"}, "origin": ORIGIN})
    for cell in ("95.0", "nan"):
        write_csv(
            track,
            ["time", "latitude", "longitude", "altitude"],
            [["1", "48", "4", "9"], ["2", cell, "4", "9"]],
        )
        with pytest.raises(
            ImportSettingsError, match=f"pose 1 is at latitude {float(cell):g}, longitude 4, altitude 9"
        ):
            import_run(source, tmp_path / "bag", page, track=track)
    track, of_track = csv_scene(run.track, tmp_path)
    page = write_page(tmp_path, of_image, of_track)
    (tmp_path / "image.h5").write_bytes(b"x")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(
        csas.MissingExtraError, match=r"import from HDF5 needs h5py.*csas_shadow_ros\[import\]"
    ):
        import_run(tmp_path / "image.h5", tmp_path / "bag", page, track=track)
