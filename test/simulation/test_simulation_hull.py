"""True voxels and shadow hulls against cases with a known answer."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.spatial
import trimesh

from csas_shadow_ros.core.errors import GeometryError
from csas_shadow_ros.core.shape.volume import Volume
from csas_shadow_ros.simulation import TARGETS, iou, make_scene, shadow_hull, voxelise_truth
from csas_shadow_ros.simulation.targets import empty_mesh

VOLUME = Volume.around((0.05, -0.03), (2.0, 2.0, 0.8), 0.03)


def circle(step_deg=4.0, radius=75.0, height=18.0):
    a = np.radians(np.arange(0.0, 360.0, step_deg))
    return np.column_stack([radius * np.cos(a), radius * np.sin(a), np.full(len(a), height)])


def centres(volume):
    return np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")


def test_voxels_of_a_box_are_those_whose_centres_it_contains():
    mesh = make_scene("box", (0.1, 0.2), 30.0).target
    z, y, x = centres(VOLUME)
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    u, v = c * (x - 0.1) + s * (y - 0.2), -s * (x - 0.1) + c * (y - 0.2)
    expected = (np.abs(u) < 0.4) & (np.abs(v) < 0.2) & (z < 0.4)
    assert expected.sum() > 1000
    assert np.array_equal(voxelise_truth(mesh, VOLUME), expected)


def test_voxels_of_a_ring_leave_its_hole_open():
    z, y, x = centres(VOLUME)
    from_ring = np.hypot(np.hypot(x, y) - 0.25, z - 0.1)
    found = voxelise_truth(make_scene("tyre").target, VOLUME)
    assert np.all(found[from_ring < 0.098])  # the mesh's facets lie up to 1 mm inside
    assert not np.any(found[from_ring > 0.1])


def test_overlapping_and_touching_bodies_are_a_union():
    a = trimesh.creation.box(bounds=[[-0.3, -0.2, 0.0], [0.1, 0.2, 0.3]])
    b = trimesh.creation.box(bounds=[[-0.1, -0.3, 0.1], [0.4, 0.1, 0.5]])
    touching = trimesh.creation.box(bounds=[[-0.6, -0.2, 0.0], [-0.3, 0.2, 0.3]])
    bodies = (a, b, touching)
    expected = np.zeros(VOLUME.shape, dtype=bool)
    for body in bodies:
        expected |= voxelise_truth(body, VOLUME)
    assert np.array_equal(voxelise_truth(trimesh.util.concatenate(bodies), VOLUME), expected)


@pytest.mark.parametrize("name", ["rock", "frame", "l_shape", "sphere", "cone"])
def test_voxels_add_up_to_the_volume_of_the_mesh(name):
    mesh = make_scene(name, (0.01, 0.02), 11.0).target
    volume = Volume.around((0.0, 0.0), (1.4, 1.4, 0.8), 0.015)
    found = np.count_nonzero(voxelise_truth(mesh, volume)) * volume.voxel_size_m**3
    assert found == pytest.approx(mesh.volume, rel=0.02)


@pytest.mark.parametrize("name", [n for n in TARGETS if n not in ("empty", "frame_grid")])
def test_a_shadow_hull_contains_its_target(name):
    mesh = make_scene(name, (0.07, -0.02), 17.0).target
    truth, hull = voxelise_truth(mesh, VOLUME), shadow_hull(mesh, circle(8.0), VOLUME)
    assert truth.sum() > 500
    assert not np.any(truth & ~hull)


def test_more_views_never_enlarge_a_hull():
    mesh = make_scene("frame").target
    few, many = shadow_hull(mesh, circle(20.0), VOLUME), shadow_hull(mesh, circle(5.0), VOLUME)
    assert not np.any(many & ~few)
    assert few.sum() > many.sum()


def inside_convex(points_xy, corners_xy):
    """Return which points lie in the convex hull of the corners."""
    equations = scipy.spatial.ConvexHull(corners_xy).equations
    return np.all(points_xy @ equations[:, :2].T + equations[:, 2] <= 1e-9, axis=-1)


def test_the_hull_of_a_box_is_every_voxel_whose_shadow_point_lies_in_the_polygon_of_its_corners():
    mesh = make_scene("box", (0.1, 0.0), 25.0).target
    sonars = circle(30.0, 60.0, 20.0)
    z, y, x = centres(VOLUME)
    points, corners = np.stack([x, y, z], axis=-1), np.asarray(mesh.vertices)
    expected = np.ones(VOLUME.shape, dtype=bool)
    for s in sonars:
        cast = [s[:2] + (p[..., :2] - s[:2]) * s[2] / (s[2] - p[..., 2:]) for p in (points, corners)]
        expected &= inside_convex(*cast)
    hull = shadow_hull(mesh, sonars, VOLUME, spacing_m=0.001)
    assert expected.sum() > 3000
    assert not np.any(expected & ~hull)
    assert np.count_nonzero(hull & ~expected) < 0.01 * expected.sum()


def test_the_hull_of_a_sphere_under_rays_at_45_degrees_is_the_sphere_between_two_cones():
    """A point p is in the shadow along d if |p|² - (p·d)² ≤ R². With d at 45° and any azimuth, and p at
    radius r and height h over the middle, (p·d)² = (r cos φ + h)²/2, least at 0 where r ≥ |h|: the sphere;
    and at (|h| - r)²/2 elsewhere: the cones r + |h| ≤ √2 R that touch it."""
    radius = middle = 0.3
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    mesh.apply_translation([0, 0, middle])
    volume = Volume.around((0.0, 0.0), (0.9, 0.9, 0.8), 0.02)
    hull = shadow_hull(mesh, circle(2.0, 1e5, 1e5), volume, spacing_m=0.001)
    z, y, x = centres(volume)
    r, h = np.hypot(x, y), z - middle
    excess = r**2 + h**2 - np.maximum(np.abs(h) - r, 0.0) ** 2 / 2.0
    assert np.all(hull[excess < (radius - 0.002) ** 2])
    assert not np.any(hull[excess > (radius + 0.004) ** 2])
    assert np.any(hull & (z > middle + radius + 0.02))  # the tip over the sphere


def test_an_empty_seabed_has_an_empty_hull_and_no_voxels():
    assert not voxelise_truth(empty_mesh(), VOLUME).any()
    assert not shadow_hull(empty_mesh(), circle(30.0), VOLUME).any()


def test_iou_is_one_for_equal_sets_zero_for_disjoint_ones_and_a_third_for_half_overlap():
    a = np.zeros((2, 2, 4), dtype=bool)
    b = a.copy()
    assert iou(a, b) == 1.0
    a[..., :2] = True
    assert iou(a, a) == 1.0
    assert iou(a, ~a) == 0.0
    b[..., 1:3] = True
    assert iou(a, b) == pytest.approx(1 / 3)


def test_bad_input_is_refused():
    mesh = make_scene("box").target
    with pytest.raises(GeometryError, match=r"shape \(3,\); expected \(n, 3\)"):
        shadow_hull(mesh, [1.0, 2.0, 3.0], VOLUME)
    with pytest.raises(GeometryError, match=r"sonar position 0 is at z = 0\.5 m; expected above the volume"):
        shadow_hull(mesh, [[75.0, 0.0, 0.5]], VOLUME)
    with pytest.raises(GeometryError, match="expected the same"):
        iou(np.zeros((1, 2, 3)), np.zeros((3, 2, 1)))
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    with pytest.raises(GeometryError, match="not closed"):
        voxelise_truth(mesh, VOLUME)
