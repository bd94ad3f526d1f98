"""Bags of sectors: what is wrong with some of them is told, and does not spoil the others."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from csas_shadow_ros.bags import BagReader, check_bag, read_run, write_run
from csas_shadow_ros.cli import main
from csas_shadow_ros.core.geometry import GroundGrid, GroundLattice, Track
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.sectors.sector import Sector
from csas_shadow_ros.nodes.playing import BagViews
from csas_shadow_ros.run_bag import replay_bag
from csas_shadow_ros.simulation.sectors import sectors_of_run
from msg_adapters import RosbagsMessages
from msg_adapters.pairs import coherent_image_to_msgs


@pytest.fixture(scope="module")
def run(tiny_box_bag):
    return read_run(tiny_box_bag.path)


@pytest.fixture(scope="module")
def sectors(run):
    return [sector for sector, _ in sectors_of_run(run.image, run.track, 30.0)]


def written(path: Path, run, sectors) -> Path:
    return write_run(path, None, run.track, sectors=sectors)


def with_band(sector: Sector, **changed: float) -> Sector:
    return replace(sector, acoustics=replace(sector.acoustics, **changed))


def texts(report, level: str) -> str:
    return "\n".join(str(f) for f in report.findings if f.level == level)


def test_right_sectors_are_usable_and_told_of(run, sectors, tmp_path, capsys) -> None:
    bag = written(tmp_path / "right", run, sectors)
    report = check_bag(bag)
    assert report.ok
    assert texts(report, "warning") == ""
    assert "away from the sonar, as they must" in texts(report, "info")
    assert main(["info", str(bag)]) == 0
    told = capsys.readouterr().out
    assert "sectors 12 that cover 360.0 of 360°" in told
    assert "image (summed from the sectors)" in told


@pytest.fixture(scope="module")
def own_sectors(run):
    return [sector for sector, _ in sectors_of_run(run.image, run.track, 30.0, "own")]


def test_sectors_on_own_lattices_are_usable_and_told_of(run, own_sectors, tmp_path, capsys) -> None:
    bag = written(tmp_path / "own", run, own_sectors)
    report = check_bag(bag)
    assert report.ok
    assert texts(report, "warning") == ""
    assert "away from the sonar, as they must" in texts(report, "info")
    assert main(["info", str(bag)]) == 0
    assert "image (summed from the sectors)" in capsys.readouterr().out
    total = read_run(bag).sector_sum()
    assert total.stamps == {sector.stamp_ns for sector in own_sectors}
    np.testing.assert_allclose(total.frame.grid.extent_m, run.image.grid.extent_m, atol=1e-9)


@pytest.mark.parametrize("wrong", [0, 5])
@pytest.mark.parametrize("what", ["folded", "too small"])
def test_one_own_lattice_that_is_wrong_is_named_and_the_others_are_summed(
    run, own_sectors, tmp_path, what, wrong
) -> None:
    odd = list(own_sectors)
    one = odd[wrong]
    lattice = GroundLattice.of(one.grid)
    if what == "folded":
        # Every fourth row over the same ground: 30° of the band no longer fit between them.
        (x, y), (bx, by) = lattice.origin_m, lattice.row_step_m
        rows = one.pixels[::4]
        grid = replace(lattice, rows=len(rows), row_step_m=(4 * bx, 4 * by), origin_m=(x, y + 1.5 * by))
        odd[wrong] = replace(one, pixels=rows, grid=grid)
        said = "fold the band of its arc"
    else:
        half = one.pixels[: lattice.rows // 2]
        odd[wrong] = replace(one, pixels=half, grid=replace(lattice, rows=len(half)))
        said = "expected all of the scene"
    bag = written(tmp_path / "odd", run, odd)
    found = read_run(bag)
    right = read_run(written(tmp_path / "rest", run, [s for i, s in enumerate(own_sectors) if i != wrong]))
    np.testing.assert_allclose(
        found.sector_sum().spectrum.values, right.sector_sum().spectrum.values, atol=1e-5
    )
    [problem] = found.problems
    assert said in str(problem)
    assert "\n" not in str(problem)
    report = check_bag(bag)
    assert not report.ok
    assert said in texts(report, "error")


def test_a_band_that_is_worked_out_anew_for_each_sector_is_the_same_band(run, sectors, tmp_path) -> None:
    errors = np.random.default_rng(0).uniform(-1e-12, 1e-12, len(sectors))
    shaken = [
        with_band(s, centre_frequency_hz=s.acoustics.centre_frequency_hz * (1 + error))
        for s, error in zip(sectors, errors, strict=True)
    ]
    bag = written(tmp_path / "shaken", run, shaken)
    assert check_bag(bag).ok
    found = read_run(bag)
    np.testing.assert_array_equal(
        found.coherent_image().pixels, read_run(written(tmp_path / "a", run, sectors)).coherent_image().pixels
    )
    assert found.problems == []


@pytest.mark.parametrize("wrong", [0, 5])
@pytest.mark.parametrize("what", ["grid", "band"])
def test_one_wrong_sector_is_named_and_the_others_are_summed(run, sectors, tmp_path, what, wrong) -> None:
    odd = list(sectors)
    one = odd[wrong]
    if what == "grid":
        g = one.grid
        grid = GroundGrid(g.rows, g.cols, g.spacing_m, g.x_min_m + 0.05, g.y_max_m)
        odd[wrong] = replace(one, grid=grid)
    else:
        odd[wrong] = with_band(one, centre_frequency_hz=70e3)
    bag = written(tmp_path / "odd", run, odd)
    found = read_run(bag)
    right = read_run(written(tmp_path / "rest", run, [s for i, s in enumerate(sectors) if i != wrong]))
    np.testing.assert_array_equal(found.coherent_image().pixels, right.coherent_image().pixels)
    [problem] = found.problems
    said = "another band than" if what == "band" else "is not like"
    assert f"{said} 11 other sectors" in str(problem)
    assert "expected" in str(problem)
    report = check_bag(bag)
    assert not report.ok
    assert said in texts(report, "error")
    played = BagViews(BagReader(bag), "sector")
    assert one.stamp_ns not in played.times
    assert len(played.times) == 11
    assert any(said in line for line in played.problems)


def test_arcs_that_no_sector_covers_are_named_by_check_info_and_run(run, sectors, tmp_path, capsys) -> None:
    bag = written(tmp_path / "gap", run, [s for i, s in enumerate(sectors) if i not in (3, 4)])
    gap = "no sectors came of 90.0° to 150.0°: 60 of 360 degrees are missing"
    assert gap in texts(check_bag(bag), "warning")
    assert main(["info", str(bag)]) == 0
    assert "missing: 90.0° to 150.0°" in capsys.readouterr().out
    out = ["--out", str(tmp_path / "out"), "--step-deg", "15", "--voxel-size-m", "0.05"]
    assert main(["run", str(bag), *out, "--no-bag", "--no-figures", "--max-objects", "1"]) == 0
    assert gap in capsys.readouterr().err
    assert gap in (tmp_path / "out" / "report.json").read_text(encoding="utf-8").replace("\\u00b0", "°")


def test_the_same_arc_under_two_stamps_is_told_of(run, sectors, tmp_path) -> None:
    again = replace(sectors[5], stamp_ns=sectors[-1].stamp_ns + 10**9)
    warned = texts(check_bag(written(tmp_path / "twice", run, [*sectors, again])), "warning")
    assert str(again.stamp_ns) in warned
    assert "it counts twice" in warned


def test_aspects_that_the_track_contradicts_are_told_of(run, sectors, tmp_path) -> None:
    in_degrees = [replace(s, aspect_rad=math.degrees(s.aspect_rad)) for s in sectors]
    told = texts(check_bag(written(tmp_path / "degrees", run, in_degrees)), "warning")
    assert "12 sectors state another aspect than the track has at their stamp" in told
    assert "look like degrees" in told
    other_way = [replace(s, aspect_rad=-s.aspect_rad) for s in sectors]
    told = texts(check_bag(written(tmp_path / "mirrored", run, other_way)), "warning")
    assert "sectors state another aspect than the track has" in told
    assert "degrees. Give" not in told
    # Stamped where a sector begins or ends, and an aspect a whole turn on: both are right.
    stamps = np.interp([s.aspect_rad + 0.25 for s in sectors], run.track.aspects_rad, run.track.stamps_ns)
    early = [
        replace(s, stamp_ns=int(stamp), aspect_rad=s.aspect_rad + math.tau)
        for s, stamp in zip(sectors, stamps, strict=True)
    ]
    assert "another aspect" not in texts(check_bag(written(tmp_path / "turn", run, early)), "warning")


def test_a_track_whose_x_and_y_are_swapped_is_told_of_by_what_sectors_say(run, sectors, tmp_path) -> None:
    # North-east axes with an altitude: a circle round the origin looks the same, but is passed the other way.
    north_east = Track(run.track.stamps_ns, run.track.positions_m[:, [1, 0, 2]])
    bag = write_run(tmp_path / "swapped", None, north_east, sectors=sectors)
    assert "sectors state another aspect than the track has" in texts(check_bag(bag), "warning")


def test_what_contradicts_itself_in_all_sectors_is_an_error_as_in_an_image(run, sectors, tmp_path) -> None:
    turned = [with_band(s, spectrum_sign=-1) for s in sectors]
    assert "spectrum_sign is -1" in texts(check_bag(written(tmp_path / "sign", run, turned)), "error")
    lower = written(tmp_path / "band", run, [with_band(s, centre_frequency_hz=30e3) for s in sectors])
    assert "energy lies in its stated band" in texts(check_bag(lower), "error")


def test_of_a_stamp_that_comes_again_the_first_image_is_played_each_time(run, sectors, tmp_path) -> None:
    again = replace(sectors[4], stamp_ns=sectors[3].stamp_ns)
    bag = written(tmp_path / "again", run, [*sectors[:4], again, *sectors[5:]])
    played = BagViews(BagReader(bag), "sector")
    first = {stamp: played.get(stamp) for stamp in played.times}
    for _ in range(2):
        for stamp in played.times:
            assert played.get(stamp) == first[stamp]


def test_replay_plays_the_sectors_where_the_image_cannot_be_used(run, sectors, tmp_path) -> None:
    pytest.importorskip("rclpy")
    image, info = coherent_image_to_msgs(RosbagsMessages(), run.image)
    data = np.array(image.data)
    data.view(np.float32)[17] = math.nan
    extra = [("image", replace(image, data=data)), ("camera_info", info)]
    bag = write_run(tmp_path / "nan", None, run.track, sectors=sectors, extra=extra)
    parameters = PipelineParameters(
        sub_aperture=SubApertureParameters(step_deg=15.0), carving=CarvingParameters(voxel_size_m=0.05)
    )
    report = replay_bag(bag, tmp_path / "out", parameters, write_bag=False, figures=False)
    assert report["dimensions"] is not None
    assert any("message 0" in problem for problem in report["problems"])
