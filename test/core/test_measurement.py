"""Measures from the sides of silhouettes, and the second look of consensus carving."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from core_data import (
    HEIGHT_M,
    RADIUS_M,
    box_support,
    drawn_sides_of,
    ground_of_pixels,
    hidden_by_box,
    hidden_by_cylinder,
    hull_of,
    make_info,
    perfect_views,
)

from csas_shadow_ros.core.geometry import Acoustics, View
from csas_shadow_ros.core.parameters import CarvingParameters
from csas_shadow_ros.core.shape.cap import cap_of
from csas_shadow_ros.core.shape.carving import (
    MASK_COVERED,
    MASK_OUTSIDE,
    MASK_SHADOW,
    MASK_UNKNOWN,
    Carver,
    carve,
)
from csas_shadow_ros.core.shape.layover import echo_zones, opaque_part
from csas_shadow_ros.core.shape.measurement import (
    SHAPES,
    PlanFit,
    agreed_sides,
    leaning_agreed,
    levels_of_mask,
    measure_object,
    shadow_height,
    sides_apart,
    silhouette_sides,
    upright_height,
)
from csas_shadow_ros.core.shape.mesh import mesh_from_grid
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid

GRAZING = math.atan2(HEIGHT_M, RADIUS_M)
INFOS = tuple(make_info(math.radians(a), size=256, spacing_m=0.012) for a in range(0, 360, 4))
#: By a band so high that one look is enough: 1.7 and 2.7 pixels a cell, as in a view of the standard profile.
ONE_LOOK = tuple(
    replace(info, aperture_rad=1e-6, acoustics=Acoustics(25e9, 40e3, 1500.0, info.acoustics.spectrum_sign))
    for info in INFOS
)
BOX = partial(hidden_by_box, low=(-0.25, -0.12, 0.0), high=(0.15, 0.18, 0.25))
DRUM = partial(hidden_by_cylinder, centre=(0.1, -0.05), radius_m=0.3, height_m=0.3)
VOLUME = Volume.around((0.0, 0.0), (1.0, 1.0, 0.45), 0.02)
drawn_sides = partial(drawn_sides_of, INFOS)


def grid_of(occupied, volume=VOLUME):
    return VoxelGrid(
        volume, (~occupied).astype(np.float32), np.full(occupied.shape, 90, np.uint16), 0.03, occupied
    )


def sides_of(hidden, infos=INFOS, target=(0.0, 0.0)):
    views = perfect_views(hidden, infos, "mask")
    return [silhouette_sides(levels_of_mask(v), v, target) for v in views]


def widths(fit):
    """Extent of a fitted plan along x and along y."""
    h = fit.solve()
    quarter = len(h) // 4
    return h[0] + h[2 * quarter], h[quarter] + h[3 * quarter]


@pytest.mark.parametrize(
    ("hidden", "sizes", "position"),
    [(BOX, (0.4, 0.3), (-0.05, 0.03)), (DRUM, (0.6, 0.6), (0.1, -0.05))],
    ids=["box", "drum"],
)
def test_exact_silhouettes_are_measured_to_less_than_a_pixel_a_side(hidden, sizes, position):
    # Every exact view has one look: nothing to undo.
    occupied = hull_of(hidden, INFOS, VOLUME)
    fit = PlanFit(sides_of(hidden, ONE_LOOK), grid_of(occupied))
    assert fit.count > 150
    assert widths(fit) == pytest.approx(sizes, abs=0.016)
    h = fit.solve()
    quarter = len(h) // 4
    for axis in (0, 1):
        middle = fit.centre[axis] + (h[axis * quarter] - h[(axis + 2) * quarter]) / 2
        assert middle == pytest.approx(position[axis], abs=0.006)


@pytest.mark.parametrize("heading_deg", [0.0, 25.0, 101.0])
def test_the_fit_undoes_the_mean_over_the_aperture(heading_deg):
    heading = math.radians(heading_deg)
    true = box_support(0.8, 0.4, heading)
    sides = drawn_sides(true)
    # The voxels are a little too large, as carving leaves them.
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    along, across = (
        x * math.cos(heading) + y * math.sin(heading),
        y * math.cos(heading) - x * math.sin(heading),
    )
    occupied = (np.abs(along) < 0.43) & (np.abs(across) < 0.23) & (z < 0.2)
    fit = PlanFit(sides, grid_of(occupied))
    h = fit.solve() + fit.centre[0] * np.cos(fit.directions) + fit.centre[1] * np.sin(fit.directions)
    assert np.abs(h - true(fit.directions)).max() < 0.006
    # Taken as they are, the edges beside the long side lie 2 cm outside of it.
    raw = max(
        s
        for side in sides
        for p, s in zip(side.direction_rad, side.support_m, strict=True)
        if abs(math.remainder(p - heading - math.pi / 2, math.pi)) < math.radians(2.1)
    )
    assert raw > 0.2 + 0.015


def with_shapes(sides, true, wrong, told_wrong):
    """Sides of one shape, which some views take for another one with a support that is 3 cm larger."""
    out = []
    for n, side in enumerate(sides):
        told = wrong if told_wrong(n) else true
        by_shape = []
        for s in side.support_m:
            of = {name: s if name == true else s + 0.03 for name in SHAPES}
            by_shape.append(tuple((of | {"flared": of["straight"]}).values()))
        own = tuple(each[SHAPES.index(told)] for each in by_shape)
        out.append(replace(side, support_m=own, shapes=(told, told), support_by_shape_m=tuple(by_shape)))
    return out


@pytest.mark.parametrize(("true", "wrong"), [("straight", "round"), ("round", "tapering")])
def test_a_view_that_is_alone_in_what_it_takes_a_side_for_is_outvoted(true, wrong):
    occupied = hull_of(BOX, INFOS, VOLUME)
    exact = drawn_sides(box_support(0.5, 0.3))
    told = with_shapes(exact, true, wrong, lambda n: n % 3 == 0)
    assert widths(PlanFit(told, grid_of(occupied))) == pytest.approx((0.5, 0.3), abs=0.006)
    # Where most views say so, they are believed.
    most = with_shapes(exact, true, wrong, lambda n: n % 3 != 0)
    assert widths(PlanFit(most, grid_of(occupied))) == pytest.approx((0.56, 0.36), abs=0.012)


def test_what_all_sides_are_counts_as_much_as_the_sides_beside():
    occupied = hull_of(BOX, INFOS, VOLUME)
    exact = drawn_sides(box_support(0.5, 0.3))

    def near_x(n):
        # Both sides of a view that looks along y face along x.
        return abs(math.sin(exact[n].info.aspect_rad)) > math.cos(math.radians(16.0))

    # A body whose sides are round but for a few that seem straight, more of them than not.
    few = with_shapes(exact, "round", "straight", lambda n: near_x(n) and n % 3 != 0)
    assert widths(PlanFit(few, grid_of(occupied))) == pytest.approx((0.5, 0.3), abs=0.006)
    # All of them seem straight there: so they are.
    wall = with_shapes(exact, "round", "straight", near_x)
    assert widths(PlanFit(wall, grid_of(occupied)))[0] > 0.55


@pytest.mark.parametrize(("stands_out_px", "counts"), [(3.0, True), (0.6, False)])
def test_a_foot_that_stands_out_of_a_straight_side_counts_if_the_views_beside_agree(stands_out_px, counts):
    occupied = hull_of(BOX, INFOS, VOLUME)
    foot_m = stands_out_px * INFOS[0].camera.spacing_m[1]
    exact = with_shapes(drawn_sides(box_support(0.4, 0.3)), "straight", "round", lambda n: False)
    sides = []
    for n, side in enumerate(exact):
        by_shape = tuple(
            (straight, tapering, rounded, straight + foot_m * (n % 4 != 0), math.nan)
            for straight, tapering, rounded, *_ in side.support_by_shape_m
        )
        sides.append(replace(side, support_by_shape_m=by_shape))
    grows = 2 * foot_m * counts
    assert widths(PlanFit(sides, grid_of(occupied))) == pytest.approx((0.4 + grows, 0.3 + grows), abs=0.006)


def test_the_carved_voxels_stand_in_where_an_arc_is_missing():
    sides = drawn_sides(box_support(0.6, 0.4), keep=lambda degrees: not 50.0 < degrees < 130.0)
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    occupied = (np.abs(x) < 0.3) & (np.abs(y) < 0.2) & (z < 0.2)
    assert widths(PlanFit(sides, grid_of(occupied))) == pytest.approx((0.6, 0.4), abs=0.02)


@pytest.mark.parametrize("gap_deg", [30.0, 60.0])
def test_sides_that_err_beside_a_gap_do_not_tell_what_lies_in_it(gap_deg):
    # As where a neighbour's shadow touches this one's, seen along both.
    exact = drawn_sides(box_support(0.6, 0.3), keep=lambda degrees: 0.5 * gap_deg < degrees % 180.0)
    exact = [one for one in exact if math.degrees(one.info.aspect_rad) % 180.0 < 180.0 - 0.5 * gap_deg]
    out = []
    for one in exact:
        off = 0.02 * np.abs(np.sin(one.direction_rad))
        out.append(replace(one, support_m=tuple(np.asarray(one.support_m) + off)))
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    occupied = (np.abs(x) < 0.3) & (np.abs(y) < 0.15) & (z < 0.2)
    assert widths(PlanFit(out, grid_of(occupied)))[1] == pytest.approx(0.3, abs=0.03)


def touched(sides, arc_deg, by_m=0.15):
    """Another shadow touches sides that face along +x, as seen from one aspect only."""
    out = []
    for one in sides:
        support = []
        for phi, s in zip(one.direction_rad, one.support_m, strict=True):
            along_x = math.cos(phi) > math.cos(math.radians(arc_deg / 2))
            support.append(s + by_m * (along_x and math.sin(phi - one.info.aspect_rad) > 0))
        out.append(replace(one, support_m=tuple(support)))
    return out


@pytest.mark.parametrize(("arc_deg", "share"), [(0.0, 0.0), (30.0, 30 / 360), (90.0, 90 / 360)])
def test_sides_that_opposite_views_see_at_different_places_are_counted(arc_deg, share):
    sides = touched(drawn_sides(box_support(0.6, 0.4)), arc_deg)
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    grid = grid_of((np.abs(x) < 0.3) & (np.abs(y) < 0.2) & (z < 0.2))
    assert sides_apart(sides, grid)[0] == pytest.approx(share, abs=0.02)
    # Of half a circle no side is seen twice.
    half = [one for one in sides if one.info.aspect_rad < math.pi - 0.3]
    assert sides_apart(half, grid)[0] == 0.0
    assert sides_apart([], grid) == (0.0, 0.0)


@pytest.mark.parametrize("out_cells", [0.0, 1.5, 2.6, 6.0])
def test_an_echo_far_outside_of_the_plan_is_a_doubt_and_moves_no_side(out_cells):
    """Near ones move it: a low foot shines. Far ones may be bright seabed."""
    bare = drawn_sides(box_support(0.6, 0.4))
    cell = bare[0].info.resolution_m[1]
    out_m = out_cells * cell
    seen = out_m + 0.75 * cell if out_cells else math.nan  # what walls spread
    sides = [replace(one, echo_support_m=tuple(s + seen for s in one.support_m)) for one in bare]
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    grid = grid_of((np.abs(x) < 0.3) & (np.abs(y) < 0.2) & (z < 0.2))
    mesh = mesh_from_grid(grid)
    measured, without = (measure_object(grid, mesh, told) for told in (sides, bare))
    for name, true in (("length_m", 0.6), ("width_m", 0.4)):
        moved = 2.0 * out_m if out_cells < 3.0 else 0.0
        assert getattr(measured, name) == pytest.approx(true + moved, abs=0.4 * cell)
        # Whichever of the two is right, the interval holds it.
        low, high = measured.intervals[name]
        assert low <= true
        assert high >= true + 2.0 * out_m
        if not out_cells:
            assert (low, high) == without.intervals[name]
    assert sides_apart(sides, grid)[1] == (1.0 if out_cells > 2.0 else 0.0)


def test_an_extent_whose_sides_lie_apart_is_told_with_less_certainty():
    exact = drawn_sides(box_support(0.6, 0.4))
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    grid = grid_of((np.abs(x) < 0.3) & (np.abs(y) < 0.2) & (z < 0.2))
    mesh = mesh_from_grid(grid)
    halves = {}
    for name, sides in (("sure", exact), ("touched", touched(exact, 40.0, 0.2))):
        low, high = measure_object(grid, mesh, sides).intervals["length_m"]
        across = measure_object(grid, mesh, sides).intervals["width_m"]
        halves[name] = (high - low) / 2, (across[1] - across[0]) / 2
    assert halves["touched"][0] > 0.15 > halves["sure"][0]
    # Nothing is wrong with the other pair of sides.
    assert halves["touched"][1] < 1.5 * halves["sure"][1]


def test_sides_of_something_else_do_not_count():
    sides = drawn_sides(box_support(0.6, 0.4))
    sides = [
        replace(s, support_m=(s.support_m[0] + 0.5, s.support_m[1])) if n % 3 == 0 else s
        for n, s in enumerate(sides)
    ]
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    occupied = (np.abs(x) < 0.3) & (np.abs(y) < 0.2) & (z < 0.2)
    assert widths(PlanFit(sides, grid_of(occupied))) == pytest.approx((0.6, 0.4), abs=0.01)


def test_without_sides_the_surface_is_measured_without_intervals():
    occupied = hull_of(BOX, INFOS, VOLUME)
    grid = grid_of(occupied)
    measured = measure_object(grid, mesh_from_grid(grid), [])
    assert measured.intervals == {}
    assert measured.length_m == pytest.approx(0.4, abs=0.04)


def test_an_interval_holds_its_measure_and_widens_with_scattered_sides():
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    occupied = (np.abs(x) < 0.3) & (np.abs(y) < 0.2) & (z < 0.2)
    grid = grid_of(occupied)
    mesh = mesh_from_grid(grid)
    calm = drawn_sides(box_support(0.6, 0.4))
    rng = np.random.default_rng(3)
    # The error is one of a block of looks, as neighbours share them.
    off = 0.04 * rng.standard_normal(30)
    wild = [replace(s, support_m=tuple(v + off[n // 3] for v in s.support_m)) for n, s in enumerate(calm)]
    halves = []
    for sides in (calm, wild):
        measured = measure_object(grid, mesh, sides)
        for name, (low, high) in measured.intervals.items():
            if hasattr(measured, name):
                assert low <= getattr(measured, name) <= high
        low, high = measured.intervals["length_m"]
        halves.append((high - low) / 2)
    assert halves[1] > 1.1 * halves[0]


def test_crumbs_beside_a_body_are_not_measured_where_the_views_are_shifted_against_one_another():
    x, y, z = VOLUME.x_m, VOLUME.y_m, VOLUME.z_m[:, None, None]
    inside = (np.abs(x)[None, :] <= 0.2) & (np.abs(y)[:, None] <= 0.15)
    crumbs = (np.abs(y) <= 0.02)[:, None] & (x > 0.2)[None, :] & (x < 0.34)[None, :]
    occupied = (inside | crumbs)[None] & (z < 0.25)
    rng = np.random.default_rng(5)
    box = lambda p: 0.2 * np.abs(np.cos(p)) + 0.15 * np.abs(np.sin(p))  # noqa: E731
    sides = [
        replace(side, support_m=tuple(v + rng.normal(0.0, 0.08) for v in side.support_m))
        for side in drawn_sides(box)
    ]
    grid = grid_of(occupied)
    measured = measure_object(grid, mesh_from_grid(grid), sides)
    assert measured.scatter_cells > 1.0
    assert measured.length_m == pytest.approx(0.4, abs=0.03)
    assert measured.width_m == pytest.approx(0.3, abs=0.03)


def test_the_same_views_in_any_order_give_the_same_measures():
    occupied = hull_of(BOX, INFOS, VOLUME)
    grid = grid_of(occupied)
    sides = sides_of(BOX)
    mesh = mesh_from_grid(grid)
    assert measure_object(grid, mesh, sides) == measure_object(grid, mesh, sides[::-1])


@pytest.mark.parametrize("half_m", [0.12, 0.2, 0.3])
def test_the_height_is_where_the_cap_begins(half_m):
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    inside = half_m - np.maximum(np.abs(x), np.abs(y))
    occupied = (inside > 0) & (z < 0.2 + math.tan(GRAZING) * np.maximum(inside, 0.0))
    cap = cap_of(grid_of(occupied), GRAZING)
    assert cap.begins_m == pytest.approx(0.2, abs=0.75 * VOLUME.voxel_size_m)
    assert cap.top_m > 0.2 + 0.5 * math.tan(GRAZING) * half_m
    # One voxel too many on its tip does not move where it begins.
    k, j, i = (int(index) for index in np.argwhere(occupied)[-1])
    occupied[k + 1, j, i] = True
    assert cap_of(grid_of(occupied), GRAZING).begins_m == pytest.approx(cap.begins_m, abs=1e-9)


def test_where_a_cap_begins_is_told_in_cells_however_fine_the_voxels_are():
    """Layers about a flat top that are drawn in by less than a cell lift where its cap seems to begin."""
    volume = Volume.around((0.0, 0.0), (0.6, 0.6, 0.4), 0.005)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    drawn_in = 0.02 * np.clip(1.0 - np.abs(z - 0.2) / 0.06, 0.0, None)
    half_m = 0.2 - drawn_in - np.clip(z - 0.2, 0.0, None) / math.tan(GRAZING)
    grid = grid_of(np.maximum(np.abs(x), np.abs(y)) < half_m, volume)
    by_voxels, by_cells = (cap_of(grid, GRAZING, cell_m=cell).begins_m for cell in (0.0, 0.02))
    assert by_voxels > 0.23
    assert by_cells == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("hole_m", [0.0, 0.05, 0.3])
def test_speckle_that_holes_a_low_top_does_not_lift_where_its_cap_begins(hole_m):
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    inside = 0.3 - np.hypot(x, y)
    occupied = (inside > 0) & (z < 0.1 + math.tan(GRAZING) * np.maximum(inside, 0.0))
    hole = (np.hypot(x, y) < hole_m / 2.0) & (z < 0.1 + math.tan(GRAZING) * 0.15)
    begins = [cap_of(grid_of(occupied & ~hole), GRAZING, room).begins_m for room in (0.0, 0.05)]
    d = VOLUME.voxel_size_m
    if hole_m == 0.05:
        assert begins[0] > 0.1 + 2.0 * d  # its layers would be as thin as the ring round the hole
        assert begins[1] == pytest.approx(0.1, abs=0.75 * d)
    else:  # what is wider than two cells is a hollow
        assert begins[1] == begins[0]


def test_a_tip_that_views_cut_each_at_its_height_is_as_high_as_half_of_them_say():
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    # A cone; of 90 views each keeps it up to a height of its own.
    tops = 0.25 + 0.02 * np.random.default_rng(2).standard_normal(90)
    share = np.mean([np.hypot(x, y) > 1.2 * (top - z) for top in tops], axis=0)
    grid = VoxelGrid(
        VOLUME, share.astype(np.float32), np.full(z.shape, 90, np.uint16), 0.03, np.asarray(share < 0.03)
    )
    cap = cap_of(grid, GRAZING)
    assert cap.top_m < 0.25 - 0.02
    assert cap.half_m == pytest.approx(0.25, abs=0.01)
    measured = measure_object(grid, mesh_from_grid(grid), drawn_sides(lambda p: np.full_like(p, 0.28)))
    assert measured.intervals["height_m"][1] > 0.25
    # Where no view counts what is above, nothing is added.
    flat = grid_of(share < 0.03)
    assert cap_of(flat, GRAZING).half_m == pytest.approx(cap_of(flat, GRAZING).top_m, abs=VOLUME.voxel_size_m)
    soft = replace(flat, method="soft", threshold=0.2)
    assert cap_of(soft, GRAZING).half_m == cap_of(soft, GRAZING).top_m


@pytest.mark.parametrize("top_m", [0.0, 0.08])
@pytest.mark.parametrize("slope", [0.7, 1.4])
def test_a_top_that_may_be_a_point_is_told_from_a_flat_one(slope, top_m):
    """A cone, whole or cut off where it is eight cells wide. No view segmented a tip of two cells."""
    cell, high = 0.02, 0.25
    volume = Volume.around((0.0, 0.0), (0.8, 0.8, 0.4), 0.005)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    inside = (high - z) / slope - cell / 4.0 - np.hypot(x, y)
    flat = high - slope * top_m
    cap = flat + math.tan(GRAZING) * (top_m - np.hypot(x, y))
    occupied = (inside > 0.0) & (z < (high - slope * cell if top_m == 0.0 else np.maximum(flat, cap)))
    told = cap_of(grid_of(occupied, volume), GRAZING, cell, cell * math.tan(GRAZING), cell)
    if top_m == 0.0:
        assert told.apex_m == pytest.approx(high, abs=0.1 * slope * cell + volume.voxel_size_m)
        assert told.top_m < high - 0.5 * slope * cell
        assert math.isnan(cap_of(grid_of(occupied, volume), GRAZING, cell).apex_m)  # no cell, no point
    else:
        assert math.isnan(told.apex_m)


def test_a_ridge_is_no_point():
    cell = 0.02
    volume = Volume.around((0.0, 0.0), (0.8, 0.8, 0.4), 0.005)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    rest = np.maximum(np.abs(y) - 0.15, 0.0)
    occupied = ((0.25 - z) / 1.0 - np.hypot(x, rest) > 0.0) & (z < 0.25 - cell)
    assert math.isnan(cap_of(grid_of(occupied, volume), GRAZING, cell, 0.01, cell).apex_m)


@pytest.mark.parametrize("radius_m", [0.25, 0.4, 0.6])
@pytest.mark.parametrize("high_m", [0.292, 0.3, 0.307])
def test_a_dome_is_told_by_how_gradually_its_cap_begins(radius_m, high_m):
    volume = Volume.around((0.003, -0.006), (1.3, 1.3, 0.45), 0.02)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    rho, slope = np.hypot(x, y), 0.24
    # A paraboloid with that radius of curvature; above where it is as steep as the rays, the cap they leave.
    rest = radius_m * slope**2 / 2
    top = np.where(rho > radius_m * slope, high_m - rho**2 / (2 * radius_m), high_m + rest - rho * slope)
    cap = cap_of(grid_of(z < top, volume), math.atan(slope))
    middle = (cap.begins_m + cap.dome_m) / 2
    assert cap.begins_m < high_m - 0.5 * rest  # taken for flat it is too low
    assert cap.begins_m <= cap.dome_m <= cap.top_m
    assert middle == pytest.approx(high_m, abs=0.6 * volume.voxel_size_m)
    assert abs(middle - high_m) < abs(cap.begins_m - high_m)


def test_a_shadow_s_length_gives_an_upright_box_s_height():
    occupied = hull_of(BOX, INFOS, VOLUME)
    grid = grid_of(occupied)
    sides = sides_of(BOX, ONE_LOOK)
    measured = measure_object(grid, mesh_from_grid(grid), sides)
    heights = [shadow_height(side, measured) for side in sides]
    assert np.median(heights) == pytest.approx(0.25, abs=0.012)


def test_upright_walls_are_as_high_as_their_shadows_say_whatever_carving_leaves_on_top():
    occupied = hull_of(BOX, INFOS, VOLUME)
    sides = sides_of(BOX, ONE_LOOK)
    # Speckle leaves a few layers more: the top layer again, twice.
    top = int(np.flatnonzero(occupied.any(axis=(1, 2)))[-1])
    flat = int(np.argmin(np.abs(VOLUME.z_m - 0.25)))
    occupied[flat : flat + 2] = occupied[flat - 2]
    assert occupied.any(axis=(1, 2))[top]
    grid = grid_of(occupied)
    measured = measure_object(grid, mesh_from_grid(grid), sides)
    assert cap_of(grid, GRAZING).begins_m > 0.27
    assert measured.height_m == pytest.approx(0.25, abs=0.008)
    low, high = measured.intervals["height_m"]
    assert low < 0.25 < high


def test_views_that_agree_by_chance_tell_no_height_where_sides_are_not_straight():
    occupied = hull_of(BOX, INFOS, VOLUME)
    grid = grid_of(occupied)
    sides = sides_of(BOX, ONE_LOOK)
    measured = measure_object(grid, mesh_from_grid(grid), sides)
    cap = cap_of(grid, GRAZING)
    told = upright_height(sides, measured, [cap.begins_m], 0.012, VOLUME.voxel_size_m)
    assert told == pytest.approx(0.25, abs=0.008)
    rounded = [replace(side, shapes=("round",) * len(side.shapes)) for side in sides]
    assert upright_height(rounded, measured, [cap.begins_m], 0.012, VOLUME.voxel_size_m) is None
    untold = [replace(side, shapes=()) for side in sides]
    assert upright_height(untold, measured, [cap.begins_m], 0.012, VOLUME.voxel_size_m) is None


@pytest.mark.long
def test_shadow_lengths_behind_walls_that_are_not_upright_do_not_tell_the_height():
    occupied = hull_of(hidden_by_cone, INFOS, VOLUME)
    grid = grid_of(occupied)
    # An exact round cone has the same shadow from every side: that its views agree is not enough.
    sides = sides_of(hidden_by_cone, ONE_LOOK)
    measured = measure_object(grid, mesh_from_grid(grid), sides)
    lengths = np.median([shadow_height(side, measured) for side in sides])
    assert lengths < 0.26  # its flat top is 0.3 m high
    assert measured.height_m == pytest.approx(0.3, abs=0.025)


# The second look


def mushroom(x, y, sonar):
    """A plate on a thin stem: lit seabed lies under its rim, between its echo and its shadow."""
    out = hidden_by_box(x, y, sonar, (-0.08, -0.08, 0.0), (0.08, 0.08, 0.25))
    for z in np.linspace(0.25, 0.35, 9):
        t = z / sonar[2]  # where the ray to the ground passes this height
        px, py = x + t * (sonar[0] - x), y + t * (sonar[1] - y)
        out |= np.maximum(np.abs(px), np.abs(py)) < 0.3
    return out


def covered_views(hidden, body, infos=INFOS):
    """Perfect masks in which everything lit before the shadow, to half a metre, is said to be covered."""
    out = []
    for view in perfect_views(hidden, infos, "mask"):
        pixels = view.pixels.copy()
        shadow = pixels == MASK_SHADOW
        first = np.where(shadow.any(axis=0), shadow.argmax(axis=0), 0)
        rows = np.arange(len(pixels))[:, None]
        near = (rows < first) & (rows >= first - 42)
        pixels[near & ~shadow] = MASK_COVERED
        out.append(replace(view, pixels=pixels))
    return out


def test_lit_seabed_that_no_echo_can_cover_carves_what_stands_under_an_overhang():
    volume = Volume.around((0.0, 0.0), (0.9, 0.9, 0.5), 0.025)
    views = covered_views(mushroom, None)
    once = Carver(volume, CarvingParameters(method="hard"))
    for view in views:
        once.integrate(view)
    grid = carve(views, volume, CarvingParameters(method="consensus"))
    low = volume.z_m < 0.2
    _, y, x = np.meshgrid(volume.z_m[low], volume.y_m, volume.x_m, indexing="ij")
    under = (np.maximum(np.abs(x), np.abs(y)) > 0.2) & (np.maximum(np.abs(x), np.abs(y)) < 0.28)
    plate = grid.occupied[(volume.z_m > 0.27) & (volume.z_m < 0.33)]
    assert plate[:, 18, 18].all()
    first = once.grid().occupied[low][under].mean()
    second = grid.occupied[low][under].mean()
    assert second < 0.9 * first


def test_where_the_body_s_own_echo_may_lie_a_covered_pixel_says_nothing():
    # An upright box hides all that is covered: the second look takes nothing away.
    volume = Volume.around((0.0, 0.0), (0.9, 0.9, 0.45), 0.025)
    views = []
    for view in perfect_views(BOX, INFOS, "mask"):
        x, y = ground_of_pixels(view.info.camera)
        u = np.array([math.cos(view.info.aspect_rad), math.sin(view.info.aspect_rad)])
        pixels = view.pixels.copy()
        # Its top, laid over towards the sonar, looks like seabed.
        for z in np.linspace(0.0, 0.25, 12):
            lay = z * math.tan(GRAZING)
            px, py = x - lay * u[0], y - lay * u[1]
            pixels[(px > -0.25) & (px < 0.15) & (py > -0.12) & (py < 0.18)] = MASK_COVERED
        views.append(replace(view, pixels=pixels))
    grid = carve(views, volume, CarvingParameters(method="consensus"))
    truth = hull_of(BOX, INFOS, volume)
    assert (grid.occupied & truth).sum() > 0.97 * truth.sum()


def test_a_covered_pixel_is_unknown_to_the_hard_method():
    info = make_info(0.0, size=96)
    for value in (MASK_COVERED, MASK_UNKNOWN):
        c = Carver(Volume.around((0, 0), (0.4, 0.4, 0.2), 0.05), CarvingParameters(method="hard"))
        c.integrate(View(info, np.full((96, 96), value, np.uint8)))
        assert c.grid().views.max() == 0
    c = Carver(Volume.around((0, 0), (0.4, 0.4, 0.2), 0.05), CarvingParameters(method="hard"))
    c.integrate(View(info, np.full((96, 96), MASK_OUTSIDE, np.uint8)))
    assert c.grid().views.min() == 1


def test_the_echo_of_a_box_lies_over_its_front_and_its_top_and_nowhere_behind():
    volume = Volume.around((0.0, 0.0), (0.9, 0.9, 0.45), 0.025)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    body = (np.abs(x) < 0.2) & (np.abs(y) < 0.2) & (z < 0.3)
    info = INFOS[0]  # the sonar is towards +x
    (zone,) = echo_zones(info, volume, body, opaque_part(body, GRAZING))
    gx, gy = ground_of_pixels(info.camera)
    lay = 0.3 * math.tan(GRAZING)
    assert zone[(gx > 0.2) & (gx < 0.2 + lay) & (np.abs(gy) < 0.18)].all()  # the front, laid over
    assert zone[(gx > -0.2 + lay) & (gx < 0.2) & (np.abs(gy) < 0.18)].all()  # the top
    cells = info.resolution_m
    assert not zone[gx < -0.2 + lay - 9 * cells[0]].any()
    assert not zone[np.abs(gy) > 0.2 + 7 * cells[1]].any()


def test_a_cap_that_shadows_cannot_tell_from_a_flat_top_hides_nothing():
    volume = Volume.around((0.0, 0.0), (0.9, 0.9, 0.45), 0.025)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    inside = 0.3 - np.maximum(np.abs(x), np.abs(y))
    flat = (inside > 0) & (z < 0.2)
    capped = (inside > 0) & (z < 0.2 + math.tan(GRAZING) * np.maximum(inside, 0))
    info = INFOS[7]
    (of_flat,) = echo_zones(info, volume, flat, opaque_part(flat, GRAZING))
    (of_capped,) = echo_zones(info, volume, capped, opaque_part(capped, GRAZING))
    assert (of_flat & ~of_capped).sum() < 0.02 * of_flat.sum()


def test_a_voxel_that_few_views_know_is_object_only_on_top_of_object():
    likelihood = np.full((6, 9, 9), 0.9, np.float32)
    views = np.full((6, 9, 9), 90, np.uint16)
    likelihood[0:3, 2:7, 2:7] = 0.0
    likelihood[3:5, 3:6, 3:6] = 0.0
    views[3:5] = 8  # a high top, whose shadow leaves the image in most views
    likelihood[5, 0, 0] = 0.0
    views[5, 0, 0] = 8  # a phantom roof
    from csas_shadow_ros.core.shape.threshold import thresholded

    volume = Volume.around((0, 0), (0.9, 0.9, 0.6), 0.1)
    grid = thresholded(volume, likelihood, views, CarvingParameters(threshold=0.03))
    assert grid.occupied[3:5, 3:6, 3:6].all()
    assert not grid.occupied[5].any()


def hidden_by_cone(x, y, sonar):
    """Where a truncated cone, 0.6 m wide, 0.3 m at its top and high, hides the seabed: a disc a layer."""
    hidden = np.zeros(np.shape(x), bool)
    for z in np.linspace(0.0, 0.3, 61):
        share = (sonar[2] - z) / sonar[2]
        at = (sonar[0] + (x - sonar[0]) * share, sonar[1] + (y - sonar[1]) * share)
        hidden |= np.hypot(*at) < 0.3 - 0.5 * z
    return hidden


def test_a_side_that_is_drawn_in_upwards_is_followed_to_its_foot_that_the_echo_hides():
    views = []
    for view in perfect_views(hidden_by_cone, INFOS, "mask"):
        pixels = view.pixels.copy()
        rho = view.info.down_range_of_rows()
        pixels[rho < 0.2] = MASK_UNKNOWN  # the cone's own echo, laid over its foot
        views.append(View(view.info, pixels))
    sides = [silhouette_sides(levels_of_mask(v), v, (0.0, 0.0)) for v in views]
    support = np.concatenate([side.support_m for side in sides])
    assert len(support) == 2 * len(INFOS)
    assert np.median(support) == pytest.approx(0.3, abs=0.012)  # a pixel; the foot hides 2.4 cm


def hidden_by_layers(layer, high_m):
    """Return what hides the seabed: `layer(x, y, z)` says what of each height is body."""

    def hidden(x, y, sonar):
        out = np.zeros(np.shape(x), bool)
        for z in np.linspace(0.0, high_m, 41)[:-1]:
            share = (sonar[2] - z) / sonar[2]
            out |= layer(sonar[0] + (x - sonar[0]) * share, sonar[1] + (y - sonar[1]) * share, z)
        return out

    return hidden


def lit_on_plan(hidden, plan, infos):
    """Return perfect views of a body that shines wherever the sonar sees it: no shadow lies on its plan."""
    views = []
    for view in perfect_views(hidden, infos, "mask"):
        pixels = view.pixels.copy()
        pixels[plan(*ground_of_pixels(view.info.camera))] = MASK_OUTSIDE
        views.append(View(view.info, pixels))
    return views


def wedge(x, y, z):
    """A wedge 0.8 m long, 0.4 m wide and 0.3 m high, that slopes down to its thin end at x = 0.4 m."""
    return (np.abs(y) < 0.2) & (x > -0.4) & (x < 0.4 - 0.8 * z / 0.3)


def steep_cone(x, y, z):
    """A cone 0.6 m wide and 0.3 m high."""
    return np.hypot(x, y) < 0.3 * (1.0 - z / 0.3)


@pytest.mark.parametrize(
    ("body", "sizes", "kept"), [(wedge, (0.8, 0.4), 0.2), (steep_cone, (0.6, 0.6), 0.24)]
)
def test_a_body_that_slopes_down_to_its_foot_is_as_long_as_the_lines_of_its_shadows_say(body, sizes, kept):
    """Its own light carves its foot away, and its shadow is too short there to be seen."""
    views = lit_on_plan(hidden_by_layers(body, 0.3), lambda x, y: body(x, y, 0.0), ONE_LOOK)
    found = [silhouette_sides(levels_of_mask(view), view, (0.0, 0.0)) for view in views]
    sides = [side for side in found if side is not None]  # along the wedge's slope nothing throws a shadow
    volume = Volume.around((0.0, 0.0), (1.2, 1.2, 0.4), 0.02)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    carved = body(x, y, z) & (np.hypot(x, y) < 2.0 * kept) & (x < kept)
    found = measure_object(grid_of(carved, volume), mesh_from_grid(grid_of(carved, volume)), sides)
    assert (found.length_m, found.width_m) == pytest.approx(sizes, abs=0.04)  # a cell and a half
    assert found.intervals["length_m"][0] < sizes[0] < found.intervals["length_m"][1]


def tower(x, y, z):
    """A tower 0.2 m wide and 0.4 m high on a base 0.8 by 0.4 m wide and 0.1 m high."""
    return np.maximum(np.abs(x), 2.0 * np.abs(y)) < np.where(z < 0.1, 0.4, 0.1)


def test_the_shadow_s_line_from_a_base_s_top_to_a_tower_s_is_no_side_that_leans():
    """It meets the ground outside of the base: the plan was 0.46 m wide."""
    views = lit_on_plan(hidden_by_layers(tower, 0.4), lambda x, y: tower(x, y, 0.0), ONE_LOOK)
    sides = [side for view in views if (side := silhouette_sides(levels_of_mask(view), view, (0.0, 0.0)))]
    assert "leaning" in [shape for side in leaning_agreed(sides) for shape in side.shapes]
    volume = Volume.around((0.0, 0.0), (1.2, 1.2, 0.5), 0.02)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    grid = grid_of(tower(x, y, z) & (z < 0.4), volume)
    assert "leaning" not in [shape for side in agreed_sides(sides, grid)[0] for shape in side.shapes]
    found = measure_object(grid, mesh_from_grid(grid), sides)
    assert (found.length_m, found.width_m) == pytest.approx((0.8, 0.4), abs=0.02)


@pytest.mark.parametrize(
    "hidden",
    [
        partial(hidden_by_box, low=(-0.3, -0.3, 0.0), high=(0.3, 0.3, 0.08)),
        DRUM,
        hidden_by_layers(lambda x, y, z: np.hypot(x, y) < np.sqrt(max(0.09 - (z - 0.3) ** 2, 0.0)), 0.6),
    ],
    ids=["low box", "drum", "ball"],
)
def test_the_far_end_of_a_shadow_is_no_side_that_leans(hidden):
    sides = leaning_agreed(sides_of(hidden, ONE_LOOK))
    assert "leaning" not in [shape for side in sides for shape in side.shapes]


def test_a_view_alone_does_not_tell_that_a_side_leans():
    views = lit_on_plan(hidden_by_layers(steep_cone, 0.3), lambda x, y: steep_cone(x, y, 0.0), ONE_LOOK)
    made = (silhouette_sides(levels_of_mask(view), view, (0.0, 0.0)) for view in views)
    # Views every 4° of 12°: six beside.
    sides = [replace(side, info=replace(side.info, aperture_rad=math.radians(12.0))) for side in made]
    few = [
        side if n % 4 == 0 else replace(side, leaning=((math.nan, math.nan),) * len(side.direction_rad))
        for n, side in enumerate(sides)
    ]
    assert "leaning" in [shape for side in leaning_agreed(sides) for shape in side.shapes]
    assert "leaning" not in [shape for side in leaning_agreed(few) for shape in side.shapes]
    # Of a program that does not tell lines.
    bare = [replace(side, leaning=()) for side in sides]
    assert leaning_agreed(bare) == bare


@pytest.mark.parametrize("radius_m", [0.02, 0.04, 0.06, 0.1])
def test_a_shadow_narrower_than_an_edge_s_profile_has_its_own_width(radius_m):
    """What is lit behind the other edge took from it: a pole of 4 cm had its sides 8 cm inside its middle."""
    pole = partial(hidden_by_cylinder, centre=(0.0, 0.0), radius_m=radius_m, height_m=0.4)
    sides = sides_of(pole, INFOS[::6])
    assert INFOS[0].resolution_m[1] > 0.06
    # Half a pixel: what a drawn silhouette is sure to.
    assert [np.mean(side.support_m) for side in sides] == pytest.approx([radius_m] * len(sides), abs=0.0065)


def hidden_by_flared(x, y, sonar):
    """A wall with a foot that stands out by 3 cm to either side and is 9 cm high."""
    wall = hidden_by_box(x, y, sonar, (-0.15, -0.15, 0.0), (0.15, 0.15, 0.35))
    return wall | hidden_by_box(x, y, sonar, (-0.18, -0.18, 0.0), (0.18, 0.18, 0.09))


def test_a_wall_s_foot_is_seen_in_its_first_rows():
    view = perfect_views(hidden_by_flared, INFOS[:1], "mask")[0]
    side = silhouette_sides(levels_of_mask(view), view, (0.0, 0.0))
    for by_shape in side.support_by_shape_m:
        told = dict(zip(SHAPES, by_shape, strict=True))
        assert told["flared"] == pytest.approx(0.18, abs=0.012)
        assert told["straight"] < 0.172
