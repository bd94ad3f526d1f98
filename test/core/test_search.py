"""The search: faint and thin bodies, dark sediment, hollows, and the sign of the spectrum."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from csas_shadow_ros.bags.check import WARNING, check_spectrum_sign
from csas_shadow_ros.core.errors import NoTargetError, SpectrumSignError
from csas_shadow_ros.core.imaging.subaperture import Spectrum
from csas_shadow_ros.core.parameters import PipelineParameters, SubApertureParameters, TargetParameters
from csas_shadow_ros.core.pipeline import run
from csas_shadow_ros.core.search import bodies, detectable
from csas_shadow_ros.core.search.bodies import (
    Judged,
    Search,
    Thrown,
    cell_m,
    search_image,
    spectrum_sign_evidence,
)
from csas_shadow_ros.core.search.decision import decide
from csas_shadow_ros.core.search.detectable import detectable_of
from csas_shadow_ros.core.search.pieces import objects_of
from csas_shadow_ros.core.search.relief import Shading, shading
from csas_shadow_ros.core.shape.result import Detectable, LeftOut, Quality, Result
from csas_shadow_ros.core.shape.verdict import judge, no_object_reason
from csas_shadow_ros.core.shape.volume import Target
from csas_shadow_ros.simulation import simulate
from csas_shadow_ros.simulation.profiles import Faults
from csas_shadow_ros.simulation.seabed import Bump, Patch, Seabed
from csas_shadow_ros.simulation.targets import box

COARSE = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=6.0))
PLACE = (0.1, -0.1)
#: How the amplitude round a body goes with the aspect: not as a slope's.
OF_A_BODY = Shading(0.5, 0.9)


def seabed_alone(bed):
    return simulate("tiny", "empty", seed=2, bed=bed)


@pytest.mark.parametrize(("radius_m", "depth_m"), [(0.3, 0.08), (0.6, 0.2), (0.5, 0.3)])
def test_a_hollow_is_no_wrong_sign_but_a_doubt(radius_m, depth_m):
    hollow = seabed_alone(Seabed(bumps=(Bump(PLACE, radius_m, -depth_m),)))
    result = run(hollow.image, hollow.track, COARSE)
    assert result.verdict == "undecided"
    assert result.quality.verdict == "not trustworthy"
    assert any("a hollow in the seabed" in reason for reason in result.quality.reasons)


@pytest.mark.parametrize(("radius_m", "depth_m"), [(0.6, 0.15), (0.6, 0.2)])
@pytest.mark.parametrize("level_db", [-8.0, -5.0, -3.0])
def test_a_hollow_that_dark_sediment_fills_is_no_wrong_sign_and_no_object(radius_m, depth_m, level_db):
    """Its lit wall is no brighter than the seabed round about."""
    mud = Patch(PLACE, (1.2 * radius_m, 1.2 * radius_m), 0.0, level_db, 0.3)
    hollow = seabed_alone(Seabed(bumps=(Bump(PLACE, radius_m, -depth_m),), patches=(mud,)))
    result = run(hollow.image, hollow.track, COARSE)
    assert result.objects == []
    assert result.verdict == "undecided"
    assert any("a hollow in" in reason for reason in result.quality.reasons)


@pytest.mark.parametrize(("radius_m", "steep"), [(0.5, 0.45), (0.5, 0.5), (0.7, 0.45), (0.7, 0.5)])
def test_a_rise_too_flat_for_a_shadow_is_a_candidate_and_no_object(radius_m, steep):
    """The sonar sees the seabed at 22°; the side of the rise away from it is up to 6 dB darker."""
    height_m = steep * 0.4 * radius_m * 2.0 / np.pi
    rise = seabed_alone(Seabed(bumps=(Bump(PLACE, radius_m, height_m),)))
    result = run(rise.image, rise.track, COARSE)
    assert (result.verdict, result.objects) == ("undecided", [])
    (left,) = result.left_out
    assert "as bright on the side of the sonar: the seabed rises, or a low body" in left.reason
    assert np.hypot(*np.subtract(left.position_m, PLACE)) < 0.1 * radius_m + 0.02


def test_the_faces_of_slopes_and_the_shadows_of_bodies_go_round_the_circle_in_other_ways():
    """Amplitude by Lambert's rule, speckle of four looks."""
    rng = np.random.default_rng(1)
    aspects = np.radians(np.arange(0.0, 360.0, 10.0))
    at = np.stack([g.ravel() for g in np.meshgrid(*(np.linspace(-1.0, 1.0, 21),) * 2)])
    radius, side = np.hypot(*at), np.arctan2(at[1], at[0])

    def seen(amplitude_of):
        looks = []
        for aspect in aspects:
            off = np.angle(np.exp(1j * (side - aspect)))
            power = amplitude_of(off) ** 2 * rng.gamma(4.0, 0.25, len(radius))
            looks.append((aspect, power, np.ones(len(radius), bool)))
        rng.shuffle(looks)
        return shading(at, looks)

    slope = np.where(radius < 1.0, 0.7 * np.sin(np.pi * radius), 0.0)
    mud = np.where(radius < 0.8, 0.5, 1.0)
    rise, hollow = (
        seen(lambda off: 1.0 + slope * np.cos(off)),
        seen(lambda off: mud - mud * slope * np.cos(off)),
    )
    assert rise.is_rise
    assert not rise.is_hollow
    assert hollow.may_be_relief
    assert hollow.is_hollow
    assert not hollow.is_rise
    # The shadow of a drum of half the disc's radius, and of one as a rod is narrow; each with an echo.
    for half in (np.arcsin(np.minimum(0.5 / np.maximum(radius, 0.5), 1.0)), np.full(len(radius), 0.2)):
        body = seen(
            lambda off, half=half: np.where(abs(off) > np.pi - half, 0.2, np.where(abs(off) < 0.1, 1.4, 1.0))
        )
        assert not body.may_be_relief
        assert body.outward > 0.3
    sediment = seen(lambda off: mud)
    assert not sediment.is_rise
    assert not sediment.is_hollow


@pytest.mark.parametrize("target", ["box", "cone", "l_shape"])
def test_bodies_still_tell_a_wrong_sign(target):
    right = simulate("tiny", target, seed=3, position_m=PLACE)
    image = replace(right.image, acoustics=replace(right.image.acoustics, spectrum_sign=-1))
    evidence, _ = spectrum_sign_evidence(image, right.track)
    assert evidence.verdict == "wrong"
    with pytest.raises(SpectrumSignError, match=r"expected \+1"):
        run(image, right.track, COARSE)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_body_whose_shadows_leave_the_image_is_undecided_and_check_says_so_before(sign):
    # 1.8 m of cylinder, 0.52 m high, on an image of 2.56 m: its shadows reach 2.2 m from the middle.
    made = simulate("tiny", "cylinder", seed=1, heading_deg=30.0, spectrum_sign=sign)
    result = run(made.image, made.track, COARSE)
    assert (result.verdict, result.quality.verdict) == ("undecided", "not trustworthy")
    (left,) = result.left_out
    assert max(map(abs, left.position_m)) < 0.2, "where it stands"
    found = re.search(r"shadow leaves the image in \d+ of 36 views; .* at least ([\d.]+) m", left.reason)
    assert 2.56 < float(found[1]) < 2 * 2.2 + 0.1
    assert any("expected an image of at least" in reason for reason in result.quality.reasons)
    warned = [text for level, text, _ in check_spectrum_sign(made.image, made.track) if level == WARNING]
    assert len(warned) == 1
    assert left.reason in warned[0]


@pytest.mark.parametrize("seed", [1, 2])
def test_shadows_that_leave_the_image_under_the_other_sign_leave_a_doubt(seed):
    right = simulate("tiny", "cylinder", seed=seed)
    image = replace(right.image, acoustics=replace(right.image.acoustics, spectrum_sign=-1))
    evidence, _ = spectrum_sign_evidence(image, right.track)
    assert evidence.verdict == "unknown"
    result = run(image, right.track, COARSE)
    assert (result.verdict == "no object", result.quality.verdict) == (False, "not trustworthy")
    doubt = "under the other spectrum_sign its shadow leaves the image"
    assert any(doubt in reason for reason in result.quality.reasons)
    warned = [text for level, text, _ in check_spectrum_sign(image, right.track) if level == WARNING]
    assert any(doubt in text for text in warned)


def test_dark_sediment_that_leads_out_of_the_image_is_no_body_whose_shadow_does():
    bank = seabed_alone(Seabed(patches=(Patch((0.9, 0.0), (0.5, 1.0), 0.0, -12.0, 0.1),)))
    result = run(bank.image, bank.track, COARSE)
    assert (result.verdict, result.left_out) == ("no object", [])


@pytest.mark.parametrize(("radius_m", "edge"), [(0.3, 0.05), (0.5, 0.2)])
def test_a_dark_disc_of_sediment_is_no_object(radius_m, edge):
    disc = seabed_alone(Seabed(patches=(Patch(PLACE, (radius_m, radius_m), 0.0, -12.0, edge),)))
    result = run(disc.image, disc.track, COARSE)
    assert result.objects == []
    assert any("sediment" in left.reason for left in result.left_out)


def test_a_faint_box_is_found_or_named_and_its_seabed_alone_is_not():
    faint = Faults(contrast_db=4.0)
    with_box = simulate("tiny", "box", seed=3, faults=faint)
    search = search_image(with_box.image, with_box.track, Spectrum.of_image(with_box.image))
    assert search.best.stands
    assert max(map(abs, search.best.position_m)) < 0.1
    result = run(with_box.image, with_box.track, COARSE)
    assert (result.verdict, result.quality.verdict) == ("object", "not trustworthy")
    assert "of the shadow is unexplained" in result.quality.reasons[0]
    assert result.dimensions.length_m == pytest.approx(0.8, abs=0.12)
    assert result.dimensions.width_m == pytest.approx(0.4, abs=0.12)
    alone = simulate("tiny", "empty", seed=3, faults=faint)
    result = run(alone.image, alone.track, COARSE)
    assert (result.verdict, result.quality.verdict, result.left_out) == ("no object", "good", [])


def test_a_pole_thinner_than_a_cell_is_found_or_named():
    pole = trimesh.creation.cylinder(0.05, 0.35, sections=24)
    pole.apply_translation((0.0, 0.0, 0.175))
    simulated = simulate("small", pole, seed=1)
    result = run(simulated.image, simulated.track, COARSE)
    assert result.verdict in ("object", "undecided")
    assert max(map(abs, result.target.position_m)) < 0.1
    if result.verdict == "undecided":
        assert "a candidate at" in result.quality.reasons[0]


def test_a_pole_beside_a_box_that_stands_out_is_an_object_too():
    """The likelihood of single views shows the box alone; their mean power shows the pole as well."""
    pole = trimesh.creation.cylinder(0.05, 0.3, sections=24)
    pole.apply_translation((0.45, 0.4, 0.15))
    beside = box(0.4, 0.3, 0.25)
    beside.apply_translation((-0.4, -0.3, 0.0))
    made = simulate("small", trimesh.util.concatenate([beside, pole]), seed=1)
    middles = [part.bounds.mean(axis=0)[:2] for part in made.truth.target.split()]

    result = run(made.image, made.track, COARSE)

    assert len(result.objects) == 2
    for one, middle, size in zip(result.objects, middles, ((0.4, 0.3, 0.25), (0.1, 0.1, 0.3)), strict=True):
        assert one.dimensions.position_m == pytest.approx(middle, abs=0.06)
        found = one.dimensions.length_m, one.dimensions.width_m, one.dimensions.height_m
        assert found == pytest.approx(size, abs=0.04)


@pytest.mark.parametrize(("seed", "contrast_db"), [(1, 8.0), (3, 12.0)])
def test_a_low_slab_is_found_and_as_high_as_it_is(seed, contrast_db):
    """At 8 dB its own echo hides the shadow of its foot: it seems to hang, and nothing else stands there."""
    slab = box(0.35, 0.35, 0.08)
    made = simulate("small", slab, seed=seed, faults=Faults(contrast_db=contrast_db))

    result = run(made.image, made.track, COARSE)

    assert result.verdict == "object"
    assert result.dimensions.position_m == pytest.approx((0.0, 0.0), abs=0.03)
    assert result.dimensions.height_m == pytest.approx(0.08, abs=0.01)
    low, high = result.dimensions.intervals["height_m"]
    assert low < 0.08 < high


@pytest.mark.parametrize(
    "bed",
    [Seabed(step_db=9.0, step_deg=30.0, step_m=0.2), Seabed(seed=1, texture_db=2.5, texture_m=0.3)],
    ids=["step", "texture"],
)
def test_a_seabed_of_several_levels_hides_no_body_from_the_local_look(bed, monkeypatch):
    """Over the whole scene's level all of the darker seabed is dark, and nothing of the brighter one is."""
    made = simulate("tiny", "empty", seed=3, bed=bed)
    search = search_image(made.image, made.track, Spectrum.of_image(made.image))
    assert (search.targets, search.left_out) == ((), ())
    told = detectable_of(search)
    assert told.is_enough
    assert told.size_m < 0.2
    monkeypatch.setattr(detectable, "look_locally", lambda *_: None)
    assert not detectable_of(search).is_enough


def test_no_object_says_what_would_have_been_found():
    made = simulate("small", "empty", seed=3)
    found = run(made.image, made.track, COARSE)
    assert (found.verdict, found.quality.verdict) == ("no object", "good")
    least = found.detectable
    assert (least.found, least.places) == (9, 9)
    cell = 0.064  # of the search's views of 6°, on this profile
    assert cell <= least.size_m <= 3.0 * cell
    assert str(least) in no_object_reason(found)
    # What it says holds: such a body, with the simulation's own echo, is found.
    body = trimesh.creation.cylinder(least.size_m / 2.0, least.height_m, sections=24)
    with_body = simulate("small", body, seed=4, position_m=(0.3, -0.4), faults=Faults(contrast_db=6.0))
    search = search_image(with_body.image, with_body.track, Spectrum.of_image(with_body.image))
    assert search.best is not None
    assert search.best.position_m == pytest.approx((0.3, -0.4), abs=least.size_m)


def test_no_object_is_limited_where_the_seabed_hides_bodies():
    result = Result(detectable=Detectable(0.4, 0.2, 6.0, 5, 9))
    judge(result)
    assert (result.verdict, result.quality.verdict) == ("no object", "limited")
    assert "found at 5 of 9 places" in result.quality.reasons[0]
    result = Result(detectable=Detectable(0.1, 0.05, 6.0, 8, 9))
    judge(result)
    assert (result.verdict, result.quality) == ("no object", Quality("good", ()))


def test_a_body_that_carving_loses_beside_an_object_is_named_as_a_candidate(box_run):
    result = run(box_run.image, box_run.track, COARSE)
    assert result.quality.verdict == "good"
    nothing = replace(result.grid, occupied=np.zeros_like(result.grid.occupied))
    objects, left_out = objects_of(nothing, (3.0, -4.0), [result.grid])
    assert objects == []

    result.left_out += left_out
    judge(result)

    assert (result.verdict, result.quality.verdict) == ("object", "limited")
    assert result.quality.reasons[0].startswith("a candidate at (3.00, -4.00) m: ")


def test_a_target_that_carving_loses_beside_another_object_is_named_as_a_candidate(box_run):
    result = run(box_run.image, box_run.track, COARSE)
    (found,) = result.objects
    result.target = replace(result.target, position_m=(3.0, -4.0))
    nothing = np.zeros_like(result.grid.occupied)
    result.grid, result.mesh, result.dimensions = replace(result.grid, occupied=nothing), None, None
    result.further = [found]

    judge(result)

    assert (result.verdict, result.quality.verdict) == ("object", "limited")
    assert result.quality.reasons[0].startswith("a candidate at (3.00, -4.00) m: its shadow is too thin")


def test_a_body_with_gaps_is_no_sediment():
    frame = simulate("tiny", "frame", seed=3, position_m=PLACE)
    search = search_image(frame.image, frame.track, Spectrum.of_image(frame.image))
    assert search.best.stands
    assert search.left_out == ()


def test_a_strong_candidate_makes_no_object_undecided_and_a_weak_one_does_not():
    weak, strong = LeftOut((1.0, 2.0), "sediment"), LeftOut((3.0, -4.0), "too low to tell", strong=True)
    result = Result(left_out=[weak])
    judge(result)
    assert (result.verdict, result.quality.verdict) == ("no object", "good")
    result = Result(left_out=[weak, strong])
    judge(result)
    assert (result.verdict, result.quality.verdict) == ("undecided", "not trustworthy")
    assert result.quality.reasons == ("a candidate at (3.00, -4.00) m: too low to tell",)


def test_a_given_volume_that_holds_nothing_is_no_object():
    target = decide(None, TargetParameters(target="given", size_m=(1.0, 1.0, 0.5))).target
    result = Result(target=target, views_used=10)
    judge(result)
    assert result.verdict == "no object"
    result = Result(target=Target((0.5, 0.0), (1.0, 1.0, 0.5), evidence=0.1), views_used=10)
    judge(result)
    assert result.verdict == "undecided"


@pytest.mark.parametrize("contrast_db", [4.0, 6.0])
def test_a_faint_body_under_a_wrong_sign_is_no_empty_seabed(contrast_db):
    """What is faint proves no sign wrong. If it is found there alone, "no object" is not good."""
    faults = Faults(contrast_db=contrast_db)
    made = simulate("tiny", box(0.3, 0.2, 0.2), seed=3, position_m=(0.1, -0.15), faults=faults)
    wrong = replace(made.image.acoustics, spectrum_sign=-made.image.acoustics.spectrum_sign)

    result = run(replace(made.image, acoustics=wrong), made.track, COARSE)

    assert (result.verdict, result.quality.verdict) == ("no object", "limited")
    (reason,) = result.quality.reasons
    assert reason.startswith("nothing tells the spectrum_sign: under the other")


@pytest.mark.parametrize("kind", ["empty", "box"])
def test_of_less_than_half_a_circle_nothing_tells_the_sign_and_the_rest_is_told(kind):
    # From aspect 0 on; the views from the other side are missing.
    made = simulate("tiny", kind, seed=2, faults=Faults(missing_arcs_deg=((150.0, 360.0),)))
    result = run(made.image, made.track, COARSE)
    assert result.sign.verdict == "unknown"
    assert result.verdict == ("no object" if kind == "empty" else "object")
    if kind == "box":
        assert any("of the circle" in reason for reason in result.quality.reasons)


def test_views_that_cannot_be_searched_are_an_error_that_names_why():
    made = simulate("tiny", "empty", seed=2)
    dark = replace(made.image, pixels=np.zeros_like(made.image.pixels))
    with pytest.raises(NoTargetError, match=r"none of \d+ views can be searched: the seabed level"):
        search_image(dark, made.track, Spectrum.of_image(dark))


def evidence_of_the_other_sign(monkeypatch, length_cells, front, *, is_faint=False, left=0.5):
    """Return what is told of the sign where the other one alone shows a body, and what was searched."""
    made = simulate("tiny", "empty", seed=2)
    searches = []

    def search(looks, camera, extent_m, *, twice=True, rises=False):
        searches.append(looks)
        nothing = Search((), None, None, is_faint=is_faint)
        if len(searches) == 1:
            return nothing
        assert rises, "the other way round they are hollows"
        thrown = Thrown(length_cells * cell_m(looks), 0.2, 0.16, front, Shading(left, 0.9))
        return replace(nothing, targets=(Target(PLACE, (0.4, 0.4, 0.2), 1e-4),), thrown=(thrown,))

    monkeypatch.setattr(bodies, "_search", search)
    evidence, stated = spectrum_sign_evidence(made.image, made.track)
    return evidence, stated, searches


@pytest.mark.parametrize(
    ("length_cells", "front", "left", "verdict"),
    [
        (3.0, 1.0, 0.5, "wrong"),
        (3.0, np.nan, 0.5, "wrong"),
        (1.2, 1.0, 0.5, "unknown"),
        (3.0, 0.4, 0.5, "unknown"),
        (3.0, 1.0, 0.05, "unknown"),
    ],
    ids=["a body", "a body at the edge", "a patch in shifted views", "a patch with soft edges", "a slope"],
)
def test_only_a_shadow_that_is_one_sided_and_long_tells_a_wrong_sign(
    monkeypatch, length_cells, front, left, verdict
):
    evidence, stated, searches = evidence_of_the_other_sign(monkeypatch, length_cells, front, left=left)
    assert len(searches) == 2
    assert evidence.verdict == verdict
    # What does not tell it is a candidate.
    assert any("falls towards the sonar" in left.reason for left in stated.left_out) == (verdict != "wrong")


@pytest.mark.parametrize(("front", "found"), [(1.3, True), (0.8, True), (np.nan, True), (0.35, False)])
def test_what_is_as_dark_before_it_as_behind_it_is_sediment_or_stands_on_it(front, found):
    made = simulate("tiny", "empty", seed=2)
    looks = search_image(made.image, made.track, Spectrum.of_image(made.image)).looks
    thrown = Thrown(3.0 * cell_m(looks), 0.25, 0.2, front, OF_A_BODY)
    body = SimpleNamespace(
        target=lambda: Target(PLACE, (0.4, 0.4, 0.2), 1e-3),
        thrown=lambda looks: thrown,
        voxels=(np.arange(2), np.arange(2), np.arange(2)),
    )
    judged = Judged()
    judged.add(body, looks)
    assert judged.stands == found
    # Over the local seabed it is looked for again.
    assert bool(judged.plans) == found
    assert [left.strong for left in judged.left_out] == [True] * (not found)
    assert all("sediment, or a body on it" in left.reason for left in judged.left_out)


@pytest.mark.parametrize(
    ("left", "outward", "cells", "power", "core", "came_to"),
    [
        (0.5, 0.9, 3.0, 0.3, 0.3, "found"),
        (0.5, 0.3, 3.0, 0.3, 0.3, "hanging"),  # where other bodies' shadows cross
        (0.5, 0.9, 3.0, 0.45, 0.3, "found"),
        (0.5, 0.3, 3.0, 0.45, 0.3, "sediment, or a body"),
        (0.05, 0.9, 3.0, 0.45, 0.3, "sediment, or a body"),
        (0.0, 0.9, 3.0, 0.3, 0.3, "the seabed rises, or a low body"),
        (0.0, 0.9, 1.6, 0.3, 0.3, "found"),  # a low body's edge, blurred, is as a slope
        (0.0, 0.9, 3.0, 0.3, 0.12, "found"),  # as dark as a shadow
        (0.0, 0.5, 3.0, 0.3, 0.3, "hanging"),
        (0.0, -0.6, 3.0, 0.3, 0.3, "a hollow in dark seabed"),
    ],
)
def test_a_faint_body_is_judged_by_its_sides(left, outward, cells, power, core, came_to):
    """One that seems to hang, beside a body that stands."""
    made = simulate("tiny", "empty", seed=2)
    looks = search_image(made.image, made.track, Spectrum.of_image(made.image)).looks
    thrown = Thrown(cells * cell_m(looks), power, core, 1.2, Shading(left, outward))
    body = SimpleNamespace(
        target=lambda: Target(PLACE, (0.4, 0.4, 0.2), 1e-3, stands=False),
        thrown=lambda looks: thrown,
        voxels=(np.arange(2), np.arange(2), np.arange(2)),
    )
    judged = Judged()
    judged.add(body, looks, faint=True)
    assert [target.stands for target, _, _ in judged.found] == [True] * (came_to == "found")
    assert len(judged.hanging) == (came_to == "hanging")
    assert [came_to in left_out.reason for left_out in judged.left_out] == [True] * (len(came_to) > 7)
    # The other way round a rise is a hollow, which the sign's evidence has to hear of.
    turned = Judged(rises=True)
    turned.add(body, looks, faint=True)
    assert not any("rises" in left_out.reason for left_out in turned.left_out)


@pytest.mark.parametrize(("length_cells", "front"), [(3.0, 1.0), (1.2, 1.0), (3.0, 0.4)])
def test_what_is_faint_raises_a_doubt_of_the_sign_even_where_it_would_prove_nothing(
    monkeypatch, length_cells, front
):
    evidence, stated, _ = evidence_of_the_other_sign(monkeypatch, length_cells, front, is_faint=True)
    assert evidence.verdict == "unknown"
    assert ["a faint body throws a shadow here" in left.reason for left in stated.left_out] == [True]
