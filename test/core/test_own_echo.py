"""Lit sides that slope down to the seabed do not carve their own body; seabed seen under one still does."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from core_data import COARSE_SONAR, hidden_by_box, iou, make_info, perfect_views

from csas_shadow_ros.core.geometry import View, unit_to_sonar
from csas_shadow_ros.core.imaging.mask_codes import MASK_OUTSIDE, MASK_SHADOW
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import run
from csas_shadow_ros.core.shape.carving import Carver, carve
from csas_shadow_ros.core.shape.layover import layover_per_metre
from csas_shadow_ros.core.shape.plan import (
    ShadowSides,
    StandingPlan,
    plan_of_sides,
    shadow_sides,
)
from csas_shadow_ros.core.shape.volume import Target, Volume
from csas_shadow_ros.simulation import Faults, shadow_hull, simulate
from csas_shadow_ros.simulation.bodies import brick, convex
from csas_shadow_ros.simulation.targets import join_bodies

VOXEL_M = 0.13


def wedge():
    """Make a body that slopes down to the seabed at one end, 17° against the 32° of the sonar."""
    low = [(x, y, 0.0) for x in (-1.1, 1.1) for y in (-0.9, 0.9)]
    return convex([*low, (-1.1, -0.9, 0.7), (-1.1, 0.9, 0.7)])


def table():
    """Make a slab on four legs."""
    legs = [brick((0.18, 0.18, 0.8), (sx * 0.9, sy * 0.5, 0.0)) for sx in (-1, 1) for sy in (-1, 1)]
    return join_bodies([*legs, brick((2.0, 1.2, 0.2), (0.0, 0.0, 0.8))])


def carved(mesh, monkeypatch, echo_db=6.0, seed=3):
    """Return the grid of a simulated body, the one that nothing was given back to, and its shadow hull."""
    simulated = simulate(
        COARSE_SONAR,
        mesh,
        seed=seed,
        heading_deg=25.0,
        faults=Faults(contrast_db=15.0),
        echo_db=echo_db,
        workers=1,
    )
    bare = []
    given_back = Carver.given_back

    def watched(self, body, *args):
        bare.append(body)
        return given_back(self, body, *args)

    monkeypatch.setattr(Carver, "given_back", watched)
    parameters = PipelineParameters(
        sub_aperture=SubApertureParameters(step_deg=6.0),
        carving=CarvingParameters(voxel_size_m=VOXEL_M),
    )
    grid = run(simulated.image, simulated.track, parameters, workers=1).grid
    hull = shadow_hull(
        simulated.truth.target, simulated.truth.sonar_m[::3], grid.volume, spacing_m=VOXEL_M / 8.0
    )
    return grid, bare[0], hull


def on_legs(slab):
    """Make a table of 0.60 x 0.45 x 0.42 m, with or without a slab of 0.9 x 0.7 x 0.1 m under it."""
    legs = [brick((0.06, 0.06, 0.35), (sx * 0.25, sy * 0.18, 0.0)) for sx in (-1, 1) for sy in (-1, 1)]
    top = brick((0.6, 0.45, 0.08), (0.0, 0.0, 0.34))
    return join_bodies([*legs, top, *([brick((0.9, 0.7, 0.1), (0.0, 0.0, 0.0))] if slab else [])])


@pytest.mark.parametrize(
    ("slab", "sizes_m", "least"),
    [(False, (0.60, 0.45, 0.42), 0.75), (True, (0.90, 0.70, 0.42), 0.8)],
    ids=["table", "slab under it"],
)
def test_a_table_is_no_block_and_a_slab_under_it_no_ring(slab, sizes_m, least):
    """They came out at 0.29 and 0.61 of their hulls, both called good."""
    made = simulate("standard", on_legs(slab), seed=5, heading_deg=20.0, workers=2)
    found = run(made.image, made.track, PipelineParameters(SubApertureParameters(step_deg=6.0)))
    hull = shadow_hull(made.truth.target, made.truth.sonar_m[::12], found.grid.volume)
    assert iou(found.grid.occupied, hull) > least
    for name, true_m in zip(("length_m", "width_m", "height_m"), sizes_m, strict=True):
        low, high = found.dimensions.intervals[name]
        assert low < true_m < high
        assert getattr(found.dimensions, name) == pytest.approx(true_m, abs=max(0.02, 0.05 * true_m))


@pytest.mark.parametrize("seed", [3, 4])
def test_seabed_is_seen_under_a_sphere_beside_a_strong_echo(seed, monkeypatch):
    """All that lies within reach of an echo's sidelobes counted as echo: spheres stood on pillars."""
    sphere = trimesh.creation.icosphere(3, 1.0)
    sphere.apply_translation((0.0, 0.0, 1.0))
    grid, _, hull = carved(sphere, monkeypatch, echo_db=15.0, seed=seed)
    assert iou(grid.occupied, hull) > 0.79
    # At a tenth of its height a sphere covers 0.36 of what it covers at its equator.
    foot = grid.occupied[int(0.2 / VOXEL_M)]
    assert foot.sum() < 0.75 * grid.occupied.sum(axis=(1, 2)).max()


@pytest.mark.parametrize("size_m", [(2.0, 1.8, 0.4), (1.6, 1.5, 0.3)])
def test_a_low_wide_body_of_which_the_search_sees_little_is_carved_whole(size_m, monkeypatch):
    """Half as wide a volume is what all its shadows cross in."""
    grid, bare, hull = carved(brick(size_m, (0.0, 0.0, 0.0)), monkeypatch)
    assert not bare.occupied.any()
    assert bare.volume.size_m[0] < size_m[0]
    assert grid.method == "consensus"
    assert iou(grid.occupied, hull) > 0.7


def test_a_side_that_slopes_down_to_the_seabed_does_not_carve_its_body(monkeypatch):
    grid, bare, hull = carved(wedge(), monkeypatch)
    assert iou(bare.occupied, hull) < 0.4
    assert iou(grid.occupied, hull) > 0.8


def test_seabed_that_is_seen_under_a_slab_still_carves(monkeypatch):
    grid, bare, _ = carved(table(), monkeypatch)
    assert np.array_equal(grid.occupied, bare.occupied)
    assert np.array_equal(grid.likelihood, bare.likelihood, equal_nan=True)


# The plan

LOW, HIGH = (-0.35, -0.2, 0.0), (0.35, 0.2, 0.3)
VOLUME = Volume.around((0.0, 0.0), (1.0, 0.8, 0.5), 0.025)
INFOS = tuple(make_info(math.radians(a), size=256, spacing_m=0.01) for a in range(0, 360, 6))


def hidden(x, y, sonar_m):
    return hidden_by_box(x, y, sonar_m, LOW, HIGH)


@pytest.fixture(scope="module")
def box():
    """Return the silhouettes of a box without its echo, and what they carve."""
    masks = perfect_views(hidden, INFOS, "mask")
    return masks, carve(list(masks), VOLUME, CarvingParameters())


def plan_of(masks, body):
    sides = [shadow_sides(mask, body, VOLUME.centre_m[:2]) for mask in masks]
    return plan_of_sides([one for one in sides if one is not None], VOLUME)


def test_the_sides_of_shadows_bound_the_plan(box):
    masks, body = box
    cell = INFOS[0].resolution_m[1]
    for mask in masks[::7]:
        side = shadow_sides(mask, body, (0.0, 0.0))
        reach = [HIGH[0] * abs(math.cos(side.direction_rad)) + HIGH[1] * abs(math.sin(side.direction_rad))]
        assert np.allclose([side.right_m, side.left_m], reach, atol=0.7 * cell)
    low, high = plan_of(masks, body).min(axis=0), plan_of(masks, body).max(axis=0)
    assert np.allclose(low, LOW[:2], atol=cell)
    assert np.allclose(high, HIGH[:2], atol=cell)


def test_a_shadow_that_is_not_the_bodys_is_no_side_of_it(box):
    masks, body = box
    right = shadow_sides(masks[0], body, (0.0, 0.0))
    pixels = masks[0].pixels.copy()
    pixels[:, :20] = MASK_SHADOW
    assert shadow_sides(View(INFOS[0], pixels), body, (0.0, 0.0)) == right
    pixels[:] = 0
    assert shadow_sides(View(INFOS[0], pixels), body, (0.0, 0.0)) is None


@pytest.mark.parametrize("wrong_m", [0.05, 0.6])
def test_a_few_wrong_views_move_no_side(wrong_m):
    # A third of those within half an aperture of each direction.
    angles = np.radians(np.arange(0.0, 360.0, 2.0))
    reach = [wrong_m if n % 3 == 0 else 0.3 for n in range(len(angles))]
    sides = [ShadowSides(t, r, r, 0.2, 0.02) for t, r in zip(angles, reach, strict=True)]
    assert np.allclose(np.hypot(*plan_of_sides(sides, VOLUME).T), 0.29, atol=0.01)


def test_the_wider_of_opposite_views_counts():
    def plan(narrow_from, narrow_to):
        sides = [
            ShadowSides(t, *((0.1, 0.1) if narrow_from <= t < narrow_to else (0.3, 0.3)), 0.2, 0.02)
            for t in np.radians(np.arange(0.0, 360.0, 6.0))
        ]
        return np.hypot(*plan_of_sides(sides, VOLUME).T)

    assert np.allclose(plan(0.0, math.pi), 0.29, atol=0.01)
    assert plan(0.0, 2.0 * math.pi).max() < 0.1


@pytest.mark.parametrize("arc_deg", [0.0, 60.0])
def test_no_sides_or_a_short_arc_of_them_bound_no_plan(arc_deg):
    sides = [ShadowSides(t, 0.3, 0.3, 0.2, 0.02) for t in np.radians(np.arange(0.0, arc_deg, 6.0))]
    assert plan_of_sides(sides, VOLUME) is None


def test_sides_that_leave_nothing_between_them_bound_no_plan():
    sides = [ShadowSides(t, -0.2, -0.2, 0.2, 0.02) for t in np.radians(np.arange(0.0, 360.0, 6.0))]
    assert plan_of_sides(sides, VOLUME) is None


def test_sides_beyond_the_volume_are_not_the_bodys_and_bound_no_plan():
    # The shadows of its neighbours touch this body's in most directions.
    def plan(share):
        angles = np.radians(np.arange(0.0, 360.0, 6.0))
        reach = np.where(np.mod(angles, math.pi) < share * math.pi, 0.9, 0.2)
        sides = [ShadowSides(t, r, r, 0.2, 0.02) for t, r in zip(angles, reach, strict=True)]
        return plan_of_sides(sides, VOLUME)

    assert plan(0.2) is not None
    assert plan(0.6) is None


WIDE = (0.6, 0.5)
WIDE_VOLUME = Volume.around((0.0, 0.0), (1.8, 1.6, 0.4), 0.04)


def wide_views(high_m):
    low, high = (-WIDE[0], -WIDE[1], 0.0), (*WIDE, high_m)
    return list(perfect_views(lambda x, y, s: hidden_by_box(x, y, s, low, high), INFOS, "mask"))


def lit_on_plan(high_m, lit_from=lambda number: True, *, walls=False):
    """Return a carver of a low wide box whose plan is lit in some views, as its top or as seabed in walls."""
    carver = Carver(WIDE_VOLUME, CarvingParameters())
    for number, mask in enumerate(wide_views(high_m)):
        pixels = mask.pixels.copy()
        if lit_from(number):
            u, v = np.meshgrid(np.arange(pixels.shape[1]), np.arange(pixels.shape[0]))
            pixel = np.stack([u, v, np.ones_like(u)], axis=-1)
            ground = (pixel @ mask.info.camera.pixel_to_ground.T)[..., :2]
            shadow_m = high_m / math.tan(mask.info.camera.grazing_rad) * unit_to_sonar(mask.info.aspect_rad)
            lit = np.all(np.abs(ground) < WIDE, axis=-1)
            if walls:  # the near one throws its shadow on what it encloses
                lit &= np.all(np.abs(ground + shadow_m) < WIDE, axis=-1)
            pixels[lit] = MASK_OUTSIDE
        carver.integrate(View(mask.info, pixels))
    return carver


@pytest.mark.parametrize(
    ("high_m", "lit_from", "walls", "comes_back"),
    [
        pytest.param(0.2, lambda number: number % 10 < 5, False, True, id="lit from half of the circle"),
        pytest.param(0.2, lambda number: True, False, True, id="the lit top of a low wide body"),
        pytest.param(0.1, lambda number: True, True, False, id="seabed within walls"),
    ],
)
def test_what_is_lit_on_a_plan_is_a_bodys_top_unless_shadows_lie_on_it(high_m, lit_from, walls, comes_back):
    """As between the blocks of a laying grid, whose shadows a slab of the grid's size would explain best."""
    carver = lit_on_plan(high_m, lit_from, walls=walls)
    body = carver.grid()
    assert body.occupied.any()
    whole = carver.given_back(body)
    hull = carve(wide_views(high_m), WIDE_VOLUME)
    if comes_back:
        assert iou(whole.occupied, hull.occupied) > 0.8 > iou(body.occupied, hull.occupied) + 0.2
    else:
        assert whole is body


@pytest.mark.parametrize("walls", [False, True])
def test_a_low_body_that_its_own_top_carved_away_comes_back_on_its_plan(walls):
    carver = lit_on_plan(0.1, walls=walls)
    lost = carver.grid()
    if not walls:
        assert not lost.occupied.any()
    nothing = replace(lost, occupied=np.zeros_like(lost.occupied))
    found = Target((0.02, -0.03), (1.6, 1.3, 0.3))
    back = carver.on_plan_of(found, nothing)
    hull = carve(wide_views(0.1), WIDE_VOLUME)
    if walls:
        assert back is None
        return
    assert iou(back.occupied, hull.occupied) > 0.8
    # What tells it better is not replaced.
    assert carver.on_plan_of(found, hull) is None


def test_without_shadow_nothing_comes_back():
    carver = Carver(VOLUME, CarvingParameters())
    for info in INFOS:
        carver.integrate(View(info, np.zeros(info.camera.shape, np.uint8)))
    assert carver.on_plan_of(Target((0.0, 0.0), (0.9, 0.6, 0.2)), carver.grid()) is None


def test_columns_stand_on_a_plan():
    corners = np.array([[-0.2, -0.1], [0.3, -0.1], [0.3, 0.25], [-0.2, 0.25]])
    x, y = VOLUME.x_m, VOLUME.y_m
    inside = ((y > -0.1) & (y < 0.25))[:, None] & ((x > -0.2) & (x < 0.3))
    assert np.array_equal(StandingPlan(corners, 0.4).columns(VOLUME), inside)


@pytest.mark.parametrize("info", INFOS[::11])
def test_what_stands_on_a_plan_is_imaged_on_its_echo(info):
    corners = np.array([[-0.2, -0.1], [0.3, -0.1], [0.3, 0.25], [-0.2, 0.25]])
    plan = StandingPlan(corners, 0.4)
    zone = plan.echo(info)
    camera = info.camera

    def at(x, y, z):
        ground = np.array([x, y]) + z * layover_per_metre(info)
        u, v = camera.ground_to_pixel[:2, :2] @ ground + camera.ground_to_pixel[:2, 2]
        return zone[round(v), round(u)]

    assert all(at(x, y, z) for x, y in corners for z in (0.0, 0.2, 0.4))
    behind = -0.7 * layover_per_metre(info) / np.linalg.norm(layover_per_metre(info))
    assert not at(*(corners.mean(axis=0) + behind), 0.0)
    assert not at(*(corners.mean(axis=0) - behind), 0.4)
    # Three cells down-range and two across beyond the plan itself.
    alone = StandingPlan(corners, 0.0).echo(info)
    cells = alone.sum() * np.prod(camera.spacing_m)
    down, across = np.array(info.resolution_m) * (6.0, 4.0)
    assert 0.5 * 0.35 < cells < (0.61 + down) * (0.61 + across)
    # Its top lies within, clear of all edges, whatever its height is.
    top = plan.top(info)
    assert top.any()
    assert not (top & ~alone).any()
    assert not (top & ~zone).any()
    clear = 1.5 * np.array(info.resolution_m)
    assert top.sum() * np.prod(camera.spacing_m) <= 0.5 * 0.35 - 2.0 * clear.min() * 0.35
