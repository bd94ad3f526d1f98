"""The object's surface: closed, outward, where and as large as its voxels."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import trimesh

from csas_shadow_ros.core.errors import NoTargetError
from csas_shadow_ros.core.shape.mesh import measure, mesh_from_grid
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid


def grid_of(inside, volume, *, soft=False, threshold=0.3):
    """Return the grid of a body; `soft` gives it the smooth likelihood that carving leaves."""
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    depth = inside(x, y, z)
    if soft:
        likelihood = np.clip(threshold - depth / volume.voxel_size_m * 0.15, 0, 1)
    else:
        likelihood = np.where(depth > 0, 0.0, 2 * threshold)
    likelihood = likelihood.astype(np.float32)
    return VoxelGrid(
        volume, likelihood, np.full(volume.shape, 9, np.uint16), threshold, likelihood < threshold
    )


def ball(x, y, z):
    return 0.3 - np.sqrt((x - 1.0) ** 2 + (y + 2.0) ** 2 + (z - 0.4) ** 2)


def turned_box(heading, length=0.8, width=0.3, height=0.4, centre=(0.2, -0.1)):
    c, s = math.cos(heading), math.sin(heading)

    def inside(x, y, z):
        a = c * (x - centre[0]) + s * (y - centre[1])
        b = -s * (x - centre[0]) + c * (y - centre[1])
        return np.minimum.reduce([length / 2 - np.abs(a), width / 2 - np.abs(b), height - z])

    return inside


BALL_VOLUME = Volume.around((1.0, -2.0), (0.9, 0.9, 0.9), 0.02)
BOX_VOLUME = Volume.around((0.2, -0.1), (1.1, 1.1, 0.6), 0.02)


@pytest.mark.parametrize("soft", [False, True])
def test_a_ball_is_closed_outward_in_its_place_and_of_its_volume(soft):
    mesh = mesh_from_grid(grid_of(ball, BALL_VOLUME, soft=soft))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 0.3**3, rel=0.05)
    outward = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center - (1.0, -2.0, 0.4))
    assert (outward > 0).mean() > 0.99
    assert mesh.center_mass == pytest.approx((1.0, -2.0, 0.4), abs=0.002)
    assert mesh.bounds == pytest.approx(np.array([[0.7, -2.3, 0.1], [1.3, -1.7, 0.7]]), abs=0.02)


@pytest.mark.parametrize("heading_deg", [0.0, 17.0, 45.0, 90.0, 130.0, 179.0])
def test_a_turned_box_has_its_dimensions_within_a_voxel_and_its_heading(heading_deg):
    grid = grid_of(turned_box(math.radians(heading_deg)), BOX_VOLUME, soft=True)
    mesh = mesh_from_grid(grid)
    assert mesh.is_watertight
    d = measure(mesh)
    assert d.length_m == pytest.approx(0.8, abs=0.02)
    assert d.width_m == pytest.approx(0.3, abs=0.02)
    assert d.height_m == pytest.approx(0.4, abs=0.02)
    assert d.volume_m3 == pytest.approx(0.8 * 0.3 * 0.4, rel=0.05)
    assert d.position_m == pytest.approx((0.2, -0.1), abs=0.01)
    off = math.degrees(d.heading_rad) - heading_deg
    assert abs((off + 90) % 180 - 90) < 1.5
    assert 0 <= d.heading_rad < math.pi


def test_an_object_on_the_seabed_is_closed_at_z_zero():
    mesh = mesh_from_grid(grid_of(turned_box(0.3), BOX_VOLUME))
    assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)


def test_an_object_that_fills_its_volume_to_every_side_is_closed():
    volume = Volume.around((0.0, 0.0), (0.2, 0.3, 0.1), 0.05)
    grid = grid_of(lambda x, y, z: np.ones(x.shape), volume)
    mesh = mesh_from_grid(grid)
    assert mesh.is_watertight
    # Marching cubes bevels edges and corners of so small a block.
    assert mesh.extents == pytest.approx((0.2, 0.3, 0.1), abs=1e-6)
    assert mesh.volume == pytest.approx(0.006, rel=0.25)


def test_a_single_voxel_is_an_object():
    volume = Volume.around((0.0, 0.0), (0.5, 0.5, 0.5), 0.1)
    occupied = np.zeros(volume.shape, bool)
    occupied[2, 2, 2] = True
    likelihood = np.where(occupied, 0.0, np.nan).astype(np.float32)
    mesh = mesh_from_grid(VoxelGrid(volume, likelihood, np.ones(volume.shape, np.uint16), 0.2, occupied))
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert mesh.center_mass == pytest.approx((0.0, 0.0, 0.25), abs=1e-6)


def test_axes_are_not_swapped():
    volume = Volume.around((5.0, -3.0), (1.2, 0.8, 0.5), 0.05)
    box = turned_box(0.0, 1.0, 0.6, 0.3, centre=(5.0, -3.0))
    bounds = mesh_from_grid(grid_of(box, volume)).bounds
    assert bounds == pytest.approx(np.array([[4.5, -3.3, 0.0], [5.5, -2.7, 0.3]]), abs=0.03)


def test_unknown_and_stray_voxels_are_outside_the_surface():
    grid = grid_of(turned_box(0.0), BOX_VOLUME)
    likelihood = grid.likelihood.copy()
    likelihood[~grid.occupied] = np.nan
    likelihood[-2, 2, 2] = 0.0  # dark, but not of the object
    other = VoxelGrid(grid.volume, likelihood, grid.views, grid.threshold, grid.occupied)
    assert mesh_from_grid(other).volume == pytest.approx(mesh_from_grid(grid).volume, rel=0.1)
    assert len(mesh_from_grid(other).split()) == 1


def test_a_far_off_scene_keeps_its_millimetres():
    volume = Volume.around((5000.0, -3000.0), (1.2, 0.8, 0.5), 0.02)
    d = measure(mesh_from_grid(grid_of(turned_box(0.4, centre=(5000.0, -3000.0)), volume, soft=True)))
    assert (d.length_m, d.width_m) == pytest.approx((0.8, 0.3), abs=0.02)
    assert d.position_m == pytest.approx((5000.0, -3000.0), abs=0.01)


def test_no_object_has_no_mesh():
    grid = grid_of(lambda x, y, z: -np.ones(x.shape), BOX_VOLUME)
    with pytest.raises(NoTargetError, match="the grid holds no object"):
        mesh_from_grid(grid)


@pytest.mark.parametrize("kind", ["stl", "ply"])
def test_a_mesh_file_gives_the_surface_back(kind):
    mesh = mesh_from_grid(grid_of(ball, BALL_VOLUME, soft=True))
    again = trimesh.load(io.BytesIO(mesh.export(file_type=kind)), file_type=kind)
    assert again.bounds == pytest.approx(mesh.bounds, abs=1e-5)
    assert again.volume == pytest.approx(mesh.volume, rel=1e-4)
    assert len(again.faces) == len(mesh.faces)
    again.merge_vertices()
    assert again.is_watertight
