"""Geometry of grids and views: where shadows fall, and which way round pictures are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from core_data import acoustics, make_info
from hypothesis import assume, given
from hypothesis import strategies as st

from csas_shadow_ros.core.errors import GeometryError, ParameterError
from csas_shadow_ros.core.geometry import (
    Acoustics,
    CoherentImage,
    GroundGrid,
    ShadowCamera,
    View,
    aspects_of_step,
    cross_range_axis,
    down_range_axis,
    fit_target_to_focus,
    unit_to_sonar,
    view_ground_to_pixel,
    wrap_angle,
)

angles = st.floats(-10.0, 10.0)
offsets = st.floats(-5.0, 5.0)
heights = st.floats(0.5, 60.0)
radii = st.floats(1.0, 200.0)


def camera_of(aspect, radius, height, spacing=0.02, centre=(0.0, 0.0), rows=100, cols=140):
    sonar = (radius * math.cos(aspect), radius * math.sin(aspect), height)
    a = view_ground_to_pixel(aspect, spacing, rows, cols, centre)
    return ShadowCamera.from_ground(a, sonar, rows, cols)


@given(angles, radii, heights, offsets, offsets, st.floats(0.0, 0.9))
def test_p_times_x_is_the_pixel_where_the_shadow_formula_puts_the_shadow(aspect, radius, height, x, y, share):
    camera = camera_of(aspect, radius, height, centre=(0.3, -0.7))
    z = share * height
    s = np.array([radius * math.cos(aspect), radius * math.sin(aspect)])
    fallen = s + (np.array([x, y]) - s) * height / (height - z)
    # column along e_c = (sin θ, -cos θ), row along -û(θ), the middle of the picture at the centre
    off = fallen - (0.3, -0.7)
    u = 69.5 + off @ (math.sin(aspect), -math.cos(aspect)) / 0.02
    v = 49.5 + off @ (-math.cos(aspect), -math.sin(aspect)) / 0.02
    h = camera.projection @ (x, y, z, 1.0)
    tolerance = 1e-6 * (1 + abs(u) + abs(v))
    assert h[:2] / h[2] == pytest.approx((u, v), abs=tolerance)
    assert camera.project((x, y, z)) == pytest.approx((u, v), abs=tolerance)
    m = camera.height_slice_affine(z)
    assert m @ (x, y, 1.0) == pytest.approx((u, v), abs=tolerance)


@given(angles, radii, heights)
def test_the_null_vector_of_p_is_the_sonar(aspect, radius, height):
    camera = camera_of(aspect, radius, height, centre=(0.4, 0.1))
    null = np.linalg.svd(camera.projection)[2][-1]
    expected = (radius * math.cos(aspect), radius * math.sin(aspect), height)
    assert null[:3] / null[3] == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert camera.sonar_m == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert camera.grazing_rad == pytest.approx(math.atan2(height, radius))
    assert abs(wrap_angle(camera.aspect_rad - aspect)) < 1e-9


@pytest.mark.parametrize("scale", [1.0, -1.0, 1e4, -1e-4])
@pytest.mark.parametrize("aspect_deg", [0, 33, 90, 200, 270])
def test_k_and_r_are_the_decomposition_of_p(aspect_deg, scale):
    camera = camera_of(math.radians(aspect_deg), 75.0, 18.0, centre=(0.2, 0.1))
    camera = ShadowCamera(camera.projection * scale, *camera.shape)
    k, r = camera.decompose()
    assert r @ r.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(r) == pytest.approx(1.0)
    assert np.all(np.diag(k) > 0)
    assert k[2, 2] == 1.0
    assert np.abs(k[np.tril_indices(3, -1)]).max() < 1e-9 * np.abs(k).max()
    again = k @ r @ np.column_stack([np.eye(3), -camera.sonar_m])
    factor = (
        camera.projection[0, 0] / again[0, 0]
        if abs(again[0, 0]) > 1
        else camera.projection[1, 0] / again[1, 0]
    )
    assert camera.projection / factor == pytest.approx(again, rel=1e-9, abs=1e-6 * np.abs(again).max())


def test_a_camera_made_from_p_alone_gives_the_same_geometry():
    info = make_info(1.1, centre=(0.3, 0.2))
    again = ShadowCamera(info.camera.projection.ravel(), *info.camera.shape)
    assert again.ground_to_pixel == pytest.approx(info.camera.ground_to_pixel)
    assert again.spacing_m == pytest.approx((0.02, 0.02))


@given(angles)
def test_a_view_is_a_rotated_map_never_a_mirrored_one(aspect):
    camera = camera_of(aspect, 75.0, 18.0)
    # North-up maps and views both have rows down: the same handedness as the ground grid's own map.
    grid = GroundGrid.centred(10, 10, 0.02)
    assert np.linalg.det(camera.ground_to_pixel[:2, :2]) < 0
    assert np.linalg.det(grid.ground_to_pixel[:2, :2]) < 0
    turn = camera.ground_to_pixel[:2, :2] @ np.linalg.inv(grid.ground_to_pixel[:2, :2])
    assert turn @ turn.T == pytest.approx(np.eye(2), abs=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1.0)


@given(angles, st.floats(0.05, 2.0))
def test_the_sonar_is_above_the_picture_and_shadows_fall_downwards(aspect, height):
    camera = camera_of(aspect, 75.0, 18.0)
    foot, shadow = camera.project((0.2, 0.1, 0.0)), camera.project((0.2, 0.1, height))
    assert shadow[1] > foot[1]
    sonar_ground = camera.ground_to_pixel @ (*camera.sonar_m[:2], 1.0)
    assert sonar_ground[1] < 0
    assert sonar_ground[0] == pytest.approx(69.5, abs=1e-6)


@given(angles)
def test_the_axes_of_a_view_are_orthogonal_and_as_the_conventions_say(aspect):
    assert down_range_axis(aspect) == pytest.approx(-unit_to_sonar(aspect))
    assert cross_range_axis(aspect) @ down_range_axis(aspect) == pytest.approx(0.0, abs=1e-12)
    assert cross_range_axis(aspect) == pytest.approx((math.sin(aspect), -math.cos(aspect)))


def test_points_at_or_above_the_sonar_cast_no_shadow():
    camera = camera_of(0.0, 75.0, 18.0)
    uv = camera.project([[0, 0, 18.0], [0, 0, 25.0], [0, 0, 17.0]])
    assert np.isnan(uv[:2]).all()
    assert np.isfinite(uv[2]).all()
    with pytest.raises(GeometryError, match=r"height 18 m is not below the sonar at 18 m"):
        camera.height_slice_affine(18.0)


def test_down_range_of_rows_is_measured_from_the_scene_origin_away_from_the_sonar():
    info = make_info(math.radians(70), centre=(0.5, -0.2), size=50)
    r = info.down_range_of_rows()
    middle = -(0.5 * math.cos(math.radians(70)) - 0.2 * math.sin(math.radians(70)))
    assert r.mean() == pytest.approx(middle)
    assert np.diff(r) == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda p: p * np.nan, "expected finite"),
        (lambda p: p * 0.0, "singular"),
        (lambda p: np.diag([-1.0, 1.0, 1.0]) @ p, "mirrors the ground"),
        (lambda p: p @ np.diag([1.0, 1.0, -1.0, 1.0]), "sonar of P is at z = -18 m"),
        (lambda p: np.array([[1, 0, 0], [0, 1, 0], [1e-3, 0, 1]]) @ p, "affine"),
    ],
)
def test_a_p_that_is_no_shadow_camera_is_refused(change, match):
    p = camera_of(0.4, 75.0, 18.0).projection
    with pytest.raises(GeometryError, match=match):
        ShadowCamera(change(np.array(p)), 100, 140)


@given(
    st.integers(2, 5000),
    st.integers(2, 5000),
    st.floats(1e-4, 5.0),
    st.floats(-100, 100),
    st.floats(-100, 100),
    st.floats(0.1, 10),
)
def test_a_ground_grid_survives_the_round_trip_through_its_projection(rows, cols, d, x, y, scale):
    grid = GroundGrid(rows, cols, d, x, y)
    again = GroundGrid.from_projection((grid.projection * scale).ravel(), rows, cols)
    assert again.shape == grid.shape
    assert again.spacing_m == pytest.approx(d, rel=1e-9)
    assert (again.x_min_m, again.y_max_m) == pytest.approx((x, y), rel=1e-9, abs=1e-9)


@given(st.integers(2, 300), st.integers(2, 300), st.floats(1e-3, 1.0), offsets, offsets)
def test_a_centred_grid_has_its_middle_where_it_was_asked_for(rows, cols, d, x, y):
    grid = GroundGrid.centred(rows, cols, d, (x, y))
    assert grid.centre_m == pytest.approx((x, y), abs=1e-9)
    assert (grid.x_of_columns().mean(), grid.y_of_rows().mean()) == pytest.approx((x, y), abs=1e-9)
    left, right, bottom, top = grid.extent_m
    assert (right - left, top - bottom) == pytest.approx((cols * d, rows * d))
    assert grid.contains(x, y)
    assert not grid.contains(right + d, y)


def test_a_ground_grid_is_north_up_with_pixel_centres_at_integers():
    grid = GroundGrid(4, 6, 0.5, -1.0, 2.0)
    assert grid.ground_to_pixel @ (-1.0, 2.0, 1.0) == pytest.approx((0, 0, 1))
    assert grid.ground_to_pixel @ (1.5, 0.5, 1.0) == pytest.approx((5, 3, 1))


@pytest.mark.parametrize(
    ("row", "col", "value", "match"),
    [
        (0, 0, -2.0, "x scale -2"),
        (1, 1, 2.0, "y scale 2"),
        (1, 1, -4.0, "expected square pixels"),
        (0, 1, 0.1, "terms besides"),
        (2, 2, 0.1, "terms besides"),
        (0, 0, math.nan, "expected finite"),
        (2, 3, 0.0, "expected finite"),
    ],
)
def test_a_projection_that_is_not_north_up_orthographic_is_refused(row, col, value, match):
    p = GroundGrid(10, 10, 0.5, 0.0, 0.0).projection
    p[row, col] = value
    with pytest.raises(GeometryError, match=match):
        GroundGrid.from_projection(p, 10, 10)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ((1, 10, 0.1, 0, 0), r"number of rows is 1 pixels; expected \[2"),
        ((10, 0, 0.1, 0, 0), "number of cols is 0"),
        ((10, 10, 0.0, 0, 0), "pixel spacing is 0"),
        ((10, 10, -0.1, 0, 0), "pixel spacing is -0.1"),
        ((10, 10, math.nan, 0, 0), "pixel spacing is nan"),
        ((10, 10, 0.1, math.inf, 0), "grid's corner is inf"),
    ],
)
def test_a_grid_out_of_bounds_is_refused_by_name_and_value(arguments, match):
    with pytest.raises((GeometryError, ParameterError), match=match):
        GroundGrid(*arguments)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ((0.0, 1e3, 1500.0, 1), "centre frequency is 0"),
        ((-1.0, 1e3, 1500.0, 1), "centre frequency is -1"),
        ((math.nan, 1e3, 1500.0, 1), "centre frequency is nan"),
        ((math.inf, 1e3, 1500.0, 1), "centre frequency is inf"),
        ((1e5, 0.0, 1500.0, 1), "bandwidth is 0"),
        ((1e5, 2.1e5, 1500.0, 1), "bandwidth is 210000"),
        ((1e5, math.nan, 1500.0, 1), "bandwidth is nan"),
        ((1e5, 1e4, 0.0, 1), "sound speed is 0"),
        ((1e5, 1e4, 4e8, 1), "sound speed is 4"),
        ((1e5, 1e4, 1500.0, 0), r"spectrum_sign is 0; expected \+1 or -1"),
        ((1e5, 1e4, 1500.0, 2), "spectrum_sign is 2"),
        ((1e5, 1e4, 1500.0, math.nan), "spectrum_sign is nan"),
    ],
)
def test_acoustics_out_of_bounds_are_refused_by_name_and_value(arguments, match):
    with pytest.raises(ParameterError, match=match):
        Acoustics(*arguments)


def test_the_ground_band_is_4_pi_f_cos_grazing_over_c():
    low, mid, high = acoustics().ground_band(0.3)
    expected = [4 * math.pi * f * math.cos(0.3) / 1500.0 for f in (48e3, 60e3, 72e3)]
    assert (low, mid, high) == pytest.approx(expected)


@given(st.floats(-1e3, 1e3))
def test_wrapped_angles_lie_in_the_half_open_circle_and_point_the_same_way(angle):
    wrapped = float(wrap_angle(angle))
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)


@pytest.mark.parametrize("step", [0.1, 1.0, 5.0, 7.2, 90.0])
def test_aspects_of_a_step_go_once_round(step):
    aspects = aspects_of_step(math.radians(step), 0.2)
    assert len(aspects) == round(360 / step)
    assert aspects[0] == 0.2
    assert np.diff(aspects) == pytest.approx(math.radians(step))
    assert aspects[-1] + math.radians(step) == pytest.approx(0.2 + 2 * math.pi)


@pytest.mark.parametrize("step", [0.0, -1.0, 7.0, 100.0, math.nan])
def test_a_step_that_does_not_divide_the_circle_is_refused(step):
    with pytest.raises(ParameterError, match="aspect step is"):
        aspects_of_step(math.radians(step))


def focused(aspect, target):
    info = make_info(aspect)
    r0 = -(target[0] * math.cos(aspect) + target[1] * math.sin(aspect))
    return info.__class__(
        info.stamp_ns, info.camera, info.acoustics, aspect, info.aperture_rad, (0.0, 0.0), r0
    )


@given(st.lists(angles, min_size=2, max_size=6), offsets, offsets)
def test_the_target_is_where_the_focus_ranges_of_the_views_meet(aspects, x, y):
    assume(max(abs(math.sin(a - b)) for a in aspects for b in aspects) > 0.1)
    assert fit_target_to_focus([focused(a, (x, y)) for a in aspects]) == pytest.approx((x, y), abs=1e-6)


def test_the_target_cannot_be_fitted_to_views_without_focus_or_of_one_aspect():
    with pytest.raises(GeometryError, match="0 views have a focus range"):
        fit_target_to_focus([make_info(0.0), make_info(1.0)])
    with pytest.raises(GeometryError, match="all look the same way"):
        fit_target_to_focus(
            [focused(1.0, (0.1, 0.2)), focused(1.0, (0.1, 0.2)), focused(1.0 + math.pi, (0.1, 0.2))]
        )


def test_pixels_of_another_shape_than_their_geometry_are_refused():
    with pytest.raises(GeometryError, match=r"\(10, 12\) pixels; its camera says \(128, 128\)"):
        View(make_info(0.0), np.zeros((10, 12), np.float32))
    with pytest.raises(GeometryError, match=r"\(10, 12\) pixels; its grid says \(12, 10\)"):
        CoherentImage(np.zeros((10, 12), np.complex64), GroundGrid(12, 10, 0.1, 0, 0), acoustics())
