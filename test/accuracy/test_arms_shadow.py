"""Figure 5 of the paper as a measurement: the thin arms' shadows show with enhancement and not without.

Seen nearly along them, the arms of the frame (8 cm thick, 30 cm above the seabed) cast shadows that are as
narrow and lie 1.2 to 1.7 m behind the target, where an aperture of 12° blurs them to three times their
width.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.ndimage

from csas_shadow_ros.core.geometry import ShadowCamera, View
from csas_shadow_ros.core.imaging.enhancement import enhance
from csas_shadow_ros.core.imaging.subaperture import SubApertures
from csas_shadow_ros.core.parameters import ShadowParameters, SubApertureParameters
from csas_shadow_ros.simulation import simulate
from csas_shadow_ros.simulation.raster import fill_triangles

TARGET = (0.0, 0.0)
ASPECTS_DEG = (20.0, 160.0, 200.0, 340.0)
#: A shadow is told from speckle by eye when it is about 6 dB under the seabed.
VISIBLE_DB = 6.0


@pytest.fixture(scope="session")
def run():
    return simulate("standard", "frame", seed=1)


def cast(bodies, camera: ShadowCamera) -> np.ndarray:
    """Mask of the pixels in the true shadow of some bodies."""
    mask = np.zeros(camera.shape, np.uint8)
    for body in bodies:
        fill_triangles(camera.project(body.triangles), mask)
    return mask.astype(bool)


def contrast_db(view: View, bodies) -> float:
    """Level of the lit seabed round the target's shadow over that in the arms' own shadow."""
    camera = view.info.camera
    pixel = camera.spacing_m[0]
    arms = [b for b in bodies if b.bounds[0, 2] > 0.05]
    parts = [b for b in bodies if b.bounds[0, 2] <= 0.05]
    assert (len(arms), len(parts)) == (2, 2)
    everything = cast(bodies, camera)
    behind = view.info.down_range_of_rows()[:, None] > 0.6
    core = scipy.ndimage.binary_erosion(cast(arms, camera) & ~cast(parts, camera)) & behind
    near = scipy.ndimage.binary_dilation(everything, iterations=round(0.35 / pixel))
    lit = near & ~scipy.ndimage.binary_dilation(everything, iterations=round(0.04 / pixel)) & behind
    assert core.sum() > 20
    power = np.square(view.pixels)
    return float(10 * np.log10(np.nanmean(power[lit]) / np.nanmean(power[core])))


def test_the_arms_of_the_frame_cast_visible_shadows_with_enhancement_and_not_without(run):
    bodies = run.truth.target.split(only_watertight=False)
    wide = SubApertures(run.image, run.track)
    reduced = SubApertures(
        run.image, run.track, SubApertureParameters(aperture_deg=4.0), spectrum=wide.spectrum
    )
    off = ShadowParameters(enhancement="none")
    levels = {"enhanced": [], "plain": [], "reduced": []}
    for aspect in np.radians(ASPECTS_DEG):
        view = wide.view_of_aspect(float(aspect))
        levels["enhanced"].append(contrast_db(enhance(view, TARGET), bodies))
        levels["plain"].append(contrast_db(enhance(view, TARGET, off), bodies))
        narrow = reduced.view_of_aspect(float(aspect))
        levels["reduced"].append(contrast_db(enhance(narrow, TARGET, off), bodies))
    mean = {name: math.fsum(values) / len(values) for name, values in levels.items()}
    assert mean["enhanced"] > VISIBLE_DB, mean
    assert mean["plain"] < VISIBLE_DB - 2.0, mean
    assert mean["enhanced"] > mean["reduced"] + 1.0, mean
