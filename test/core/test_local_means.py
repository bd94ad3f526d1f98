"""Means over boxes of known pixels are those that summing box by box gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from csas_shadow_ros.core.local_means import LocalMeans


def box_by_box(power: np.ndarray, known: np.ndarray, radius: tuple[int, int]) -> np.ndarray:
    out = np.full(power.shape, np.inf)
    for v, u in np.argwhere(known):
        box = np.s_[max(0, v - radius[0]) : v + radius[0] + 1, max(0, u - radius[1]) : u + radius[1] + 1]
        out[v, u] = power[box][known[box]].astype(np.float64).mean()
    return out


@given(
    st.integers(1, 24),
    st.integers(1, 24),
    st.tuples(st.integers(0, 9), st.integers(0, 9)),
    st.floats(0.0, 1.0),
    st.integers(0, 2**31),
)
def test_means_are_those_of_the_known_pixels_in_the_box(rows, cols, radius, share, seed):
    rng = np.random.default_rng(seed)
    power = rng.exponential(size=(rows, cols)).astype(np.float32)
    known = rng.random((rows, cols)) < share
    power[~known] = 0.0
    local = LocalMeans(power, known)
    expected = box_by_box(power, known, radius)
    np.testing.assert_allclose(local.mean(radius), expected, rtol=1e-5)
    # On a threshold itself rounding decides.
    threshold = 0.8
    sure = np.abs(expected - threshold) > 1e-6
    assert np.array_equal(local.under(radius, threshold)[sure], (known & (expected < threshold))[sure])
    over = known & (expected > threshold)
    assert np.array_equal(local.over(radius, threshold)[sure], over[sure])
    assert local.total_known == known.sum()


@pytest.mark.parametrize("glare", [1e9, 3e38])
def test_a_glaring_pixel_changes_no_mean_that_does_not_hold_it(glare):
    power = np.random.default_rng(1).exponential(size=(80, 90)).astype(np.float32)
    known = np.ones(power.shape, bool)
    clean = LocalMeans(power, known).mean((2, 2))
    power[10, 12] = glare
    local = LocalMeans(power, known)
    far = np.ones(power.shape, bool)
    far[8:13, 10:15] = False
    np.testing.assert_allclose(local.mean((2, 2))[far], clean[far], rtol=1e-5)
    assert local.over((1, 1), 1e6)[9:12, 11:14].all()  # the highest echo threshold, 60 dB
