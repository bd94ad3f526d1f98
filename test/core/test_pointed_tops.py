"""Pointed tops: views lose a tip of a cell or two, and the interval says so."""

from __future__ import annotations

import pytest

from csas_shadow_ros.core.parameters import PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import run
from csas_shadow_ros.simulation import simulate
from csas_shadow_ros.simulation.bodies import frustum
from csas_shadow_ros.simulation.profiles import Faults


@pytest.mark.parametrize(("wide_m", "high_m", "seed"), [(0.3, 0.3, 2), (0.3, 0.2, 1)])
def test_the_height_s_interval_of_a_cone_holds_its_point(wide_m, high_m, seed):
    """Without the point it ends at 0.28 and 0.19 m."""
    made = simulate("small", frustum(wide_m, 0.0, high_m), seed=seed, faults=Faults(contrast_db=12.0))
    coarse = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=6.0))
    found = run(made.image, made.track, coarse).dimensions
    low, high = found.intervals["height_m"]
    assert low <= high_m <= high
    assert low > 0.4 * high_m
    assert high < 1.4 * high_m


def test_the_height_s_interval_of_a_drum_is_not_widened():
    made = simulate("small", frustum(0.3, 0.3, 0.2), seed=1, faults=Faults(contrast_db=12.0))
    coarse = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=6.0))
    found = run(made.image, made.track, coarse).dimensions
    low, high = found.intervals["height_m"]
    assert high - found.height_m == pytest.approx(found.height_m - low, abs=1e-9)
