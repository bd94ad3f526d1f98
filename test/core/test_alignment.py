"""Views that lie beside one another across range are put together by the sides of their shadows."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from core_data import box_support, drawn_sides_of, hidden_by_box, make_info, perfect_views

from csas_shadow_ros.core import pipeline
from csas_shadow_ros.core.geometry import cross_range_axis
from csas_shadow_ros.core.later_stages import run_views
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.reconstruction import Reconstruction
from csas_shadow_ros.core.shape.alignment import shifts_across
from csas_shadow_ros.core.shape.measurement import levels_of_mask, silhouette_sides
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid

INFOS = tuple(make_info(math.radians(a), size=256, spacing_m=0.012) for a in range(0, 360, 4))
CELL_M = INFOS[0].resolution_m[1]
VOLUME = Volume.around((0.0, 0.0), (3.0, 3.0, 0.6), 0.05)
SUPPORT = box_support(1.6, 0.8, heading=0.4)


def grid():
    """Voxels of the box that the sides are drawn of."""
    x, y, z = VOLUME.x_m, VOLUME.y_m[:, None], VOLUME.z_m[:, None, None]
    along, across = x * math.cos(0.4) + y * math.sin(0.4), y * math.cos(0.4) - x * math.sin(0.4)
    occupied = ((np.abs(along) < 0.8) & (np.abs(across) < 0.4))[None] & (z < 0.4)
    views = np.full(occupied.shape, len(INFOS), np.uint16)
    return VoxelGrid(VOLUME, (~occupied).astype(np.float32), views, 0.03, occupied)


def rough(sides, cells, seed=1):
    """Sides with an error of each edge, 1σ in cells."""
    rng = np.random.default_rng(seed)
    return [
        replace(side, support_m=tuple(v + rng.normal(0.0, cells * CELL_M) for v in side.support_m))
        for side in sides
    ]


def shifted(sides, cells, seed=2):
    """Sides of views that lie beside their place, and how far (1σ in cells; m)."""
    drawn = np.random.default_rng(seed).normal(0.0, cells * CELL_M, len(sides)).tolist()
    shifts = dict(zip((side.info.stamp_ns for side in sides), drawn, strict=True))
    return [side.moved_back({n: -s for n, s in shifts.items()}) for side in sides], shifts


def test_a_view_that_is_moved_back_shows_the_ground_where_it_is():
    info = INFOS[13]
    point = np.array([0.3, -0.2])
    beside = point + 0.07 * cross_range_axis(info.aspect_rad)
    seen = info.camera.ground_to_pixel @ [*beside, 1.0]
    assert info.moved_back(0.07).camera.ground_to_pixel @ [*point, 1.0] == pytest.approx(seen)
    assert info.moved_back(0.07).camera.sonar_m == pytest.approx(info.camera.sonar_m)
    assert info.moved_back(0.0) is info


def test_sides_that_are_moved_back_are_those_of_the_view_that_is():
    hidden = partial(hidden_by_box, low=(-0.25, -0.12, 0.0), high=(0.15, 0.18, 0.25))
    mask = perfect_views(hidden, INFOS[7:8], "mask")[0]
    side = silhouette_sides(levels_of_mask(mask), mask, (0.0, 0.0))
    info = mask.info.moved_back(0.06)
    moved = side.moved_back({info.stamp_ns: 0.06})
    again = replace(mask, info=info)
    told = silhouette_sides(levels_of_mask(again), again, (0.0, 0.0))
    assert np.array_equal(moved.info.camera.projection, told.info.camera.projection)
    assert moved.shift_m == 0.06
    # Rays fan out from the sonar, so that a shadow farther beside it is a little wider.
    assert moved.support_m == pytest.approx(told.support_m, abs=0.03 * CELL_M)
    for by_shape, other in zip(moved.support_by_shape_m, told.support_by_shape_m, strict=True):
        assert by_shape == pytest.approx(other, abs=0.03 * CELL_M, nan_ok=True)
    assert moved.tip_m == told.tip_m


@pytest.mark.parametrize("cells", [0.8, 1.2, 1.5])
def test_shifts_of_views_are_told_by_their_sides(cells):
    sides, true = shifted(rough(drawn_sides_of(INFOS, SUPPORT), 0.25), cells)
    told = shifts_across(sides, grid())
    assert told.keys() == true.keys()
    error = np.array([told[stamp] - true[stamp] for stamp in true]) / CELL_M
    assert float(np.std(error)) < 0.35


def test_a_part_that_only_one_side_shows_does_not_move_its_view():
    """Half of the views see a rod of 1 m on their right: their left sides tell where they are."""
    sides, true = shifted(rough(drawn_sides_of(INFOS, SUPPORT), 0.25), 1.2)
    sides = [
        replace(side, support_m=(side.support_m[0] + 1.0, side.support_m[1])) if n % 2 else side
        for n, side in enumerate(sides)
    ]
    told = shifts_across(sides, grid())
    error = np.array([told[stamp] - true[stamp] for stamp in true]) / CELL_M
    assert float(np.std(error)) < 0.5


@pytest.mark.parametrize("cells", [0.0, 0.4, 1.0, 2.0])
def test_edges_that_are_rough_by_themselves_move_no_view(cells):
    assert shifts_across(rough(drawn_sides_of(INFOS, SUPPORT), cells), grid()) == {}


def test_views_that_show_one_side_each_are_not_moved():
    """One shift fits one side however rough it is."""
    sides, _ = shifted(drawn_sides_of(INFOS, SUPPORT), 1.2)
    one = [
        replace(side, direction_rad=side.direction_rad[n % 2 :][:1], support_m=side.support_m[n % 2 :][:1])
        for n, side in enumerate(sides)
    ]
    assert shifts_across(one, grid()) == {}


def test_without_sides_nothing_is_moved():
    assert shifts_across([], grid()) == {}


# A whole run

P = PipelineParameters(
    sub_aperture=SubApertureParameters(step_deg=6.0), carving=CarvingParameters(voxel_size_m=0.02)
)


@pytest.fixture(scope="session")
def views(box_run):
    """A run's shadow views, and what comes of them."""
    made = []
    result = pipeline.run(box_run.image, box_run.track, P, on_view=lambda view: made.append(view.shadow))
    return made, result


@pytest.fixture(scope="session")
def misplaced(views):
    """The same views, each beside its place by 1.5 cells (1σ), and how far, m."""
    made, _ = views
    shifts = np.random.default_rng(4).normal(0.0, 1.5 * made[0].info.resolution_m[1], len(made))
    return [replace(v, info=v.info.moved_back(-s)) for v, s in zip(made, shifts, strict=True)], shifts


def test_a_run_whose_views_are_misplaced_comes_out_as_if_they_were_not(views, misplaced, monkeypatch):
    right = views[1].dimensions
    cell_m = misplaced[0][0].info.resolution_m[1]
    decision = replace(views[1].decision, others=())
    result = run_views(lambda: misplaced[0], "shadow", P, decision=decision)
    found = result.dimensions
    assert found.length_m == pytest.approx(right.length_m, abs=0.6 * cell_m)
    assert found.width_m == pytest.approx(right.width_m, abs=0.6 * cell_m)
    assert found.scatter_cells < 0.5
    told = np.array([result.evidence[v.info.stamp_ns].shift_m for v in misplaced[0]])
    assert float(np.std(told - misplaced[1])) < 0.6 * cell_m
    assert result.quality.verdict != "good"
    assert any("beside one another across range" in reason for reason in result.quality.reasons)
    # What it would be without.
    monkeypatch.setattr("csas_shadow_ros.core.reconstruction.shifts_across", lambda *_: {})
    bare = run_views(lambda: misplaced[0], "shadow", P, decision=decision)
    assert bare.dimensions.scatter_cells > 1.0
    assert np.count_nonzero(bare.grid.occupied) < 0.9 * np.count_nonzero(result.grid.occupied)


def test_results_of_misplaced_views_do_not_depend_on_what_was_asked_before(views, misplaced):
    """Asking for a result moves nothing for the next one, nor for views that come later."""
    decision = replace(views[1].decision, others=())
    whole = Reconstruction(decision, P)
    asked = Reconstruction(decision, P)
    for made, ask in ((whole, False), (asked, True)):
        for number, view in enumerate(misplaced[0][::2]):
            made.add(pipeline.ProcessedView(decision.target, P, shadow=view))
            if ask and number == 25:
                made.result()
    first, other = whole.result(), asked.result()
    assert any(one.shift_m for one in first.evidence.values())
    assert other.dimensions == first.dimensions
    assert other.evidence == first.evidence
    assert np.array_equal(other.grid.occupied, first.grid.occupied)


def test_views_that_lie_where_they_should_are_not_moved(views):
    assert {one.shift_m for one in views[1].evidence.values()} == {0.0}
