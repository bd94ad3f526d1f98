"""The examples on measured data, where they are at hand, and their parts on made-up data everywhere."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from csas_shadow_ros.bags import read_run, write_run
from csas_shadow_ros.core.errors import CsasError
from csas_shadow_ros.core.geometry import wrap_angle
from csas_shadow_ros.core.imaging.likelihood import echo_mask, view_levels
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples"))
import airsas
import t72_shadows
from real_data import data_file


def _data(name: str) -> Path:
    try:
        return data_file(name)
    except CsasError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def chips():
    return t72_shadows.load_views(_data(t72_shadows.FILE))


@pytest.fixture(scope="module")
def chip_bag(chips, tmp_path_factory):
    return t72_shadows.write_bag(tmp_path_factory.mktemp("t72") / "bag", chips)


@pytest.fixture(scope="module")
def vehicle(chip_bag):
    carving = CarvingParameters(voxel_size_m=0.1)
    return t72_shadows.reconstruct(chip_bag, PipelineParameters(carving=carving))


@pytest.fixture(scope="module")
def cut_out():
    return airsas.load_run(_data(airsas.FILE))


# T-72


def test_shadows_of_the_chips_fall_downwards(chips):
    power = np.mean([np.square(v.pixels) for v in chips], axis=0)
    middle = slice(54, 74)
    below, above, side = power[74:94, middle].mean(), power[20:40, middle].mean(), power[74:94, :20].mean()
    assert below < 0.4 * above
    assert below < 0.4 * side


def _echo_axis(view, mirror):
    """Axis of a view's bright echo on the ground: a doubled-angle vector, the longer the clearer."""
    levels = view_levels(view)
    echo = echo_mask(levels.local, 12.0)
    rows, cols = np.nonzero(echo[:, ::-1] if mirror else echo)
    pixels = np.column_stack([cols, rows, np.ones(len(rows))])
    ground = pixels @ view.info.camera.pixel_to_ground[:2].T
    covariance = np.cov(ground.T)
    return complex(covariance[0, 0] - covariance[1, 1], 2.0 * covariance[0, 1]) / np.trace(covariance)


def test_the_vehicle_points_the_same_way_from_all_sides_only_if_chips_are_not_mirrored(chips, vehicle):
    right = np.array([_echo_axis(v, mirror=False) for v in chips])
    mirrored = np.array([_echo_axis(v, mirror=True) for v in chips])
    assert abs(right.mean()) > 0.75 * np.abs(right).mean()
    assert abs(mirrored.mean()) < 0.25 * np.abs(mirrored).mean()
    heading = np.angle(right.mean()) / 2.0
    carved = t72_shadows.Shape.of(vehicle.grid).body.heading_rad
    assert abs(math.remainder(heading - carved, math.pi)) < math.radians(10.0)


def test_the_bag_gives_back_every_chip_and_its_geometry(chips, chip_bag):
    run = read_run(chip_bag)
    assert run.image is None
    assert run.track is None
    back = list(run.views("shadow"))
    assert len(back) == len(chips) == 232
    assert run.problems == []
    for a, b in zip(chips, back, strict=True):
        np.testing.assert_array_equal(a.pixels, b.pixels)
        np.testing.assert_allclose(b.info.camera.projection, a.info.camera.projection, rtol=1e-12)
        assert float(wrap_angle(a.info.aspect_rad - b.info.aspect_rad)) == pytest.approx(0.0, abs=1e-9)


def test_the_hull_comes_out_within_20_percent(vehicle):
    body = t72_shadows.Shape.of(vehicle.grid).body
    measured = body.length_m, body.width_m, body.height_m
    assert measured == pytest.approx(t72_shadows.TRUE_M, rel=0.2)


def test_the_dimensions_are_the_hull_s_within_10_percent_and_within_the_intervals(vehicle):
    found = vehicle.dimensions
    measured = found.length_m, found.width_m, found.height_m
    assert measured == pytest.approx(t72_shadows.TRUE_M, rel=0.1)
    for name, true in zip(("length_m", "width_m", "height_m"), t72_shadows.TRUE_M, strict=True):
        low, high = found.intervals[name]
        assert low < true < high
    assert vehicle.mesh.is_watertight


def test_chips_that_were_cut_out_one_by_one_are_put_together(vehicle):
    shifts = np.array([one.shift_m for one in vehicle.evidence.values()])
    assert 0.2 < float(np.std(shifts)) < 0.6
    assert vehicle.dimensions.scatter_cells < 0.6
    assert vehicle.quality.verdict == "limited"


def test_the_reconstruction_casts_the_shadows_that_were_measured(vehicle, chips):
    compared = t72_shadows.agreement(vehicle, chips[::8])
    assert len(compared) >= 25
    inside, lit = np.median(compared, axis=0)
    assert inside > 0.5
    assert lit < 0.05
    turned = vehicle.mesh.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [0, 0, 1]))
    inside_turned, lit_turned = np.median(
        t72_shadows.agreement(dataclasses.replace(vehicle, mesh=turned), chips[::8]), axis=0
    )
    assert inside_turned < inside
    assert lit_turned > 3.0 * lit


def test_all_chips_are_used(vehicle):
    assert vehicle.views_used == 232
    assert vehicle.rejected == {}


# AirSAS


def test_the_band_from_frequencies_is_where_the_energy_lies(cut_out):
    low, high, share = airsas.energy_in_band(*cut_out)
    psi = math.atan2(0.2385, 0.85)
    assert low == pytest.approx(4 * math.pi * 10e3 * math.cos(psi) / 344.3519, rel=1e-4)
    assert (round(low), round(high)) == (351, 1054)
    assert share > 0.95


@pytest.fixture(scope="module")
def cut_out_result(cut_out, tmp_path_factory):
    bag = write_run(tmp_path_factory.mktemp("airsas") / "bag", *cut_out)
    return airsas.process(bag, (0.0,))


def test_no_shadows_give_no_verdict_on_the_sign(cut_out_result):
    assert cut_out_result.result.sign.verdict == "unknown"


def test_where_there_are_no_shadows_there_is_no_object(cut_out_result):
    assert cut_out_result.result.mesh is None


def test_faces_of_the_cut_out_echo_towards_their_own_side(cut_out_result):
    composites = cut_out_result.composites
    assert len(composites.stamps) == 360
    aspect, anisotropy = composites.dominant_aspect()
    x, y = np.meshgrid(composites.grid.x_of_columns(), composites.grid.y_of_rows())
    level = composites.multilook()
    faces = (level > np.nanpercentile(level, 95)) & (anisotropy > 0.4) & (np.hypot(x, y) < 0.2)
    assert faces.sum() > 100
    # The cut-out is 0.07 m by 0.2 m with its middle at (0, 0.01) m.
    outwards = np.arctan2((y - 0.01) / 0.2, x / 0.07)
    assert np.mean(np.cos(aspect[faces] - outwards[faces]) > 0.0) > 0.9


def test_a_shown_view_is_complex_and_known_inside_the_image(cut_out_result):
    pixels = cut_out_result.views[0.0]
    assert pixels.dtype == np.complex64
    middle = slice(pixels.shape[0] // 4, 3 * pixels.shape[0] // 4)
    assert np.isfinite(pixels[middle, middle]).all()


# Anywhere


def _grid(occupied: np.ndarray) -> VoxelGrid:
    volume = Volume((0.0, 0.0, 0.05), 0.1, occupied.shape)
    likelihood = np.where(occupied, 0.0, 1.0).astype(np.float32)
    return VoxelGrid(volume, likelihood, np.full(occupied.shape, 9, np.uint16), 0.5, occupied)


def test_the_body_loses_a_rod_and_keeps_its_size():
    occupied = np.zeros((12, 40, 110), bool)
    occupied[:10, 8:32, 10:70] = True
    with_rod = occupied.copy()
    with_rod[7:9, 19:22, 70:100] = True
    shape = t72_shadows.Shape.of(_grid(with_rod))
    alone = t72_shadows.Shape.of(_grid(occupied)).whole
    assert shape.whole.length_m > alone.length_m + 2.5
    assert (shape.body.length_m, shape.body.width_m, shape.body.height_m) == pytest.approx(
        (alone.length_m, alone.width_m, alone.height_m), rel=0.05
    )


@pytest.mark.parametrize("example", [t72_shadows, airsas])
def test_missing_data_are_named(example, tmp_path, capsys):
    assert example.main([str(tmp_path / "nothing"), "--out", str(tmp_path / "out")]) == 1
    message = capsys.readouterr().err
    assert example.FILE in message
    assert "CSAS_REAL_DATA" in message
    assert not (tmp_path / "out").exists()
