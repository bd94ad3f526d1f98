"""One reconstruction, whoever feeds it: in any order, whole views or parts; bodies that are given up."""

from __future__ import annotations

import random
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from csas_shadow_ros.core import pipeline
from csas_shadow_ros.core.parameters import CarvingParameters, PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import ProcessedView
from csas_shadow_ros.core.reconstruction import Reconstruction
from csas_shadow_ros.core.search.decision import Decision
from csas_shadow_ros.core.shape.verdict import cut_sides
from csas_shadow_ros.core.shape.volume import Target
from csas_shadow_ros.simulation import simulate

COARSE = PipelineParameters(
    sub_aperture=SubApertureParameters(step_deg=10.0), carving=CarvingParameters(voxel_size_m=0.03)
)


@pytest.fixture(scope="session")
def whole(box_run):
    """A run, and its views as they went in."""
    views = []
    result = pipeline.run(box_run.image, box_run.track, COARSE, on_view=views.append)
    return result, views


def assert_same(a, b):
    assert a.dimensions == b.dimensions
    assert a.verdict == b.verdict
    assert a.quality == b.quality
    assert a.evidence == b.evidence
    assert a.arc_rad == b.arc_rad
    assert a.grid.seabed == b.grid.seabed
    for x, y in ((a.grid, b.grid), (a.other_grid, b.other_grid)):
        assert np.array_equal(x.likelihood, y.likelihood, equal_nan=True)
        assert np.array_equal(x.occupied, y.occupied)
    assert np.array_equal(a.matter, b.matter)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_order_of_views_changes_nothing(whole, seed):
    result, views = whole
    again = Reconstruction(replace(result.decision, others=()), COARSE, run_ns=result.run_ns)
    shuffled = random.Random(seed).sample(views, len(views))
    for view in shuffled:
        assert again.add(view)
    assert_same(again.result(), result)


@pytest.mark.parametrize("first", ["mask", "shadow"])
def test_parts_of_a_view_that_come_one_by_one_leave_what_whole_views_leave(whole, first):
    result, views = whole
    again = Reconstruction(replace(result.decision, others=()), COARSE, run_ns=result.run_ns)
    target = result.target
    for view in views:
        parts = [
            (ProcessedView(target, COARSE, shadow_mask=view.mask), ("mask",)),
            (ProcessedView(target, COARSE, likelihood=view.likelihood), ("likelihood",)),
            (ProcessedView(target, COARSE, shadow=view.shadow), ("levels", "look")),
        ]
        for piece, names in parts if first == "mask" else parts[::-1]:
            again.add(piece, parts=names)
    assert_same(again.result(), result)


def test_a_view_that_comes_again_changes_nothing(whole):
    result, views = whole
    again = Reconstruction(replace(result.decision, others=()), COARSE, run_ns=result.run_ns)
    for view in (*views, *views[:5]):
        again.add(view)
    assert_same(again.result(), result)
    assert not again.add(views[0])


def test_silhouettes_alone_are_measured_by_themselves(whole):
    result, views = whole
    alone = Reconstruction(Decision(result.target), COARSE, compare=False, compose=False)
    for view in views:
        alone.add(ProcessedView(result.target, COARSE, shadow_mask=view.mask), parts=("mask",))
    found = alone.result()
    assert np.array_equal(found.grid.occupied, result.grid.occupied)
    assert found.matter is None
    # To a resolution cell: a mask tells its edges to a pixel, levels to a fraction of one.
    cell_m = views[0].mask.info.resolution_m[1]
    assert found.dimensions.length_m == pytest.approx(result.dimensions.length_m, abs=cell_m)


def with_silhouettes_apart(whole, columns):
    """Reconstruct a run again from silhouettes that no two views agree on."""
    result, views = whole
    again = Reconstruction(replace(result.decision, others=()), COARSE, compose=False)
    for number, view in enumerate(views):
        shift = (-columns, columns)[number % 2]
        mask = replace(view.mask, pixels=np.roll(view.mask.pixels, shift, axis=1))
        again.add(ProcessedView(result.target, COARSE, shadow_mask=mask, likelihood=view.likelihood))
    return again.result()


def test_what_silhouettes_are_too_little_for_is_carved_from_the_mean_likelihood(whole):
    result, _ = whole
    found = with_silhouettes_apart(whole, 12)  # as of speckle
    assert not found.other_grid.occupied.any()
    assert found.grid.method == "soft"
    assert np.array_equal(found.grid.occupied, result.other_grid.occupied)
    assert found.verdict == "object"
    assert found.quality.verdict != "good"
    assert any("mean likelihood of all views" in reason for reason in found.quality.reasons)
    assert not found.dimensions.intervals


def test_a_volume_that_cuts_the_object_is_told(whole):
    result, views = whole
    x, y, z = result.target.size_m
    small = replace(result.target, size_m=(0.3 * x, y, z))
    cut = Reconstruction(Decision(small), COARSE)
    for view in views:
        cut.add(ProcessedView(small, COARSE, shadow=view.shadow))
    found = cut.result()
    assert cut_sides(result.grid) == []
    assert result.quality.verdict == "good"
    assert {"west side", "east side"} <= set(cut_sides(found.grid))
    assert found.quality.verdict == "not trustworthy"
    assert any("cuts the object" in reason for reason in found.quality.reasons)


def test_a_mean_likelihood_that_explains_little_of_the_shadow_is_no_object(whole):
    found = with_silhouettes_apart(whole, 40)  # far from what is dark on the mean
    assert not found.grid.occupied.any()
    assert found.verdict == "undecided"
    assert "too thin or too faint to carve" in found.quality.reasons[0]


@pytest.mark.parametrize("method", ["consensus", "hard", "soft"])
@pytest.mark.parametrize("size_m", [(0.24, 0.18, 0.15), (0.15, 0.15, 0.15)])
def test_a_volume_that_lies_within_the_object_is_told(whole, method, size_m):
    result, views = whole
    inside = Target(result.target.position_m, size_m)
    parameters = replace(COARSE, carving=replace(COARSE.carving, method=method))
    carved = Reconstruction(Decision(inside), parameters)
    carved.feed(
        [view.shadow for view in views], lambda shadow: [ProcessedView(inside, parameters, shadow=shadow)]
    )
    found = carved.result()
    assert found.verdict == "object"
    assert found.quality.verdict == "not trustworthy"
    assert any("lies inside the object" in reason for reason in found.quality.reasons)


def test_without_a_usable_view_the_answer_is_undecided(whole):
    nothing = Reconstruction(Decision(whole[0].target), COARSE)
    nothing.refuse(0.0, "too dark")
    found = nothing.result()
    assert found.verdict == "undecided"
    assert "too dark" in found.quality.reasons[0]
    assert Reconstruction(Decision(None), COARSE).result().verdict == "no object"


@pytest.mark.parametrize("method", ["soft", "hard"])
def test_a_result_is_compared_with_the_shadows_whatever_carved_it(whole, method):
    result, views = whole
    p = replace(COARSE, carving=replace(COARSE.carving, method=method))
    again = Reconstruction(replace(result.decision, others=()), p, run_ns=result.run_ns)
    for view in views:
        again.add(view)

    evidence = again.result().evidence.values()

    assert len(evidence) == len(views)
    assert np.isfinite([[one.unexplained, one.lit] for one in evidence]).all()


@pytest.mark.parametrize("method", ["soft", "consensus"])
def test_shadows_that_leave_most_images_widen_no_object(method):
    """Soft carving filled what only views along a line know: 0.89 x 0.81 x 0.58 m for 0.8 x 0.4 x 0.4 m."""
    made = simulate("tiny", "box", heading_deg=0.0)
    p = replace(COARSE, carving=CarvingParameters(method=method, voxel_size_m=0.02))

    found = pipeline.run(made.image, made.track, p)

    for name, true_m in (("length_m", 0.8), ("width_m", 0.4), ("height_m", 0.4)):
        low, high = found.dimensions.intervals[name]
        assert low < true_m < high
        assert getattr(found.dimensions, name) == pytest.approx(true_m, abs=0.06)
    assert found.quality.verdict == "limited"
    assert re.search(r"leaves the image in .* expected an image of at least \d", str(found.quality.reasons))


def test_a_body_whose_every_shadow_leaves_the_image_has_its_plan_and_no_height():
    """It came out 1.38 x 1.35 x 0.88 m for a drum of 1.12 x 1.12 x 0.67 m on a standard image, `limited`."""
    drum = trimesh.creation.cylinder(0.3, 0.6, sections=48)
    drum.apply_translation((0.0, 0.0, 0.3))
    made = simulate("tiny", drum, seed=2, workers=2)
    p = replace(COARSE, carving=CarvingParameters(voxel_size_m=0.02))

    found = pipeline.run(made.image, made.track, p)

    for name in ("length_m", "width_m"):
        low, high = found.dimensions.intervals[name]
        assert low < 0.6 < high
        assert getattr(found.dimensions, name) == pytest.approx(0.6, abs=0.05)
    assert not {"height_m", "volume_m3"} & set(found.dimensions.intervals)
    assert found.quality.verdict == "not trustworthy"
    assert any("none tells the height" in reason for reason in found.quality.reasons)
