"""l_out: the printed formula, and the levels that it needs, on Rayleigh data whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from core_data import make_view
from hypothesis import given
from hypothesis import strategies as st

from csas_shadow_ros.core.errors import ViewError
from csas_shadow_ros.core.imaging.enhancement import enhance
from csas_shadow_ros.core.imaging.likelihood import (
    echo_mask,
    expected_l_out,
    l_out,
    outside_likelihood,
    seabed_level,
    view_levels,
)
from csas_shadow_ros.core.imaging.local_means import LocalMeans
from csas_shadow_ros.core.imaging.subaperture import SubApertures
from csas_shadow_ros.core.parameters import LikelihoodParameters, ShadowParameters, SubApertureParameters

SIZE = 384


def printed(i, sigma_r, sigma_s):
    p_r = i / sigma_r**2 * np.exp(-(i**2) / (2 * sigma_r**2))
    p_s = i / sigma_s**2 * np.exp(-(i**2) / (2 * sigma_s**2))
    return (p_r / (p_r + p_s)) ** 2


def evaluated(i, sigma_r, contrast):
    power = np.atleast_1d(np.asarray((i / sigma_r) ** 2 / 2, np.float32))
    return np.asarray(l_out(power, contrast))


def speckle(seed=0, size=SIZE):
    return np.random.default_rng(seed).rayleigh(1.0, (size, size)).astype(np.float32)


def shadow_boxes(share, size=SIZE):
    """Return a mask with one solid shadow that covers a share of the view."""
    mask = np.zeros((size, size), bool)
    side = math.sqrt(share) * size
    mask[size // 2 - 20 : size // 2 - 20 + round(side * 0.8), 60 : 60 + round(side / 0.8)] = True
    return mask


@given(st.floats(1e-3, 5.0), st.floats(1.02, 20.0), st.floats(0.01, 100.0))
def test_l_out_is_the_printed_formula_wherever_that_does_not_overflow(relative, contrast, sigma_r):
    i = relative * sigma_r
    expected = printed(i, sigma_r, sigma_r / contrast)
    assert evaluated(i, sigma_r, contrast)[0] == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize("contrast", [1.1, 3.0, 10.0, 100.0])
def test_l_out_is_finite_bounded_and_grows_with_the_amplitude_from_zero_to_any_brightness(contrast):
    i = np.r_[0.0, np.geomspace(1e-6, 1e4, 2000)]
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        out = evaluated(i, 1.0, contrast)
    assert np.isfinite(out).all()
    assert out.min() >= 0.0
    assert out.max() <= 1.0
    assert (np.diff(out) >= -1e-7).all()
    assert out[0] == pytest.approx((1 + contrast**2) ** -2, rel=1e-4)
    assert out[-1] == 1.0


@pytest.mark.parametrize("contrast", [1.5, 4.0, 10.0])
def test_the_expected_l_out_of_shadow_and_seabed_is_what_drawing_finds(contrast):
    rng = np.random.default_rng(3)
    i = rng.rayleigh(1.0, 400_000)
    drawn = printed(i / contrast, 1.0, 1.0 / contrast).mean(), printed(i, 1.0, 1.0 / contrast).mean()
    assert expected_l_out(contrast) == pytest.approx(drawn, abs=3e-3)


@pytest.mark.parametrize("background", ["local", "global"])
def test_the_seabed_level_is_right_within_3_percent_beside_20_percent_shadow_and_5_percent_echoes(background):
    amplitude = 2.5 * speckle(1)
    amplitude[shadow_boxes(0.2)] *= 10 ** (-12 / 20)
    amplitude[10 : 10 + round(0.05 * SIZE**2 / 100), 200:300] *= 10 ** (15 / 20)
    levels = view_levels(make_view(amplitude), LikelihoodParameters(background=background))
    assert levels.seabed_level == pytest.approx(2.5, rel=0.03)


@pytest.mark.parametrize("background", ["local", "global"])
def test_the_seabed_level_scales_with_the_image(background):
    a = seabed_level(speckle(2), background)
    assert np.allclose(seabed_level(speckle(2) * np.float32(1e-6), background), a * 1e-6, rtol=1e-3, atol=0)


def test_a_local_level_follows_a_seabed_that_varies_by_3_db_to_either_side():
    v, u = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(-1, 1, SIZE), indexing="ij")
    level = 10 ** ((3.0 * (0.7 * u + 0.3 * v**2)) / 20)
    amplitude = (speckle(3) * level).astype(np.float32)
    amplitude[shadow_boxes(0.1)] *= 0.25
    local, flat = seabed_level(amplitude, "local"), seabed_level(amplitude, "global")
    nodes = np.linspace(-1, 1, len(local))
    v, u = np.meshgrid(nodes, nodes, indexing="ij")
    level = 10 ** ((3.0 * (0.7 * u + 0.3 * v**2)) / 20)
    error = [math.sqrt(np.mean((estimate / level - 1) ** 2)) for estimate in (local, flat)]
    assert error[0] < 0.05
    assert error[1] > 0.12
    assert np.abs(20 * np.log10(local / level)).max() < 1.0


@pytest.mark.parametrize("contrast_db", [8.0, 12.0, 16.0, 20.0])
@pytest.mark.parametrize("share", [0.03, 0.2])
def test_the_contrast_is_measured_within_1_db(contrast_db, share):
    amplitude = speckle(4)
    amplitude[shadow_boxes(share)] *= 10 ** (-contrast_db / 20)
    levels = view_levels(make_view(amplitude))
    assert levels.estimated
    assert 20 * math.log10(levels.contrast) == pytest.approx(contrast_db, abs=1.0)
    assert 0.3 * share < levels.shadow_fraction < 1.1 * share


@pytest.mark.parametrize("contrast_db", [5.0, 6.0, 7.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_faint_shadow_of_a_target_is_measured_as_well(contrast_db, seed):
    """It was taken for the assumed 12 dB, by which most of it is no shadow."""
    amplitude = speckle(seed)
    amplitude[shadow_boxes(0.1)] *= 10 ** (-contrast_db / 20)
    levels = view_levels(make_view(amplitude))
    assert levels.estimated
    assert 20 * math.log10(levels.contrast) == pytest.approx(contrast_db, abs=1.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_faint_patch_is_no_shadow_where_no_target_is_known(seed):
    amplitude = speckle(seed)
    amplitude[shadow_boxes(0.1)] *= 10 ** (-5.0 / 20)
    assert not view_levels(make_view(amplitude), target=False).estimated


def test_a_view_without_shadow_falls_back_on_the_assumed_contrast():
    levels = view_levels(make_view(speckle(5)), LikelihoodParameters(shadow_contrast_db=14.0))
    assert not levels.estimated
    assert 20 * math.log10(levels.contrast) == pytest.approx(14.0)
    assert math.isnan(levels.shadow_fraction)


def test_the_contrast_hypothesis_is_used_as_it_is_when_asked_for():
    amplitude = speckle(6)
    amplitude[shadow_boxes(0.2)] *= 0.1
    p = LikelihoodParameters(shadow_level="contrast", shadow_contrast_db=9.0)
    levels = view_levels(make_view(amplitude), p)
    assert not levels.estimated
    assert levels.contrast == pytest.approx(10 ** (9 / 20))


@pytest.mark.parametrize("floor", [0.3, 0.6])
def test_pixels_that_a_receiver_clipped_to_zero_are_not_taken_for_shadow(floor):
    raw = speckle(7)
    clipped = np.maximum(raw - np.float32(floor), 0).astype(np.float32)
    assert (clipped == 0).mean() > 0.03
    levels = view_levels(make_view(clipped))
    assert not levels.estimated
    out = outside_likelihood(make_view(clipped)).pixels
    assert np.isfinite(out).mean() > 0.99
    told = outside_likelihood(make_view(clipped), LikelihoodParameters(echo_unknown=False)).pixels
    assert np.isfinite(told).all()


def test_a_shadow_that_a_receiver_clipped_to_zero_is_certain_shadow_and_finite():
    amplitude = speckle(8)
    dark = shadow_boxes(0.1)
    amplitude[dark] = 0.0
    out = outside_likelihood(make_view(amplitude)).pixels
    assert np.isfinite(out).all()
    assert out[dark].max() < 1e-3
    assert out[~dark].mean() > 0.7


def test_shadow_is_unlikely_and_seabed_likely_to_be_outside_as_expected():
    amplitude = speckle(9)
    dark = shadow_boxes(0.15)
    amplitude[dark] *= 10 ** (-12 / 20)
    view = make_view(amplitude)
    out = outside_likelihood(view).pixels
    shadow, seabed = expected_l_out(10 ** (12 / 20))
    assert out.dtype == np.float32
    assert out[dark].mean() == pytest.approx(shadow, abs=0.02)
    assert np.nanmean(out[~dark]) == pytest.approx(seabed, abs=0.02)
    assert view.pixels is amplitude


def test_what_the_view_does_not_know_stays_unknown_and_stamp_and_camera_are_kept():
    amplitude = speckle(10)
    amplitude[:50] = np.nan
    view = make_view(amplitude)
    out = outside_likelihood(view)
    assert np.isnan(out.pixels[:50]).all()
    assert np.isfinite(out.pixels[50:]).mean() > 0.999
    assert out.info is view.info


def test_levels_given_are_levels_used():
    view = make_view(speckle(11))
    levels = view_levels(view, LikelihoodParameters(shadow_contrast_db=20.0))
    a = outside_likelihood(view, LikelihoodParameters(shadow_contrast_db=20.0))
    b = outside_likelihood(view, LikelihoodParameters(shadow_contrast_db=3.0), levels)
    assert np.array_equal(a.pixels, b.pixels, equal_nan=True)


def mask_of(amplitude, echo_db=8.0):
    known = np.isfinite(amplitude)
    power = (np.nan_to_num(amplitude).astype(np.float32) ** 2 / 2).astype(np.float32)
    return echo_mask(LocalMeans(power, known, (1.67, 2.66)), echo_db)


def test_a_bright_patch_is_an_echo_and_speckle_is_not():
    amplitude = speckle(12)
    patch = np.zeros(amplitude.shape, bool)
    patch[100:108, 150:162] = True
    amplitude[patch] *= 10 ** (15 / 20)
    mask = mask_of(amplitude)
    assert mask[patch].mean() > 0.98
    grown = np.zeros_like(patch)
    grown[97:111, 147:165] = True
    assert mask[~grown].mean() < 1e-3


def test_the_echo_of_a_simulated_empty_seabed_is_nothing(empty_run):
    view = enhance(
        SubApertures(empty_run.image, empty_run.track, SubApertureParameters()).view(40),
        (0.0, 0.0),
        ShadowParameters(),
    )
    out = outside_likelihood(view).pixels
    lost = np.isnan(out) & np.isfinite(view.pixels)
    assert lost.sum() < 2e-3 * np.isfinite(view.pixels).sum()


def test_echoes_know_nothing_unless_told_otherwise():
    amplitude = speckle(13)
    amplitude[100:110, 150:160] *= 10 ** (15 / 20)
    view = make_view(amplitude)
    assert np.isnan(outside_likelihood(view).pixels[102:108, 152:158]).all()
    told = outside_likelihood(view, LikelihoodParameters(echo_unknown=False)).pixels
    assert np.isfinite(told).all()
    assert told[102:108, 152:158].mean() > 0.95


def test_smoothing_separates_shadow_from_seabed_better():
    amplitude = speckle(14)
    dark = shadow_boxes(0.15)
    amplitude[dark] *= 10 ** (-12 / 20)
    view = make_view(amplitude)
    plain = outside_likelihood(view).pixels
    smooth = outside_likelihood(view, LikelihoodParameters(smoothing_m=0.08)).pixels

    def gap(out):
        return (np.nanmean(out[~dark]) - out[dark].mean()) / np.nanstd(out[~dark])

    assert gap(smooth) > 2 * gap(plain)


@pytest.mark.parametrize(
    ("pixels", "match"),
    [
        (np.ones((64, 64), np.float64), "shadow view has float64 pixels; expected float32"),
        (np.ones((64, 64), np.complex64), "shadow view has complex64 pixels"),
        (np.full((64, 64), np.nan, np.float32), "view has 0 known pixels; expected at least 256"),
        (np.zeros((64, 64), np.float32), "seabed level of the view is zero"),
    ],
)
def test_views_without_levels_are_refused(pixels, match):
    with pytest.raises(ViewError, match=match):
        outside_likelihood(make_view(pixels))


def test_a_view_with_its_known_pixels_scattered_is_used_or_refused_for_what_it_lacks():
    """Enough known pixels, but in no solid block: not a reason to call the seabed zero."""
    amplitude = speckle(15)
    amplitude[::2] = np.nan
    try:
        level = view_levels(make_view(amplitude)).seabed_level
    except ViewError as error:
        assert "is zero" not in str(error)  # noqa: PT017
    else:
        assert level == pytest.approx(1.0, rel=0.05)


def test_the_likelihood_of_a_view_is_the_formula_of_its_known_pixels():
    amplitude = speckle(4, 128)
    amplitude[shadow_boxes(0.1, 128)] *= 0.1
    amplitude[:, :9], amplitude[5, 40:50], amplitude[90:93, 70:73] = np.nan, np.inf, 30.0
    view = make_view(amplitude)
    levels = view_levels(view)
    got = outside_likelihood(view, None, levels).pixels
    told = levels.known & ~levels.echoes(LikelihoodParameters().echo_db)
    assert not told[91, 71]
    np.testing.assert_array_equal(np.isnan(got), ~told)
    np.testing.assert_allclose(got[told], l_out(levels.power, levels.contrast)[told], atol=1e-6)
