"""Multi-look and colour-by-aspect images of views whose content is known."""

from __future__ import annotations

import colorsys
import math

import numpy as np
import pytest
from core_data import ground_of_pixels, make_info

from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.core.geometry import GroundGrid, View, wrap_angle
from csas_shadow_ros.core.imaging.composites import Composites, level_image

GRID = GroundGrid.centred(90, 110, 0.02, (0.1, -0.05))


def composed(pixels_of, aspects_deg, size=160):
    out = Composites(GRID)
    for a in aspects_deg:
        info = make_info(math.radians(a), size=size)
        assert out.integrate(View(info, pixels_of(info)))
    return out


def spot(info, position, level=10.0, floor=1.0, width=0.04):
    x, y = ground_of_pixels(info.camera)
    power = floor**2 + level**2 * np.exp(-0.5 * ((x - position[0]) ** 2 + (y - position[1]) ** 2) / width**2)
    return np.sqrt(power).astype(np.float32)


def pixel_of(x, y):
    u, v, _ = GRID.ground_to_pixel @ (x, y, 1.0)
    return round(v), round(u)


def test_the_multilook_of_constant_power_is_constant():
    def phasors(info):
        rng = np.random.default_rng(info.stamp_ns % 1000)
        return (3.0 * np.exp(2j * np.pi * rng.random(info.camera.shape))).astype(np.complex64)

    image = composed(phasors, range(0, 360, 10)).multilook()
    assert image.shape == GRID.shape
    assert np.allclose(image, 3.0, rtol=1e-4)


def test_the_multilook_is_the_root_of_the_mean_power_and_smooths_speckle():
    def speckle(info):
        return (
            np.random.default_rng(round(info.aspect_rad * 1e6))
            .rayleigh(1.0, info.camera.shape)
            .astype(np.float32)
        )

    image = composed(speckle, range(0, 360, 10)).multilook()
    assert np.sqrt((image**2).mean()) == pytest.approx(math.sqrt(2.0), rel=0.02)
    assert image.std() / image.mean() < 0.15


@pytest.mark.parametrize("position", [(0.6, 0.3), (-0.7, 0.5), (0.4, -0.6)])
def test_a_point_appears_at_its_ground_position_north_up(position):
    image = composed(lambda info: spot(info, position), range(0, 360, 20)).multilook()
    row, col = np.unravel_index(np.nanargmax(image), image.shape)
    assert GRID.x_of_columns()[col] == pytest.approx(position[0], abs=0.02)
    assert GRID.y_of_rows()[row] == pytest.approx(position[1], abs=0.02)


@pytest.mark.parametrize("aspect_deg", [10.0, 130.0, 200.0, 345.0])
def test_a_one_sided_scatterer_has_the_hue_of_its_aspect_and_more_colour_than_an_isotropic_one(aspect_deg):
    one_sided, isotropic = (0.5, 0.2), (-0.4, -0.3)

    def pixels(info):
        out = spot(info, isotropic)
        if abs(float(wrap_angle(info.aspect_rad - math.radians(aspect_deg)))) < math.radians(21):
            out = np.hypot(out, spot(info, one_sided, level=30.0, floor=0.0)).astype(np.float32)
        return out

    c = composed(pixels, range(0, 360, 10))
    aspect, anisotropy = c.dominant_aspect()
    there, elsewhere = pixel_of(*one_sided), pixel_of(*isotropic)
    assert abs(float(wrap_angle(aspect[there] - math.radians(aspect_deg)))) < math.radians(6)
    assert anisotropy[there] > 0.9
    assert anisotropy[elsewhere] < 0.05
    rgb = c.color_by_aspect()
    assert rgb.dtype == np.uint8
    assert rgb.shape == (*GRID.shape, 3)
    hue, saturation, _ = colorsys.rgb_to_hsv(*(rgb[there] / 255.0))
    assert abs(float(wrap_angle(2 * math.pi * hue - math.radians(aspect_deg)))) < math.radians(8)
    assert saturation > colorsys.rgb_to_hsv(*(rgb[elsewhere] / 255.0))[1] + 0.5


def test_a_view_counts_once_and_the_order_does_not_matter():
    infos = [make_info(math.radians(a), size=160) for a in range(0, 360, 30)]
    views = [View(i, spot(i, (0.3, 0.1 * k % 0.5))) for k, i in enumerate(infos)]
    a, b = Composites(GRID), Composites(GRID)
    for view in views:
        assert a.integrate(view) is True
        assert a.integrate(view) is False
    for view in reversed(views):
        b.integrate(view)
    assert a.stamps == b.stamps
    assert np.allclose(a.multilook(), b.multilook(), rtol=1e-5, equal_nan=True)


def test_what_no_view_saw_is_unknown_and_black():
    def half(info):
        out = np.ones(info.camera.shape, np.float32)
        out[ground_of_pixels(info.camera)[0] < 0] = np.nan
        return out

    c = composed(half, range(0, 360, 30))
    image, rgb = c.multilook(), c.color_by_aspect()
    west = GRID.x_of_columns() < -0.03
    assert np.isnan(image[:, west]).all()
    assert (rgb[:, west] == 0).all()
    assert np.isfinite(image[:, GRID.x_of_columns() > 0.03]).all()


def test_the_grid_made_for_a_view_covers_what_the_view_covers():
    view = View(make_info(0.7, size=100, spacing_m=0.03, centre=(0.4, -0.2)), np.ones((100, 100), np.float32))
    grid = Composites.for_view(view).grid
    assert grid.spacing_m == pytest.approx(0.03)
    assert grid.shape == (100, 100)
    assert grid.centre_m == pytest.approx((0.4, -0.2))


def test_nothing_to_show_is_refused():
    with pytest.raises(ParameterError, match="no known pixel above zero"):
        Composites(GRID).color_by_aspect()
    with pytest.raises(ParameterError, match="no known pixel above zero"):
        level_image(np.zeros((4, 4)), 30.0)
    with pytest.raises(ParameterError, match="dynamic_range_db is 0"):
        Composites(GRID).color_by_aspect(0.0)


def test_levels_are_shown_over_the_range_asked_for():
    amplitude = np.array([[1.0, 10 ** (-10 / 20), 10 ** (-40 / 20), 0.0, np.nan]])
    assert level_image(amplitude, 20.0)[0] == pytest.approx([1.0, 0.5, 0.0, 0.0, 0.0], abs=0.01)
