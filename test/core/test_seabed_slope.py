"""The seabed's slope: exact shadow ends of any top give it back, a run over one is carved as over none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from core_data import make_info
from hypothesis import given
from hypothesis import strategies as st

from csas_shadow_ros.core.geometry import Track, View, down_range_axis
from csas_shadow_ros.core.imaging.mask_codes import MASK_SHADOW, MASK_UNKNOWN
from csas_shadow_ros.core.parameters import PipelineParameters, SubApertureParameters, TargetParameters
from csas_shadow_ros.core.pipeline import run
from csas_shadow_ros.core.shape.carving import Carver
from csas_shadow_ros.core.shape.seabed import SeabedSlope, ShadowEnd, seabed_slope, shadow_end

RANGE_M, HEIGHT_M, TOP_M = 20.0, 6.0, 0.4
STEP_DEG = 3.0


def ends_of(top, gradient=(0.0, 0.0), too_high_m=0.0, keep=lambda _: True):
    """Return the exact shadow ends of points at one height, as a track tells them that errs by a slope."""
    ends = []
    for degrees in np.arange(0.0, 360.0, STEP_DEG):
        if not keep(degrees):
            continue
        aspect = math.radians(degrees)
        sonar = np.array([RANGE_M * math.cos(aspect), RANGE_M * math.sin(aspect), HEIGHT_M])
        cast = sonar[:2] + (top - sonar[:2]) * HEIGHT_M / (HEIGHT_M - TOP_M)
        end = cast[np.argmax(cast @ down_range_axis(aspect))]
        told = (sonar[0], sonar[1], sonar[2] + too_high_m + float(np.dot(gradient, sonar[:2])))
        ends.append(ShadowEnd(make_info(aspect, sonar_m=told), (float(end[0]), float(end[1]))))
    return ends


corners = st.lists(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)), min_size=1, max_size=7, unique=True)
slopes = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))


@given(corners, slopes)
def test_the_exact_ends_of_any_flat_top_give_the_slope_back(top, gradient):
    found = seabed_slope(ends_of(np.array(top), gradient), (0.0, 0.0), TOP_M)
    assert found is not None
    assert found.gradient == pytest.approx(gradient, abs=math.tan(math.radians(0.4)))
    # It says itself how sure it is.
    assert np.abs(np.subtract(found.gradient, gradient)).max() < 4.0 * found.sigma + 1e-3


@given(corners, slopes, st.floats(0.0, 360.0))
def test_a_missing_arc_does_not_mislead_it(top, gradient, start):
    ends = ends_of(np.array(top), gradient, keep=lambda degrees: (degrees - start) % 360.0 > 90.0)
    found = seabed_slope(ends, (0.0, 0.0), TOP_M)
    assert found is not None
    assert np.abs(np.subtract(found.gradient, gradient)).max() < 4.0 * found.sigma + 1e-3


def test_a_height_that_is_wrong_all_round_is_no_slope():
    top = np.array([(0.4, 0.2), (-0.4, 0.2), (-0.4, -0.2), (0.4, -0.2)])
    found = seabed_slope(ends_of(top, too_high_m=0.5), (0.0, 0.0), TOP_M)
    assert found is not None
    assert not found.believed


def test_it_does_not_depend_on_the_order_of_the_views():
    ends = ends_of(np.array([(0.5, 0.1), (-0.2, 0.3), (-0.4, -0.2)]), (0.02, -0.01))
    assert seabed_slope(ends[::-1], (0.0, 0.0), TOP_M) == seabed_slope(ends, (0.0, 0.0), TOP_M)


@pytest.mark.parametrize(
    "keep", [lambda degrees: degrees % 18.0 == 0.0, lambda degrees: degrees < 150.0], ids=["few", "short arc"]
)
def test_too_little_of_a_circle_tells_nothing(keep):
    top = np.array([(0.4, 0.2), (-0.4, -0.2)])
    assert seabed_slope(ends_of(top, (0.03, 0.0), keep=keep), (0.0, 0.0), TOP_M) is None


def test_a_slope_changes_the_sonars_height_and_nothing_else():
    info = make_info(aspect_rad=0.0, sonar_m=(RANGE_M, 0.0, HEIGHT_M))
    slope = SeabedSlope((0.05, 0.0), 0.001, (0.0, 0.0))
    assert slope.believed
    raised = slope.corrected(info)
    assert raised.camera.sonar_m == pytest.approx((RANGE_M, 0.0, HEIGHT_M - 0.05 * RANGE_M))
    np.testing.assert_allclose(raised.camera.ground_to_pixel, info.camera.ground_to_pixel, atol=1e-9)
    assert replace(raised, camera=info.camera) == info


@pytest.mark.parametrize(
    ("gradient", "sigma"), [((0.05, 0.0), 0.02), ((0.005, 0.0), 1e-4), ((0.5, 0.0), 0.001)]
)
def test_chance_trifles_and_cliffs_are_not_believed(gradient, sigma):
    info = make_info(aspect_rad=0.0, sonar_m=(RANGE_M, 0.0, HEIGHT_M))
    slope = SeabedSlope(gradient, sigma, (0.0, 0.0))
    assert not slope.believed
    assert slope.corrected(info) is info


def test_a_shadow_has_an_end_only_where_seabed_is_seen_behind_it():
    info = make_info(0.0, size=64)
    mask = np.zeros((64, 64), np.uint8)
    mask[20:40, 10:21] = MASK_SHADOW
    found = shadow_end(View(info, mask))
    assert found is not None
    pixel = info.camera.ground_to_pixel @ np.array([*found.point_m, 1.0])
    assert pixel[:2] == pytest.approx((15.0, 39.5))
    mask[40:44] = MASK_UNKNOWN  # an echo, or too dark for seabed: seabed comes after it
    assert shadow_end(View(info, mask)) == found
    mask[40:] = MASK_UNKNOWN
    assert shadow_end(View(info, mask)) is None
    mask[40:] = MASK_SHADOW
    assert shadow_end(View(info, mask)) is None
    assert shadow_end(View(info, np.zeros((64, 64), np.uint8))) is None


TILT = math.tan(math.radians(2.0))


@pytest.fixture(scope="session")
def level_and_tilted(box_run):
    """Reconstruct a box over a level seabed, and with a track whose heights refer to a level 2° off."""
    positions = box_run.track.positions_m.copy()
    positions[:, 2] -= TILT * positions[:, 0]
    parameters = PipelineParameters(
        sub_aperture=SubApertureParameters(step_deg=4.0),
        target=TargetParameters(target="given", position_m=(0.1, -0.15), size_m=(1.0, 1.0, 0.5)),
    )
    masks = []

    def keep(view):
        masks.append(view.mask)

    level = run(box_run.image, box_run.track, parameters)
    tilted = run(box_run.image, Track(box_run.track.stamps_ns, positions), parameters, on_view=keep)
    return level, tilted, masks


def test_a_level_seabed_is_left_as_it_is(level_and_tilted):
    slope = level_and_tilted[0].grid.seabed
    assert slope is not None
    assert not slope.believed
    assert slope.slope_rad < math.radians(0.5)


def test_a_run_over_a_slope_is_carved_as_over_a_level(level_and_tilted):
    level, tilted, masks = level_and_tilted
    slope = tilted.grid.seabed
    assert slope.believed
    # The track lies TILT · x too low: as if the seabed fell towards +x.
    assert slope.gradient == pytest.approx((-TILT, 0.0), abs=min(3.0 * slope.sigma, math.radians(0.5)))
    a, b = level.grid.occupied, tilted.grid.occupied
    agreement = (a & b).sum() / (a | b).sum()
    carver = Carver(tilted.grid.volume)
    for mask in masks:
        carver.integrate(mask)
    leaning = carver.first_look().occupied
    assert agreement > 0.93
    assert agreement > (a & leaning).sum() / (a | leaning).sum() + 0.03
    # Where no shadow tells the height, it is as uncertain as its interval says.
    for one, other in ((level, tilted), (tilted, level)):
        low, high = one.dimensions.intervals["height_m"]
        assert low < other.dimensions.height_m < high < low + 0.25
    # What is measured beside the grid stands over the same seabed.
    heights = [side.info.camera.sonar_m[2] for side in tilted.sides]
    told = [mask.info.camera.sonar_m[2] for mask in masks]
    assert np.ptp(heights) < 0.3 * np.ptp(told)


def test_the_grid_over_a_slope_does_not_depend_on_the_order_of_the_views(level_and_tilted):
    _, tilted, masks = level_and_tilted
    grids = []
    for order in (masks, masks[::-1]):
        carver = Carver(tilted.grid.volume)
        for mask in order:
            carver.integrate(mask)
        grids.append(carver.grid())
    np.testing.assert_array_equal(grids[0].likelihood, grids[1].likelihood)
    np.testing.assert_array_equal(grids[0].occupied, tilted.grid.occupied)
