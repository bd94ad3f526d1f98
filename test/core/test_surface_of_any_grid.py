"""The surface of any grid at all is closed, and of one piece with its voxels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from csas_shadow_ros.core.shape.mesh import _march_tetrahedra, mesh_from_grid, surface_field
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid


def random_grid(
    seed: int, shape: tuple[int, int, int], share: float, kind: str, threshold: float
) -> VoxelGrid:
    rng = np.random.default_rng(seed)
    volume = Volume((1.0, -2.0, 0.05), 0.1, shape)
    occupied = rng.random(shape) < share
    occupied[tuple(rng.integers(0, n) for n in shape)] = True
    if kind == "two-valued":
        likelihood = np.where(occupied, 0.0, 1.0)
    else:
        likelihood = rng.random(shape)
        if kind == "unknown":
            likelihood[rng.random(shape) < 0.3] = np.nan
    return VoxelGrid(volume, likelihood.astype(np.float32), np.ones(shape, np.uint16), threshold, occupied)


def check_closed(grid: VoxelGrid) -> None:
    mesh = mesh_from_grid(grid)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    voxel = grid.volume.voxel_size_m
    bodies = float(np.count_nonzero(grid.occupied)) * voxel**3
    # It ends within a voxel of the centres: a cube of eight voxels round each.
    assert 0.0 < mesh.volume < 8.0 * bodies
    low = np.asarray(grid.volume.origin_m) - voxel
    assert (mesh.bounds[0] >= low).all()
    assert (mesh.bounds[1] <= low + (np.array(grid.volume.shape[::-1]) + 1) * voxel).all()


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    shape=st.tuples(*[st.integers(1, 7)] * 3),
    share=st.floats(0.0, 1.0),
    kind=st.sampled_from(["two-valued", "any", "unknown"]),
    threshold=st.sampled_from([0.0, 1e-6, 0.03, 0.3, 0.5, 1.0, float("nan")]),
)
def test_the_surface_of_any_grid_is_closed(seed, shape, share, kind, threshold):
    check_closed(random_grid(seed, shape, share, kind, threshold))


@pytest.mark.parametrize("seed", range(60))
def test_the_surface_of_a_random_two_valued_grid_is_closed(seed):
    check_closed(random_grid(seed, (6, 6, 6), 0.5, "two-valued", 0.3))


@pytest.mark.parametrize("seed", range(20))
def test_tetrahedra_leave_every_voxel_on_its_side(seed):
    # Voxels that meet at a corner or an edge alone are what cubes leave open.
    grid = random_grid(seed, (4, 5, 6), 0.4, "two-valued", 0.3)
    vertices, faces = _march_tetrahedra(surface_field(grid))
    corners = vertices[faces] - (1.0, 1.0, 1.0)  # the padding
    nodes = np.argwhere(np.ones(grid.volume.shape, bool))[:, ::-1].astype(float)  # (x, y, z)
    a, b, c = (corners[None, :, i] - nodes[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    triple = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
    below = (
        la * lb * lc
        + np.einsum("ijk,ijk->ij", a, b) * lc
        + np.einsum("ijk,ijk->ij", b, c) * la
        + np.einsum("ijk,ijk->ij", c, a) * lb
    )
    winding = np.arctan2(triple, below).sum(axis=1) / (2 * np.pi)
    assert winding == pytest.approx(grid.occupied.ravel().astype(float), abs=1e-6)
