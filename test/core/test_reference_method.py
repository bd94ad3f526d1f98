"""Section 4 of the paper, literally: the fast likelihood, segmentation and carving are the loops' results."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest
from core_data import hidden_by_box, hidden_by_cylinder, make_info, make_view, perfect_views

from csas_shadow_ros.core import reference
from csas_shadow_ros.core.geometry import View
from csas_shadow_ros.core.imaging import likelihood, segmentation
from csas_shadow_ros.core.parameters import CarvingParameters, LikelihoodParameters
from csas_shadow_ros.core.shape.carving import Carver, carve
from csas_shadow_ros.core.shape.volume import Volume

#: Carving accumulates in such steps: a value is off by half of one, and a little for single precision.
STEP = 1 / 4096
OFF = 0.51 * STEP
#: One σ_r a view, as in the paper.
ONE_LEVEL = LikelihoodParameters(background="global")
#: The paper's reading of l_out: an echo is bright and so outside.
PRINTED = replace(ONE_LEVEL, echo_unknown=False)
#: 10 x 12 x 14 voxels of 5 cm.
VOLUME = Volume.around((0.1, -0.05), (0.7, 0.6, 0.5), 0.05)
#: A low sonar near by, a high one far off, and a volume that is not in the middle of the views.
SONARS = [(20.0, 6.0), (25.0, 12.0), (30.0, 9.0), (40.0, 20.0), (30.0, 12.0), (22.0, 15.0)]
DRUM = partial(hidden_by_cylinder, centre=(0.1, -0.05), radius_m=0.22, height_m=0.3)
BOX = partial(hidden_by_box, low=(-0.1, -0.2, 0.0), high=(0.25, 0.1, 0.25))


@lru_cache(maxsize=4)
def geometry(size):
    infos = []
    for n, (range_m, height_m) in enumerate(SONARS):
        aspect = 0.2 + n * math.pi / 3
        sonar = (range_m * math.cos(aspect), range_m * math.sin(aspect), height_m)
        infos.append(make_info(aspect, size=size, sonar_m=sonar, centre=(0.05, 0.02)))
    return tuple(infos)


def blotches(rng, values, size):
    """Draw patches of 12 pixels of some values: some blocks of voxels see one value only, some do not."""
    small = rng.choice(values, (-(-size // 12),) * 2)
    return small.repeat(12, axis=0).repeat(12, axis=1)[:size, :size]


def random_likelihoods(size):
    rng = np.random.default_rng(5)
    pixels = rng.random((len(SONARS), size, size), np.float32)
    pixels[rng.random(pixels.shape) < 0.03] = np.nan
    return [View(info, p) for info, p in zip(geometry(size), pixels, strict=True)]


def random_masks(size, seed=6):
    rng = np.random.default_rng(seed)
    values = np.array([0, 64, 128, 255, 255, 255], np.uint8)
    return [View(info, blotches(rng, values, size)) for info in geometry(size)]


def carved(views, method):
    carver = Carver(VOLUME, CarvingParameters(method=method, min_views_fraction=0.0))
    for view in views:
        carver.integrate(view)
    return carver


def mean_of_seen(values):
    """Return the mean over the last axis of what is no NaN; NaN if all is."""
    seen = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(seen, values, 0.0).sum(axis=-1) / seen.sum(axis=-1)


def scene(seed, *, size=120, level=3.0, to_the_edge=False):
    """Return a view of a target's echo, its lit top and its shadow; another shadow, and unknown seabed.

    The target is at pixel (60, 50) = (column, row).
    """
    rng = np.random.default_rng(seed)
    relative = np.ones((size, size))
    relative[40:42, 52:68] = 6.0
    relative[40:42, 56:62] = 1.0  # an edge that glitters has gaps
    relative[50 : size if to_the_edge else 85, 52:68] = 0.12
    relative[70:84, 72:80] = 0.12  # beside it and behind, as a thin part's
    relative[50:56, 41:46] = 0.05  # as small as speckle
    relative[100:115, 5:30] = 0.12
    amplitude = (level * relative * rng.rayleigh(1.0, (size, size))).astype(np.float32)
    v, u = np.mgrid[:size, :size]
    amplitude[v + u < 30] = np.nan
    amplitude[60:62, 60] = np.nan
    view = make_view(amplitude, aspect_rad=0.3 + seed)
    x, y, _ = view.info.camera.pixel_to_ground @ np.array([60.0, 50.0, 1.0])
    return view, (float(x), float(y))


def levels_of(view):
    levels = likelihood.view_levels(view, ONE_LEVEL)
    return levels, levels.seabed_level, levels.seabed_level / levels.contrast


@lru_cache(maxsize=2)
def speckled_views():
    """Return six views of a box on a seabed of Rayleigh speckle, its shadow 16 dB under it."""
    rng = np.random.default_rng(9)
    views = []
    for mask in perfect_views(BOX, geometry(96), "mask"):
        relative = np.where(mask.pixels == 255, 0.16, 1.0)
        views.append(View(mask.info, (relative * rng.rayleigh(2.0, relative.shape)).astype(np.float32)))
    return tuple(views)


@pytest.mark.parametrize("contrast_db", [3.0, 6.0, 12.0, 20.0])
def test_the_fast_l_out_is_the_printed_formula_pixel_by_pixel(contrast_db):
    sigma_r, contrast = 0.7, 10 ** (contrast_db / 20)
    rng = np.random.default_rng(1)
    amplitude = rng.rayleigh(sigma_r, (40, 50)).astype(np.float32)
    amplitude[20:] /= contrast
    printed = reference.l_out(amplitude, sigma_r, sigma_r / contrast)
    power = (0.5 * (amplitude / np.float32(sigma_r)) ** 2).astype(np.float32)
    np.testing.assert_allclose(likelihood.l_out(power, contrast), printed, rtol=0, atol=1e-6)


def test_where_the_printed_formula_is_0_over_0_the_fast_l_out_is_its_limit():
    amplitude = np.array([[0.0, 1e-6, 38.0, 50.0, np.nan]])
    printed = reference.l_out(amplitude, 1.0, 0.25)
    np.testing.assert_array_equal(np.isnan(printed), [[True, False, False, True, True]])
    fast = likelihood.l_out((0.5 * amplitude[:, :4] ** 2).astype(np.float32), 4.0)
    np.testing.assert_allclose(fast, printed[:, [1, 1, 2, 2]], rtol=1e-5)


def test_a_view_becomes_the_printed_formula_of_its_amplitudes():
    for view in speckled_views():
        _, sigma_r, sigma_s = levels_of(view)
        printed = reference.l_out(view.pixels, sigma_r, sigma_s)
        fast = likelihood.outside_likelihood(view, PRINTED).pixels
        np.testing.assert_allclose(fast, printed, rtol=0, atol=2e-6)


@pytest.mark.parametrize("to_the_edge", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_the_dark_pixels_are_those_of_the_loop(seed, to_the_edge):
    view, _ = scene(seed, to_the_edge=to_the_edge)
    levels, sigma_r, sigma_s = levels_of(view)
    dark = reference.dark_pixels(view, sigma_r, sigma_s)
    assert dark[55:80, 55:59].all()
    np.testing.assert_array_equal(segmentation.dark_pixels(levels), dark)


@pytest.mark.parametrize("to_the_edge", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_the_segmented_shadow_is_the_loop_s_pixel_by_pixel(seed, to_the_edge):
    view, target = scene(seed, to_the_edge=to_the_edge)
    levels, sigma_r, sigma_s = levels_of(view)
    reach = 16 * view.info.camera.spacing_m[0]
    literal = reference.silhouette(view, sigma_r, sigma_s, target, reach)
    # It is the target's, not the other one; its echo is unknown and its lit top covered, beside the gap too.
    assert (literal[55:80, 55:59] == reference.SHADOW).all()
    assert not (literal[95:, :35] == reference.SHADOW).any()
    assert (literal[73:82, 75:77] == reference.SHADOW).all()
    assert not (literal[48:60, 38:49] == reference.SHADOW).any()
    assert reference.dark_pixels(view, sigma_r, sigma_s)[48:60, 38:49].any()
    assert (literal[40:42, 62:68] == reference.UNKNOWN).all()
    assert (literal[45:48, 54:66] == reference.COVERED).all()
    np.testing.assert_array_equal(
        segmentation.segment_shadow(view, target, ONE_LEVEL, levels, reach_m=reach).pixels, literal
    )


def test_a_shadow_point_by_the_ray_is_where_the_projection_matrix_puts_it():
    rng = np.random.default_rng(2)
    for info in geometry(96):
        for point in rng.uniform((-1, -1, 0), (1, 1, 2), (20, 3)):
            ground = reference.shadow_point(tuple(point), tuple(info.camera.sonar_m))
            # The ray: sonar, point and shadow lie on a line.
            ray = np.array([*ground, 0.0]) - info.camera.sonar_m
            assert np.linalg.norm(np.cross(ray, point - info.camera.sonar_m)) < 1e-9
            pixel = reference.ground_pixel(ground, info.camera)
            np.testing.assert_allclose(info.camera.project(point), pixel, atol=1e-8)


# Views of 0.8 m do not see the shadows of high voxels.
@pytest.mark.parametrize("size", [40, 240])
def test_soft_carving_is_the_loop_s_mean_within_a_step(size):
    views = random_likelihoods(size)
    literal = reference.soft_carving(views, VOLUME)
    assert np.isnan(literal).any() == (size == 40)
    np.testing.assert_allclose(carved(views, "soft").likelihood(), literal, rtol=0, atol=OFF)


@pytest.mark.parametrize("size", [40, 240])
@pytest.mark.parametrize("method", ["hard", "consensus"])
def test_what_silhouettes_add_up_to_is_the_loop_s_within_a_step(method, size):
    masks = random_masks(size)
    values = reference.values_at_shadows([reference.outside_silhouette(m) for m in masks], VOLUME)
    carver = carved(masks, method)
    np.testing.assert_allclose(carver.likelihood(), mean_of_seen(values), rtol=0, atol=OFF)
    np.testing.assert_array_equal(carver.first_look().views, np.isfinite(values).sum(axis=-1))


@pytest.mark.parametrize("seed", range(3))
def test_hard_carving_removes_what_the_loop_removes(seed):
    masks = random_masks(96, seed)
    left = reference.hard_carving(masks, VOLUME)
    # A contradiction of less than half a step is none to the fast path; these views hold no such.
    values = reference.values_at_shadows([reference.outside_silhouette(m) for m in masks], VOLUME)
    assert not ((values > 0) & (values < STEP)).any()
    assert 0 < np.count_nonzero(left) < left.size
    np.testing.assert_array_equal(carved(masks, "hard").likelihood() > 0, ~left)


@pytest.mark.parametrize("body", [DRUM, BOX], ids=["drum", "box"])
def test_the_hard_carved_object_of_exact_silhouettes_is_what_the_loop_leaves(body):
    masks = list(perfect_views(body, geometry(240), "mask"))
    left = reference.hard_carving(masks, VOLUME)
    assert np.count_nonzero(left) > 27
    np.testing.assert_array_equal(carve(masks, VOLUME, CarvingParameters(method="hard")).occupied, left)


def test_from_amplitudes_to_silhouettes_to_voxels_section_4_1_is_the_loop_s():
    fast, literal = [], []
    for view in speckled_views():
        levels, sigma_r, sigma_s = levels_of(view)
        pixels = reference.silhouette(view, sigma_r, sigma_s, (0.1, -0.05), 0.3)
        literal.append(View(view.info, pixels))
        fast.append(segmentation.segment_shadow(view, (0.1, -0.05), ONE_LEVEL, levels, reach_m=0.3))
    left = reference.hard_carving(literal, VOLUME)
    assert np.count_nonzero(left) > 27
    removed = carved(fast, "hard").likelihood() > 0
    np.testing.assert_array_equal(removed, ~left)


def test_from_amplitudes_to_likelihoods_to_voxels_section_4_2_is_the_loop_s():
    fast, literal = [], []
    for view in speckled_views():
        levels, sigma_r, sigma_s = levels_of(view)
        literal.append(View(view.info, reference.l_out(view.pixels, sigma_r, sigma_s)))
        fast.append(likelihood.outside_likelihood(view, PRINTED, levels))
    mean = reference.soft_carving(literal, VOLUME)
    # Dark inside the box, bright beside it.
    assert mean[2, 5, 7] < 0.2 < 0.6 < mean[2, 0, 0]
    np.testing.assert_allclose(carved(fast, "soft").likelihood(), mean, rtol=0, atol=OFF)
