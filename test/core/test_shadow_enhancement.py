"""Fixed focus shadow enhancement: against the literal filter, its identities, and what it does to shadows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.ndimage
from core_data import (
    band_limited_image,
    circle_track,
    ground_of_pixels,
    make_info,
    sub_apertures,
    view_and_reference,
)

from csas_shadow_ros.core import reference
from csas_shadow_ros.core.errors import ViewError
from csas_shadow_ros.core.geometry import CoherentImage, View
from csas_shadow_ros.core.imaging.enhancement import enhance, focus, focus_phase_rate, focus_range
from csas_shadow_ros.core.imaging.subaperture import Spectrum, SubApertures
from csas_shadow_ros.core.parameters import ShadowParameters, SubApertureParameters

TARGET = (0.3, -0.2)
EXACT, SMALL, NONE = (ShadowParameters(enhancement=e) for e in ("exact", "small_angle", "none"))


def rms_difference(a, b, where):
    return math.sqrt(np.mean(np.abs(a - b)[where] ** 2) / np.mean(np.abs(b)[where] ** 2))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("aspect_deg", [0.0, 33.0, 45.0, 141.7, 270.0])
@pytest.mark.parametrize(("parameters", "target"), [(EXACT, TARGET), (SMALL, TARGET), (EXACT, (-0.4, 0.3))])
def test_enhancement_is_the_literal_filter_within_2_percent_away_from_borders(
    sign, aspect_deg, parameters, target
):
    view, literal, camera = view_and_reference(sign, aspect_deg, faded=True)
    shadow = enhance(view, target, parameters)
    aspect = math.radians(aspect_deg)
    literal = reference.enhance(
        literal,
        band_limited_image(sign),
        camera,
        aspect,
        reference.focus_range(aspect, target),
        small_angle=parameters is SMALL,
    )
    inside = scipy.ndimage.binary_erosion(np.isfinite(shadow.pixels), iterations=10)
    behind = view.info.down_range_of_rows()[:, None] > focus_range(view.info, target)
    assert (inside & behind).sum() > 500
    assert rms_difference(shadow.pixels, np.abs(literal[::4, ::4]), inside) < 0.02
    assert rms_difference(shadow.pixels, np.abs(literal[::4, ::4]), inside & behind) < 0.02
    # And so are the complex numbers, once the carrier and each row's own constant phase are put back.
    focused = focus(view, target, parameters)
    x, y = ground_of_pixels(view.info.camera)
    kx, ky = view.info.carrier_rad_m
    _, k0, _ = view.info.acoustics.ground_band(view.info.camera.grazing_rad)
    delta = np.maximum(view.info.down_range_of_rows() - focus_range(view.info, target), 0.0)[:, None]
    whole = focused.pixels * np.exp(1j * (kx * x + ky * y + sign * k0 * delta))
    assert rms_difference(whole, literal[::4, ::4], inside) < 0.02
    np.testing.assert_allclose(np.abs(focused.pixels), shadow.pixels, rtol=1e-6)


@pytest.mark.parametrize("parameters", [EXACT, SMALL])
def test_rows_up_to_the_focus_range_are_untouched(parameters):
    view, _, _ = view_and_reference(1, 33.0)
    shadow = enhance(view, TARGET, parameters)
    before = view.info.down_range_of_rows() <= focus_range(view.info, TARGET)
    assert 20 < before.sum() < len(before) - 20
    np.testing.assert_allclose(shadow.pixels[before], np.abs(view.pixels[before]), rtol=1e-6)
    behind = ~before & np.isfinite(shadow.pixels).any(axis=1)
    assert np.all(np.nanmax(np.abs(shadow.pixels - np.abs(view.pixels))[behind][5:], axis=1) > 0)


def test_a_focus_behind_the_whole_image_changes_nothing():
    view, _, _ = view_and_reference(1, 33.0)
    far = -50.0 * np.array([math.cos(view.info.aspect_rad), math.sin(view.info.aspect_rad)])
    shadow = enhance(view, (float(far[0]), float(far[1])))
    np.testing.assert_allclose(shadow.pixels, np.abs(view.pixels), rtol=1e-6)


def test_no_enhancement_is_the_amplitude_of_the_view():
    view, _, _ = view_and_reference(1, 33.0)
    shadow = enhance(view, TARGET, NONE)
    np.testing.assert_allclose(shadow.pixels, np.abs(view.pixels), rtol=1e-6)


def test_an_enhanced_view_keeps_its_stamp_and_geometry_and_tells_its_focus():
    view, _, _ = view_and_reference(1, 33.0)
    shadow = enhance(view, TARGET)
    assert shadow.pixels.dtype == np.float32
    assert shadow.info.stamp_ns == view.info.stamp_ns
    assert shadow.info.camera is view.info.camera
    assert shadow.info.focus_range_m == pytest.approx(
        -(0.3 * math.cos(0.57595865) - 0.2 * math.sin(0.57595865))
    )
    assert (shadow.pixels[np.isfinite(shadow.pixels)] >= 0).all()


@pytest.mark.parametrize("scale", [1e-25, 1e25])
def test_amplitudes_whose_squares_single_precision_does_not_hold_are_right_too(scale):
    view, _, _ = view_and_reference(1, 33.0)
    scaled = replace(view, pixels=view.pixels * np.float32(scale))
    expected = enhance(view, TARGET).pixels * np.float32(scale)
    np.testing.assert_allclose(enhance(scaled, TARGET).pixels, expected, rtol=1e-4, atol=1e-6 * scale)


def test_a_pixel_that_is_not_finite_is_unknown_and_counts_as_zero_in_its_row():
    view, _, _ = view_and_reference(1, 33.0)
    row, col = len(view.pixels) * 2 // 3, len(view.pixels) // 2
    assert view.info.down_range_of_rows()[row] > focus_range(view.info, TARGET)
    zero, holes = view.pixels.copy(), view.pixels.copy()
    zero[row, col : col + 2] = 0.0
    holes[row, col : col + 2] = complex(math.nan, 1.0), complex(1.0, math.inf)
    expected = enhance(replace(view, pixels=zero), TARGET).pixels
    expected[row, col : col + 2] = math.nan
    np.testing.assert_allclose(enhance(replace(view, pixels=holes), TARGET).pixels, expected, rtol=1e-6)


def test_enhancement_leaves_the_view_that_it_was_given_alone():
    view, _, _ = view_and_reference(1, 45.0)
    before = view.pixels.copy()
    enhance(view, TARGET)
    assert np.array_equal(view.pixels, before, equal_nan=True)


def lit_patch(aspect_deg=20.0, sign=1):
    """Return a view whose energy lies far from the side borders, on every row."""
    view = sub_apertures(sign).view_of_aspect(math.radians(aspect_deg))
    cols = view.pixels.shape[1]
    window = np.exp(-0.5 * ((np.arange(cols) - cols / 2) / 8.0) ** 2)
    return View(view.info, (np.nan_to_num(view.pixels) * window).astype(np.complex64))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("parameters", [EXACT, SMALL])
def test_the_energy_of_every_row_is_kept(sign, parameters):
    view = lit_patch(sign=sign)
    shadow = enhance(view, (0.1, 0.1), parameters)
    before = (np.abs(view.pixels) ** 2).sum(axis=1)
    after = np.nansum(shadow.pixels.astype(float) ** 2, axis=1)
    lit = before > 0.05 * before.max()
    assert lit.sum() > 30
    assert after[lit] == pytest.approx(before[lit], rel=0.01)


def test_the_view_is_unknown_where_the_aperture_looked_past_the_image():
    view, _, _ = view_and_reference(1, 45.0)
    shadow = enhance(view, TARGET)
    offsets = view.info.down_range_of_rows() - focus_range(view.info, TARGET)
    spacing = view.info.camera.spacing_m[1]
    for row in np.flatnonzero(np.isfinite(view.pixels).any(axis=1)):
        known, left = np.flatnonzero(np.isfinite(view.pixels[row])), np.isfinite(shadow.pixels[row])
        margin = max(0.0, offsets[row]) * math.tan(view.info.aperture_rad / 2) / spacing
        inside = (np.arange(len(left)) >= known[0] + margin) & (np.arange(len(left)) <= known[-1] - margin)
        assert abs(int(inside.sum()) - int(left.sum())) <= 2


@pytest.mark.parametrize("sign", [1, -1])
def test_what_is_not_known_does_not_come_back_on_the_other_side(sign):
    """A bright strip at one side of the image must not leak to the other side of a filtered row."""
    view = sub_apertures(sign).view_of_aspect(0.0)
    lit = np.nan_to_num(view.pixels)
    cols = np.flatnonzero(np.isfinite(view.pixels).any(axis=0))
    lit[:, cols[0] + 6 :] = 0
    lit[np.isnan(view.pixels)] = np.nan
    shadow = enhance(View(view.info, lit), (1.0, 0.0), EXACT)
    right = shadow.pixels[:, cols[-1] - 30 : cols[-1]]
    assert np.nanmax(right) < 0.05 * np.nanmax(np.abs(lit))


def test_the_filter_s_phase_rate_is_the_printed_one():
    info = make_info(0.3)
    k0 = info.acoustics.ground_band(info.camera.grazing_rad)[1]
    k_c = np.linspace(-0.5 * k0, 0.5 * k0, 11)
    # σ = -1: the paper's exp(-jΔ sqrt(4k₀² - k_x²)), 2k₀ = K₀, less a phase common to the row
    minus = replace(info, acoustics=replace(info.acoustics, spectrum_sign=-1))
    assert focus_phase_rate(k_c, minus, "exact") == pytest.approx(k0 - np.sqrt(k0**2 - k_c**2))
    assert focus_phase_rate(k_c, info, "exact") == pytest.approx(np.sqrt(k0**2 - k_c**2) - k0)
    assert focus_phase_rate(k_c, info, "small_angle") == pytest.approx(-(k_c**2) / (2 * k0))
    assert np.isfinite(focus_phase_rate(np.array([1.5 * k0]), info, "exact")).all()


def test_the_simplified_filter_differs_little_at_6_degrees_and_more_at_40():
    difference = []
    for aperture_deg in (6.0, 40.0):
        view = sub_apertures(1, aperture_deg, faded=True).view_of_aspect(0.4)
        target = (0.6, 0.3)
        a, b = (enhance(view, target, p).pixels for p in (EXACT, SMALL))
        known = np.isfinite(a) & np.isfinite(b)
        known &= view.info.down_range_of_rows()[:, None] > focus_range(view.info, target)
        difference.append(rms_difference(b, a, known))
    assert difference[0] < 0.005
    assert difference[1] > 0.05


@pytest.mark.parametrize("parameters", [EXACT, SMALL])
def test_a_conjugate_image_with_the_other_sign_is_enhanced_to_the_same_amplitude(parameters):
    image = band_limited_image(1)
    conjugate = CoherentImage(image.pixels.conj(), image.grid, replace(image.acoustics, spectrum_sign=-1))
    a = enhance(sub_apertures(1).view_of_aspect(0.7), TARGET, parameters).pixels
    b = SubApertures(conjugate, circle_track(), sub_apertures(1).parameters).view_of_aspect(0.7)
    b = enhance(b, TARGET, parameters).pixels
    assert rms_difference(b, a, np.isfinite(a)) < 2e-3


def test_views_that_cannot_be_enhanced_are_refused():
    info = make_info(0.3)
    with pytest.raises(ViewError, match="float32 pixels; expected complex"):
        enhance(View(info, np.ones((128, 128), np.float32)), TARGET)
    with pytest.raises(ViewError, match="no finite pixel"):
        enhance(View(info, np.full((128, 128), np.nan, np.complex64)), TARGET)


def mean_power(run, parameters, *, aperture_deg=12.0, lie_about_sign=False):
    """Mean power of the views of a target that looks the same from everywhere, and its axes."""
    p = SubApertureParameters(aperture_deg=aperture_deg, step_deg=5.0, spacing_m=0.02)
    sa = SubApertures(run.image, run.track, p, spectrum=Spectrum.of_image(run.image))
    total = count = 0
    for i in range(len(sa)):
        view = sa.view(i)
        if lie_about_sign:
            a = replace(view.info.acoustics, spectrum_sign=-view.info.acoustics.spectrum_sign)
            view = replace(view, info=replace(view.info, acoustics=a))
        power = enhance(view, (0.0, 0.0), parameters).pixels.astype(float) ** 2
        known = np.isfinite(power)
        total, count = total + np.where(known, power, 0.0), count + known
    r = view.info.down_range_of_rows()
    across = (np.arange(view.info.camera.cols) - (view.info.camera.cols - 1) / 2) * sa.spacing_m
    with np.errstate(invalid="ignore"):
        return total / count, r, across


def edge_width(power, r, across, span):
    """Distance over which the side edges of a shadow rise from 25 % to 75 % of the seabed's power."""
    rows = (r > span[0]) & (r < span[1])
    near = np.abs(across) < 0.8
    profile, across = np.nanmean(power[rows][:, near], axis=0), across[near]
    profile = 0.5 * (profile + profile[::-1])
    right = across >= 0
    x, p = across[right], profile[right]
    seabed, dark = np.nanmean(p[(x > 0.5) & (x < 0.75)]), p[:3].min()
    p = np.maximum.accumulate(np.nan_to_num((p - dark) / (seabed - dark), nan=1.0))
    first = [float(x[np.argmax(p >= level)]) for level in (0.25, 0.75)]
    p0 = [np.argmax(p >= level) for level in (0.25, 0.75)]
    exact = [
        x[i - 1] + (level - p[i - 1]) / (p[i] - p[i - 1]) * (x[i] - x[i - 1])
        for i, level in zip(p0, (0.25, 0.75), strict=True)
    ]
    assert first[0] > 0
    return exact[1] - exact[0]


def test_enhancement_sharpens_shadow_edges_and_a_wrong_sign_doubles_their_blur(drum_run):
    # The drum is 0.4 m wide and 0.3 m high: its shadow's sides are straight to 0.3 · 30/11.7 = 0.77 m.
    span, aperture = (0.5, 0.74), 24.0
    sharp = edge_width(*mean_power(drum_run, EXACT, aperture_deg=aperture), span)
    plain = edge_width(*mean_power(drum_run, NONE, aperture_deg=aperture), span)
    wrong = edge_width(*mean_power(drum_run, EXACT, aperture_deg=aperture, lie_about_sign=True), span)
    # Looks spread evenly over ±12° smear an edge 0.62 m behind the target over ±13 cm: 25 to 75 % in 13 cm.
    assert plain == pytest.approx(2 * 0.62 * math.tan(math.radians(12)) / 2, rel=0.25)
    assert sharp < 0.6 * plain
    assert wrong == pytest.approx(2 * plain, rel=0.25)


def test_a_post_s_shadow_is_seen_with_enhancement_but_not_without_nor_in_a_4_degree_aperture(post_run):
    """Figure 5 with an upright post, 12 cm thick: two cells of resolution."""

    def contrast_db(parameters, aperture_deg):
        power, r, across = mean_power(post_run, parameters, aperture_deg=aperture_deg)
        rows = (r > 0.95) & (r < 1.15)
        shadow = np.nanmean(power[rows][:, np.abs(across) < 0.03])
        seabed = np.nanmean(power[rows][:, (np.abs(across) > 0.35) & (np.abs(across) < 0.6)])
        return 10 * math.log10(seabed / shadow)

    enhanced, plain, narrow = contrast_db(EXACT, 12.0), contrast_db(NONE, 12.0), contrast_db(NONE, 4.0)
    assert enhanced > 5.5
    assert enhanced > plain + 1.5
    assert enhanced > narrow + 1.5
