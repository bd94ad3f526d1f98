"""What hides a point from the sonar, by either tracer; and who asks for one at all."""

from __future__ import annotations

import importlib.util
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from csas_shadow_ros.simulation import occlusion
from csas_shadow_ros.simulation.targets import box

ROOT = Path(__file__).resolve().parents[2]
needs_embree = pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="embreex is missing")
TRACERS = [
    pytest.param(occlusion.embree_tracer, marks=needs_embree, id="embree"),
    pytest.param(occlusion.plain_tracer, id="plain"),
]


def rays(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Return rays upwards from seabed round a box, in directions of grazing sonars."""
    rng = np.random.default_rng(5)
    origins = np.column_stack([rng.uniform(-1.2, 1.2, (count, 2)), np.zeros(count)])
    aspect = rng.uniform(0.0, 2.0 * math.pi, count)
    directions = np.column_stack([np.cos(aspect), np.sin(aspect), np.full(count, 0.4)])
    return origins, directions / np.linalg.norm(directions, axis=1)[:, None]


def meets_box(origins: np.ndarray, directions: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Tell by slabs which rays meet a box, and NaN-free: no direction here has a zero component."""
    near, far = (low - origins) / directions, (high - origins) / directions
    enters, leaves = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    return (enters < leaves) & (leaves > 0.0)


@pytest.mark.parametrize("make", TRACERS)
def test_a_tracer_finds_what_the_slabs_of_a_box_hide(make) -> None:
    mesh = box()
    origins, directions = rays()
    low, high = np.asarray(mesh.bounds)
    outside = np.any((origins < low - 0.01) | (origins > high + 0.01), axis=1)
    expected = meets_box(origins, directions, low, high)[outside]
    assert 20 < expected.sum() < len(expected) - 20
    told = make(np.asarray(mesh.triangles))(origins[outside], directions[outside])
    np.testing.assert_array_equal(told, expected)


@pytest.mark.parametrize("make", TRACERS)
def test_no_rays_meet_nothing(make) -> None:
    assert make(np.asarray(box().triangles))(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)


@needs_embree
@pytest.mark.parametrize("target", ["rock", "frame_grid"])
def test_the_same_is_seen_where_embree_is_missing(target: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from csas_shadow_ros.simulation.scene import SceneModel
    from csas_shadow_ros.simulation.targets import make_scene

    def visible() -> np.ndarray:
        model = SceneModel(
            make_scene(target),
            seed=1,
            echo_db=12.0,
            scatterer_spacing_m=0.02,
            cable_db=10.0,
            cell_m=(0.05, 0.05),
        )
        return model._visible(np.array([20.0, 3.0, 6.0]))[0]

    usual = visible()
    for name in ("embreex", "embreex.mesh_construction"):
        monkeypatch.setitem(sys.modules, name, None)
    # Points beside a ray that grazes an edge may differ: one in two hundred at most.
    points, before = ({tuple(p) for p in found} for found in (visible(), usual))
    assert len(before) > 100
    assert len(points ^ before) <= len(before) / 200


BLOCKED = """
import sys
class Refuse:
    def find_spec(self, name, *_):
        if name.split(".")[0] in ("embreex",):
            raise ImportError(name + " is not to be imported")
sys.meta_path.insert(0, Refuse())
from csas_shadow_ros.cli import main
status = main(sys.argv[1:])
sys.exit(status)
"""


@pytest.mark.parametrize(
    "arguments",
    [
        ("--help",),
        ("run", "--help"),
        ("info", "{bag}"),
        ("run", "{bag}", "--out", "{out}", "--no-figures", "--step-deg", "30"),
    ],
    ids=lambda a: " ".join(a[:2]),
)
def test_the_command_line_runs_where_embree_is_missing(arguments, tmp_path: Path) -> None:
    filled = [a.format(bag=ROOT / "bags" / "demo", out=tmp_path / "out") for a in arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED, *filled], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
