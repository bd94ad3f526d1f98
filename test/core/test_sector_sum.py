"""Sectors: images of arcs at baseband that add up to the full-circle image."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from core_data import acoustics, band_limited_image, normalised_rms

from csas_shadow_ros.core import reference
from csas_shadow_ros.core.errors import GeometryError
from csas_shadow_ros.core.geometry import GroundGrid
from csas_shadow_ros.core.sectors.sector import Sector, image_from_sectors


def sectors_of(image, n):
    width = 2 * math.pi / n
    x, y = np.meshgrid(image.grid.x_of_columns(), image.grid.y_of_rows())
    out = []
    for i in range(n):
        aspect = (i + 0.5) * width
        carrier = 466.0 * image.acoustics.spectrum_sign * np.array([math.cos(aspect), math.sin(aspect)])
        pixels = reference.sub_aperture(image, aspect, width) * np.exp(
            -1j * (carrier[0] * x + carrier[1] * y)
        )
        pixels = pixels.astype(np.complex64)
        out.append(Sector(pixels, image.grid, image.acoustics, 1000 + i, aspect, width, tuple(carrier)))
    return out


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("n", [1, 7])
def test_sectors_put_back_on_their_carriers_sum_to_the_image(sign, n):
    image = band_limited_image(sign)
    total = image_from_sectors(iter(sectors_of(image, n)))
    assert normalised_rms(total.pixels, image.pixels, np.ones(image.grid.shape, bool)) < 1e-5
    assert total.grid == image.grid
    assert total.acoustics == image.acoustics
    assert total.stamp_ns == 1000 + n - 1


def test_a_sector_that_comes_twice_counts_once_and_none_is_changed():
    image = band_limited_image()
    sectors = sectors_of(image, 3)
    before = sectors[0].pixels.copy()
    once, twice = image_from_sectors(sectors), image_from_sectors([*sectors, *sectors])
    assert np.array_equal(once.pixels, twice.pixels)
    assert np.array_equal(sectors[0].pixels, before)


def test_sectors_of_different_grids_or_bands_are_refused():
    image = band_limited_image()
    first, second, _ = sectors_of(image, 3)
    grid = image.grid
    shifted = GroundGrid(grid.rows, grid.cols, grid.spacing_m, grid.x_min_m + 0.01, grid.y_max_m)
    with pytest.raises(GeometryError, match=r"it covers x = .*; expected all of the scene, x = -0\.86 to"):
        image_from_sectors([first, replace(second, grid=shifted)])
    with pytest.raises(GeometryError, match="another band"):
        image_from_sectors([first, replace(second, acoustics=acoustics(-1))])
    with pytest.raises(GeometryError, match="no sectors"):
        image_from_sectors([])
    with pytest.raises(GeometryError, match="sector has"):
        replace(first, pixels=first.pixels[1:])
