"""Hollows that no shadow shows: what echoes open, what they must leave alone."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from csas_shadow_ros.core import pipeline
from csas_shadow_ros.core.geometry import Acoustics, ShadowCamera, ViewInfo
from csas_shadow_ros.core.imaging.likelihood import Levels
from csas_shadow_ros.core.imaging.local_means import ECHO_CELLS, LocalMeans
from csas_shadow_ros.core.later_stages import run_views
from csas_shadow_ros.core.parameters import PipelineParameters, SubApertureParameters, TargetParameters
from csas_shadow_ros.core.shape.hollows import EchoLook, matter_mesh, matter_of
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.simulation import iou, simulate, voxelise_truth

VIEWS = 48
GRAZING = math.radians(30.0)
PIXEL = 0.04
MIDDLE = (0.3, -0.2)
VOLUME = Volume.around(MIDDLE, (0.9, 0.9, 0.3), 0.03)


def view_of(number: int, aspect: float, side: int = 61) -> ViewInfo:
    """Return a view of the scene: columns along e_c, rows along e_r, the origin in its middle."""
    c, s = math.cos(aspect), math.sin(aspect)
    half = side // 2
    ground = np.array([[s / PIXEL, -c / PIXEL, half], [-c / PIXEL, -s / PIXEL, half], [0.0, 0.0, 1.0]])
    sonar = (20.0 * c, 20.0 * s, 20.0 * math.tan(GRAZING))
    camera = ShadowCamera.from_ground(ground, sonar, side, side)
    return ViewInfo(number, camera, Acoustics(100e3, 30e3, 1500.0, 1), aspect, math.radians(12.0))


INFOS = [view_of(n, 2.0 * math.pi * n / VIEWS) for n in range(VIEWS)]
Z, Y, X = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
OUT = np.maximum(np.abs(X - MIDDLE[0]), np.abs(Y - MIDDLE[1]))
SOLID = (OUT < 0.3) & (Z < 0.2)
WALLS = SOLID & (OUT > 0.2)


def grid_of(occupied):
    likelihood = np.where(occupied, np.float32(0.0), np.float32(1.0))
    return VoxelGrid(VOLUME, likelihood, np.full(occupied.shape, VIEWS, np.uint16), 0.03, occupied)


def hidden(body, points, sonar):
    """Walk from points (n, 3) to the sonar; say which come through the body."""
    d = VOLUME.voxel_size_m
    way = sonar - points
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    out = np.zeros(len(points), bool)
    for step in np.arange(0.0, 0.5, d / 4.0):
        i, j, k = np.round((points + step * way - VOLUME.origin_m) / d).astype(int).T
        inside = (i >= 0) & (j >= 0) & (k >= 0) & (i < X.shape[2]) & (j < X.shape[1]) & (k < X.shape[0])
        out[inside] |= body[k[inside], j[inside], i[inside]]
    return out


def look_at(body, info, silent=None):
    """Image a body as rough as the seabed: its shadow, then the echoes of what is in view, with speckle."""
    rng = np.random.default_rng(info.stamp_ns)
    camera, sonar = info.camera, np.asarray(info.camera.sonar_m)
    v, u = np.indices(camera.shape).reshape(2, -1)
    ground = np.stack([u, v, np.ones_like(u)]).T @ camera.pixel_to_ground.T
    ground[:, 2] = 0.001
    mean = np.where(hidden(body, ground, sonar), 0.05, 1.0).reshape(camera.shape)
    points = np.stack([X[body], Y[body], Z[body]], axis=1)
    answers = np.ones(len(points), bool) if silent is None else ~silent[body]
    seen = np.zeros(len(points), bool)
    for axis in range(3):
        face = np.zeros_like(points)
        face[:, axis] = 0.51 * VOLUME.voxel_size_m * np.sign(sonar - points)[:, axis]
        seen |= ~hidden(body, points + face, sonar)
    shift = math.tan(camera.grazing_rad) * np.array([math.cos(info.aspect_rad), math.sin(info.aspect_rad)])
    at = points[:, :2] + points[:, 2:] * shift
    u, v, _ = np.round(camera.ground_to_pixel @ np.column_stack([at, np.ones(len(at))]).T).astype(int)
    mean[v[seen & answers], u[seen & answers]] = 1.0
    coarse = rng.exponential(size=tuple(n // 2 + 1 for n in camera.shape)).repeat(2, 0).repeat(2, 1)
    power = (mean * coarse[: camera.shape[0], : camera.shape[1]]).astype(np.float32)
    levels = Levels(1.0, 4.0, 0.1, True, LocalMeans(power, np.ones(camera.shape, bool), info.cell_px))
    return EchoLook.of(levels, info, VOLUME)


@pytest.fixture(scope="session")
def looks_at_walls():
    return [look_at(WALLS, info) for info in INFOS]


def test_a_solid_box_of_rough_surface_keeps_every_voxel():
    matter = matter_of(grid_of(SOLID), [look_at(SOLID, info) for info in INFOS])
    assert np.array_equal(matter, SOLID)


def test_a_hole_between_walls_is_opened_and_the_walls_stay(looks_at_walls):
    matter = matter_of(grid_of(SOLID), looks_at_walls)
    assert iou(matter, WALLS) > iou(SOLID, WALLS) + 0.15
    middle = (OUT < 0.1) & (Z > 0.15) & SOLID
    assert not matter[middle].any()
    assert np.count_nonzero(matter & WALLS) > 0.9 * np.count_nonzero(WALLS)


def test_nothing_is_ever_added(looks_at_walls):
    for occupied in (SOLID, WALLS, SOLID & (MIDDLE[0] > X), np.zeros_like(SOLID)):
        before = occupied.copy()
        matter = matter_of(grid_of(occupied), looks_at_walls)
        assert not (matter & ~occupied).any()
        assert np.array_equal(occupied, before)


def test_the_order_of_the_views_does_not_matter(looks_at_walls):
    mixed = list(looks_at_walls)
    random.Random(1).shuffle(mixed)
    grid = grid_of(SOLID)
    assert np.array_equal(matter_of(grid, mixed), matter_of(grid, looks_at_walls))


def test_a_body_whose_top_returns_nothing_is_not_eaten():
    top = SOLID & ~np.roll(SOLID, -1, 0)
    looks = [look_at(SOLID, info, silent=top) for info in INFOS]
    dark = np.mean([look.pixels()[0].mean() for look in looks])
    assert dark > np.mean([look_at(SOLID, info).pixels()[0].mean() for info in INFOS]) + 0.02
    assert np.array_equal(matter_of(grid_of(SOLID), looks), SOLID)


def test_views_that_know_nothing_of_the_body_open_nothing(looks_at_walls):
    assert np.array_equal(matter_of(grid_of(SOLID), []), SOLID)
    far = Volume.around((30.0, 0.0), (0.9, 0.9, 0.3), 0.03)
    off = VoxelGrid(
        far, *(getattr(grid_of(SOLID), n) for n in ("likelihood", "views", "threshold", "occupied"))
    )
    assert np.array_equal(matter_of(off, looks_at_walls), SOLID)


def test_a_look_holds_the_same_bits_round_the_target_as_the_whole_view_and_is_small():
    info = view_of(1, math.radians(25.0), 200)
    rng = np.random.default_rng(3)
    known = rng.random(info.camera.shape) < 0.95
    power = np.where(known, rng.exponential(size=known.shape), 0.0).astype(np.float32)
    levels = Levels(1.0, 4.0, 0.1, True, LocalMeans(power, known, info.cell_px))
    look = EchoLook.of(levels, info, VOLUME)
    whole = EchoLook.of(levels, info, Volume.around(MIDDLE, (20.0, 20.0, 0.3), 0.1))
    assert whole.shape == info.camera.shape
    (v, u), (rows, cols) = look.first, look.shape
    half = levels.local.box_px(ECHO_CELLS)  # so far the box of the mean reaches out
    inner = tuple(slice(n, -n) for n in half)
    for part, full in zip(look.pixels(), whole.pixels(), strict=True):
        assert np.array_equal(part[inner], full[v : v + rows, u : u + cols][inner])
    assert rows * cols < 0.1 * known.size
    assert len(look.packed) <= 2 * (rows * cols + 7) // 8 + 64


def test_the_surface_of_the_matter_is_closed_and_smaller_by_the_hollow(looks_at_walls):
    grid = grid_of(SOLID)
    matter = matter_of(grid, looks_at_walls)
    whole, left = matter_mesh(grid, SOLID), matter_mesh(grid, matter)
    assert left.is_watertight
    hollow = np.count_nonzero(SOLID & ~matter) * VOLUME.voxel_size_m**3
    assert whole.volume - left.volume == pytest.approx(hollow, rel=0.25)


@pytest.fixture(scope="session")
def ring_result():
    """A simulated tyre, through the pipeline, and its views."""
    made = simulate("tiny", "tyre", seed=5)
    seen = []
    p = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=5.0))
    return made, p, pipeline.run(made.image, made.track, p, on_view=seen.append), seen


def test_the_hole_of_a_simulated_ring_is_opened_from_above(ring_result):
    made, _, result, _ = ring_result
    truth = voxelise_truth(made.truth.target, result.grid.volume)
    assert iou(result.matter, truth) > iou(result.grid.occupied, truth) + 0.02
    assert not (result.matter & ~result.grid.occupied).any()
    assert result.matter_mesh is not result.mesh
    assert result.matter_mesh.volume < result.mesh.volume


def test_views_that_start_later_in_the_chain_leave_the_same_matter(ring_result):
    _, p, result, seen = ring_result
    views = [view.shadow for view in seen]
    target = TargetParameters("given", result.target.position_m, result.target.size_m)
    later = run_views(lambda: reversed(views), "shadow", replace(p, target=target))
    assert np.array_equal(later.grid.occupied, result.grid.occupied)
    assert np.array_equal(later.matter, result.matter)


def test_a_simulated_box_has_no_hollow_and_its_surface_is_the_hulls(box_run):
    p = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=5.0))
    result = pipeline.run(box_run.image, box_run.track, p)
    assert np.array_equal(result.matter, result.grid.occupied)
    assert result.matter_mesh is result.mesh
    assert max(len(look.packed) for look in result.looks.values()) < 10_000


def test_masks_alone_tell_of_no_echo(ring_result):
    _, p, result, seen = ring_result
    target = TargetParameters("given", result.target.position_m, result.target.size_m)
    masks = run_views(lambda: [view.mask for view in seen], "shadow_mask", replace(p, target=target))
    assert masks.grid is not None
    assert masks.matter is None
    assert masks.matter_mesh is None
