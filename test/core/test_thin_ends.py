"""Bodies that thin out: their ends are carved and measured, and what stays open is in the interval."""

from __future__ import annotations

import math

import numpy as np
import pytest
from core_data import make_view

from csas_shadow_ros.core.imaging import segmentation
from csas_shadow_ros.core.imaging.likelihood import view_levels
from csas_shadow_ros.core.imaging.mask_codes import MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN
from csas_shadow_ros.core.imaging.segmentation import segment_shadow
from csas_shadow_ros.core.parameters import PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import run
from csas_shadow_ros.core.search.pieces import objects_of, without_neighbours
from csas_shadow_ros.core.shape import measurement
from csas_shadow_ros.core.shape.carving import carve
from csas_shadow_ros.core.shape.echo_sides import echo_reach_px
from csas_shadow_ros.core.shape.measurement import doubted
from csas_shadow_ros.core.shape.mesh import Dimensions
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.simulation import iou, shadow_hull, simulate
from csas_shadow_ros.simulation.bodies import frustum
from csas_shadow_ros.simulation.profiles import Faults
from csas_shadow_ros.simulation.targets import join_bodies

COARSE = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=6.0))
SIZE = 400
MIDDLE = SIZE // 2


def tapering_shadow(seed):
    """Draw a view of a shadow that begins 60 columns wide and ends in a point."""
    rows, columns = np.indices((SIZE, SIZE))
    along = (rows - MIDDLE) / 120.0
    shadow = (along >= 0.0) & (np.abs(columns - MIDDLE) < 30.0 * (1.0 - along))
    amplitude = np.random.default_rng(seed).rayleigh(1.0, shadow.shape).astype(np.float32)
    amplitude[shadow] *= 0.2
    return make_view(amplitude), shadow


def segmented(view):
    x, y, w = view.info.camera.pixel_to_ground @ np.array([MIDDLE, MIDDLE, 1.0])
    return segment_shadow(view, (x / w, y / w), reach_m=40 * view.info.camera.spacing_m[1]).pixels


@pytest.mark.parametrize("seed", range(4))
def test_the_point_of_a_shadow_is_not_called_lit_seabed(seed, monkeypatch):
    view, shadow = tapering_shadow(seed)
    mask = segmented(view)
    point = shadow & (np.indices(shadow.shape)[0] > MIDDLE + 90)
    missed = (mask == MASK_OUTSIDE) & point
    beside = ~shadow & (mask != MASK_SHADOW)
    monkeypatch.setattr(segmentation, "_UNSURE_DARK", -1.0)  # as if it were not there
    before = (segmented(view) == MASK_OUTSIDE) & point
    assert missed.sum() < 0.7 * before.sum()
    # Seabed beside the shadow stays lit enough to carve: most of it, and all that is far away.
    down, across = (math.ceil(6 * px) for px in view.info.cell_px)
    near = np.zeros_like(shadow)
    near[MIDDLE - down : MIDDLE + 120 + down, MIDDLE - 30 - across : MIDDLE + 30 + across] = True
    assert (mask == MASK_UNKNOWN)[beside & near].mean() < 0.2
    assert not (mask == MASK_UNKNOWN)[~near].any()


def test_more_is_left_of_bodies_that_thin_out(monkeypatch):
    """Carved alone, without what plans and the search's mean give back to them."""

    def overlap(seed):
        made = simulate("small", frustum(0.3, 0.0, 0.5), seed=seed, faults=Faults(contrast_db=12.0))
        masks = []
        target = run(made.image, made.track, COARSE, on_view=lambda view: masks.append(view.mask)).target
        grid = carve(masks, target.volume(0.02))
        return iou(grid.occupied, shadow_hull(made.truth.target, made.truth.sonar_m, grid.volume))

    found = [overlap(seed) for seed in (4, 5)]
    monkeypatch.setattr(segmentation, "_UNSURE_DARK", -1.0)  # as if it were not there
    before = [overlap(seed) for seed in (4, 5)]
    assert np.mean(found) > np.mean(before) + 0.01
    assert min(np.subtract(found, before)) > 0.0


def test_a_low_flank_that_shines_is_on_the_plan(monkeypatch):
    """A limpet's rim casts no shadow long enough to segment; its echo ends where the rim does."""
    made = simulate("small", frustum(0.6, 0.3, 0.12), seed=5, echo_db=16.0, faults=Faults(contrast_db=12.0))
    found = run(made.image, made.track, COARSE).dimensions
    monkeypatch.setattr(measurement, "echo_reach_px", lambda *_: (math.nan, math.nan))
    narrower = run(made.image, made.track, COARSE).dimensions
    # Its plan is a circle: the echoes of all sides move one diameter.
    assert narrower.length_m + 0.01 < found.length_m < 0.6
    assert narrower.width_m + 0.01 < found.width_m < 0.6


def test_an_echo_behind_the_shadow_or_apart_from_it_is_of_something_else():
    view, shadow = tapering_shadow(1)
    pixels = view.pixels.copy()
    pixels[MIDDLE - 20 : MIDDLE, MIDDLE - 50 : MIDDLE + 40] *= 6.0  # its own, 90 columns wide
    pixels[MIDDLE + 60 : MIDDLE + 70, MIDDLE : MIDDLE + 120] *= 6.0  # stands in the shadow
    pixels[MIDDLE - 20 : MIDDLE, MIDDLE - 120 : MIDDLE - 90] *= 6.0  # beside it
    seen = make_view(pixels)
    x, y, w = seen.info.camera.pixel_to_ground @ np.array([MIDDLE, MIDDLE, 1.0])
    mask = segment_shadow(seen, (x / w, y / w), reach_m=40 * seen.info.camera.spacing_m[1])
    right, left = echo_reach_px(view_levels(seen), mask, shadow, (MIDDLE, MIDDLE))
    cell = seen.info.cell_px[1]
    assert right == pytest.approx(40.0, abs=cell)
    assert left == pytest.approx(50.0, abs=cell)


def test_a_view_without_an_echo_tells_no_reach():
    view, shadow = tapering_shadow(2)
    x, y, w = view.info.camera.pixel_to_ground @ np.array([MIDDLE, MIDDLE, 1.0])
    mask = segment_shadow(view, (x / w, y / w), reach_m=40 * view.info.camera.spacing_m[1])
    assert all(map(math.isnan, echo_reach_px(view_levels(view), mask, shadow, (MIDDLE, MIDDLE))))


def test_shadow_that_is_unexplained_widens_intervals_by_its_share():
    intervals = {"length_m": (0.9, 1.1), "height_m": (0.02, 0.18), "heading_rad": (-0.1, 0.1)}
    found = Dimensions(1.0, 0.5, 0.1, 0.1, 0.0, (0.0, 0.0), intervals=intervals)
    wide = doubted(found, 0.3).intervals
    assert wide["length_m"] == pytest.approx((0.6, 1.4))
    assert wide["height_m"] == pytest.approx((0.0, 0.21))  # no height is negative
    assert wide["heading_rad"] == intervals["heading_rad"]
    assert doubted(found, 0.0) == found


def grid_of(*boxes):
    volume = Volume.around((0.0, 0.0), (4.0, 2.0, 0.5), 0.05)
    occupied = np.zeros(volume.shape, bool)
    for first, last, top in boxes:
        inside = (volume.x_m >= first) & (volume.x_m < last)
        occupied[: round(top / 0.05), 15:25, inside] = True
    likelihood = np.where(occupied, np.float32(0.0), np.float32(1.0))
    return VoxelGrid(volume, likelihood, np.ones(volume.shape, np.uint16), 0.03, occupied)


def test_neighbours_in_one_volume_are_told_apart_and_a_body_with_a_gap_is_not():
    grid = grid_of((-1.5, -0.5, 0.3), (-0.4, 0.0, 0.2), (1.0, 1.5, 0.2))
    own, rest = without_neighbours(grid, 0.3)
    assert own.occupied.sum() + rest.occupied.sum() == grid.occupied.sum()
    x = grid.volume.x_m
    assert x[np.nonzero(rest.occupied)[2]].min() > 0.9
    assert x[np.nonzero(own.occupied)[2]].max() < 0.1  # both sides of the gap
    # Whoever points at the smaller one means it.
    pointed, _ = without_neighbours(grid, 0.3, (1.2, 0.0))
    np.testing.assert_array_equal(pointed.occupied, rest.occupied)
    assert without_neighbours(own, 0.3) == (own, None)
    ((neighbour,), nothing) = objects_of(rest, (0.0, 0.0), [own], cut=True)
    assert nothing == []
    assert neighbour.volume.centre_m[0] == pytest.approx(1.25, abs=0.05)


@pytest.mark.parametrize("foot_m", [0.3, 0.7])
def test_a_low_bright_foot_without_a_shadow_is_told(foot_m):
    """A drum 0.30 m wide on a foot that rises at 11°, under the sonar's 22°: was 0.23 to 0.40 m, "good"."""
    foot = frustum(foot_m, 0.3, (foot_m - 0.3) / 10.0 + 1e-6)
    drum = frustum(0.3, 0.3, 0.2 + (foot_m - 0.3) / 10.0)
    faults = Faults(contrast_db=12.0)
    bright = simulate("small", join_bodies([foot, drum]), seed=1, faults=faults, echo_db=17.0)
    result = run(bright.image, bright.track, COARSE)
    low, high = result.dimensions.intervals["length_m"]
    assert low <= 0.3 + 0.02
    assert high >= 0.95 * foot_m
    told = [reason for reason in result.quality.reasons if "a low foot" in reason]
    assert bool(told) == (foot_m > 0.3)
    assert (result.quality.verdict == "good") == (foot_m == 0.3)
