"""Several objects in one scene: each is found, carved in a volume of its own and measured; no phantom is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from core_data import COARSE_SONAR

from csas_shadow_ros.core import pipeline
from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.core.imaging.subaperture import Spectrum
from csas_shadow_ros.core.parameters import (
    CarvingParameters,
    PipelineParameters,
    SubApertureParameters,
    TargetParameters,
)
from csas_shadow_ros.core.search.bodies import Search, search_image, stands_on_seabed
from csas_shadow_ros.core.search.decision import decide
from csas_shadow_ros.core.search.pieces import connected_pieces, objects_of, overlap_share
from csas_shadow_ros.core.shape.volume import Target, Volume, VoxelGrid
from csas_shadow_ros.simulation import Faults, iou, shadow_hull, simulate
from csas_shadow_ros.simulation.targets import box, cylinder, join_bodies

#: A scene and what was found in it are dear: one worker makes each.
of_two, of_laying_grid = (pytest.mark.xdist_group(name) for name in ("two objects", "laying grid"))

#: Coarse, for speed: 60 views a circle, voxels of 2.5 cm.
COARSE = PipelineParameters(
    sub_aperture=SubApertureParameters(step_deg=6.0, check_sign=False),
    carving=CarvingParameters(voxel_size_m=0.025),
)
BOX_M, CYLINDER_M = (0.8, 0.4, 0.4), (0.8, 0.3, 0.3)


@pytest.fixture(scope="session")
def two():
    """A box and a piece of a cylinder, 2.2 m apart."""
    bodies = box(*BOX_M), cylinder(CYLINDER_M[0], CYLINDER_M[1])
    for body, x in zip(bodies, (-1.1, 1.1), strict=True):
        body.apply_translation([x, 0.25 * x, 0.0])
    # The scene is set so that its middle is the origin.
    run = simulate("standard", join_bodies(bodies), seed=5)
    middles = [part.bounds.mean(axis=0)[:2] for part in run.truth.target.split()]
    return run, sorted((tuple(m) for m in middles), key=lambda m: m[0])


@pytest.fixture(scope="session")
def two_objects(two):
    return pipeline.run(two[0].image, two[0].track, COARSE)


@pytest.fixture(scope="session")
def in_laying_grid():
    run = simulate("standard", "frame_grid", seed=1)
    return run, pipeline.run(run.image, run.track, COARSE)


def on_bounds(grid, bounds, margin):
    """Say which occupied voxels of a grid stand on the plan of a body's bounds."""
    (low, high), (_, j, i) = bounds, np.nonzero(grid.occupied)
    x, y = grid.volume.x_m[i], grid.volume.y_m[j]
    inside = (low[0] - margin < x) & (x < high[0] + margin)
    return inside & (low[1] - margin < y) & (y < high[1] + margin)


def block_grid(low, high, *, origin=(0.0, 0.0), voxel=0.1, shape=(8, 12, 12)):
    """Return a grid in which the voxels [low, high) (z, y, x) are occupied."""
    volume = Volume((origin[0], origin[1], voxel / 2), voxel, shape)
    occupied = np.zeros(shape, bool)
    occupied[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    return VoxelGrid(volume, np.zeros(shape, np.float32), np.ones(shape, np.uint16), 0.03, occupied)


@of_two
def test_a_further_body_takes_a_view_each_quarter_of_an_aperture(two):
    run, _ = two

    def carved(step_deg):
        views = replace(COARSE.sub_aperture, aperture_deg=24.0, step_deg=step_deg)
        return pipeline.run(run.image, run.track, replace(COARSE, sub_aperture=views))

    often, rarely = carved(3.0), carved(6.0)
    assert (often.views_used, rarely.views_used) == (120, 60)
    assert [one.views_used for one in (*often.further, *rarely.further)] == [60, 60]


@of_two
@pytest.mark.parametrize(
    ("aspect_deg", "step_deg", "stage", "bodies"),
    [
        (6.0, 6.0, "sub_aperture", 2),
        (-354.0, 6.0, "sub_aperture", 2),
        (7.0, 6.0, "sub_aperture", 1),
        (7.0, 0.0, "sub_aperture", 2),
        (6.0, 6.0, "shadow", 1),
    ],
)
def test_which_bodies_take_a_view(two_objects, aspect_deg, step_deg, stage, bodies):
    info = replace(two_objects.sides[0].info, aspect_rad=math.radians(aspect_deg))
    decision = replace(two_objects.decision, others_step_rad=math.radians(step_deg))
    assert len(decision.bodies_of(info, stage)) == bodies


@of_two
def test_two_separate_bodies_are_two_objects_each_where_and_as_large_as_it_is(two, two_objects):
    _, middles = two
    objects = sorted(two_objects.objects, key=lambda o: o.dimensions.position_m[0])
    assert len(objects) == 2
    assert two_objects.left_out == []
    for one, middle, (length, width, height) in zip(objects, middles, (BOX_M, CYLINDER_M), strict=True):
        d = one.dimensions
        assert d.position_m == pytest.approx(middle, abs=0.04)
        assert d.length_m == pytest.approx(length, abs=0.08)
        assert d.width_m == pytest.approx(width, abs=0.08)
        assert d.height_m == pytest.approx(height, abs=0.08)
        assert abs(math.remainder(d.heading_rad, math.pi)) < math.radians(6.0)
        assert {"length_m", "width_m", "height_m"} <= set(d.intervals)
        assert one.mesh.is_watertight
        assert one.views_used == 60


@of_two
def test_each_object_is_carved_in_a_volume_of_its_own_that_holds_it_alone(two, two_objects):
    first, second = two_objects.objects
    for one, other in ((first, second), (second, first)):
        assert overlap_share(one.grid, other.grid) == 0.0
        assert len(connected_pieces(one.grid.occupied)) == 1
        x, y = other.dimensions.position_m
        assert not (
            abs(x - one.target.position_m[0]) < one.target.size_m[0] / 2
            and abs(y - one.target.position_m[1]) < one.target.size_m[1] / 2
        )


@of_two
def test_what_else_is_known_to_stand_there_takes_nothing_from_the_target(two, two_objects):
    run, _ = two
    alone = pipeline.run(run.image, run.track, COARSE, max_objects=1)
    assert len(alone.objects) == 1
    assert len(two_objects.objects) == 2
    assert two_objects.objects[0].grid is two_objects.grid
    assert not (alone.grid.occupied & ~two_objects.grid.occupied).any()
    assert alone.views_used == two_objects.views_used
    assert "no more than 1" in alone.left_out[0].reason


@of_two
def test_the_mean_likelihood_of_the_target_does_not_change_by_one_bit_however_many_bodies_are_carved(two):
    run, _ = two
    p = replace(
        COARSE,
        carving=CarvingParameters(method="soft", voxel_size_m=0.04),
        sub_aperture=SubApertureParameters(step_deg=20.0, check_sign=False),
    )
    several, alone = (pipeline.run(run.image, run.track, p, max_objects=n) for n in (8, 1))
    assert len(several.objects) == 2
    assert np.array_equal(alone.grid.likelihood, several.grid.likelihood, equal_nan=True)
    assert np.array_equal(alone.mesh.vertices, several.mesh.vertices)
    # Shadow that nothing found explains widens the intervals; sizes are the same.
    assert replace(alone.dimensions, intervals={}) == replace(several.dimensions, intervals={})


@of_two
def test_a_target_that_is_given_is_the_only_object(two):
    run, middles = two
    given = TargetParameters(target="given", position_m=middles[1])
    p = replace(COARSE, target=given, sub_aperture=SubApertureParameters(step_deg=20.0, check_sign=False))
    result = pipeline.run(run.image, run.track, p)
    assert len(result.objects) == 1
    assert result.objects[0].dimensions.position_m == pytest.approx(middles[1], abs=0.1)


@pytest.mark.parametrize("height_m", [0.3, 0.4])
def test_a_low_wide_body_beside_another_is_an_object_too(height_m):
    """Its own lit top carves all of it away, or leaves a few voxels."""
    bodies = box(1.2, 0.9, 1.0), box(1.9, 1.8, height_m)
    for body, place in zip(bodies, ((-1.8, 1.2), (1.6, -1.2)), strict=True):
        body.apply_translation([*place, 0.0])
    faults = Faults(contrast_db=12.0)
    run = simulate(COARSE_SONAR, join_bodies(bodies), seed=1, faults=faults, echo_db=6.0, workers=1)
    carving = CarvingParameters(voxel_size_m=0.13)
    p = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=6.0), carving=carving)
    objects = pipeline.run(run.image, run.track, p, workers=1).objects
    assert len(objects) == 2
    found = objects[1].dimensions
    assert (found.length_m, found.width_m) == pytest.approx((1.9, 1.8), abs=0.325)  # 2.5 voxels
    low, high = found.intervals["height_m"]
    assert low <= height_m <= high


@pytest.mark.parametrize(
    ("contrast_db", "echo_db", "seed", "found"), [(8.0, 12.0, 7, 0), (8.0, 12.0, 8, 0), (11.0, 14.0, 10, 1)]
)
def test_a_faint_low_body_whose_foot_is_lost_is_found_or_named_beside_another(
    contrast_db, echo_db, seed, found
):
    """It seemed to hang, as what is where shadows of others cross, and went unsaid."""
    bodies = box(1.0, 0.6, 0.6), box(2.1, 1.8, 0.28)
    for body, place in zip(bodies, ((-1.3, -0.6), (1.2, 0.4)), strict=True):
        body.apply_translation([*place, 0.0])
    faults = Faults(contrast_db=contrast_db)
    made = simulate(COARSE_SONAR, join_bodies(bodies), seed=seed, faults=faults, echo_db=echo_db, workers=1)
    search = search_image(made.image, made.track, Spectrum.of_image(made.image))

    def near(those):
        return [one for one in those if np.hypot(*np.subtract(one.position_m, (1.2, 0.4))) < 0.5]

    assert [target.stands for target in near(search.targets)] == [True] * found
    assert [left.strong for left in near(search.left_out)] == [True] * (1 - found)


def test_a_body_of_which_carving_leaves_crumbs_is_a_candidate():
    crumbs = block_grid((0, 4, 4), (2, 6, 6))
    found, left_out = objects_of(crumbs, (0.5, 0.6), [])
    assert found == []
    assert [one.strong for one in left_out] == [True]
    assert left_out[0].position_m == (0.5, 0.6)
    # Beside an object they are only crumbs.
    both = np.array(crumbs.occupied)
    both[0:5, 8:12, 8:12] = True
    found, left_out = objects_of(replace(crumbs, occupied=both), (0.5, 0.6), [])
    assert len(found) + len(left_out) == 2
    assert not left_out[0].strong


@of_laying_grid
def test_the_laying_grid_does_not_merge_with_the_target_in_it(in_laying_grid):
    run, result = in_laying_grid
    hull = shadow_hull(run.truth.target, run.truth.sonar_m, result.grid.volume)
    assert iou(result.grid.occupied, hull) > 0.67
    for part in run.truth.decor.split():
        assert not on_bounds(result.grid, part.bounds, 0.0).any()


@of_laying_grid
def test_every_object_told_in_the_laying_grid_is_really_there(in_laying_grid):
    run, result = in_laying_grid
    assert any("phantom" in left.reason for left in result.left_out)
    blocks = [part.bounds for part in run.truth.decor.split()]
    for one in result.objects[1:]:
        really = np.logical_or.reduce([on_bounds(one.grid, bounds, 0.1) for bounds in blocks])
        assert really.mean() > 0.9
        assert one.dimensions.height_m < 0.3


def test_an_empty_seabed_holds_no_object(empty_run):
    p = replace(COARSE, sub_aperture=SubApertureParameters(step_deg=30.0))
    result = pipeline.run(empty_run.image, empty_run.track, p)
    assert result.objects == []
    assert result.left_out == []


def test_a_single_body_is_a_single_object(box_run):
    result = pipeline.run(box_run.image, box_run.track, COARSE)
    assert len(result.objects) == 1
    assert result.objects[0].mesh is result.mesh
    assert result.left_out == []


@pytest.mark.parametrize("count", [0, -1, 65])
def test_a_number_of_objects_out_of_range_is_refused(box_run, count):
    with pytest.raises(ParameterError, match=f"max_objects is {count}.* expected"):
        pipeline.run(box_run.image, box_run.track, COARSE, max_objects=count)


def test_what_hangs_higher_than_it_is_high_does_not_stand_on_the_seabed():
    assert stands_on_seabed(0.0, 0.3)
    assert stands_on_seabed(0.1, 0.3)
    assert not stands_on_seabed(0.5, 0.8)


def test_phantoms_take_no_place_of_a_body_and_bodies_beyond_the_most_are_named():
    bodies = [Target((float(k), 0.0), (1.0, 1.0, 0.5), 9.0 - k, stands=k != 1) for k in range(5)]
    search = Search(tuple(bodies), Volume((0.0, 0.0, 0.0), 1.0, (1, 1, 1)), np.zeros((1, 1, 1), np.float32))
    decision = decide(search, TargetParameters(), max_objects=3)
    assert decision.target == bodies[0]
    assert decision.others == (bodies[2], bodies[3])
    assert [left.position_m[0] for left in decision.left_out] == [1.0, 4.0]
    assert "phantom" in decision.left_out[0].reason
    assert "no more than 3" in decision.left_out[1].reason


@pytest.mark.parametrize("offset", [0.0, 0.03, -0.04])
def test_the_share_of_two_objects_is_that_of_the_smaller_one_on_any_lattice(offset):
    large = block_grid((0, 2, 2), (4, 10, 10))
    half_in = block_grid((0, 4, 8), (4, 8, 12), origin=(offset, offset))
    away = block_grid((0, 0, 0), (2, 2, 2), origin=(5.0, 5.0))
    assert overlap_share(large, half_in) == pytest.approx(0.5)
    assert overlap_share(half_in, large) == pytest.approx(0.5)
    assert overlap_share(large, away) == 0.0
    assert overlap_share(large, large) == 1.0
