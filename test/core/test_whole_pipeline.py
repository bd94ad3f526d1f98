"""The method from image to shape on small simulated runs: search, segmentation, and the whole chain."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from core_data import circle_track, ground_of_pixels, hidden_by_box, iou

from csas_shadow_ros.core import pipeline
from csas_shadow_ros.core.errors import NoTargetError, ParameterError, SpectrumSignError, ViewError
from csas_shadow_ros.core.geometry import Acoustics, CoherentImage, GroundGrid, Track, View
from csas_shadow_ros.core.imaging.enhancement import enhance
from csas_shadow_ros.core.imaging.likelihood import outside_likelihood, view_levels
from csas_shadow_ros.core.imaging.segmentation import require_silhouette, segment_shadow
from csas_shadow_ros.core.imaging.subaperture import Spectrum, SubApertures
from csas_shadow_ros.core.parameters import (
    CarvingParameters,
    PipelineParameters,
    SubApertureParameters,
    TargetParameters,
)
from csas_shadow_ros.core.search.bodies import search_views, spectrum_sign_evidence
from csas_shadow_ros.core.search.decision import decide_by_image
from csas_shadow_ros.core.shape.carving import Carver
from csas_shadow_ros.core.shape.volume import Volume
from csas_shadow_ros.simulation import simulate
from csas_shadow_ros.simulation.targets import box, cylinder

SMALL_BOX = box(0.35, 0.25, 0.2)
GIVEN = TargetParameters(target="given", position_m=(0.1, -0.15), size_m=(0.8, 0.7, 0.4))
FAST = PipelineParameters(
    sub_aperture=SubApertureParameters(step_deg=10.0, check_sign=False),
    carving=CarvingParameters(method="soft"),
    target=GIVEN,
)


def found_in(image, track, target=None):
    """Return the target that is decided on, without a look at the spectrum's sign."""
    p = PipelineParameters(
        sub_aperture=SubApertureParameters(check_sign=False), target=target or TargetParameters()
    )
    return decide_by_image(image, track, p, spectrum=Spectrum.of_image(image)).target


def turned(hidden_low, hidden_high, position, heading):
    """Shadow of a box that was turned about its middle: look at the scene in the box's own frame."""
    c, s = math.cos(heading), math.sin(heading)

    def hidden(x, y, sonar):
        def local(px, py):
            return c * (px - position[0]) + s * (py - position[1]), -s * (px - position[0]) + c * (
                py - position[1]
            )

        return hidden_by_box(*local(x, y), (*local(sonar[0], sonar[1]), sonar[2]), hidden_low, hidden_high)

    return hidden


BOX_SHADOW = turned((-0.25, -0.15, 0.0), (0.25, 0.15, 0.25), (0.1, -0.15), math.radians(25.0))


@pytest.fixture(scope="session")
def box_result(box_run):
    p = replace(FAST, sub_aperture=SubApertureParameters(step_deg=10.0), target=TargetParameters())
    calls, seen = [], []
    result = pipeline.run(
        box_run.image,
        box_run.track,
        p,
        progress=lambda i, n: calls.append((i, n)),
        on_view=seen.append,
        workers=2,
    )
    return result, calls, seen


@pytest.mark.parametrize("aspect_deg", [0.0, 65.0, 140.0, 205.0, 290.0])
def test_the_segmented_shadow_is_the_true_one(box_run, aspect_deg):
    sa = SubApertures(box_run.image, box_run.track)
    view = enhance(sa.view_of_aspect(math.radians(aspect_deg)), (0.1, -0.15))
    mask = segment_shadow(view, (0.1, -0.15))
    assert mask.pixels.dtype == np.uint8
    assert set(np.unique(mask.pixels)) <= {0, 64, 128, 255}
    assert (mask.pixels[np.isnan(view.pixels)] == 128).all()
    assert mask.info is view.info
    truth = BOX_SHADOW(*ground_of_pixels(view.info.camera), view.info.camera.sonar_m)
    told = (mask.pixels == 0) | (mask.pixels == 255)
    assert iou((mask.pixels == 255) & told, truth & told) > 0.7
    # What is left open must not be most of the shadow.
    assert np.count_nonzero(truth & told) > 0.5 * np.count_nonzero(truth)


def test_no_shadow_of_the_target_is_an_empty_mask_that_can_be_refused(empty_run):
    view = enhance(SubApertures(empty_run.image, empty_run.track).view(33), (0.0, 0.0))
    mask = segment_shadow(view, (0.0, 0.0))
    assert not (mask.pixels == 255).any()
    with pytest.raises(ViewError, match="no shadow of the target was segmented"):
        require_silhouette(mask)


@pytest.mark.parametrize(
    ("target", "position"),
    [
        (SMALL_BOX, (0.6, 0.0)),
        (SMALL_BOX, (-0.42, 0.42)),
        (cylinder(0.6, 0.25), (0.2, -0.55)),
    ],
    ids=["east", "north-west", "cylinder"],
)
def test_a_body_is_found_wherever_it_lies_and_fits_the_volume(target, position):
    run = simulate("tiny", target, seed=6, position_m=position)
    found = found_in(run.image, run.track)
    assert found is not None
    (low, high) = run.truth.target.bounds
    for axis in (0, 1):
        assert found.position_m[axis] - found.size_m[axis] / 2 < low[axis]
        assert found.position_m[axis] + found.size_m[axis] / 2 > high[axis]
    assert found.size_m[2] > high[2]
    assert np.hypot(found.position_m[0] - position[0], found.position_m[1] - position[1]) < 0.15


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_an_empty_seabed_holds_no_body(seed, empty_run):
    run = empty_run if seed == 11 else simulate("tiny", "empty", seed=seed)
    evidence, search = spectrum_sign_evidence(run.image, run.track)
    assert search.best is None
    assert evidence.verdict == "unknown"
    evidence.check()


@pytest.mark.parametrize("sign", [1, -1])
def test_the_shadows_tell_a_right_spectrum_sign_from_a_wrong_one(sign, box_run):
    run = (
        box_run
        if sign == 1
        else simulate("tiny", box(0.5, 0.3, 0.25), seed=3, position_m=(0.1, -0.15), spectrum_sign=-1)
    )
    right, search = spectrum_sign_evidence(run.image, run.track)
    assert right.verdict == "right"
    assert search.best is not None
    right.check()
    lie = replace(run.image, acoustics=replace(run.image.acoustics, spectrum_sign=-sign))
    wrong, _ = spectrum_sign_evidence(lie, run.track)
    assert wrong.verdict == "wrong"
    with pytest.raises(SpectrumSignError, match=rf"spectrum_sign is [{-sign:+d}]+: .* expected [{sign:+d}]+"):
        wrong.check()


def test_a_position_that_is_given_is_used_and_sizes_given_override(box_run):
    given = found_in(box_run.image, box_run.track, GIVEN)
    assert given.position_m == (0.1, -0.15)
    assert given.size_m == (0.8, 0.7, 0.4)
    auto = found_in(box_run.image, box_run.track, TargetParameters(target="given", position_m=(0.12, -0.1)))
    assert auto.position_m == (0.12, -0.1)
    assert all(s > 0.2 for s in auto.size_m)
    some = found_in(box_run.image, box_run.track, TargetParameters(size_m=(0.0, 0.0, 0.33)))
    assert some.size_m[2] == 0.33
    assert some.size_m[:2] == auto.size_m[:2]
    with pytest.raises(NoTargetError, match=r"no object at the given position \(-0.9, 0.9\)"):
        found_in(box_run.image, box_run.track, TargetParameters(target="given", position_m=(-0.9, 0.9)))
    with pytest.raises(NoTargetError, match="there is no view"):
        search_views([])


def test_the_pipeline_is_its_stages_done_by_hand(box_run, box_result):
    result, _, _ = box_result
    evidence, search = spectrum_sign_evidence(box_run.image, box_run.track)
    target = search.best
    assert result.target == target
    assert result.sign == evidence
    carver = Carver(Volume.around(target.position_m, target.size_m, 0.02), CarvingParameters(method="soft"))
    sa = SubApertures(box_run.image, box_run.track, SubApertureParameters(step_deg=10.0))
    for index in reversed(range(len(sa))):
        shadow = enhance(sa.view(index), target.position_m)
        carver.integrate(outside_likelihood(shadow, levels=view_levels(shadow)))
    grid = carver.grid()
    assert np.array_equal(result.grid.likelihood, grid.likelihood, equal_nan=True)
    assert np.array_equal(result.grid.occupied, grid.occupied)
    assert result.grid.threshold == grid.threshold


def test_progress_is_told_once_a_view_and_views_come_in_order(box_result):
    result, calls, seen = box_result
    assert calls == [(i, 36) for i in range(1, 37)]
    assert [round(math.degrees(v.shadow.info.aspect_rad)) for v in seen] == list(range(0, 360, 10))
    assert result.views_used == 36
    assert result.rejected == {}
    assert len(result.evidence) == 36
    assert set(result.grid.views.ravel()) <= set(range(37))


def test_a_box_comes_out_where_and_about_as_large_as_it_is(box_result):
    result, _, _ = box_result
    d = result.dimensions
    assert result.mesh.is_watertight
    assert d.position_m == pytest.approx((0.1, -0.15), abs=0.06)
    assert d.length_m == pytest.approx(0.5, abs=0.2)
    assert d.width_m == pytest.approx(0.3, abs=0.2)
    assert d.height_m == pytest.approx(0.25, abs=0.12)
    assert d.volume_m3 == pytest.approx(result.mesh.volume)


def test_the_composites_of_a_run_cover_its_image(box_run, box_result):
    composites = box_result[0].composites
    image = composites.multilook()
    left, right, bottom, top = box_run.image.grid.extent_m
    x, y = composites.grid.x_of_columns(), composites.grid.y_of_rows()
    inside = ((y > bottom + 0.05) & (y < top - 0.05))[:, None] & ((x > left + 0.05) & (x < right - 0.05))[
        None
    ]
    assert np.isfinite(image[inside]).all()
    assert len(composites.stamps) == 36


def test_one_worker_and_two_leave_identical_grids(box_run, box_result):
    two, _, _ = box_result
    p = replace(FAST, sub_aperture=SubApertureParameters(step_deg=10.0), target=TargetParameters())
    one = pipeline.run(box_run.image, box_run.track, p, workers=1)
    for a, b in ((one.grid, two.grid), (one.other_grid, two.other_grid)):
        assert np.array_equal(a.likelihood, b.likelihood, equal_nan=True)
        assert np.array_equal(a.occupied, b.occupied)
        assert np.array_equal(a.views, b.views)
    assert np.array_equal(one.composites.multilook(), two.composites.multilook(), equal_nan=True)


@pytest.mark.parametrize("method", ["consensus", "hard", "soft"])
def test_every_method_leaves_its_grid_and_another_to_compare_with(box_run, method):
    p = replace(
        FAST,
        carving=CarvingParameters(method=method),
        sub_aperture=SubApertureParameters(step_deg=30.0, check_sign=False),
    )
    result = pipeline.run(box_run.image, box_run.track, p)
    assert result.grid.method == method
    assert result.other_grid.method != method
    assert result.views_used == 12
    assert result.grid.occupied.any()
    assert result.sign is None


def test_a_gap_in_the_track_is_rejected_with_aspect_and_reason_and_the_run_goes_on(box_run):
    t = box_run.track
    degrees = np.degrees(t.aspects_rad) % 360
    keep = (degrees < 85) | (degrees > 125)
    track = Track(t.stamps_ns[keep], t.positions_m[keep])
    result = pipeline.run(box_run.image, track, FAST)
    assert sorted(result.rejected) == [90.0, 100.0, 110.0, 120.0]
    assert all("track gap" in reason for reason in result.rejected.values())
    assert "aspect 100.0°" in result.rejected[100.0]
    assert result.views_used == 32
    assert result.grid.views.max() == 32
    assert result.grid.occupied.any()


def test_an_empty_seabed_is_a_result_without_object_but_with_its_pictures(empty_run):
    p = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=30.0))
    result = pipeline.run(empty_run.image, empty_run.track, p)
    assert result.target is None
    assert result.grid is None
    assert result.mesh is None
    assert result.dimensions is None
    assert result.views_used == 0
    assert result.sign.verdict == "unknown"
    assert np.isfinite(result.composites.multilook()).any()


def test_a_wrong_spectrum_sign_stops_the_run(box_run):
    lie = replace(box_run.image, acoustics=replace(box_run.image.acoustics, spectrum_sign=-1))
    with pytest.raises(SpectrumSignError, match=r"spectrum_sign is -1: .*expected \+1"):
        pipeline.run(lie, box_run.track)


def test_a_track_elsewhere_is_refused_rather_than_guessed(box_run):
    lost = circle_track(keep=lambda d: d < 20)
    result = pipeline.run(box_run.image, lost, FAST)
    assert len(result.rejected) >= 34
    assert result.views_used == 36 - len(result.rejected)


def test_an_l_comes_out_as_an_l_and_not_mirrored():
    from csas_shadow_ros.simulation import shadow_hull
    from csas_shadow_ros.simulation.targets import l_shape

    run = simulate("tiny", l_shape(0.8, 0.6, 0.2, 0.3), seed=8)
    p = PipelineParameters(
        sub_aperture=SubApertureParameters(step_deg=5.0, check_sign=False),
        target=TargetParameters(target="given", position_m=(0.0, 0.0), size_m=(1.1, 1.1, 0.4)),
    )
    grid = pipeline.run(run.image, run.track, p).grid
    hull = shadow_hull(run.truth.target, run.track.positions_m[::10], grid.volume)
    right = iou(grid.occupied, hull)
    mirrored = max(iou(grid.occupied[:, ::-1], hull), iou(grid.occupied[:, :, ::-1], hull))
    turned_round = iou(grid.occupied[:, ::-1, ::-1], hull)
    assert right > 0.6
    assert right > 1.4 * max(mirrored, turned_round)


def test_views_are_given_on_with_all_their_stages(box_result):
    _, _, seen = box_result
    for view in seen:
        infos = [v.info.stamp_ns for v in (view.sub_aperture, view.shadow, view.likelihood, view.mask)]
        assert len(set(infos)) == 1
        assert isinstance(view.mask, View)
    assert cv2.countNonZero((seen[0].mask.pixels == 255).astype(np.uint8)) > 0


def test_an_image_with_a_pixel_that_is_not_finite_is_refused_by_its_place():
    rng = np.random.default_rng(0)
    pixels = (rng.standard_normal((64, 64)) + 1j * rng.standard_normal((64, 64))).astype(np.complex64)
    grid = GroundGrid.centred(64, 64, 0.005)
    image = CoherentImage(pixels, grid, Acoustics(60e3, 20e3, 1500.0, 1))
    pixels[3, 7] = np.nan
    with pytest.raises(ParameterError, match=r"1 of \d+ pixels not finite, the first at row 3, column 7"):
        Spectrum.of_image(image)


@pytest.mark.parametrize(
    "method",
    [
        "consensus",
        pytest.param("hard", marks=pytest.mark.long),
        pytest.param("soft", marks=pytest.mark.long),
    ],
)
def test_shadows_that_leave_the_image_leave_unknown_voxels_and_no_roof(method):
    height = 0.4
    run = simulate("tiny", box(0.8, 0.4, height), seed=3)
    image, first, last = run.image, 16, run.image.grid.rows - 32
    grid = replace(image.grid, rows=last - first, y_max_m=image.grid.y_max_m - first * image.grid.spacing_m)
    cut = replace(image, pixels=np.ascontiguousarray(image.pixels[first:last]), grid=grid)
    parameters = PipelineParameters(
        sub_aperture=SubApertureParameters(step_deg=10.0), carving=CarvingParameters(method=method)
    )
    result = pipeline.run(cut, run.track, parameters)
    assert result.grid is not None
    assert result.dimensions is not None
    volume = result.grid.volume
    assert volume.size_m[2] > 1.4 * height
    assert np.isnan(result.grid.likelihood[volume.z_m > 1.4 * height]).any()
    assert 0.8 * height < result.dimensions.height_m < 1.4 * height
