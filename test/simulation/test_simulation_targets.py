"""Meshes: closed, at rest on the seabed, of the stated size, and placed where they were told to be."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from csas_shadow_ros.core.errors import GeometryError, ParameterError
from csas_shadow_ros.simulation import TARGETS, load_mesh, make_scene

SOLID = [name for name in TARGETS if name != "empty"]


@pytest.mark.parametrize("name", SOLID)
def test_targets_are_closed_bodies_with_outward_normals_resting_on_the_seabed(name):
    mesh = make_scene(name).target
    assert mesh.is_watertight
    assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-9)
    assert np.allclose(mesh.bounds[:, :2].mean(axis=0), 0.0, atol=1e-6)
    for body in mesh.split(only_watertight=False):
        assert body.volume > 0


@pytest.mark.parametrize(
    ("name", "dims", "volume"),
    [
        ("box", (0.8, 0.4, 0.4), 0.128),
        ("cylinder", (1.8, 0.52, 0.52), math.pi * 0.26**2 * 1.8),
        ("cone", (0.98, 0.98, 0.35), math.pi * 0.35 / 3 * (0.49**2 + 0.49 * 0.25 + 0.25**2)),
        ("sphere", (0.8, 0.8, 0.76), 4 / 3 * math.pi * 0.4**3 - math.pi * 0.04**2 * (0.4 - 0.04 / 3)),
        ("tyre", (0.7, 0.7, 0.2), 2 * math.pi**2 * 0.25 * 0.1**2),
        ("l_shape", (1.0, 0.65, 0.3), (1.0 * 0.25 + 0.4 * 0.25) * 0.3),
        ("frame", (1.2, 0.5, 0.45), 2 * 0.3 * 0.5 * 0.45 + 2 * 0.6 * 0.08**2),
    ],
)
def test_targets_have_their_stated_size_and_volume(name, dims, volume):
    scene = make_scene(name)
    assert scene.dims_m == pytest.approx(dims, rel=1e-3)
    assert scene.target.volume == pytest.approx(volume, rel=0.02)


def test_the_frame_is_empty_between_and_under_its_arms():
    mesh = make_scene("frame").target
    empty = [(0, 0, 0.34), (0, 0, 0.1), (0, 0.21, 0.1)]
    solid = [(0, 0.21, 0.34), (0, -0.21, 0.34), (0.45, 0, 0.2)]
    inside = [any(body.contains([p])[0] for body in mesh.split()) for p in empty + solid]
    assert inside == [False, False, False, True, True, True]


def test_the_laying_grid_is_made_of_separate_blocks_round_a_square_and_is_no_part_of_the_target():
    scene = make_scene("frame_grid", (0.4, 0.0), 45.0)
    blocks = scene.decor.split()
    assert len(blocks) == 20
    assert np.allclose([b.volume for b in blocks], 0.5 * 0.2 * 0.1)
    centres = np.array([b.centroid for b in blocks]) - [0.4, 0.0, 0.0]
    turn = trimesh.transformations.rotation_matrix(math.radians(-45), [0, 0, 1])[:3, :3]
    assert np.allclose(np.abs(centres @ turn.T)[:, :2].max(axis=1), 1.4, atol=0.05)
    assert scene.target.volume == pytest.approx(make_scene("frame").target.volume)
    assert len(scene.cables) == 3


def test_position_and_heading_turn_counter_clockwise_about_the_target():
    scene = make_scene("box", (1.0, -2.0), 90.0)
    assert np.allclose(scene.target.bounds, [[0.8, -2.4, 0.0], [1.2, -1.6, 0.4]])
    tip = make_scene("l_shape", (0.0, 0.0), 90.0).target.vertices
    assert np.isclose(tip[:, 1].max(), 0.5)
    # The long limb's side, -y before, is at +x after a quarter turn.
    assert np.any(np.all(np.isclose(tip, [0.325, 0.5, 0.0]), axis=1))


def test_rocks_differ_by_seed_and_repeat_by_seed():
    a, b, c = (make_scene("rock", seed=s).target for s in (1, 1, 2))
    assert np.array_equal(a.vertices, b.vertices)
    assert np.abs(a.vertices - c.vertices).max() > 0.01


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "glb"])
def test_a_mesh_file_of_any_common_format_becomes_a_target(tmp_path, suffix):
    path = tmp_path / f"thing.{suffix}"
    mesh = make_scene("cone").target
    mesh.apply_translation([3.0, 4.0, 5.0])
    mesh.export(path)
    scene = make_scene(path, (0.5, 0.0))
    assert scene.name == "thing"
    assert np.allclose(scene.target.bounds, [[0.01, -0.49, 0], [0.99, 0.49, 0.35]], atol=1e-5)
    assert scene.target.volume == pytest.approx(mesh.volume, rel=1e-4)


def test_a_mesh_that_is_inside_out_is_turned(tmp_path):
    mesh = make_scene("box").target
    mesh.invert()
    mesh.export(tmp_path / "inside_out.stl")
    assert load_mesh(tmp_path / "inside_out.stl").volume == pytest.approx(0.128)


def test_an_open_mesh_is_refused(tmp_path):
    mesh = make_scene("box").target
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    mesh.export(tmp_path / "open.stl")
    with pytest.raises(GeometryError, match=r"open\.stl.* is not closed"):
        make_scene(tmp_path / "open.stl")


def test_a_missing_mesh_file_is_refused_by_name():
    with pytest.raises(GeometryError, match=r"nowhere\.stl"):
        make_scene("/tmp/nowhere.stl")


def test_an_unknown_target_is_refused_with_the_names_that_exist():
    with pytest.raises(ParameterError, match="target is 'boat'; expected one of frame, frame_grid, box"):
        make_scene("boat")
