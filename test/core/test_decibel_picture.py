"""Pictures in decibels."""

from __future__ import annotations

import numpy as np
import pytest

from csas_shadow_ros.core.imaging.display import HIGHEST_DB, LOWEST_DB, decibel_picture


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_a_picture_is_linear_in_decibels_over_the_median_whatever_the_scale(scale: float) -> None:
    levels_db = np.arange(LOWEST_DB - 5.0, HIGHEST_DB + 6.0)
    # As many at 0 dB that this is the median.
    amplitude = np.concatenate((10.0 ** (levels_db / 20.0), np.ones(2 * levels_db.size)))[None, :] * scale
    picture = decibel_picture(amplitude)[0, : levels_db.size].astype(float)
    expected = 1.0 + 254.0 * (np.clip(levels_db, LOWEST_DB, HIGHEST_DB) - LOWEST_DB) / (
        HIGHEST_DB - LOWEST_DB
    )
    assert np.abs(picture - expected).max() <= 0.51


def test_what_is_not_known_is_black_and_what_is_dark_is_not_quite() -> None:
    view = np.array([[np.nan, 0.0], [1.0, 1.0]], np.float32)
    assert decibel_picture(view)[0].tolist() == [0, 1]
    assert not decibel_picture(np.full((2, 3), np.nan)).any()
    assert decibel_picture(np.zeros((2, 3))).tolist() == [[1] * 3] * 2


def test_a_seabed_of_speckle_and_its_shadow_are_told_apart_by_the_eye() -> None:
    rng = np.random.default_rng(1)
    amplitude = rng.rayleigh(1.0, (200, 200))
    amplitude[80:120, 80:120] *= 10.0 ** (-12.0 / 20.0)
    amplitude[0, 0] = 300.0  # an echo, beside which the whole seabed is black from minimum to maximum
    picture = decibel_picture(amplitude)
    linear = 255.0 * amplitude / amplitude.max()
    shadow = np.zeros(picture.shape, bool)
    shadow[80:120, 80:120] = True
    assert picture[~shadow].mean() - picture[shadow].mean() > 60.0
    assert linear[~shadow].mean() - linear[shadow].mean() < 2.0
