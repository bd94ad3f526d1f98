"""camera_info: geometry and band survive unchanged, and what breaks the contract is refused by name."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from csas_shadow_ros.core.geometry import (
    Acoustics,
    GroundGrid,
    GroundLattice,
    ShadowCamera,
    ViewInfo,
    view_ground_to_pixel,
)
from csas_shadow_ros.core.shape.volume import Volume
from msg_adapters import (
    AdapterError,
    GroundInfo,
    Pairer,
    RosbagsMessages,
    check_pair,
    coherent_image_from_msgs,
    coherent_image_to_msgs,
    ground_info_from_msg,
    ground_info_to_msg,
    ground_picture_from_msgs,
    ground_picture_to_msgs,
    sector_from_msgs,
    sector_to_msgs,
    view_from_msgs,
    view_info_from_msg,
    view_info_to_msg,
    view_to_msgs,
    voxel_grid_from_msgs,
    voxel_grid_to_msgs,
)
from msg_adapters.topics import D_ENTRIES, STREAMS, TOPICS, VIEW_STREAMS, absolute_name

STAGES = ("sub_aperture", "shadow", "likelihood", "shadow_mask")


def same_grid(a, b):
    return a.shape == b.shape and np.allclose(
        (a.spacing_m, a.x_min_m, a.y_max_m), (b.spacing_m, b.x_min_m, b.y_max_m), rtol=1e-12, atol=1e-12
    )


def test_the_full_image_survives_the_round_trip(factory, coherent):
    back = coherent_image_from_msgs(*coherent_image_to_msgs(factory, coherent))
    np.testing.assert_array_equal(back.pixels, coherent.pixels)
    assert same_grid(back.grid, coherent.grid)
    assert (back.acoustics, back.stamp_ns) == (coherent.acoustics, coherent.stamp_ns)


def test_a_sector_on_a_turned_lattice_with_oblong_pixels_survives_the_round_trip(factory, sector):
    lattice = GroundLattice(12, 17, (1.5, -2.25), (0.03, 0.04), (0.016, -0.012))
    image, info = sector_to_msgs(factory, replace(sector, grid=lattice))
    back = sector_from_msgs(image, info)
    assert isinstance(back.grid, GroundLattice)
    np.testing.assert_allclose(back.grid.pixel_to_ground, lattice.pixel_to_ground, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(back.pixels, sector.pixels)
    info.p[0] *= -1.0
    info.p[1] *= -1.0
    info.p[3] *= -1.0
    with pytest.raises(AdapterError, match=r"sector/camera_info\.p: .*mirrored"):
        sector_from_msgs(image, info)


def test_a_sector_survives_the_round_trip(factory, sector):
    image, info = sector_to_msgs(factory, sector)
    assert info.distortion_model == "csas_sector"
    assert math.isnan(info.d[8])
    back = sector_from_msgs(image, info)
    np.testing.assert_array_equal(back.pixels, sector.pixels)
    assert same_grid(back.grid, sector.grid)
    for name in ("acoustics", "stamp_ns", "aspect_rad", "aperture_rad", "carrier_rad_m"):
        assert getattr(back, name) == getattr(sector, name)


@pytest.mark.parametrize("stage", STAGES)
def test_a_view_survives_the_round_trip_to_the_last_bit(factory, views, stage):
    view = views[stage]
    image, info = view_to_msgs(factory, view, stage)
    assert image.header.stamp == info.header.stamp
    assert info.distortion_model == STREAMS[stage].distortion_model
    back = view_from_msgs(image, info, stage)
    np.testing.assert_array_equal(back.pixels, view.pixels)
    np.testing.assert_array_equal(back.info.camera.projection, view.info.camera.projection)
    np.testing.assert_equal(back.info.focus_range_m, view.info.focus_range_m)
    for name in ("stamp_ns", "acoustics", "aspect_rad", "aperture_rad", "carrier_rad_m"):
        assert getattr(back.info, name) == getattr(view.info, name)


def test_k_and_r_are_the_decomposition_of_p(factory, views, coherent):
    for info in (
        view_to_msgs(factory, views["shadow"], "shadow")[1],
        coherent_image_to_msgs(factory, coherent)[1],
    ):
        k, r = np.reshape(info.k, (3, 3)), np.reshape(info.r, (3, 3))
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(r) == pytest.approx(1.0)
        np.testing.assert_array_equal(np.tril(k, -1), 0)
    # The view's left 3x3 is K R up to scale; the ground image's P drops the depth of K R instead.
    info = view_to_msgs(factory, views["shadow"], "shadow")[1]
    m, kr = np.reshape(info.p, (3, 4))[:, :3], np.reshape(info.k, (3, 3)) @ np.reshape(info.r, (3, 3))
    scale = np.linalg.norm(m) / np.linalg.norm(kr) * np.sign(m[2, 2] * kr[2, 2])
    np.testing.assert_allclose(kr * scale, m, atol=1e-9 * np.linalg.norm(m))
    info = coherent_image_to_msgs(factory, coherent)[1]
    p, kr = np.reshape(info.p, (3, 4)), np.reshape(info.k, (3, 3)) @ np.reshape(info.r, (3, 3))
    np.testing.assert_allclose(kr[:2, :2], p[:2, :2])
    np.testing.assert_allclose(np.reshape(info.k, (3, 3))[:2, 2], p[:2, 3])


def test_composites_survive_the_round_trip(factory, coherent):
    info = GroundInfo(coherent.stamp_ns, coherent.grid, coherent.acoustics)
    rng = np.random.default_rng(0)
    for stream, pixels in (
        ("multilook", rng.random(coherent.grid.shape, dtype=np.float32)),
        ("color_by_aspect", rng.integers(0, 256, (*coherent.grid.shape, 3), dtype=np.uint8)),
    ):
        ground, back = ground_picture_from_msgs(
            *ground_picture_to_msgs(factory, pixels, info, stream), stream
        )
        np.testing.assert_array_equal(back, pixels)
        assert same_grid(ground.grid, coherent.grid)
    with pytest.raises(AdapterError, match=r"multilook/image has \(3, 3\) pixels; expected \(12, 17\)"):
        ground_picture_to_msgs(factory, np.ones((3, 3), np.float32), info, "multilook")


def test_a_dense_grid_survives_and_lies_north_up_on_the_ground(factory):
    volume = Volume((-0.4, 0.3, 0.05), 0.1, (4, 5, 6))
    rng = np.random.default_rng(0)
    likelihood = rng.random(volume.shape, dtype=np.float32)
    likelihood[1, 2, 3] = np.nan
    image, info = voxel_grid_to_msgs(factory, volume, likelihood, 77)
    assert (image.height, image.width, image.encoding) == (5, 6, "32FC4")
    assert list(info.d) == [0.05, 0.1]
    stamp, back_volume, back = voxel_grid_from_msgs(image, info)
    assert stamp == 77
    np.testing.assert_array_equal(back, likelihood)
    assert back_volume.shape == volume.shape
    np.testing.assert_allclose(back_volume.origin_m, volume.origin_m, atol=1e-12)
    assert back_volume.voxel_size_m == pytest.approx(volume.voxel_size_m)
    # P of its camera_info sends a voxel's (x, y) to the pixel whose channels are that column of voxels.
    iz, iy, ix = 2, 4, 1
    u, v, w = np.reshape(info.p, (3, 4)) @ (volume.x_m[ix], volume.y_m[iy], volume.z_m[iz], 1.0)
    pixels = np.frombuffer(bytes(image.data), "<f4").reshape(5, 6, 4)
    assert pixels[round(v / w), round(u / w), iz] == likelihood[iz, iy, ix]


def test_a_dense_grid_that_contradicts_itself_is_refused(factory):
    volume = Volume((0.0, 0.0, 0.05), 0.1, (4, 5, 6))
    likelihood = np.zeros(volume.shape, np.float32)
    image, info = voxel_grid_to_msgs(factory, volume, likelihood, 77)
    info.d = factory.doubles([0.05, 0.2])
    with pytest.raises(AdapterError, match=r"d\[1\], the layer spacing, is 0\.2 m; expected cubes .* 0\.1 m"):
        voxel_grid_from_msgs(image, info)
    with pytest.raises(AdapterError, match=r"has \(5, 5, 6\) voxels; expected \(4, 5, 6\)"):
        voxel_grid_to_msgs(factory, volume, np.zeros((5, 5, 6), np.float32), 77)
    with pytest.raises(AdapterError, match=r"number of rows is 1 pixels"):
        voxel_grid_to_msgs(factory, Volume((0, 0, 0), 0.1, (4, 1, 6)), np.zeros((4, 1, 6), np.float32), 77)


def entry(i, value):
    def change(factory, msg):
        d = [float(v) for v in msg.d]
        d[i] = value
        msg.d = factory.doubles(d)

    return change


def entries(n):
    def change(factory, msg):
        msg.d = factory.doubles(([float(v) for v in msg.d] * 2)[:n])

    return change


def field(**fields):
    def change(factory, msg):
        for name, value in fields.items():
            setattr(msg, name, value)

    return change


def projection(change_p):
    def change(factory, msg):
        p = np.reshape(np.array(msg.p, np.float64), (3, 4)).copy()
        msg.p = np.asarray(change_p(p), np.float64).reshape(12)

    return change


def frame(name):
    def change(factory, msg):
        msg.header.frame_id = name

    return change


def stamp(sec):
    def change(factory, msg):
        msg.header.stamp.sec = sec

    return change


def roi(factory, msg):
    msg.roi.width = 3


ANY = [
    (frame(""), r"camera_info\.header\.frame_id is ''; expected the name of the scene's frame"),
    (stamp(-5), r"camera_info\.header\.stamp is -5 s"),
    (field(distortion_model="plumb_bob"), r"distortion_model is 'plumb_bob'; expected one of: csas_"),
    (field(distortion_model=""), r"distortion_model is ''; expected one of: csas_"),
    (entries(0), r"d has 0 entries; expected \d: centre frequency \(Hz\), bandwidth \(Hz\), sound speed"),
    (entries(3), r"d has 3 entries; expected \d: .*spectrum_sign"),
    (entry(0, math.nan), r"d\[0\], the centre frequency \(Hz\), is nan; expected a finite number"),
    (entry(0, -1.0), r"camera_info\.d: centre frequency is -1\.0 Hz; expected \(0,"),
    (entry(1, math.inf), r"d\[1\], the bandwidth \(Hz\), is inf"),
    (entry(1, 500e3), r"camera_info\.d: bandwidth is 500000\.0 Hz"),
    (entry(2, 0.0), r"camera_info\.d: sound speed is 0\.0 m/s"),
    (entry(3, 0.0), r"d\[3\], the spectrum_sign, is 0; expected \+1 or -1"),
    (entry(3, 0.9), r"d\[3\], the spectrum_sign, is 0\.9; expected \+1 or -1"),
    (field(width=0), r"camera_info\.width is 0 pixels"),
    (field(height=0), r"camera_info\.height is 0 pixels"),
    (field(binning_x=2), r"binning is 2 by 0; expected none"),
    (roi, r"roi is 3 by 0 at 0, 0; expected none"),
    (projection(lambda p: p * np.nan), r"camera_info\.p: P .*expected finite"),
    (projection(lambda p: p * 0), r"camera_info\.p: P "),
]

GROUND = [
    (entries(5), r"d has 5 entries; expected 4: centre frequency"),
    (field(distortion_model="csas_shadow"), r"model is 'csas_shadow'; expected one of: csas_image"),
    (projection(lambda p: p * [[1], [-1], [1]]), r"p: P has x scale 50 and y scale 50 px/m;.*north up"),
    (projection(lambda p: p * [[2], [1], [1]]), r"p: pixels of the ground-plane .*expected square"),
    (
        projection(lambda p: p + np.array([[0, 5, 0, 0], [0] * 4, [0] * 4])),
        r"p: P of the ground-plane image has terms bes",
    ),
]

VIEW = [
    (entries(8), r"d has 8 entries; expected 9: .*focus range"),
    (entries(10), r"d has 10 entries; expected 9"),
    (entry(4, math.nan), r"d\[4\], the aspect \(rad\), is nan"),
    (entry(5, 0.0), r"d\[5\], the aperture width, is 0 rad; expected \(0, 2 pi\]"),
    (entry(5, -0.1), r"d\[5\], the aperture width, is -0\.1 rad"),
    (entry(5, 7.0), r"d\[5\], the aperture width, is 7 rad"),
    (entry(6, math.inf), r"d\[6\], the carrier kx \(rad/m\), is inf"),
    (entry(8, math.inf), r"d\[8\], the focus range \(m\), is inf; expected .* NaN before"),
    (entry(4, math.radians(280.0)), r"rows point 180\.0 degrees away from .* the aspect in d\[4\]"),
    (entry(4, math.radians(107.0)), r"rows point 7\.0 degrees away"),
    (field(distortion_model="csas_image"), r"distortion_model is 'csas_image'; expected one of: csas_shadow"),
    (projection(lambda p: p * [[-1], [1], [1]]), r"p: P mirrors the ground"),
]


@pytest.mark.parametrize(("spoil", "match"), ANY + GROUND, ids=[m for _, m in ANY + GROUND])
def test_a_malformed_info_of_the_image_is_refused(factory, coherent, spoil, match):
    msg = coherent_image_to_msgs(factory, coherent)[1]
    spoil(factory, msg)
    with pytest.raises(AdapterError, match=match):
        ground_info_from_msg(msg)


@pytest.mark.parametrize(("spoil", "match"), ANY + VIEW, ids=[m for _, m in ANY + VIEW])
def test_a_malformed_info_of_a_view_is_refused(factory, views, spoil, match):
    msg = view_to_msgs(factory, views["likelihood"], "likelihood")[1]
    spoil(factory, msg)
    with pytest.raises(AdapterError, match=match):
        view_info_from_msg(msg, "likelihood")


def test_a_sonar_at_another_aspect_than_stated_is_refused(factory):
    aspect = 0.5
    ground = view_ground_to_pixel(aspect, 0.05, 8, 8, (0.0, 0.0))
    camera = ShadowCamera.from_ground(ground, (75.0, 0.0, 18.0), 8, 8)
    info = ViewInfo(1, camera, Acoustics(120e3, 40e3, 1500, 1), aspect, math.radians(12))
    msg = view_info_to_msg(factory, info, "shadow")
    with pytest.raises(AdapterError, match=r"sonar stands at aspect 0\.0 degrees, but d\[4\] says 28\.6"):
        view_info_from_msg(msg, "shadow")


def test_an_image_and_an_info_of_other_stamp_or_size_are_refused(factory, coherent):
    image, info = coherent_image_to_msgs(factory, coherent)
    info.header.stamp.sec += 1
    with pytest.raises(AdapterError, match=r"is stamped 1700000001123456789 ns; expected .* 17000000001234"):
        coherent_image_from_msgs(image, info)
    info.header.stamp.sec -= 1
    info.width += 1
    with pytest.raises(AdapterError, match=r"camera_info\.width is 18; expected the image's width, 17"):
        check_pair(image, info)


def test_a_view_is_not_written_as_a_stream_without_views(factory, views):
    with pytest.raises(AdapterError, match=r"'image' holds no views; expected one of: sub_aperture"):
        view_info_to_msg(factory, views["shadow"].info, "image")


@given(
    aspect=st.floats(-10, 10),
    ground_range=st.floats(1, 1e4),
    slope=st.floats(0.02, 2),
    spacing=st.floats(1e-3, 10),
    focus=st.one_of(st.just(math.nan), st.floats(-100, 100)),
    sign=st.sampled_from([1, -1]),
)
def test_any_view_geometry_survives_to_the_last_bit(aspect, ground_range, slope, spacing, focus, sign):
    sonar = (ground_range * math.cos(aspect), ground_range * math.sin(aspect), ground_range * slope)
    camera = ShadowCamera.from_ground(view_ground_to_pixel(aspect, spacing, 30, 40, (0, 0)), sonar, 30, 40)
    info = ViewInfo(9, camera, Acoustics(1e5, 1e4, 1500, sign), aspect, 0.2, (1.0, -2.0), focus)
    back = view_info_from_msg(view_info_to_msg(RosbagsMessages(), info, "shadow"), "shadow")
    np.testing.assert_array_equal(back.camera.projection, camera.projection)
    assert (back.aspect_rad, back.acoustics, back.carrier_rad_m) == (aspect, info.acoustics, (1.0, -2.0))


@given(
    rows=st.integers(2, 5000),
    cols=st.integers(2, 5000),
    spacing=st.floats(1e-3, 10),
    x=st.floats(-1e3, 1e3),
    y=st.floats(-1e3, 1e3),
)
def test_any_ground_grid_survives_to_a_billionth_of_a_pixel(rows, cols, spacing, x, y):
    info = GroundInfo(0, GroundGrid(rows, cols, spacing, x, y), Acoustics(1e5, 1e4, 1500, 1))
    grid = ground_info_from_msg(ground_info_to_msg(RosbagsMessages(), info)).grid
    assert grid.shape == (rows, cols)
    assert grid.spacing_m == pytest.approx(spacing, rel=1e-12)
    assert abs(grid.x_min_m - x) <= 1e-9 * spacing + 1e-12 * abs(x)
    assert abs(grid.y_max_m - y) <= 1e-9 * spacing + 1e-12 * abs(y)


def test_the_pairer_joins_a_stamp_in_either_order_and_names_orphans(factory, coherent):
    pairer = Pairer("image", capacity=2)
    pairs = []
    for i in range(5):
        moved = type(coherent)(coherent.pixels, coherent.grid, coherent.acoustics, 1000 + i)
        image, info = coherent_image_to_msgs(factory, moved)
        pairs.append((image, info))
    assert pairer.add(pairs[0][0], is_info=False) is None
    assert pairer.add(pairs[0][1], is_info=True) == pairs[0]
    assert pairer.add(pairs[1][1], is_info=True) is None
    assert pairer.add(pairs[1][0], is_info=False) == pairs[1]
    for image, _ in pairs[2:5]:
        assert pairer.add(image, is_info=False) is None
    assert pairer.orphans == ["image: image stamped 1002 ns has no camera_info of the same stamp"]
    assert len(pairer.flush()) == 3


def test_the_contract_names_every_topic_once_and_each_stream_has_its_pair():
    assert len({t.name for t in TOPICS.values()}) == len(TOPICS)
    for s in STREAMS.values():
        assert TOPICS[s.image_topic].encodings == s.encodings
        assert TOPICS[s.info_topic].distortion_models == (s.distortion_model,)
        assert s.distortion_model in D_ENTRIES
    assert set(VIEW_STREAMS) <= set(STREAMS)
    assert all(t.description for t in TOPICS.values())


def test_names_are_joined_with_one_slash():
    assert absolute_name("image") == "/csas/image"
    assert absolute_name("image", "boat/csas/") == "/boat/csas/image"
    assert absolute_name("image", "") == "/image"
    assert absolute_name("/diagnostics", "/csas") == "/diagnostics"
