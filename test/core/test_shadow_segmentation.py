"""The target's shadow is found whole, wherever in the view it leads."""

from __future__ import annotations

import numpy as np
import pytest
from core_data import make_view
from scipy import ndimage

from csas_shadow_ros.core.imaging.likelihood import view_levels
from csas_shadow_ros.core.imaging.segmentation import dark_pixels, segment_shadow

SIZE = 400
MIDDLE = SIZE // 2
WIDTH = 24

#: Bands of shadow (rows, columns), all of which hang together; the target is in the middle.
BANDS = {
    "none": [],
    "short": [(MIDDLE, MIDDLE + 60, MIDDLE - 12, MIDDLE + 12)],
    "to the far edge": [(MIDDLE, SIZE, MIDDLE - 12, MIDDLE + 12)],
    "aside to the left edge and up to the top": [
        (MIDDLE, MIDDLE + 30, 0, MIDDLE + 12),
        (0, MIDDLE + 30, 0, WIDTH),
    ],
    "aside to the right, down and back": [
        (MIDDLE, MIDDLE + 30, MIDDLE - 12, SIZE - 20),
        (MIDDLE, SIZE - 40, SIZE - 20 - WIDTH, SIZE - 20),
        (SIZE - 40 - WIDTH, SIZE - 40, 60, SIZE - 20),
    ],
}


def drawn(bands):
    shadow = np.zeros((SIZE, SIZE), bool)
    for top, bottom, left, right in bands:
        shadow[top:bottom, left:right] = True
    return shadow


@pytest.mark.parametrize("bands", BANDS.values(), ids=BANDS.keys())
def test_a_shadow_that_leads_away_from_the_target_is_found_to_its_end(bands):
    shadow, away = drawn(bands), drawn([(20, 20 + WIDTH, MIDDLE, SIZE)])
    amplitude = np.random.default_rng(3).rayleigh(1.0, shadow.shape).astype(np.float32)
    amplitude[shadow | away] *= 0.05
    view = make_view(amplitude)
    target = view.info.camera.pixel_to_ground @ np.array([MIDDLE, MIDDLE, 1.0])
    x, y = target[:2] / target[2]
    mask = segment_shadow(view, (x, y), reach_m=10 * view.info.camera.spacing_m[1])
    found = mask.pixels == 255
    assert found[ndimage.binary_erosion(shadow, iterations=4)].all()
    assert not found[~ndimage.binary_dilation(shadow, iterations=6)].any()
    # To the pixel it is what hangs together of all that is dark in the view.
    label, _ = ndimage.label(dark_pixels(view_levels(view)), np.ones((3, 3)))
    kept = set(np.unique(label[shadow])) - {0}
    np.testing.assert_array_equal(found, np.isin(label, list(kept)))
