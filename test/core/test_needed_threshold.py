"""The threshold that a voxel needs, against the voxels that a threshold leaves."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage

from csas_shadow_ros.core.shape.threshold import needed_threshold, occupied_voxels


@pytest.mark.parametrize("method", ["consensus", "hard", "soft"])
@pytest.mark.parametrize("partly_seen", [False, True])
def test_it_gives_the_object_of_every_threshold_but_for_stray_pieces(method: str, partly_seen: bool) -> None:
    rng = np.random.default_rng(3)
    smooth = scipy.ndimage.gaussian_filter(rng.random((12, 20, 20)), 2)
    likelihood = ((smooth - smooth.min()) / np.ptp(smooth)).astype(np.float32)
    likelihood[rng.random(likelihood.shape) < 0.05] = np.nan
    seen = rng.random(likelihood.shape) < 0.8 if partly_seen else None
    needed = needed_threshold(likelihood, method, seen)
    for threshold in (0.1, 0.3, 0.5, 0.8):
        body = needed < np.float32(threshold)
        labels, count = scipy.ndimage.label(body, np.ones((3, 3, 3), bool))
        sizes = np.bincount(labels.ravel(), minlength=count + 1)
        sizes[0] = 0
        kept = (sizes >= 0.05 * sizes.max())[labels] & body if sizes.max() >= 27 else np.zeros_like(body)
        np.testing.assert_array_equal(kept, occupied_voxels(likelihood, threshold, method, seen))
