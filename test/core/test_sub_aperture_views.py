"""Sub-aperture views: the fast wedge against the literal full-size steps, and what any wedge must satisfy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.ndimage
from core_data import (
    SPACING_M,
    acoustics,
    band_limited_image,
    circle_track,
    ground_of_pixels,
    image_of_spectrum,
    nominal_grazing,
    normalised_rms,
    on_carrier,
    point_image,
    sub_apertures,
    view_and_reference,
    wavenumber_lattice,
)

from csas_shadow_ros.core import reference
from csas_shadow_ros.core.errors import ParameterError, ViewError
from csas_shadow_ros.core.geometry import Acoustics, CoherentImage, GroundGrid, unit_to_sonar
from csas_shadow_ros.core.imaging.subaperture import Spectrum, SubApertures, taper_table
from csas_shadow_ros.core.parameters import SubApertureParameters

ASPECTS = [0.0, 33.0, 45.0, 90.0, 141.7, 180.0, 270.0, 333.3]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("aspect_deg", ASPECTS)
def test_the_fast_view_is_the_literal_one_within_2_percent_away_from_borders(sign, aspect_deg):
    view, literal, _ = view_and_reference(sign, aspect_deg)
    inside = scipy.ndimage.binary_erosion(np.isfinite(view.pixels), iterations=8)
    assert inside.mean() > 0.2
    assert normalised_rms(on_carrier(view), literal[::4, ::4], inside) < 0.02


def test_a_wide_aperture_is_the_literal_one_too():
    view, literal, _ = view_and_reference(1, 33.0, 40.0)
    inside = scipy.ndimage.binary_erosion(np.isfinite(view.pixels), iterations=8)
    assert normalised_rms(on_carrier(view), literal[::3, ::3], inside) < 0.02


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("aspect_deg", [0.0, 52.0, 225.0])
def test_a_view_on_its_carrier_is_the_true_image_at_those_points(sign, aspect_deg):
    grid = GroundGrid.centred(300, 360, SPACING_M, (1.3, -0.7))
    kx, ky = wavenumber_lattice(grid)
    k, look = (
        np.hypot(kx, ky),
        np.angle(np.exp(1j * (np.arctan2(sign * ky, sign * kx) - math.radians(aspect_deg)))),
    )
    low, _, high = acoustics().ground_band(nominal_grazing())
    band = (k > low + 5) & (k < high - 5)
    rng = np.random.default_rng(1)
    chosen = rng.choice(np.flatnonzero(band & (np.abs(look) < math.radians(5.5))), 12, replace=False)
    others = rng.choice(np.flatnonzero(band & (np.abs(look) > math.radians(6.5))), 40, replace=False)
    values = np.zeros(k.size, complex)
    values[chosen] = np.exp(2j * np.pi * rng.random(12))
    values[others] = 3.0
    view = SubApertures(
        image_of_spectrum(values.reshape(k.shape), grid, sign), circle_track()
    ).view_of_aspect(math.radians(aspect_deg))
    x, y = ground_of_pixels(view.info.camera)
    truth = np.zeros(x.shape, complex)
    for i in chosen:
        truth += values[i] * np.exp(1j * (kx.flat[i] * x + ky.flat[i] * y))
    assert normalised_rms(on_carrier(view), truth, np.isfinite(view.pixels)) < 0.005


@pytest.mark.parametrize("aspect_deg", [0.0, 77.0])
def test_the_carrier_lies_in_the_middle_of_the_wedge_on_the_side_the_sign_says(aspect_deg):
    low, mid, high = acoustics().ground_band(nominal_grazing())
    for sign in (1, -1):
        info = sub_apertures(sign).info(math.radians(aspect_deg))
        along = sign * np.asarray(info.carrier_rad_m) @ unit_to_sonar(math.radians(aspect_deg))
        across = np.asarray(info.carrier_rad_m) @ (
            -math.sin(math.radians(aspect_deg)),
            math.cos(math.radians(aspect_deg)),
        )
        assert low < along < high
        assert abs(along - mid) < 0.05 * mid
        assert abs(across) < 5.0


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("aperture_deg", [8.0, 12.0, 30.0, 40.0])
@pytest.mark.parametrize("shape", [(320, 384), (300, 300)])
def test_each_bin_of_the_annulus_is_in_exactly_one_view_of_a_partition(sign, aperture_deg, shape):
    grid = GroundGrid.centred(*shape, SPACING_M)
    image = CoherentImage(np.zeros(shape, np.complex64), grid, acoustics(sign))
    ones = Spectrum(np.ones(shape, np.complex64), grid)
    parameters = SubApertureParameters(aperture_deg=aperture_deg, step_deg=aperture_deg)
    sa = SubApertures(image, circle_track(), parameters, spectrum=ones)
    count = np.zeros(shape, int)
    for aspect in sa.aspects_rad:
        box, centre = sa.baseband(float(aspect))
        bins = np.abs(np.fft.fft2(box))
        v, u = np.nonzero(bins > 1e-3 * bins.max())
        v = np.where(v > box.shape[0] // 2, v - box.shape[0], v)
        u = np.where(u > box.shape[1] // 2, u - box.shape[1], u)
        count[(centre[0] + v) % shape[0], (centre[1] + u) % shape[1]] += 1
    k = np.hypot(*wavenumber_lattice(grid))
    low, _, high = acoustics().ground_band(nominal_grazing())
    wrong = np.argwhere((count != 1) & (k > low) & (k < high))
    assert len(wrong) == 0, f"{len(wrong)} bins in no view or in two, such as {wrong[:4].tolist()}"
    assert count[(k < 0.9 * low)].max() == 0


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("aperture_deg", [8.0, 12.0, 30.0])
def test_the_literal_sub_apertures_of_a_partition_sum_to_the_image(sign, aperture_deg):
    image = band_limited_image(sign)
    total = sum(
        reference.sub_aperture(image, math.radians(a), math.radians(aperture_deg))
        for a in np.arange(0.0, 360.0, aperture_deg)
    )
    assert normalised_rms(total, image.pixels, np.ones(image.pixels.shape, bool)) < 1e-6


@pytest.mark.parametrize("sign", [1, -1])
def test_the_views_of_a_partition_sum_to_the_image(sign):
    """Every view, put back on its carrier, sampled at common ground points and added up."""
    image = band_limited_image(sign)
    parameters = SubApertureParameters(aperture_deg=12.0, step_deg=12.0, oversampling=4.0)
    sa = SubApertures(image, circle_track(), parameters)
    rows, cols = np.meshgrid(np.arange(100, 220, 7), np.arange(110, 270, 7), indexing="ij")
    x, y = image.grid.x_of_columns()[cols], image.grid.y_of_rows()[rows]
    total = np.zeros(x.shape, complex)
    for i in range(len(sa)):
        view = sa.view(i)
        a = view.info.camera.ground_to_pixel
        u, v = (a[0, 0] * x + a[0, 1] * y + a[0, 2], a[1, 0] * x + a[1, 1] * y + a[1, 2])
        filled = np.nan_to_num(view.pixels)
        baseband = scipy.ndimage.map_coordinates(filled, [v, u], order=5)
        kx, ky = view.info.carrier_rad_m
        total += baseband * np.exp(1j * (kx * x + ky * y))
    assert normalised_rms(total, image.pixels[rows, cols], np.ones(x.shape, bool)) < 0.02


def test_the_energy_of_all_views_is_that_of_the_image():
    image = band_limited_image()
    parameters = SubApertureParameters(aperture_deg=12.0, step_deg=12.0)
    sa = SubApertures(image, circle_track(), parameters)
    power = sum(float(np.nanmean(np.abs(sa.view(i).pixels) ** 2)) for i in range(len(sa)))
    assert power == pytest.approx(float(np.mean(np.abs(image.pixels) ** 2)), rel=0.01)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("position", [(0.3123, -0.2461), (-0.411, 0.3337)])
def test_a_point_appears_at_its_pixel_in_the_view_of_every_aspect(sign, position):
    sa = SubApertures(point_image(position, sign), circle_track(), SubApertureParameters(step_deg=20.0))
    for i in range(len(sa)):
        view = sa.view(i)
        power = np.log(np.nan_to_num(np.abs(view.pixels)) + 1e-9)
        row, col = np.unravel_index(power.argmax(), power.shape)
        r, c = power[row - 1 : row + 2, col], power[row, col - 1 : col + 2]
        peak = (
            col + 0.5 * (c[0] - c[2]) / (c[0] - 2 * c[1] + c[2]),
            row + 0.5 * (r[0] - r[2]) / (r[0] - 2 * r[1] + r[2]),
        )
        expected = view.info.camera.project((*position, 0.0))
        assert np.hypot(*(peak - expected)) < 0.25, view.info.aspect_rad


def response_width(samples, spacing):
    """-3 dB width of a sampled response, finely interpolated."""
    fine = np.linspace(0, len(samples) - 1, 100 * len(samples))
    level = scipy.ndimage.map_coordinates(samples, [fine], order=3)
    above = fine[level > level.max() / math.sqrt(2.0)]
    return (above[-1] - above[0]) * spacing


@pytest.mark.parametrize("aperture_deg", [6.0, 12.0, 40.0])
def test_the_response_to_a_point_is_as_wide_as_the_wedge_says_along_both_axes(aperture_deg):
    low, _, high = acoustics().ground_band(nominal_grazing())
    k, alpha = np.linspace(low, high, 60), np.radians(aperture_deg) * np.linspace(-0.5, 0.5, 60)
    kk, aa = np.meshgrid(k, alpha)
    distance = np.linspace(-0.25, 0.25, 251)
    along = [abs(np.sum(kk * np.exp(1j * kk * np.cos(aa) * r))) for r in distance]
    across = [abs(np.sum(kk * np.exp(1j * kk * np.sin(aa) * r))) for r in distance]
    parameters = SubApertureParameters(aperture_deg=aperture_deg, oversampling=6.0)
    sa = SubApertures(point_image((0.1, -0.05)), circle_track(), parameters)
    view = sa.view_of_aspect(math.radians(33.0))
    amplitude = np.nan_to_num(np.abs(view.pixels))
    row, col = np.unravel_index(amplitude.argmax(), amplitude.shape)
    n = round(0.25 / sa.spacing_m)
    for samples, theory in (
        (amplitude[row - n : row + n, col], along),
        (amplitude[row, col - n : col + n], across),
    ):
        assert response_width(samples, sa.spacing_m) == pytest.approx(
            response_width(np.array(theory), 0.002), rel=0.04
        )


def test_a_view_is_nan_exactly_off_the_image():
    view = sub_apertures().view_of_aspect(math.radians(33.0))
    x, y = ground_of_pixels(view.info.camera)
    left, right, bottom, top = band_limited_image().grid.extent_m
    inside = np.minimum.reduce([x - left, right - x, y - bottom, top - y])
    clear = np.abs(inside) > 1e-6
    assert np.array_equal(np.isfinite(view.pixels)[clear], (inside > 0)[clear])
    assert (inside > 0).any()
    assert (inside < 0).any()


def test_a_view_holds_the_whole_image_at_every_aspect_unless_told_otherwise():
    grid = band_limited_image().grid
    left, right, bottom, top = grid.extent_m
    for aspect_deg in (0.0, 40.0, 129.0):
        camera = sub_apertures().info(math.radians(aspect_deg)).camera
        corners = camera.project([(x, y, 0.0) for x in (left, right) for y in (bottom, top)])
        assert corners.min() > -1.0
        assert corners.max() < camera.rows
    small = SubApertures(band_limited_image(), circle_track(), SubApertureParameters(extent_m=0.8))
    assert small.size * small.spacing_m == pytest.approx(0.8, abs=small.spacing_m)
    assert np.isfinite(small.view(3).pixels).all()


def test_a_conjugate_image_with_the_other_sign_gives_the_same_amplitudes():
    image = band_limited_image(1)
    mirrored = CoherentImage(image.pixels.conj(), image.grid, acoustics(-1))
    a = sub_apertures(1).view_of_aspect(0.7).pixels
    b = SubApertures(mirrored, circle_track(), sub_apertures(1).parameters).view_of_aspect(0.7).pixels
    assert normalised_rms(np.abs(b), np.abs(a), np.isfinite(a)) < 1e-3


def test_the_stamp_and_the_camera_of_a_view_are_the_sonar_s_when_it_was_there():
    track = circle_track(clockwise=True, start_deg=40.0)
    sa = SubApertures(band_limited_image(), track)
    for index in (0, 33, 200):
        info = sa.info(float(sa.aspects_rad[index]))
        stamp, sonar = track.at_aspect(float(sa.aspects_rad[index]))
        assert info.stamp_ns == stamp
        assert info.camera.sonar_m == pytest.approx(sonar)
        assert math.isnan(info.focus_range_m)


def test_the_views_are_as_many_as_the_step_says_and_have_stamps_of_their_own():
    sa = SubApertures(band_limited_image(), circle_track(), SubApertureParameters(step_deg=5.0))
    assert len(sa) == 72
    assert len({sa.info(float(a)).stamp_ns for a in sa.aspects_rad}) == 72


def test_a_view_in_a_gap_of_the_track_is_refused_with_aspect_and_coverage():
    track = circle_track(keep=lambda d: not 80 < d < 110)
    sa = SubApertures(band_limited_image(), track)
    with pytest.raises(
        ViewError, match=r"track gap: the track covers 0% of the 12° aperture at aspect 95.0°"
    ):
        sa.view(95)
    with pytest.raises(
        ViewError, match=r"track gap: the track covers 67% .* aspect 78.0°; expected at least 75%"
    ):
        sa.view(78)
    assert np.isfinite(sa.view(76).pixels).any()
    lenient = SubApertures(band_limited_image(), track, SubApertureParameters(min_coverage=0.5))
    assert np.isfinite(lenient.view(78).pixels).any()
    with pytest.raises(ViewError, match="track gap"):
        SubApertures(band_limited_image(), track, SubApertureParameters(min_coverage=0.0)).view(95)


def test_a_band_that_the_pixels_fold_is_refused():
    grid = GroundGrid.centred(64, 64, 0.006)
    image = CoherentImage(np.zeros((64, 64), np.complex64), grid, acoustics())
    with pytest.raises(ParameterError, match=r"band reaches K = 560 rad/m .* 6 mm holds only 524 rad/m"):
        SubApertures(image, circle_track())
    wide = Acoustics(60e3, 60e3, 1500.0, 1)
    with pytest.raises(ParameterError, match="expected a pixel of at most"):
        SubApertures(CoherentImage(image.pixels, GroundGrid.centred(64, 64, SPACING_M), wide), circle_track())


def test_views_too_coarse_for_their_wedge_are_refused():
    """Pixels of 10 cm hold 31 rad/m to either side; the 12° wedge is 59 rad/m to either side wide."""
    with pytest.raises(ParameterError, match=r"spacing_m is 0.1"):
        SubApertures(band_limited_image(), circle_track(), SubApertureParameters(spacing_m=0.1)).view(0)


@pytest.mark.parametrize("name", ["none", "tukey", "taylor"])
def test_a_taper_is_symmetric_and_positive(name):
    window = taper_table(name)
    assert window == pytest.approx(window[::-1], abs=1e-6)
    assert window.min() >= 0.0
    assert window.max() == pytest.approx(1.0, abs=0.01)
    assert (window.min() == 1.0) == (name == "none")


def test_an_unknown_taper_is_refused():
    with pytest.raises(ParameterError, match=r"taper is 'hann'; expected one of: none, tukey, taylor"):
        taper_table("hann")


@pytest.mark.parametrize("name", ["tukey", "taylor"])
def test_a_tapered_view_has_the_energy_of_its_taper(name):
    image = band_limited_image()
    power = [
        np.nanmean(
            np.abs(SubApertures(image, circle_track(), SubApertureParameters(taper=t)).view(20).pixels) ** 2
        )
        for t in ("none", name)
    ]
    expected = float(np.mean(taper_table(name).astype(float) ** 2))
    assert power[1] / power[0] == pytest.approx(expected, rel=0.06)


def test_a_taper_lowers_the_cross_range_sidelobes_and_widens_the_main_lobe():
    def cut(taper):
        parameters = SubApertureParameters(aperture_deg=12.0, taper=taper, oversampling=4.0)
        amplitude = np.nan_to_num(
            np.abs(SubApertures(point_image((0.1, -0.05)), circle_track(), parameters).view(0).pixels)
        )
        row, _ = np.unravel_index(amplitude.argmax(), amplitude.shape)
        return amplitude[row] / amplitude.max()

    plain, taylor = cut("none"), cut("taylor")
    far = np.abs(np.arange(len(plain)) - plain.argmax()) > 12
    assert 20 * np.log10(taylor[far].max()) < 20 * np.log10(plain[far].max()) - 4
    assert response_width(taylor, 1.0) > 1.1 * response_width(plain, 1.0)


def test_a_size_that_does_not_transform_fast_gives_the_same_views():
    """A point on an image of prime size, which is padded, is where and what it is on a round one."""
    grid = GroundGrid.centred(331, 389, SPACING_M, (0.1, -0.05))
    big = point_image((0.12, -0.03), rows=400, cols=400)
    dv = round((big.grid.y_max_m - grid.y_max_m) / SPACING_M - 0.5)
    du = round((grid.x_min_m - big.grid.x_min_m) / SPACING_M - 0.5)
    grid = GroundGrid(
        331, 389, SPACING_M, float(big.grid.x_of_columns()[du]), float(big.grid.y_of_rows()[dv])
    )
    cropped = CoherentImage(big.pixels[dv : dv + 331, du : du + 389], grid, big.acoustics)
    parameters = SubApertureParameters(extent_m=0.8)
    a = SubApertures(big, circle_track(), parameters).view_of_aspect(0.6)
    b = SubApertures(cropped, circle_track(), parameters).view_of_aspect(0.6)
    # Both look at their own middle; compare at the same ground points, near the point.
    x, y = ground_of_pixels(a.info.camera)
    near = np.hypot(x - 0.12, y + 0.03) < 0.2
    at = b.info.camera.ground_to_pixel @ np.stack([x[near], y[near], np.ones(near.sum())])
    kx, ky = b.info.carrier_rad_m
    filled = scipy.ndimage.map_coordinates(b.pixels, [at[1], at[0]], order=3) * np.exp(
        1j * (kx * x[near] + ky * y[near])
    )
    truth = on_carrier(a)[near]
    assert normalised_rms(filled, truth, np.ones(truth.shape, bool)) < 0.08


def test_the_view_of_the_other_sign_is_that_of_the_opposite_aspect_turned_by_180_degrees():
    image = band_limited_image(1)
    claimed = CoherentImage(image.pixels, image.grid, acoustics(-1))
    other = SubApertures(claimed, circle_track(), sub_apertures(1).parameters)
    view = other.view_of_aspect(math.radians(33.0)).pixels
    turned = sub_apertures(1).view_of_aspect(math.radians(213.0)).pixels[::-1, ::-1]
    known = np.isfinite(view) & np.isfinite(turned)
    assert known.mean() > 0.3
    assert (np.isfinite(view) ^ np.isfinite(turned)).mean() < 0.01
    assert normalised_rms(np.abs(view), np.abs(turned), known) < 1e-3
