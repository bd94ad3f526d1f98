"""What a carved body explains of the views: low wide bodies keep their tops, and misfits are told."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from core_data import ground_of_pixels, hidden_by_box, iou, make_info

from csas_shadow_ros.core.geometry import View
from csas_shadow_ros.core.imaging.mask_codes import MASK_COVERED, MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN
from csas_shadow_ros.core.imaging.masks import near_covered
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import run
from csas_shadow_ros.core.shape.carving import Carver, carve
from csas_shadow_ros.core.shape.explained import cast_shadow, shadow_fit, unexplained_shadow
from csas_shadow_ros.core.shape.layover import layover_per_metre
from csas_shadow_ros.core.shape.result import Result, ViewEvidence
from csas_shadow_ros.core.shape.verdict import explained_share, judge
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.simulation import shadow_hull, simulate, voxelise_truth

#: Six times as long as high: its shadow is half as long as its top.
LOW, HIGH = (-0.45, -0.3, 0.0), (0.45, 0.3, 0.15)
VOLUME = Volume.around((0.0, 0.0), (1.3, 1.0, 0.4), 0.025)
INFOS = tuple(make_info(math.radians(a), size=256, spacing_m=0.012) for a in range(0, 360, 5))


def lit_top(info, low=LOW, high=HIGH):
    """Return where the top of a box is imaged, laid over towards the sonar, and its near 3 cm."""
    x, y = ground_of_pixels(info.camera)

    def on_top(moved):
        px, py = x - moved[0], y - moved[1]
        return (px >= low[0]) & (px <= high[0]) & (py >= low[1]) & (py <= high[1])

    layover = high[2] * layover_per_metre(info)
    towards = layover / np.linalg.norm(layover)
    return on_top(layover), on_top(layover) & ~on_top(layover - 0.03 * towards)


def mask_of(info, low=LOW, high=HIGH):
    """Return the mask of a box whose top is as bright as the seabed and whose near edge glitters."""
    x, y = ground_of_pixels(info.camera)
    top, edge = lit_top(info, low, high)
    mask = np.where(hidden_by_box(x, y, info.camera.sonar_m, low, high), MASK_SHADOW, MASK_OUTSIDE)
    mask[(mask == MASK_SHADOW) & top] = MASK_COVERED
    mask[top] = MASK_COVERED
    mask[edge] = MASK_UNKNOWN
    return View(info, mask.astype(np.uint8))


def box_voxels(low=LOW, high=HIGH, volume=VOLUME):
    x, y, z = (
        (axis >= a) & (axis <= b)
        for axis, a, b in zip((volume.x_m, volume.y_m, volume.z_m), low, high, strict=True)
    )
    return z[:, None, None] & y[:, None] & x


def test_a_low_wide_body_is_not_carved_by_its_own_lit_top():
    grid = carve([mask_of(info) for info in INFOS], VOLUME, CarvingParameters())
    truth = box_voxels()
    below = slice(0, truth.any(axis=(1, 2)).sum())
    assert iou(grid.occupied[below], truth[below]) > 0.9


def test_taken_for_lit_seabed_its_top_would_carve_it():
    # What the test above would see if far covered pixels were not asked for.
    near = [near_covered(mask_of(info)) for info in INFOS]
    assert iou(carve(near, VOLUME, CarvingParameters()).occupied, box_voxels()) < 0.5


def test_open_ground_before_a_shadow_is_not_filled():
    # A plate on the seabed before the box explains no shadow: covered pixels alone do not make it.
    low, high = (-0.1, -0.3, 0.0), (0.1, 0.3, 0.3)
    views = []
    for info in INFOS:
        mask = mask_of(info, low, high).pixels.copy()
        plate, _ = lit_top(info, (-0.5, -0.3, 0.0), (-0.1, 0.3, 0.01))
        mask[plate & (mask == MASK_OUTSIDE)] = MASK_COVERED
        views.append(View(info, mask))
    grid = carve(views, VOLUME, CarvingParameters())
    truth = box_voxels(low, high)
    beside = np.asarray(VOLUME.x_m < -0.2)
    assert grid.occupied[:, :, beside].sum() < 0.1 * truth.sum()
    assert (grid.occupied & truth).sum() > 0.9 * truth.sum()


@pytest.mark.parametrize("aspect", [0.0, 40.0, 200.0])
def test_a_bodys_shadow_is_where_rays_are_blocked(aspect):
    info = make_info(math.radians(aspect), size=256, spacing_m=0.012)
    x, y = ground_of_pixels(info.camera)
    blocked = hidden_by_box(x, y, info.camera.sonar_m, LOW, HIGH)
    cast = cast_shadow(View(info, np.zeros(blocked.shape, np.uint8)), VOLUME, box_voxels())
    assert iou(cast, blocked) > 0.93


def test_what_a_body_does_not_cast_is_unexplained():
    info = INFOS[18]  # from the north: the halves stand side by side
    mask = mask_of(info)
    whole, half = box_voxels(), box_voxels(high=(0.0, 0.3, 0.15))
    grid = carve([mask_of(one) for one in INFOS], VOLUME, CarvingParameters())
    assert unexplained_shadow(mask, [replace(grid, occupied=whole)]).sum() == 0
    right = shadow_fit(mask, [replace(grid, occupied=whole)])
    less = shadow_fit(mask, [replace(grid, occupied=half)])
    more = shadow_fit(mask, [replace(grid, occupied=box_voxels(high=(0.45, 0.3, 0.3)))])
    assert right.unexplained == 0.0
    assert right.lit < 0.01
    assert less.unexplained > 0.2
    assert less.lit < 0.01
    assert more.unexplained == 0.0
    assert more.lit > 0.2
    # Two bodies explain together what each alone does not.
    other = replace(grid, occupied=whole & ~half)
    assert shadow_fit(mask, [replace(grid, occupied=half), other]).unexplained == 0.0


def test_a_faint_top_behind_a_shadow_is_not_taken_for_lit_seabed():
    # In line with the sonar the top of the farther box, laid over, lies on the shadow of the nearer one.
    near, far = ((-0.2, -0.15, 0.0), (0.2, 0.15, 0.3)), ((0.6, -0.2, 0.0), (1.0, 0.2, 0.3))
    volume = Volume.around((0.0, 0.0), (0.9, 0.8, 0.5), 0.025)
    beyond = Volume.around((0.8, 0.0), (0.7, 0.7, 0.5), 0.025)
    carver = Carver(volume, CarvingParameters())
    for info in INFOS:
        x, y = ground_of_pixels(info.camera)
        top, _ = lit_top(info, *far)
        shadow = hidden_by_box(x, y, info.camera.sonar_m, *near)
        carver.integrate(View(info, np.where(shadow & ~top, MASK_SHADOW, MASK_OUTSIDE).astype(np.uint8)))
    truth = box_voxels(*near, volume=volume)
    alone = carver.grid()
    behind = box_voxels(*far, volume=beyond)
    other = VoxelGrid(
        beyond,
        np.zeros(beyond.shape, np.float32),
        np.full(beyond.shape, len(INFOS), np.uint16),
        alone.threshold,
        behind,
        "consensus",
    )
    assert iou(alone.occupied, truth) < 0.75, "or the scene shows nothing"
    beside = carver.beside(alone, [other])
    layers = truth.any(axis=(1, 2)).sum()
    assert iou(beside.occupied[:layers], truth[:layers]) > 0.9
    # What is far off changes nothing.
    far_off = replace(other, volume=Volume.around((30.0, 0.0), (0.7, 0.7, 0.5), 0.025))
    assert np.array_equal(carver.beside(alone, [far_off]).occupied, alone.occupied)


def test_near_covered_pixels_are_those_within_a_stretchs_own_length():
    info = make_info(0.0, size=40)
    cells = info.cell_px
    flank, beside = round(1.2 * cells[0]), round(0.75 * cells[1])
    assert (flank, beside) == (2, 2)
    mask = np.zeros((40, 40), np.uint8)
    mask[2, :] = MASK_UNKNOWN
    mask[3:20, :] = MASK_COVERED
    mask[20:30, :] = MASK_SHADOW
    near = near_covered(View(info, mask)).pixels
    assert (near[3:18] == MASK_OUTSIDE).all()  # no echo within ten rows: the flank alone
    assert (near[18:20] == MASK_COVERED).all()
    mask[12, 4] = MASK_UNKNOWN
    near = near_covered(View(info, mask)).pixels
    assert (near[13:20, 2:7] == MASK_COVERED).all()  # it speaks for two columns on either side
    assert (near[3:12] == MASK_OUTSIDE).all()
    assert (near[13:18, 7:] == MASK_OUTSIDE).all()
    assert (near[mask != MASK_COVERED] == mask[mask != MASK_COVERED]).all()


def evidence(unexplained=0.0, lit=0.0, n=10):
    return {
        i: ViewEvidence(i, 0.1 * i, (30.0, 0.0, 12.0), height_m=0.3, unexplained=unexplained, lit=lit)
        for i in range(n)
    }


@pytest.mark.parametrize(
    ("unexplained", "lit", "quality", "word"),
    [
        (0.03, 0.01, "good", ""),
        (0.15, 0.0, "limited", "15 % of the shadow is unexplained"),
        (0.45, 0.0, "not trustworthy", "45 % of the shadow is unexplained"),
        (0.0, 0.2, "not trustworthy", "20 % of the shadow that it would cast is lit"),
    ],
)
def test_a_result_that_does_not_explain_the_pictures_says_so(unexplained, lit, quality, word):
    result = Result(views_used=10, arc_rad=2.0 * math.pi, evidence=evidence(unexplained, lit))
    judge(result)
    assert result.quality.verdict == quality
    assert word in "; ".join(result.quality.reasons)
    assert explained_share(result) == pytest.approx(1.0 - unexplained)


@pytest.mark.parametrize(
    ("refused", "quality"), [(0, "good"), (3, "limited"), (10, "limited"), (11, "not trustworthy")]
)
def test_views_that_were_refused_cost_trust_and_most_of_them_all(refused, quality):
    rejected = {float(i): "it is dark" for i in range(refused)}
    composites: Any = object()  # there are views
    result = Result(views_used=10, arc_rad=2.0 * math.pi, rejected=rejected, composites=composites)
    judge(result)
    assert result.quality.verdict == quality


def test_no_reason_holds_what_separates_reasons():
    result = Result(views_used=1, arc_rad=2.0 * math.pi, rejected={0.0: "dark; too dark"})
    judge(result)
    assert "1 of 2 views were not used: dark, too dark" in result.quality.reasons


def test_nothing_is_said_of_a_fit_that_nobody_looked_at():
    result = Result(views_used=10, arc_rad=2.0 * math.pi, evidence=evidence(math.nan, math.nan))
    judge(result)
    assert result.quality.verdict == "good"
    assert explained_share(result) is None


@pytest.fixture(scope="session")
def mattress(tmp_path_factory):
    """A simulated box that is five times as long as high, and what the chain makes of it."""
    mesh = trimesh.creation.box((1.0, 0.6, 0.2))
    mesh.apply_translation((0.0, 0.0, 0.1))
    file = tmp_path_factory.mktemp("mattress") / "mattress.stl"
    mesh.export(file)
    made = simulate("tiny", str(file), seed=5, heading_deg=20.0, workers=1)
    parameters = PipelineParameters(
        sub_aperture=SubApertureParameters(step_deg=6.0), carving=CarvingParameters(voxel_size_m=0.04)
    )
    return made, run(made.image, made.track, parameters, workers=1)


def test_a_simulated_low_wide_box_is_whole_and_trusted(mattress):
    made, result = mattress
    grid = result.grid
    hull = shadow_hull(made.truth.target, made.truth.sonar_m[::4], grid.volume)
    assert iou(grid.occupied, hull) > 0.8
    truth = voxelise_truth(made.truth.target, grid.volume)
    assert (grid.occupied & truth).sum() > 0.9 * truth.sum()
    assert result.verdict == "object"
    assert result.quality.verdict == "good"
    assert explained_share(result) > 0.97


def test_views_tell_how_well_the_shape_explains_them(mattress):
    _, result = mattress
    told = [one for one in result.evidence.values() if math.isfinite(one.unexplained)]
    assert len(told) == result.views_used
    assert all(0.0 <= one.unexplained <= 1.0 and 0.0 <= one.lit <= 1.0 for one in told)
