"""Simulated runs that several tests look at, made once."""

from __future__ import annotations

import hypothesis
import pytest
import trimesh

from csas_shadow_ros.simulation import Faults, simulate
from csas_shadow_ros.simulation.targets import box

# The same examples in every run: a failure is then the change's, not the draw's.
hypothesis.settings.register_profile("same", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("same")


def upright_cylinder(diameter_m, height_m):
    mesh = trimesh.creation.cylinder(radius=diameter_m / 2.0, height=height_m, sections=48)
    mesh.apply_translation([0.0, 0.0, height_m / 2.0])
    return mesh


@pytest.fixture(scope="session")
def post_run():
    """A thin post: what figure 5's arms are, the same from all sides."""
    return simulate("tiny", upright_cylinder(0.12, 0.5), seed=2, faults=Faults(contrast_db=20.0))


@pytest.fixture(scope="session")
def drum_run():
    """An upright cylinder in the middle: its shadow has the same outline in every view."""
    return simulate("tiny", upright_cylinder(0.4, 0.3), seed=4, faults=Faults(contrast_db=20.0))


@pytest.fixture(scope="session")
def box_run():
    return simulate("tiny", box(0.5, 0.3, 0.25), seed=3, position_m=(0.1, -0.15), heading_deg=25.0)


@pytest.fixture(scope="session")
def empty_run():
    return simulate("tiny", "empty", seed=11)
