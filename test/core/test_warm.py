"""What is loaded ahead is what a run then uses: the first view has nothing left to wait for."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

STAGES = {
    "composites": ("warm_composites()", "imaging.composites"),
    "enhancement": ("warm_enhancement()", "imaging.enhancement"),
    "likelihood": ("warm_likelihood()", "imaging.segmentation"),
    "carving": ("warm_carving()", "shape.carving"),
    "soft carving": ("warm_carving(CarvingParameters(method='soft'))", "shape.carving"),
    "sub-apertures": ("warm_sub_apertures()", "sectors.streaming"),
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


#: Runs a bag after everything was called once, and tells what had to be compiled or loaded besides.
RUN = """
import json, sys
from pathlib import Path
from csas_shadow_ros.core import kernels
from csas_shadow_ros.core.warm import warm_all
from csas_shadow_ros.parameter_file import pipeline_parameters
from csas_shadow_ros.run_bag import process_bag
from csas_shadow_ros.simulation.warm import warm_simulation

warm_all()
warm_simulation()
given = {k: set(k.signatures) for k in kernels.KERNELS}
out = Path(sys.argv[2])
coarse = dict(step_deg=15.0, min_views_fraction=0.1)
runs = [(sys.argv[1], "auto", {}), (sys.argv[3], "auto", {})]
runs += [(str(out / "0" / "result.mcap"), "shadow", {})]
silhouettes = dict(target="given", size_m=(1.2, 1.0, 0.6))
runs += [(str(out / "0" / "result.mcap"), "shadow_mask", silhouettes)]
runs += [(str(out / "0" / "result.mcap"), "likelihood", dict(silhouettes, method="soft"))]
for number, (bag, stage, more) in enumerate(runs):
    parameters = pipeline_parameters({**coarse, **more})
    process_bag(bag, out / str(number), parameters, start_from=stage, figures=False)
late = {k.py_func.__name__: str(set(k.signatures) - given.get(k, set())) for k in kernels.KERNELS}
late = {name: new for name, new in late.items() if new != "set()"}
print(json.dumps([len(given), late]))
"""


def test_after_warming_up_no_run_has_anything_left_to_compile(tiny_box_bag, tmp_path: Path) -> None:
    from csas_shadow_ros.simulation import simulate_bag

    sectors = tmp_path / "sectors"
    simulate_bag(sectors, "tiny", "box", sectors_deg=30.0)
    command = [sys.executable, "-c", RUN, tiny_box_bag.path, tmp_path / "out", sectors]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    known, late = json.loads(done.stdout.splitlines()[-1])
    assert known > 30
    assert late == {}
