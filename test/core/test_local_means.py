"""Means over boxes of known pixels are those that summing box by box gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import ndimage

from csas_shadow_ros.core.imaging.local_means import LocalMeans


def box_by_box(power: np.ndarray, known: np.ndarray, radius: tuple[int, int]) -> np.ndarray:
    out = np.full(power.shape, np.inf)
    for v, u in np.argwhere(known):
        box = np.s_[max(0, v - radius[0]) : v + radius[0] + 1, max(0, u - radius[1]) : u + radius[1] + 1]
        out[v, u] = power[box][known[box]].astype(np.float64).mean()
    return out


def radius_of(half_cells, cell_px, shape) -> tuple[int, int]:
    rows, cols = (round(min(a * b, n)) for a, b, n in zip(half_cells, cell_px, shape, strict=True))
    return max(1, rows), max(1, cols)


def size_of(radius: tuple[int, int]) -> tuple[int, int]:
    return 2 * radius[0] + 1, 2 * radius[1] + 1


#: Pixels a resolution cell, (rows, cols): of coarse and of fine views.
CELLS = st.tuples(st.floats(0.3, 6.0), st.floats(0.3, 9.0))
#: Of a view of the standard profile.
STANDARD = (1.67, 2.66)


@st.composite
def views(draw):
    rows, cols = draw(st.integers(1, 40)), draw(st.integers(1, 70))
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    power = rng.exponential(size=(rows, cols)).astype(np.float32)
    known = rng.random((rows, cols)) < draw(st.floats(0.0, 1.0))
    # As in a view, most of what is unknown is beyond the ends of its rows; some rows hold nothing.
    first, last = np.sort(rng.integers(-cols // 2, cols + cols // 2 + 1, (2, rows)), axis=0)
    column = np.arange(cols)
    known &= (column >= first[:, None]) & (column < last[:, None])
    power[~known] = 0.0
    return power, known


@given(views(), CELLS, st.tuples(st.floats(0.1, 3.0), st.floats(0.1, 3.0)), st.floats(0.1, 2.0))
def test_a_pixel_is_under_a_threshold_where_the_mean_in_its_box_is(view, cell_px, half, threshold):
    power, known = view
    local = LocalMeans(power, known, cell_px)
    expected = box_by_box(power, known, radius_of(half, cell_px, power.shape))
    # On a threshold itself rounding decides.
    sure = np.abs(expected - threshold) > 1e-6
    assert np.array_equal(local.under(half, threshold)[sure], (known & (expected < threshold))[sure])
    assert local.total_known == known.sum()


@given(views(), CELLS, st.data())
def test_a_part_of_a_view_is_marked_as_in_the_whole(view, cell_px, data):
    local = LocalMeans(*view, cell_px)
    part = tuple(
        slice(*sorted(data.draw(st.tuples(st.integers(0, n), st.integers(0, n))))) for n in view[0].shape
    )
    np.testing.assert_array_equal(local.under((1.0, 1.0), 0.8, *part), local.under((1.0, 1.0), 0.8)[part])


@given(views(), CELLS, st.floats(1.0, 3.0))
def test_echoes_are_the_pixels_over_a_threshold_in_the_mean_and_their_neighbours(view, cell_px, threshold):
    power, known = view
    radius = radius_of((0.6, 0.375), cell_px, power.shape)
    mean = box_by_box(power, known, radius)
    assume(not (np.abs(mean - threshold) < 1e-6).any())
    marks = known & (mean > threshold)
    expected = ndimage.maximum_filter(marks, size_of(radius), mode="constant", cval=False)
    np.testing.assert_array_equal(LocalMeans(power, known, cell_px).echoes(threshold), expected)


@given(views(), CELLS, st.floats(0.5, 2.0))
def test_interiors_are_the_pixels_all_of_whose_neighbours_are_under_a_threshold(view, cell_px, threshold):
    power, known = view
    radius = radius_of((1.2, 0.75), cell_px, power.shape)
    mean = box_by_box(power, known, radius)
    assume(not (np.abs(mean - threshold) < 1e-6).any())
    # Beyond the view's edge there is no neighbour; an unknown one is not known to be dark.
    brightest = ndimage.maximum_filter(mean, size_of(radius), mode="constant", cval=-np.inf)
    inside = brightest < threshold
    levels, powers = LocalMeans(power, known, cell_px).interiors(threshold)
    np.testing.assert_allclose(levels, brightest[inside], rtol=1e-5)
    np.testing.assert_array_equal(powers, power[inside])


@pytest.mark.parametrize("glare", [1e9, 3e38])
def test_a_glaring_pixel_changes_no_mean_that_does_not_hold_it(glare):
    power = np.random.default_rng(1).exponential(size=(80, 90)).astype(np.float32)
    known = np.ones(power.shape, bool)
    clean = LocalMeans(power, known, STANDARD)
    with_glare = power.copy()
    with_glare[10, 12] = glare
    local = LocalMeans(with_glare, known, STANDARD)
    far = ~np.zeros(power.shape, bool)
    far[8:13, 10:15] = False
    mean = box_by_box(power, known, (2, 2))
    for threshold in (0.5, 1.0, 2.0):
        sure = far & (np.abs(mean - threshold) > 1e-6)
        np.testing.assert_array_equal(
            local.under((1.2, 0.75), threshold)[sure], clean.under((1.2, 0.75), threshold)[sure]
        )
    echoes = local.echoes(1e6)  # the highest echo threshold, 60 dB
    assert echoes[8:13, 10:15].all()
    assert echoes.sum() == 25
