"""Sectors on lattices of their own: what holds an arc's band gives the same sum, what does not is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import ducc0
import numpy as np
import pytest
from core_data import acoustics, band_limited_image, circle_track, nominal_grazing
from hypothesis import given, settings
from hypothesis import strategies as st

from csas_shadow_ros.core import reference
from csas_shadow_ros.core.errors import GeometryError, ParameterError
from csas_shadow_ros.core.geometry import GroundGrid, GroundLattice, ground_from_projection
from csas_shadow_ros.core.sectors.sector import Sector, scene_of, unfit
from csas_shadow_ros.core.sectors.streaming import SectorSum
from csas_shadow_ros.simulation.sectors import sectors_of_run

ARC = math.radians(20.0)
#: Middle of the band on the ground (rad/m), and its half width and half height at 20° with some to spare.
MIDDLE, HALF_ALONG, HALF_ACROSS = 466.0, 105.0, 105.0


@lru_cache(maxsize=8)
def arc_of_image(sign, aspect_deg):
    """Return the image of one arc on the scene's lattice, and its coefficients there."""
    image, aspect = band_limited_image(sign), math.radians(aspect_deg)
    pixels = reference.sub_aperture(image, aspect, ARC)
    whole = Sector(pixels.astype(np.complex64), image.grid, image.acoustics, 1, aspect, ARC)
    return whole, np.fft.fft2(pixels, norm="forward")


def sampled(sign, aspect_deg, lattice, carrier):
    """Return that arc sampled on any lattice: the sum of its coefficients there, divided by the carrier."""
    whole, values = arc_of_image(sign, aspect_deg)
    grid, to_ground = whole.grid, lattice.pixel_to_ground
    u, v = np.meshgrid(np.arange(lattice.cols), np.arange(lattice.rows))
    x, y = (row[0] * u + row[1] * v + row[2] for row in to_ground[:2])
    down, right = (grid.y_max_m - y) / grid.spacing_m, (x - grid.x_min_m) / grid.spacing_m
    found = ducc0.nufft.u2nu(
        grid=values.astype(complex),
        coord=np.stack([down.ravel(), right.ravel()], axis=1),
        forward=False,
        epsilon=1e-12,
        periodicity=[float(n) for n in grid.shape],
        fft_order=True,
    ).reshape(lattice.shape)
    pixels = (found * np.exp(-1j * (carrier[0] * x + carrier[1] * y))).astype(np.complex64)
    return replace(whole, pixels=pixels, grid=lattice, carrier_rad_m=carrier)


def turned_lattice(scene, turn_rad, step_m, guard):
    """Return the lattice at that turn, of (column, row) steps, with so many pixels beyond the scene."""
    left, right, bottom, top = scene.extent_m
    across, down = (
        np.array([math.cos(turn_rad), math.sin(turn_rad)]),
        np.array([math.sin(turn_rad), -math.cos(turn_rad)]),
    )
    sizes = []
    for way, step in zip((across, down), step_m, strict=True):
        reach = (right - left) * abs(way[0]) + (top - bottom) * abs(way[1])
        sizes.append(math.ceil(reach / step) + 2 * guard)
    cols, rows = sizes
    a, b = across * step_m[0], down * step_m[1]
    middle = np.array([(left + right) / 2.0, (bottom + top) / 2.0])
    origin = middle - a * (cols - 1) / 2.0 - b * (rows - 1) / 2.0
    return GroundLattice(rows, cols, tuple(map(float, origin)), tuple(map(float, a)), tuple(map(float, b)))


def spectrum_of(sector, scene):
    total = SectorSum(scene=scene)
    total.add(sector)
    return total.spectrum.values, total.margin_rad


def assert_same_sum(own, sign, aspect_deg, tolerance):
    whole, _ = arc_of_image(sign, aspect_deg)
    (expected, margin), (found, own_margin) = spectrum_of(whole, whole.grid), spectrum_of(own, whole.grid)
    assert own_margin == margin, "views wait no longer for it"
    error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
    assert error < tolerance


ASPECTS = st.sampled_from([0.0, 33.0, 90.0, 200.0])
SIGNS = st.sampled_from([1, -1])


@settings(max_examples=25, deadline=None)
@given(
    sign=SIGNS,
    aspect_deg=ASPECTS,
    rows=st.integers(92, 200),
    cols=st.integers(110, 240),
    off=st.tuples(st.floats(-12.0, 12.0), st.floats(-12.0, 12.0)),
)
def test_a_decimated_lattice_over_the_scene_gives_the_whole_lattices_spectrum(
    sign, aspect_deg, rows, cols, off
):
    whole, _ = arc_of_image(sign, aspect_deg)
    left, right, bottom, top = whole.grid.extent_m
    step_x, step_y = (right - left) / cols, (top - bottom) / rows
    lattice = GroundLattice(
        rows, cols, (left + step_x / 2.0, top - step_y / 2.0), (step_x, 0.0), (0.0, -step_y)
    )
    carrier = carrier_of(sign, aspect_deg, off)
    own = sampled(sign, aspect_deg, lattice, carrier)
    reach = np.abs(sign * band_of_arc(aspect_deg) - np.array(carrier)[:, None]).max(axis=1)
    if step_x * reach[0] <= math.pi and step_y * reach[1] <= math.pi:
        assert unfit(own, whole.grid) == ""
        assert_same_sum(own, sign, aspect_deg, 2e-6)


def band_of_arc(aspect_deg):
    """Return wavenumbers (kx, ky) round the arc's band on the ground, sign left out."""
    low, _, high = acoustics().ground_band(nominal_grazing())
    angles = math.radians(aspect_deg) + np.linspace(-ARC / 2.0, ARC / 2.0, 101)
    return np.concatenate([k * np.stack([np.cos(angles), np.sin(angles)]) for k in (low, high)], axis=1)


def carrier_of(sign, aspect_deg, off=(0.0, 0.0)):
    angle = math.radians(aspect_deg)
    return sign * MIDDLE * math.cos(angle) + off[0], sign * MIDDLE * math.sin(angle) + off[1]


@settings(max_examples=20, deadline=None)
@given(
    sign=SIGNS,
    aspect_deg=ASPECTS,
    turn_deg=st.floats(-30.0, 30.0),
    oblong=st.floats(0.8, 1.25),
)
def test_a_turned_lattice_gives_the_whole_lattices_spectrum(sign, aspect_deg, turn_deg, oblong):
    whole, _ = arc_of_image(sign, aspect_deg)
    # Along and across the arc, at twice what its band needs, with sixteen pixels beyond the scene.
    steps = tuple(math.pi / (2.0 * 1.4 * half) for half in (HALF_ALONG / oblong, HALF_ACROSS * oblong))
    lattice = turned_lattice(whole.grid, math.radians(aspect_deg + turn_deg), steps, 16)
    own = sampled(sign, aspect_deg, lattice, carrier_of(sign, aspect_deg))
    assert unfit(own, whole.grid) == ""
    assert_same_sum(own, sign, aspect_deg, 5e-6)


@settings(max_examples=40, deadline=None)
@given(
    sign=SIGNS, aspect_deg=st.floats(0.0, 360.0), turn_deg=st.floats(0.0, 360.0), coarse=st.floats(1.1, 3.0)
)
def test_a_lattice_that_does_not_hold_its_band_is_refused_with_one_line(sign, aspect_deg, turn_deg, coarse):
    scene = band_limited_image(sign).grid
    carrier = carrier_of(sign, aspect_deg)
    across = np.array([math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))])
    # The finest pixel that folds, and a tenth more: the track's mean grazing angle is not the sector's.
    reach = np.abs(across @ (sign * band_of_arc(aspect_deg) - np.array(carrier)[:, None])).max()
    lattice = turned_lattice(scene, math.radians(turn_deg), (coarse * math.pi / reach, 0.004), 2)
    blank = np.zeros(lattice.shape, np.complex64)
    folded = Sector(blank, lattice, acoustics(sign), 5, math.radians(aspect_deg), ARC, carrier)
    with pytest.raises(
        GeometryError, match=r"^sector at 5 ns: .* fold the band .*; expected at most"
    ) as error:
        SectorSum(scene=scene).add(folded, nominal_grazing())
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_circle_on_own_lattices_needs_no_lattice_of_the_scene_and_no_order(sign):
    image, track = band_limited_image(sign), circle_track(start_deg=33.0)
    own = [sector for sector, _ in sectors_of_run(image, track, 12.0, "own")]
    assert len({sector.grid.shape for sector in own}) > 3, "each its own"
    sums = [SectorSum(), SectorSum()]
    for total, order in zip(sums, (own, own[::-1]), strict=True):
        for sector in order:
            total.add(sector)
    a, b = sums
    assert a.arcs.whole
    assert a.margin_rad < 1e-3
    assert a.frame.grid.shape == b.frame.grid.shape
    np.testing.assert_allclose(
        a.spectrum.values, b.spectrum.values, atol=1e-6 * np.abs(a.spectrum.values).max()
    )
    known = SectorSum(scene=image.grid)
    for sector in own:
        known.add(sector)
    error = np.abs(known.image().pixels - image.pixels).max()
    assert error < 1e-5 * np.abs(image.pixels).max()


def test_a_sector_of_its_own_size_adds_to_an_image_that_is_padded_too():
    # 7 · 41 rows and 383 columns transform slowly: their spectrum is that of a larger image.
    image = band_limited_image(1, rows=287, cols=383)
    track = circle_track()
    sums = []
    for lattice in ("image", "own"):
        total = SectorSum(scene=image.grid)
        for sector, _ in sectors_of_run(image, track, 30.0, lattice):
            total.add(sector)
        sums.append(total.spectrum.values)
    assert sums[0].shape != image.grid.shape
    assert np.linalg.norm(sums[1] - sums[0]) < 1e-5 * np.linalg.norm(sums[0])


def test_the_scene_that_own_lattices_tell_of_holds_the_band_over_the_same_ground():
    image = band_limited_image()
    sector = next(s for s, _ in sectors_of_run(image, circle_track(), 12.0, "own"))
    scene = scene_of(sector)
    np.testing.assert_allclose(scene.extent_m, image.grid.extent_m, atol=scene.spacing_m)
    assert math.pi / scene.spacing_m >= acoustics().ground_band(0.0)[2] * (1 - 1e-12)
    whole = next(s for s, _ in sectors_of_run(image, circle_track(), 12.0))
    assert scene_of(whole) is whole.grid


def test_own_lattices_take_less_than_the_image_and_an_unknown_lattice_is_refused():
    image = band_limited_image()
    own = sum(s.pixels.nbytes for s, _ in sectors_of_run(image, circle_track(), 12.0, "own"))
    assert own < 2 * image.pixels.nbytes
    with pytest.raises(ParameterError, match="sector lattice is 'round'; expected one of: image, own"):
        next(sectors_of_run(image, circle_track(), 12.0, "round"))


def test_a_projection_that_is_turned_reads_back_and_one_that_is_no_map_is_refused():
    scene = band_limited_image().grid
    lattice = turned_lattice(scene, 0.4, (0.013, 0.021), 3)
    back = ground_from_projection(lattice.projection, *lattice.shape)
    assert isinstance(back, GroundLattice)
    np.testing.assert_allclose(back.pixel_to_ground, lattice.pixel_to_ground, rtol=1e-12, atol=1e-12)
    assert isinstance(ground_from_projection(scene.projection, *scene.shape), GroundGrid)
    mirrored = lattice.projection
    mirrored[0] *= -1.0
    with pytest.raises(GeometryError, match="mirrored"):
        ground_from_projection(mirrored, *lattice.shape)
    tilted = lattice.projection
    tilted[2, 0] = 0.1
    with pytest.raises(GeometryError, match="expected an orthographic map"):
        ground_from_projection(tilted, *lattice.shape)
    with pytest.raises(GeometryError, match="expected two directions"):
        GroundLattice(4, 4, (0.0, 0.0), (0.1, 0.0), (0.2, 0.0))


@pytest.mark.parametrize("size_m", [200.0, 1e5, 1e9])
def test_a_small_sector_that_tells_of_a_huge_scene_is_refused_at_once(size_m):
    lattice = GroundLattice(60, 70, (0.0, 0.0), (size_m / 70, 0.0), (0.0, -size_m / 60))
    # A band so narrow that those pixels hold it.
    narrow = replace(acoustics(), bandwidth_hz=1e-9)
    aspect, arc = 0.0, 1e-12
    carrier = (narrow.ground_band(nominal_grazing())[1], 0.0)
    blank = np.zeros(lattice.shape, np.complex64)
    with pytest.raises(GeometryError, match=r"^sector at 5 ns: it covers .* pixels; expected at most"):
        SectorSum().add(Sector(blank, lattice, narrow, 5, aspect, arc, carrier))
