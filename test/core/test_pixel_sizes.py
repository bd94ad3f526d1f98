"""Views of finer pixels show the same scene: every threshold is one of resolution cells."""

from __future__ import annotations

import pytest

from csas_shadow_ros.core.parameters import PipelineParameters, SubApertureParameters
from csas_shadow_ros.core.pipeline import run
from csas_shadow_ros.simulation import simulate

CELL_M = 0.0644  # of the tiny profile, across


def measured(simulated, oversampling):
    views = SubApertureParameters(step_deg=10.0, oversampling=oversampling)
    found = run(simulated.image, simulated.track, PipelineParameters(sub_aperture=views)).dimensions
    assert found is not None
    return found


@pytest.mark.parametrize(("target", "seed"), [("box", 1), ("l_shape", 2)])
def test_extents_are_the_same_whatever_the_pixel(target, seed):
    simulated = simulate("tiny", target, seed=seed)
    coarse, fine = (measured(simulated, oversampling) for oversampling in (1.5, 4.0))
    for name in ("length_m", "width_m"):
        # A pixel of the coarser view.
        assert getattr(fine, name) == pytest.approx(getattr(coarse, name), abs=CELL_M / 1.5), name
    # Down-range a cell is half as long, and tells a height of tan of the grazing angle of it.
    assert fine.height_m == pytest.approx(coarse.height_m, abs=CELL_M)
