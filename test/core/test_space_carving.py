"""Carving: what order, repetition and missing views may not change, and exact shadows of exact bodies."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
import scipy.ndimage
from core_data import HEIGHT_M, hidden_by_box, hidden_by_cylinder, hull_of, iou, make_info, perfect_views

from csas_shadow_ros.core.errors import GeometryError, ParameterError, ViewError
from csas_shadow_ros.core.geometry import View
from csas_shadow_ros.core.imaging.masks import KeptMask
from csas_shadow_ros.core.parameters import CarvingParameters
from csas_shadow_ros.core.shape.carving import Carver, carve
from csas_shadow_ros.core.shape.threshold import object_threshold, occupied_voxels, supported
from csas_shadow_ros.core.shape.volume import Volume

KINDS = [("soft", "likelihood"), ("consensus", "mask"), ("hard", "mask")]
SOFT = CarvingParameters(method="soft")
INFOS = tuple(make_info(math.radians(a), size=256, spacing_m=0.012) for a in range(0, 360, 5))
DRUM = partial(hidden_by_cylinder, centre=(0.1, -0.05), radius_m=0.3, height_m=0.3)
BOX = partial(hidden_by_box, low=(-0.25, -0.12, 0.0), high=(0.15, 0.18, 0.25))
VOLUME = Volume.around((0.0, 0.0), (1.0, 1.0, 0.5), 0.025)
SMALL = Volume.around((0.0, 0.0), (0.5, 0.4, 0.2), 0.05)


def l_shaped(x, y, sonar):
    """An L in plan: long limb along +x, short one along +y from its -x end."""
    return hidden_by_box(x, y, sonar, (-0.4, -0.25, 0), (0.4, -0.05, 0.2)) | hidden_by_box(
        x, y, sonar, (-0.4, -0.25, 0), (-0.2, 0.3, 0.2)
    )


def gate(x, y, sonar):
    """Two posts and a lintel; the ground between the posts is seen from the sides."""
    return hidden_by_box(x, y, sonar, (-0.4, -0.1, 0), (-0.25, 0.1, 0.4)) | hidden_by_box(
        x, y, sonar, (0.25, -0.1, 0), (0.4, 0.1, 0.4)
    )


def random_views(n=12, seed=0, kind="likelihood"):
    rng = np.random.default_rng(seed)
    views = []
    for i in range(n):
        info = make_info(2 * math.pi * i / n, size=96)
        if kind == "mask":
            pixels = rng.choice(np.array([0, 128, 255], np.uint8), (96, 96))
        else:
            pixels = rng.random((96, 96), np.float32)
            pixels[rng.random((96, 96)) < 0.05] = np.nan
        views.append(View(info, pixels))
    return views


def carver(method="soft", volume=SMALL, **kwargs):
    return Carver(volume, CarvingParameters(method=method, **kwargs))


def same(a, b):
    return (
        np.array_equal(a.likelihood, b.likelihood, equal_nan=True)
        and np.array_equal(a.views, b.views)
        and np.array_equal(a.occupied, b.occupied)
        and np.array_equal(a.threshold, b.threshold, equal_nan=True)
    )


@pytest.mark.parametrize(("method", "kind"), KINDS)
def test_the_order_of_views_changes_not_one_bit(method, kind):
    views = random_views(kind=kind)
    grids = []
    for order in (range(12), reversed(range(12)), np.random.default_rng(1).permutation(12)):
        c = carver(method)
        for i in order:
            c.integrate(views[i])
        grids.append(c.grid())
    assert same(grids[0], grids[1])
    assert same(grids[0], grids[2])


@pytest.mark.parametrize(("method", "kind"), KINDS)
def test_a_view_counts_once_however_often_it_is_sent(method, kind):
    views = random_views(kind=kind)
    once, twice = carver(method), carver(method)
    for view in views:
        assert once.integrate(view) is True
        assert twice.integrate(view) is True
        assert twice.integrate(view) is False
    other_pixels = View(views[0].info, views[1].pixels)
    assert twice.integrate(other_pixels) is False
    assert same(once.grid(), twice.grid())
    assert once.stamps == twice.stamps == {v.info.stamp_ns for v in views}


@pytest.mark.parametrize(("method", "kind"), KINDS)
def test_one_by_one_all_at_once_and_in_threads_give_the_same_grid(method, kind):
    views = random_views(kind=kind)
    single = carver(method)
    for view in views:
        single.integrate(view)
        single.grid()  # asking for the grid meanwhile changes nothing
    with ThreadPoolExecutor(2) as pool:
        threaded = Carver(SMALL, CarvingParameters(method=method), pool=pool)
        for view in views:
            threaded.integrate(view)
        assert same(single.grid(), threaded.grid())
    assert same(single.grid(), carve(views, SMALL, CarvingParameters(method=method)))


def test_the_soft_likelihood_is_the_mean_over_the_views_that_see_the_voxel():
    views = random_views()
    grid = carve(views, SMALL, SOFT)
    z, y, x = np.meshgrid(SMALL.z_m, SMALL.y_m, SMALL.x_m, indexing="ij")
    points = np.stack([x, y, z], axis=-1)
    values = []
    for view in views:
        uv = view.info.camera.project(points)
        iu, iv = np.floor(uv[..., 0]).astype(int), np.floor(uv[..., 1]).astype(int)
        fu, fv = uv[..., 0] - iu, uv[..., 1] - iv
        p = view.pixels
        top = (1 - fu) * p[iv, iu] + fu * p[iv, iu + 1]
        low = (1 - fu) * p[iv + 1, iu] + fu * p[iv + 1, iu + 1]
        values.append((1 - fv) * top + fv * low)
    seen = np.isfinite(values)
    assert np.array_equal(grid.views, seen.sum(axis=0))
    expected = np.nansum(values, axis=0) / seen.sum(axis=0)
    assert grid.likelihood == pytest.approx(expected, abs=3e-4)


@pytest.mark.parametrize("hidden", [DRUM, BOX], ids=["drum", "box"])
@pytest.mark.parametrize(("method", "kind"), KINDS)
def test_perfect_shadows_carve_the_hull_within_one_voxel(method, kind, hidden):
    # Any view that contradicts removes: the hull is what no view contradicts.
    p = CarvingParameters(method=method, threshold=0.5 / len(INFOS))
    grid = carve(perfect_views(hidden, INFOS, kind), VOLUME, p)
    hull = hull_of(hidden, INFOS, VOLUME)
    assert hull.sum() > 500
    ball = np.ones((3, 3, 3), bool)
    assert not (scipy.ndimage.binary_erosion(hull, ball, border_value=1) & ~grid.occupied).any()
    assert not (grid.occupied & ~scipy.ndimage.binary_dilation(hull, ball)).any()


@pytest.mark.parametrize("hidden", [DRUM, BOX], ids=["drum", "box"])
@pytest.mark.parametrize(("method", "kind"), KINDS)
def test_the_automatic_threshold_finds_the_hull_of_perfect_shadows(method, kind, hidden):
    grid = carve(perfect_views(hidden, INFOS, kind), VOLUME, CarvingParameters(method=method))
    hull = hull_of(hidden, INFOS, VOLUME)
    assert iou(grid.occupied, hull) > 0.75


@pytest.mark.parametrize(("method", "kind"), KINDS)
def test_an_l_comes_out_as_an_l_not_as_its_mirror_image(method, kind):
    p = CarvingParameters(method=method, threshold=0.5 / len(INFOS))
    grid = carve(perfect_views(l_shaped, INFOS, kind), VOLUME, p)

    def at(x, y, z=0.05):
        d = VOLUME.voxel_size_m
        i, j, k = (round((c - o) / d) for c, o in zip((x, y, z), VOLUME.origin_m, strict=True))
        return bool(grid.occupied[k, j, i])

    assert at(0.3, -0.15)
    assert at(-0.3, 0.2)
    assert at(-0.3, -0.15)
    assert not at(0.3, 0.2)
    assert not at(0.15, 0.15)
    assert not at(0.3, 0.1)


@pytest.mark.parametrize(("method", "kind"), KINDS)
def test_the_space_between_two_posts_stays_empty(method, kind):
    p = CarvingParameters(method=method, threshold=0.5 / len(INFOS))
    grid = carve(perfect_views(gate, INFOS, kind), VOLUME, p)
    middle = np.abs(VOLUME.x_m) < 0.1
    assert not grid.occupied[:, :, middle].any()
    assert grid.occupied[:, :, VOLUME.x_m < -0.25].any()
    assert grid.occupied[:, :, VOLUME.x_m > 0.25].any()


@pytest.mark.parametrize(("method", "kind"), KINDS)
def test_a_shadow_that_leaves_the_image_leaves_unknown_voxels_and_no_roof(method, kind):
    # Views of 1.3 m: shadows of anything over (0.65 - 0.3) · 12/30 m leave them.
    infos = tuple(make_info(math.radians(a), size=108, spacing_m=0.012) for a in range(0, 360, 5))
    volume = Volume.around((0.0, 0.0), (0.9, 0.9, 1.2), 0.03)
    drum = partial(hidden_by_cylinder, centre=(0.0, 0.0), radius_m=0.2, height_m=0.6)
    grid = carve(perfect_views(drum, infos, kind), volume, CarvingParameters(method=method))
    top = volume.z_m > 0.8
    assert np.isnan(grid.likelihood[top]).all()
    assert not grid.occupied[top].any()
    assert grid.occupied[volume.z_m < 0.2].any()
    # What only the views along a line know is not bounded along it: the drum grew to 0.51 m under its roof.
    plan = grid.occupied.any(axis=0)
    for axis, coordinates in enumerate((volume.x_m, volume.y_m)):
        assert np.ptp(coordinates[plan.any(axis=axis)]) <= 2.0 * 0.2 + volume.voxel_size_m


def test_voxels_seen_by_too_few_views_are_unknown_and_no_object():
    views = perfect_views(DRUM, INFOS, "likelihood")
    hidden = []
    for i, view in enumerate(views):
        pixels = view.pixels.copy()
        if i >= 10:  # only 10 of 72 views know anything
            pixels[:] = np.nan
        hidden.append(View(view.info, pixels))
    grid = carve(hidden, VOLUME, CarvingParameters(method="soft", min_views_fraction=0.25))
    assert grid.views.max() == 10
    assert np.isnan(grid.likelihood).all()
    assert math.isnan(grid.threshold)
    assert not grid.occupied.any()
    some = carve(hidden, VOLUME, CarvingParameters(method="soft", min_views_fraction=0.1))
    assert np.isfinite(some.likelihood).any()


@pytest.mark.parametrize(("method", "kind"), KINDS)
def test_no_view_and_no_shadow_mean_no_object(method, kind):
    empty = carver(method).grid()
    assert math.isnan(empty.threshold)
    assert np.isnan(empty.likelihood).all()
    assert not empty.occupied.any()
    lit = carve(
        perfect_views(lambda x, y, s: np.zeros(x.shape, bool), INFOS, kind),
        VOLUME,
        CarvingParameters(method=method),
    )
    assert math.isnan(lit.threshold)
    assert not lit.occupied.any()


def test_speckle_without_a_body_is_no_object():
    rng = np.random.default_rng(5)
    views = [View(i, (rng.random((256, 256)) ** 0.5).astype(np.float32)) for i in INFOS]
    grid = carve(views, VOLUME, SOFT)
    assert math.isnan(grid.threshold)
    assert not grid.occupied.any()


def one_contradiction(method, threshold=0.0):
    views = list(perfect_views(DRUM, INFOS, "mask"))
    pixels = views[7].pixels.copy()
    u, _ = views[7].info.camera.project((0.1, -0.05, 0.15))
    pixels[:, : round(u)] = 0  # one view sees half of the shadow only
    views[7] = View(views[7].info, pixels)
    grid = carve(views, VOLUME, CarvingParameters(method=method, threshold=threshold))
    z, y, x = np.meshgrid(VOLUME.z_m, VOLUME.y_m, VOLUME.x_m, indexing="ij")
    uv = views[7].info.camera.project(np.stack([x, y, z], axis=-1))
    contradicted = uv[..., 0] < round(u) - 2
    assert np.count_nonzero(contradicted & hull_of(DRUM, INFOS, VOLUME)) > 500
    return grid, contradicted


def test_hard_carving_removes_what_one_view_contradicts():
    """Conventions: a voxel outside one view's segmented silhouette is removed."""
    grid, contradicted = one_contradiction("hard")
    assert not grid.occupied[contradicted].any()
    assert grid.occupied.any()


def test_consensus_carving_keeps_what_one_of_72_views_contradicts():
    grid, contradicted = one_contradiction("consensus")
    hull = hull_of(DRUM, INFOS, VOLUME)
    inner = scipy.ndimage.binary_erosion(hull, np.ones((3, 3, 3), bool), border_value=1)
    assert grid.occupied[inner & contradicted].all()


def test_hard_carving_removes_a_voxel_under_others_too_when_one_view_contradicts_it():
    """An overhang: two views see the seabed lit under a slab that they see as shadow."""
    likelihood = np.zeros((4, 5, 5), np.float32)
    likelihood[0:2, 2, 2] = 2 / 72
    assert occupied_voxels(likelihood, object_threshold_of_hard(), "hard")[2:].all()
    assert not occupied_voxels(likelihood, object_threshold_of_hard(), "hard")[0:2, 2, 2].any()


def object_threshold_of_hard():
    known = np.ones((20, 20, 20), np.float32)
    known[:5, :5, :5] = 0.0
    return object_threshold(known, "hard")


def test_unknown_pixels_of_a_mask_remove_nothing():
    views = perfect_views(DRUM, INFOS, "mask")
    half_known = [
        View(v.info, np.where(np.indices(v.pixels.shape)[1] % 40 < 12, 128, v.pixels).astype(np.uint8))
        for v in views
    ]
    p = CarvingParameters(method="hard")
    a, b = carve(views, VOLUME, p), carve(half_known, VOLUME, p)
    known = np.isfinite(b.likelihood)
    assert np.count_nonzero(b.views < a.views) > 1000
    removed = [np.where(known, g.likelihood, 0) * g.views for g in (a, b)]
    assert (removed[1] <= removed[0] + 1e-3).all()


def test_a_volume_that_reaches_the_sonar_is_refused():
    view = random_views(1)[0]
    tall = Volume.around((0.0, 0.0), (0.2, 0.2, HEIGHT_M + 0.5), 0.1)
    c = Carver(tall, SOFT)
    with pytest.raises(ViewError, match=r"the volume reaches 12\.\d+ m, the sonar is at 12 m"):
        c.integrate(view)
    assert c.stamps == set()


@pytest.mark.parametrize(
    ("method", "pixels", "match"),
    [
        ("soft", np.zeros((96, 96), np.uint8), "soft carving got uint8 pixels; expected float32"),
        ("soft", np.zeros((96, 96), np.float64), "soft carving got float64 pixels"),
        ("soft", np.full((96, 96), 1.5, np.float32), r"l_out of the view spans \[1, 1.5\]"),
        ("soft", np.full((96, 96), -0.1, np.float32), r"l_out of the view spans \[-0.1"),
        ("soft", np.full((96, 96), np.inf, np.float32), r"l_out of the view spans \[1, inf\]"),
        ("hard", np.zeros((96, 96), np.float32), "hard carving got float32 pixels; expected a uint8 mask"),
        (
            "consensus",
            np.zeros((96, 96), np.float32),
            "consensus carving got float32 pixels; expected a uint8",
        ),
        ("consensus", np.full((96, 96), 1, np.uint8), "mask holds the value 1; expected 0, 64, 128 or 255"),
        ("hard", np.full((96, 96), 7, np.uint8), r"mask .* 7; expected 0, 64, 128 or 255"),
    ],
)
def test_pixels_that_the_method_does_not_take_are_refused_and_leave_no_trace(method, pixels, match):
    c = carver(method)
    with pytest.raises(ViewError, match=match):
        c.integrate(View(make_info(0.0, size=96), pixels))
    assert c.stamps == set()
    assert c.grid().views.max() == 0


def test_there_is_nothing_to_carve_without_views():
    with pytest.raises(ParameterError, match="there are no views"):
        carve([], SMALL)


def patchy_masks(size, n=10):
    """Return masks of large patches, so that whole blocks of voxels see the same, cut by image edges."""
    rng = np.random.default_rng(5)
    values = np.array([0, 64, 128, 255, 255, 0], np.uint8)
    for i in range(n):
        info = make_info(0.2 + 2 * math.pi * i / n, size=size, spacing_m=0.012)
        coarse = rng.choice(values, (4, 4))
        yield View(info, np.kron(coarse, np.ones((size // 4, size // 4), np.uint8)))


@pytest.mark.parametrize("size", [240, 120])
def test_each_voxel_counts_what_a_bilinear_look_at_its_own_pixel_says(size):
    volume = Volume.around((0.05, -0.1), (1.3, 0.9, 0.4), 0.02)
    views = list(patchy_masks(size))
    c = carver("hard", volume, min_views_fraction=0.0, threshold=0.5)
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    total, count = np.zeros(volume.shape), np.zeros(volume.shape, int)
    for view in views:
        c.integrate(view)
        outside = np.where(view.pixels == 255, 0.0, 1.0)
        outside[(view.pixels == 128) | (view.pixels == 64)] = np.nan
        uv = view.info.camera.project(np.stack([x, y, z], axis=-1))
        u, v = uv[..., 0], uv[..., 1]
        inside = (u >= 0) & (v >= 0) & (u <= size - 1) & (v <= size - 1)
        i, j = (np.clip(np.floor(w), 0, size - 2).astype(int) for w in (v, u))
        f, g = v - i, u - j
        value = (outside[i, j] * (1 - g) + outside[i, j + 1] * g) * (1 - f)
        value += (outside[i + 1, j] * (1 - g) + outside[i + 1, j + 1] * g) * f
        known = inside & np.isfinite(value)
        total[known] += value[known]
        count += known
    grid = c.grid()
    assert len(np.unique(count)) > 3
    # Voxels that fall on a line between pixels within rounding may go either way.
    assert (grid.views != count).mean() < 1e-4
    known = (count > 0) & (grid.views == count)
    assert np.abs(grid.likelihood - total / np.maximum(count, 1))[known].max() < 1e-3
    assert np.isnan(grid.likelihood[grid.views == 0]).all()


@pytest.mark.parametrize("part", [slice(20, 40), slice(0, 96), slice(95, 96), slice(0, 0)])
def test_a_changed_mask_leaves_the_grid_that_it_alone_would_leave(part):
    rng = np.random.default_rng(3)
    before = [View(one.info, one.pixels.copy()) for one in patchy_masks(96)]
    changed = Carver(VOLUME)
    for view in before:
        view.pixels[rng.random((96, 96)) < 0.1] = 64  # covered
        changed.integrate(view)
    after = {}
    for view in before[::2]:
        pixels = view.pixels.copy()
        pixels[part, 10:60] = rng.choice(np.array([0, 64, 128, 255], np.uint8), pixels[part, 10:60].shape)
        after[view.info.stamp_ns] = View(view.info, pixels)
    again = changed._again(
        lambda kept: KeptMask.of(after[kept.info.stamp_ns]) if kept.info.stamp_ns in after else kept
    )
    fresh = Carver(VOLUME)
    for view in before:
        fresh.integrate(after.get(view.info.stamp_ns, view))
    assert (part.stop > part.start) != np.array_equal(again._sums.total, changed._sums.total)
    assert np.array_equal(again._sums.total, fresh._sums.total)
    assert np.array_equal(again._sums.count, fresh._sums.count)
    assert again.stamps == fresh.stamps


@pytest.mark.parametrize("shift", [0, 3])
def test_a_zone_of_echo_leaves_what_a_mask_without_it_leaves(shift):
    rng = np.random.default_rng(4)
    box = (slice(shift, 15), slice(shift, 30), slice(2, 30))
    part = Volume(
        tuple(VOLUME.origin_m[a] + box[2 - a].start * VOLUME.voxel_size_m for a in range(3)),
        VOLUME.voxel_size_m,
        tuple(s.stop - s.start for s in box),
    )
    whole, fresh = Carver(VOLUME), Carver(part)
    views = [View(one.info, one.pixels.copy()) for one in patchy_masks(96)]
    for view in views:
        view.pixels[rng.random((96, 96)) < 0.3] = 64
        whole.integrate(view)
    sums = whole._sums.part(box, part)
    for view in views:
        zone = rng.random((96, 96)) < 0.5
        sums.change_mask(view.pixels, view.pixels, view.info, zone)
        alone = np.where((view.pixels == 64) & ~zone, np.uint8(0), view.pixels)
        fresh.integrate(View(view.info, alone))
    assert np.array_equal(sums.total, fresh._sums.total)
    assert np.array_equal(sums.count, fresh._sums.count)


def test_a_grid_is_a_picture_of_the_moment():
    views = random_views()
    c = carver()
    c.integrate(views[0])
    before = c.grid()
    copy = before.likelihood.copy(), before.views.copy()
    c.integrate(views[1])
    assert np.array_equal(before.likelihood, copy[0], equal_nan=True)
    assert np.array_equal(before.views, copy[1])


def test_the_threshold_asked_for_is_the_threshold_used():
    grid = carve(
        perfect_views(DRUM, INFOS, "likelihood"), VOLUME, CarvingParameters(method="soft", threshold=0.2)
    )
    assert grid.threshold == 0.2
    dark = grid.likelihood < 0.2
    assert (grid.occupied & ~dark).sum() < 0.02 * dark.sum()


def test_no_voxel_much_darker_than_the_rest_is_no_object():
    rng = np.random.default_rng(0)
    noise = (0.8 + 0.05 * rng.standard_normal((20, 30, 30))).astype(np.float32)
    assert math.isnan(object_threshold(noise, "soft"))
    assert math.isnan(object_threshold(np.full((5, 5, 5), np.nan, np.float32), "soft"))
    noise[2:8, 10:15, 10:15] = 0.05
    threshold = object_threshold(noise, "soft")
    assert 0.05 < threshold < 0.5
    assert np.array_equal(occupied_voxels(noise, threshold, "soft"), noise == np.float32(0.05))


def test_support_fills_down_to_the_seabed_but_not_where_the_seabed_is_seen_lit():
    likelihood = np.full((6, 4, 4), np.nan, np.float32)
    likelihood[4, 1, 1] = likelihood[4, 2, 2] = 0.05
    likelihood[:4, 2, 2] = 0.9  # seen lit under an overhang
    out = supported(likelihood < 0.1, likelihood, 0.3)
    assert out[:5, 1, 1].all()
    assert out[4, 2, 2]
    assert not out[:4, 2, 2].any()
    assert out.sum() == 6


def test_stray_voxels_are_no_part_of_the_object():
    likelihood = np.full((10, 20, 20), 0.9, np.float32)
    likelihood[0:6, 5:12, 5:12] = 0.05
    likelihood[0, 18, 18] = 0.05
    out = occupied_voxels(likelihood, 0.2, "soft")
    assert out[0:6, 5:12, 5:12].all()
    assert out.sum() == 6 * 7 * 7


def test_a_volume_stands_on_the_seabed_round_its_position():
    volume = Volume.around((1.0, -2.0), (0.5, 0.31, 0.2), 0.1)
    assert volume.shape == (2, 4, 5)
    assert volume.centre_m == pytest.approx((1.0, -2.0, 0.1))
    assert volume.size_m == pytest.approx((0.5, 0.4, 0.2))
    assert volume.z_m == pytest.approx([0.05, 0.15])
    assert volume.x_m.mean() == pytest.approx(1.0)
    assert volume.y_m.mean() == pytest.approx(-2.0)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (((0, 0, 0), 0.0, (2, 2, 2)), "voxel size is 0"),
        (((0, 0, 0), math.nan, (2, 2, 2)), "voxel size is nan"),
        (((0, math.nan, 0), 0.1, (2, 2, 2)), "origin of the volume is nan"),
        (((0, 0, 0), 0.1, (2, 0, 2)), "voxels along y is 0"),
        (((0, 0, 0), 0.1, (2, 2, 99999)), "voxels along x is 99999"),
    ],
)
def test_a_volume_out_of_bounds_is_refused(arguments, match):
    with pytest.raises((ParameterError, GeometryError), match=match):
        Volume(*arguments)


@pytest.mark.parametrize("method", ["consensus", "hard", "soft"])
def test_a_few_voxels_are_no_object(method):
    likelihood = np.full((6, 6, 6), 0.9, np.float32)
    likelihood[0:2, 2:4, 2:4] = 0.0
    assert not occupied_voxels(likelihood, 0.04, method).any()
    likelihood[0:3, 1:4, 1:4] = 0.0
    assert occupied_voxels(likelihood, 0.04, method).sum() == 27
