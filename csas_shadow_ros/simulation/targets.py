"""Targets as closed meshes that rest on the seabed (z = 0), centred on the origin, and how they are placed.

A mesh may consist of several closed bodies that touch or overlap: shadows are unions, and occupancy
counts windings. Lengths run along +x before the heading turns them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..core.errors import GeometryError, ParameterError, check_type
from ..core.shape.solid import judge_solid

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scene:
    """What lies on the seabed, in the scene frame.

    Parameters
    ----------
    name : str
        Target's name.
    target : trimesh.Trimesh
        The target; without faces for an empty seabed.
    decor : trimesh.Trimesh
        Solids that cast shadows and echo but are no part of the target.
    cables : tuple of ndarray, shape (n, 3)
        Thin smooth lines on the seabed: they glint where they lie across the line of sight.
    dims_m : (float, float, float)
        Length, width, height of the target before it was turned.
    position_m : (float, float)
        Where the target's origin was put.
    heading_rad : float
        How far it was turned, counter-clockwise.
    """

    name: str
    target: trimesh.Trimesh
    decor: trimesh.Trimesh
    cables: tuple[FloatArray, ...]
    dims_m: tuple[float, float, float]
    position_m: tuple[float, float]
    heading_rad: float


def _turn(angle_rad: float, axis: Sequence[float] = (0.0, 0.0, 1.0)) -> FloatArray:
    """Return the 4×4 rotation about an axis."""
    return np.asarray(trimesh.transformations.rotation_matrix(angle_rad, axis))


def join_bodies(bodies: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return one mesh of several bodies, none merged with another."""
    faces, vertices, first = [], [], 0
    for body in bodies:
        vertices.append(body.vertices)
        faces.append(body.faces + first)
        first += len(body.vertices)
    return trimesh.Trimesh(vertices=np.concatenate(vertices), faces=np.concatenate(faces), process=False)


def _block(size: Sequence[float], centre_xy: Sequence[float], z_min: float = 0.0) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh = trimesh.creation.box(extents=size)
    mesh.apply_translation([centre_xy[0], centre_xy[1], z_min + size[2] / 2.0])
    return mesh


def empty_mesh() -> trimesh.Trimesh:
    """Return a mesh without faces."""
    return trimesh.Trimesh(vertices=np.zeros((0, 3)), faces=np.zeros((0, 3), dtype=np.int64), process=False)


def box(length_m: float = 0.8, width_m: float = 0.4, height_m: float = 0.4) -> trimesh.Trimesh:
    """Make a box."""
    return _block((length_m, width_m, height_m), (0.0, 0.0))


def cylinder(length_m: float = 1.8, diameter_m: float = 0.52) -> trimesh.Trimesh:
    """Make a cylinder that lies along x."""
    radius = diameter_m / 2.0
    mesh: trimesh.Trimesh = trimesh.creation.cylinder(radius=radius, height=length_m, sections=64)
    mesh.apply_transform(_turn(math.pi / 2.0, (0.0, 1.0, 0.0)))
    mesh.apply_translation([0.0, 0.0, -mesh.bounds[0, 2]])
    return mesh


def _revolve(profile: Any, sections: int = 72) -> trimesh.Trimesh:
    mesh = trimesh.creation.revolve(np.asarray(profile, dtype=np.float64), sections=sections)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def cone(
    base_diameter_m: float = 0.98, top_diameter_m: float = 0.5, height_m: float = 0.35
) -> trimesh.Trimesh:
    """Make a truncated cone."""
    base, top = base_diameter_m / 2.0, top_diameter_m / 2.0
    return _revolve([[0.0, 0.0], [base, 0.0], [top, height_m], [0.0, height_m]])


def sphere(diameter_m: float = 0.8, buried_m: float = 0.04) -> trimesh.Trimesh:
    """Make the part of a sphere that stands out of the seabed."""
    r = diameter_m / 2.0
    start = math.asin(buried_m / r - 1.0)
    angles = np.linspace(start, math.pi / 2.0, 32)
    arc = np.column_stack([r * np.cos(angles), r * np.sin(angles) + r - buried_m])
    arc[0, 1] = 0.0
    arc[-1, 0] = 0.0
    profile = np.vstack([[0.0, 0.0], arc]) if arc[0, 0] > 1e-9 else arc
    return _revolve(profile)


def tyre(outer_diameter_m: float = 0.7, height_m: float = 0.2) -> trimesh.Trimesh:
    """Make a ring that lies flat, its hole open."""
    minor = height_m / 2.0
    major = outer_diameter_m / 2.0 - minor
    mesh: trimesh.Trimesh = trimesh.creation.torus(major, minor, major_sections=64, minor_sections=24)
    mesh.apply_translation([0.0, 0.0, -mesh.bounds[0, 2]])
    return mesh


def l_shape(
    length_m: float = 1.0, width_m: float = 0.65, limb_m: float = 0.25, height_m: float = 0.3
) -> trimesh.Trimesh:
    """Make an L: the long limb along +x, the short one along +y from its -x end.

    It has no mirror plane but the horizontal one.
    """
    long_limb = _block((length_m, limb_m, height_m), (0.0, -(width_m - limb_m) / 2.0))
    short = _block((limb_m, width_m - limb_m, height_m), (-(length_m - limb_m) / 2.0, limb_m / 2.0))
    return join_bodies([long_limb, short])


def frame(
    length_m: float = 1.2,
    part_m: tuple[float, float, float] = (0.3, 0.5, 0.45),
    arm_m: float = 0.08,
    arm_height_m: float = 0.34,
) -> trimesh.Trimesh:
    """Make the paper's target (figure 1a): two upright parts joined by two thin arms.

    The middle, between the arms and under them, is empty.

    Parameters
    ----------
    length_m : float
        Outer length along x.
    part_m : (float, float, float)
        Size of each upright part along (x, y, z).
    arm_m : float
        Side of the arms' square section.
    arm_height_m : float
        Height of the middle of the arms.
    """
    gap = length_m - 2.0 * part_m[0]
    shift = (length_m - part_m[0]) / 2.0
    side = (part_m[1] - arm_m) / 2.0
    bodies = [_block(part_m, (s * shift, 0.0)) for s in (-1, 1)]
    bodies += [_block((gap, arm_m, arm_m), (0.0, s * side), arm_height_m - arm_m / 2.0) for s in (-1, 1)]
    return join_bodies(bodies)


def rock(seed: int = 0, size_m: tuple[float, float, float] = (0.7, 0.5, 0.35)) -> trimesh.Trimesh:
    """Make an irregular boulder, flat where it sinks into the seabed."""
    rng = np.random.default_rng([seed, 0x0C])
    mesh = trimesh.creation.icosphere(subdivisions=4)
    v = mesh.vertices.copy()
    relief = np.ones(len(v))
    for order in (2.0, 3.5, 6.0):
        for _ in range(5):
            axis = rng.standard_normal(3)
            axis *= order / np.linalg.norm(axis)
            relief += 0.13 / order * 2.0 * np.sin(v @ axis + rng.uniform(0, 2 * math.pi))
    v *= relief[:, None]
    v[:, 2] = np.maximum(v[:, 2], -0.55)  # the foot; flattened triangles keep the mesh closed
    v -= (v.min(axis=0) + v.max(axis=0)) / 2.0
    v *= np.asarray(size_m) / (v.max(axis=0) - v.min(axis=0))
    v[:, 2] -= v[:, 2].min()
    return trimesh.Trimesh(vertices=v, faces=mesh.faces, process=False)


def laying_grid(seed: int = 0, side_m: float = 3.0) -> trimesh.Trimesh:
    """Make the square outline of separate 20 cm × 50 cm concrete blocks of the paper's figure 1a."""
    rng = np.random.default_rng([seed, 0x6D])
    half = side_m / 2.0 - 0.1
    bodies = []
    for turn in range(4):
        angle = turn * math.pi / 2.0
        # Five blocks a side from one corner on, so that the next side begins where this one ends.
        for along in np.linspace(-half + 0.15, half - 0.45, 5):
            mesh = trimesh.creation.box(extents=(0.5, 0.2, 0.1))
            mesh.apply_transform(_turn(rng.normal(0, 0.03)))
            mesh.apply_translation([along + rng.normal(0, 0.01), half + rng.normal(0, 0.01), 0.05])
            mesh.apply_transform(_turn(angle))
            bodies.append(mesh)
    return join_bodies(bodies)


def _cable(start: Sequence[float], stop: Sequence[float], sag_m: float, height_m: float = 0.01) -> FloatArray:
    """Return points every 1 mm of a parabolic arc on the seabed."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(stop, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    t = np.linspace(0.0, 1.0, max(2, round(length / 0.001)))[:, None]
    side = np.array([-(b - a)[1], (b - a)[0]]) / length
    xy = a + t * (b - a) + 4.0 * sag_m * t * (1.0 - t) * side
    return np.column_stack([xy, np.full(len(xy), height_m)])


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Read a mesh file in metres and set it on the seabed, centred on the origin.

    Raises
    ------
    GeometryError
        If the file cannot be read, or the mesh is not closed.
    """
    try:
        mesh = trimesh.load(str(path), force="mesh")
    except Exception as error:  # trimesh raises whatever its readers raise
        raise GeometryError(f"mesh file {str(path)!r} cannot be read: {error}") from error
    return _rest_on_seabed(mesh, repr(str(path)))


def _rest_on_seabed(mesh: Any, name: str) -> trimesh.Trimesh:
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise GeometryError(f"mesh {name} has no faces; expected a closed surface")
    solid = judge_solid(mesh)
    if solid.open_edges:
        raise GeometryError(
            f"mesh {name} is not closed: it ends at {solid.open_edges} edges; expected a closed surface"
        )
    closed = solid.mesh
    low, high = closed.bounds
    closed.apply_translation([-(low[0] + high[0]) / 2.0, -(low[1] + high[1]) / 2.0, -low[2]])
    return closed


TARGETS: dict[str, Callable[[], trimesh.Trimesh]] = {
    "frame": frame,
    "frame_grid": frame,
    "box": box,
    "cylinder": cylinder,
    "cone": cone,
    "sphere": sphere,
    "tyre": tyre,
    "rock": rock,
    "l_shape": l_shape,
    "empty": empty_mesh,
}
MESH_SUFFIXES = (".stl", ".ply", ".obj", ".glb", ".gltf", ".off")


def make_scene(
    target: str | Path | trimesh.Trimesh,
    position_m: tuple[float, float] = (0.0, 0.0),
    heading_deg: float = 0.0,
    seed: int = 0,
) -> Scene:
    """Place a target on the seabed.

    Parameters
    ----------
    target : str, Path or trimesh.Trimesh
        Name in `TARGETS`, a mesh file (metres), or a closed mesh.
    position_m : (float, float)
        Scene x, y of the target's origin.
    heading_deg : float
        Turn, counter-clockwise.
    seed : int
        Of what is irregular: the rock, the blocks of the laying grid.

    Raises
    ------
    ParameterError
        If the target's name is unknown.
    GeometryError
        If a mesh cannot be read, has no faces or is not closed.
    """
    check_type("target", target, (str, Path, trimesh.Trimesh), "a name, a mesh file or a mesh")
    decor = empty_mesh()
    cables: tuple[FloatArray, ...] = ()
    if isinstance(target, trimesh.Trimesh):
        name, mesh = "mesh", _rest_on_seabed(target, "given")
    elif Path(target).suffix.lower() in MESH_SUFFIXES:
        name, mesh = Path(target).stem, load_mesh(target)
    elif str(target) in TARGETS:
        name = str(target)
        mesh = rock(seed) if name == "rock" else TARGETS[name]()
    else:
        raise ParameterError(
            f"target is {str(target)!r}; expected one of {', '.join(TARGETS)}, or a mesh file"
            f" ({', '.join(MESH_SUFFIXES)})"
        )
    if name == "frame_grid":
        decor = laying_grid(seed)
        cables = (
            _cable((0.55, 0.3), (0.9, 2.4), 0.06),
            _cable((-2.3, 1.75), (-0.2, 2.05), -0.05),
            _cable((-2.2, -0.9), (-1.0, -2.3), 0.05),
        )
    dims = tuple(float(s) for s in mesh.extents) if len(mesh.faces) else (0.0, 0.0, 0.0)
    heading = math.radians(heading_deg)
    pose = _turn(heading)
    pose[:2, 3] = position_m
    for body in (mesh, decor):
        if len(body.faces):
            body.apply_transform(pose)
    cables = tuple(c @ pose[:3, :3].T + pose[:3, 3] for c in cables)
    x, y = (float(v) for v in position_m)
    return Scene(name, mesh, decor, cables, (dims[0], dims[1], dims[2]), (x, y), heading)
