"""What is loaded ahead is what a run then uses: the first view has nothing left to wait for."""

from __future__ import annotations

import subprocess
import sys

import pytest

STAGES = {
    "composites": ("warm_composites()", "composites"),
    "enhancement": ("warm_enhancement()", "shadow"),
    "likelihood": ("warm_likelihood()", "segmentation"),
    "carving": ("warm_carving()", "carving"),
    "soft carving": ("warm_carving(CarvingParameters(method='soft'))", "carving"),
    "sub-apertures": ("warm_sub_apertures()", "streaming"),
}


@pytest.mark.parametrize("stage", STAGES)
def test_each_stage_warms_up_and_calls_its_kernels(stage: str) -> None:
    call, module = STAGES[stage]
    code = f"""
import sys
from csas_shadow_ros.core.parameters import CarvingParameters
from csas_shadow_ros.core import warm
warm.{call}
import numba
m = sys.modules["csas_shadow_ros.core.{module}"]
kernels = [k for k in vars(m).values() if isinstance(k, numba.core.dispatcher.Dispatcher)]
print(sum(bool(k.signatures) for k in kernels), "trimesh" in sys.modules)
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    called, trimesh = told.split()
    assert int(called) > 0
    assert (trimesh == "True") == ("carving" in stage)
