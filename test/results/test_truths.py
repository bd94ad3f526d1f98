"""Truths as CAD and scanners give them: judged by name, scored where they can be."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from csas_shadow_ros.core.errors import CsasError, GeometryError
from csas_shadow_ros.core.shape.mesh import measure, mesh_from_grid
from csas_shadow_ros.core.shape.solid import apart, judge_solid, open_edges
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.results import TruthError, read_truth, score
from csas_shadow_ros.results.truth import of_nothing, of_objects, placed
from csas_shadow_ros.simulation import get_profile, make_scene, simulate
from csas_shadow_ros.simulation.hull import enclosed_volume, shadow_hull, voxelise_truth

SCENE = (-1.28, 1.28, -1.28, 1.28)
VOXEL = 0.04
SONAR = [[10 * math.cos(a), 10 * math.sin(a), 6.0] for a in np.linspace(0, 2 * math.pi, 12, endpoint=False)]


def a_box(size=(0.8, 0.4, 0.4), at=(0.0, 0.0, 0.2)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(at)
    return mesh


def joined(*bodies: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(list(bodies))


def turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    out = mesh.copy()
    out.invert()
    return out


def mirrored(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return it inside out, its walls cut along the other diagonals."""
    return trimesh.Trimesh(mesh.vertices * (1, -1, 1), mesh.faces, process=False)


def raw(faces) -> trimesh.Trimesh:
    return trimesh.Trimesh(a_box().vertices, faces, process=False)


def some_turned() -> trimesh.Trimesh:
    faces = a_box().faces.copy()
    faces[[1, 4, 7]] = faces[[1, 4, 7]][:, ::-1]
    return raw(faces)


def truth_beside(tmp_path, mesh):
    mesh.export(tmp_path / "bag.truth.stl")
    return read_truth(tmp_path / "bag")


def carved(mesh: trimesh.Trimesh) -> VoxelGrid:
    """Return the grid that holds just this solid."""
    volume = Volume.around((0.0, 0.0), (2.0, 1.4, 0.8), VOXEL)
    occupied = voxelise_truth(mesh, volume)
    likelihood = np.where(occupied, 0.0, 1.0).astype(np.float32)
    return VoxelGrid(volume, likelihood, np.ones(volume.shape, np.uint16), 0.5, occupied)


BOX = a_box()
PAIR = joined(a_box((0.4, 0.4, 0.4), (-0.2, 0.0, 0.2)), a_box((0.4, 0.4, 0.4), (0.2, 0.0, 0.2)))
HOLLOW = joined(BOX, turned(a_box((0.58, 0.18, 0.18))))
#: Mesh, what it is in truth, its volume, and what is said of it.
USABLE = {
    "as it should be": (BOX, BOX, 0.128, ""),
    "finely cut": (BOX.subdivide_to_size(0.05), BOX, 0.128, ""),
    "inside out": (turned(BOX), BOX, 0.128, "it was inside out"),
    "two faces twice": (raw(np.vstack([BOX.faces, BOX.faces[:2]])), BOX, 0.128, "2 faces are there twice"),
    "all faces twice": (joined(BOX, BOX), BOX, 0.128, "12 faces are there twice"),
    "three faces turned": (some_turned(), BOX, 0.128, "faces were turned the other way"),
    "halves that touch": (PAIR, BOX, 0.128, ""),
    "halves, one inside out": (
        joined(a_box((0.4, 0.4, 0.4), (-0.2, 0, 0.2)), mirrored(a_box((0.4, 0.4, 0.4), (0.2, 0, 0.2)))),
        BOX,
        0.128,
        "",
    ),
    "two apart, one inside out": (
        joined(a_box((0.3, 0.4, 0.4), (-0.25, 0, 0.2)), turned(a_box((0.3, 0.4, 0.4), (0.25, 0, 0.2)))),
        joined(a_box((0.3, 0.4, 0.4), (-0.25, 0, 0.2)), a_box((0.3, 0.4, 0.4), (0.25, 0, 0.2))),
        0.096,
        "1 bodies were inside out",
    ),
    "one on the other's foot": (joined(BOX, a_box((0.8, 0.4, 0.2), (0, 0, 0.1))), BOX, 0.128, ""),
    "parts that overlap": (
        joined(a_box((0.5, 0.4, 0.4), (-0.15, 0, 0.2)), a_box((0.5, 0.4, 0.4), (0.15, 0, 0.2))),
        BOX,
        0.128,
        "",
    ),
    "a hollow inside": (HOLLOW, HOLLOW, 0.128 - 0.58 * 0.18**2, ""),
    "a hollow, all inside out": (turned(HOLLOW), HOLLOW, 0.128 - 0.58 * 0.18**2, "it was inside out"),
    "bodies that share an edge": (
        joined(a_box((0.4, 0.2, 0.4), (-0.2, -0.1, 0.2)), a_box((0.4, 0.2, 0.4), (0.2, 0.1, 0.2))),
        None,
        0.064,
        "",
    ),
}


@pytest.mark.parametrize("name", USABLE)
def test_a_truth_that_encloses_a_volume_is_scored_whatever_its_faces_are_like(tmp_path, name):
    mesh, same, volume, note = USABLE[name]
    truth = truth_beside(tmp_path, mesh)
    assert truth.problem == ""
    assert (note in " ".join(truth.notes)) if note else truth.notes == ()
    # Overlaps are counted in voxels of a hundredth of the body.
    assert truth.dimensions.volume_m3 == pytest.approx(
        volume, rel=0.02 if "overlap" in name or "foot" in name else 1e-5
    )
    scores = score(truth, carved(same if same is not None else judge_solid(mesh).mesh), SONAR)
    assert scores["iou_truth"] == 1.0
    assert scores["iou_hull_truth"] > 0.3


def test_a_truth_in_ascii_is_the_same(tmp_path):
    (tmp_path / "bag.truth.stl").write_text(trimesh.exchange.stl.export_stl_ascii(BOX))
    truth = read_truth(tmp_path / "bag")
    assert (truth.problem, truth.notes) == ("", ())
    assert truth.dimensions.volume_m3 == pytest.approx(0.128, rel=1e-6)


def test_an_open_truth_has_sides_but_neither_volume_nor_score(tmp_path):
    mesh = BOX.copy()
    mesh.update_faces(np.arange(12) > 1)
    truth = truth_beside(tmp_path, mesh)
    d = truth.dimensions
    assert (d.length_m, d.width_m, d.height_m) == pytest.approx((0.8, 0.4, 0.4), abs=1e-6)
    assert math.isnan(d.volume_m3)
    with pytest.raises(TruthError, match=r"bag\.truth\.stl is not closed: it ends at 4 edges; expected"):
        score(truth, carved(BOX), SONAR)


@pytest.mark.parametrize(
    ("scale", "moved", "told"),
    [
        (
            1000.0,
            0.0,
            r"is 800 x 400 x 400 m, the scene .*expected a mesh in metres \(in mm it would be 0\.8 x",
        ),
        (100.0, 0.0, r"is 80 x 40 x 40 m, .*\(in cm it would be 0\.8 x 0\.4 x 0\.4 m\)"),
        (1 / 0.0254, 0.0, r"is 31\.5 x 15\.75 x 15\.75 m, .*expected a mesh in metres"),
        (0.001, 0.0, r"is 0\.0008 x 0\.0004 x 0\.0004 m, less than a voxel of 0\.04 m"),
        (1.0, 4.5e5, r"lies at \(450000, 0\) m, the scene .*; expected the scene frame"),
    ],
)
def test_a_truth_in_other_units_or_another_frame_is_refused_by_name(tmp_path, scale, moved, told):
    mesh = BOX.copy()
    mesh.apply_scale(scale)
    mesh.apply_translation((moved, 0, 0))
    truth = placed(truth_beside(tmp_path, mesh), SCENE, VOXEL)
    assert truth.dimensions is None
    with pytest.raises(TruthError, match=told):
        score(truth, carved(BOX), SONAR)


def test_a_truth_that_takes_more_memory_than_a_run_is_refused_before_it_is_taken(tmp_path):
    mesh = BOX.copy()
    mesh.apply_scale(1000.0)  # and nobody says how large the scene is
    with pytest.raises(TruthError, match=r"take 20\d\d\d x 10\d\d\d x 10\d\d\d voxels of 0\.04 m together"):
        score(truth_beside(tmp_path, mesh), carved(BOX), SONAR)


def test_a_truth_nearly_as_high_as_the_sonar_is_refused_before_its_shadow_is_drawn():
    with pytest.raises(CsasError, match=r"shadow takes 2\.6e\+05 x .* points of 0\.0025 m; expected at most"):
        shadow_hull(a_box((2.0, 2.0, 5.9), (0, 0, 2.95)), SONAR, carved(BOX).volume)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda stl, record: stl.write_bytes(b"no mesh"), "bag.truth.stl cannot be read"),
        (lambda stl, record: stl.write_bytes(b""), "bag.truth.stl cannot be read"),
        (lambda stl, record: os.truncate(stl, 200), "bag.truth.stl cannot be read"),
        (lambda stl, record: os.truncate(stl, 65_000_000), "expected at most 64000000"),
        (lambda stl, record: (stl.unlink(), os.mkfifo(stl)), "bag.truth.stl is not a plain file"),
        (lambda stl, record: (stl.unlink(), stl.mkdir()), "bag.truth.stl is not a plain file"),
        (lambda stl, record: record.write_text("[1, 2]"), "holds a list; expected an object"),
        (lambda stl, record: record.write_text("[" * 100_000), "cannot be read"),
        (lambda stl, record: record.write_bytes(b"\xff\xfe"), "cannot be read"),
        (lambda stl, record: os.truncate(record, 1_000_001), "expected at most 1000000"),
    ],
)
def test_a_truth_that_cannot_be_read_is_named(tmp_path, spoil, told):
    stl, record = tmp_path / "bag.truth.stl", tmp_path / "bag.truth.json"
    BOX.export(stl)
    record.write_text(json.dumps({"name": "box"}))
    spoil(stl, record)
    with pytest.raises(TruthError, match=told):
        read_truth(tmp_path / "bag")


def test_a_truth_with_corners_that_are_no_numbers_is_refused(tmp_path):
    stl = tmp_path / "bag.truth.stl"
    BOX.export(stl)
    data = bytearray(stl.read_bytes())
    data[84 + 12 : 84 + 16] = np.float32(np.nan).tobytes()
    stl.write_bytes(data)
    with pytest.raises(TruthError, match=r"1 corners that are not finite|cannot be read"):
        read_truth(tmp_path / "bag")


def test_bodies_of_which_some_are_inside_out_beyond_repair_are_refused(tmp_path):
    # They touch along walls that are cut along different diagonals: nothing tells their faces apart.
    halves = joined(a_box((0.4, 0.4, 0.4), (-0.2, 0, 0.2)), turned(a_box((0.4, 0.4, 0.4), (0.2, 0, 0.2))))
    with pytest.raises(TruthError, match=r"inside out in 0\.06\d+ m³ of it; expected normals that point out"):
        truth_beside(tmp_path, halves)


# -- what the simulator writes --------------------------------------------------------------------------


@pytest.mark.parametrize("heading_deg", [0.0, 40.0, 77.0])
@pytest.mark.parametrize("target", ["l_shape", "frame", "tyre", "cylinder", "rock"])
@pytest.mark.parametrize("position_m", [(0.0, 0.0), (0.15, -0.1)])
def test_every_truth_that_is_written_is_closed_for_any_reader(tmp_path, target, heading_deg, position_m):
    scene = make_scene(target, position_m, heading_deg, 5)
    apart(scene.target).export(tmp_path / "bag.truth.stl")
    mesh = trimesh.load(tmp_path / "bag.truth.stl", force="mesh")
    mesh.merge_vertices()
    assert mesh.is_watertight
    truth = read_truth(tmp_path / "bag")
    assert (truth.problem, truth.notes) == ("", ())
    assert mesh.bounds == pytest.approx(scene.target.bounds, abs=3e-6)
    assert truth.dimensions.volume_m3 == pytest.approx(enclosed_volume(scene.target), rel=2e-5)


def test_a_truth_that_is_not_closed_is_not_written(tmp_path):
    run = simulate(get_profile("tiny", rows=64, cols=64), "box")
    run.truth.target.update_faces(np.arange(12) > 1)
    with pytest.raises(GeometryError, match="mesh is not closed: it ends at 4 edges"):
        run.truth.save(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "volume"), [("halves that touch", 0.128), ("inside out", 0.128)])
def test_a_target_file_may_be_of_bodies_that_touch_or_inside_out(tmp_path, name, volume):
    USABLE[name][0].export(tmp_path / "it.stl")
    assert make_scene(tmp_path / "it.stl").target.volume == pytest.approx(volume, rel=1e-5)


def test_a_target_in_millimetres_is_refused_before_the_memory_is_taken(tmp_path):
    mesh = BOX.copy()
    mesh.apply_scale(1000.0)
    mesh.export(tmp_path / "mm.stl")
    script = (
        "import re, sys\n"
        "from csas_shadow_ros.core.errors import GeometryError\n"
        "from csas_shadow_ros.simulation import get_profile, simulate\n"
        "try:\n"
        "    simulate(get_profile('tiny', height_m=900.0, radius_m=1500.0), sys.argv[1], workers=1)\n"
        "except GeometryError as error:\n"
        "    print(error)\n"
        # Of this program alone: what `getrusage` tells begins with the memory of whoever started it.
        "print(int(re.search(r'VmHWM:\\s+(\\d+) kB', open('/proc/self/status').read())[1]) // 1024, 'MiB')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "mm.stl"],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    told, used = done.stdout.splitlines()
    assert "expected at most 2e+06: a mesh in metres" in told
    assert int(used.split()[0]) < 1000


# -- which body is which object --------------------------------------------------------------------------

#: Two boxes a metre apart, turned: the whole scene measures 1.9 m.
SMALL, LARGE = a_box((0.5, 0.3, 0.3), (0.9, 0.7, 0.15)), a_box((0.8, 0.4, 0.4), (-0.5, -0.4, 0.2))


def lengths(truth, *found) -> list[float | None]:
    own = of_objects(truth, [measure(body) for body in found], VOXEL)
    return [None if one is None else round(one.dimensions.length_m, 3) for one in own]


def moved(mesh: trimesh.Trimesh, x: float, y: float = 0.0) -> trimesh.Trimesh:
    out = mesh.copy()
    out.apply_translation((x, y, 0.0))
    return out


def test_each_object_has_the_truth_of_its_own_body(tmp_path):
    truth = truth_beside(tmp_path, joined(SMALL, LARGE))
    assert lengths(truth, moved(LARGE, 0.05), SMALL) == [0.8, 0.5]
    assert lengths(truth, SMALL) == [0.5]
    assert of_objects(truth, [measure(SMALL)], VOXEL)[0].dimensions.volume_m3 == pytest.approx(0.045)
    assert lengths(truth, moved(SMALL, 0.0, -1.5)) == [None], "nothing stands there"
    assert lengths(truth, trimesh.creation.box((2.6, 2.6, 0.4))) == [
        round(measure(joined(SMALL, LARGE)).length_m, 3)
    ]


def test_a_score_is_of_the_body_that_the_object_is(tmp_path):
    truth = truth_beside(tmp_path, joined(SMALL, LARGE))
    (mine,) = of_objects(truth, [measure(LARGE)], VOXEL)
    assert score(mine, carved(LARGE), SONAR)["iou_truth"] == 1.0
    assert score(truth, carved(LARGE), SONAR)["iou_truth"] < 0.8


def test_bodies_that_cannot_be_told_apart_are_compared_as_one_or_not_at_all(tmp_path):
    halves = a_box((0.4, 0.4, 0.4), (-0.21, 0, 0.2)), a_box((0.4, 0.4, 0.4), (0.21, 0, 0.2))
    truth = truth_beside(tmp_path, joined(*halves))  # 2 cm apart, half of a voxel
    assert lengths(truth, a_box((0.82, 0.4, 0.4))) == [0.82]
    assert lengths(truth, *halves) == [None, None]


def test_of_one_body_the_truth_is_the_targets_wherever_it_was_found(tmp_path):
    truth = truth_beside(tmp_path, BOX)
    far = moved(BOX, 3.0)
    assert lengths(truth, far) == lengths(truth, BOX) == [0.8]
    assert lengths(truth, far, BOX) == [None, 0.8]
    assert lengths(truth, far, moved(far, 3.0)) == [0.8, None]
    left, right = a_box((0.35, 0.4, 0.4), (-0.2, 0, 0.2)), a_box((0.3, 0.4, 0.4), (0.25, 0, 0.2))
    assert lengths(truth, right, left) == [None, 0.8], "of one that broke in two it is the larger part's"


def test_where_nothing_was_found_no_body_of_several_stands_for_the_scene(tmp_path):
    truth = truth_beside(tmp_path, joined(SMALL, LARGE))
    assert of_nothing(truth, VOXEL) is None
    truth = truth_beside(tmp_path, BOX)
    assert of_nothing(truth, VOXEL) is truth


# -- solids ---------------------------------------------------------------------------------------------


def test_open_edges_are_counted_with_their_direction():
    assert open_edges(BOX.faces) == 0
    assert open_edges(BOX.faces[1:]) == 3
    assert open_edges(some_turned().faces) > 0
    assert open_edges(np.vstack([BOX.faces, BOX.faces[:1]])) == 3
    assert open_edges(np.zeros((0, 3), int)) == 0


def test_a_surface_from_a_grid_is_a_solid_without_a_word():
    solid = judge_solid(mesh_from_grid(carved(BOX)))
    assert (solid.notes, solid.open_edges) == ((), 0)
