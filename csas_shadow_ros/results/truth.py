"""The truth that a simulated bag has beside it, and how far a reconstruction is from it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..core.errors import CsasError
from ..core.shape.mesh import Dimensions, measure
from ..core.shape.solid import judge_solid, open_edges
from ..core.shape.volume import Volume, VoxelGrid

if TYPE_CHECKING:
    import trimesh

#: Margin round the true target in which scores look for what was wrongly left standing, voxels.
_MARGIN_VOXELS = 2
#: Largest truth that is read: trimesh takes some 500 bytes a triangle, STL has 50.
_MOST_BYTES = 64_000_000
_MOST_RECORD_BYTES = 1_000_000
#: Voxels of the lattice that scores are counted on, some ten bytes each, or twice those of the grid itself.
_MOST_VOXELS = 1 << 25
#: A truth so many times as long as the scene is in other units: a target that fills a quarter of the scene is
#: 10 times as long as it in inches taken for metres, 25 in centimetres, 250 in millimetres.
_OTHER_UNITS = 8.0
#: An object is a body where so much of the smaller one's plan lies in the other's: not so what stands beside
#: it, and a neighbour that its plan's rectangle cuts.
_SAME_PLAN = 0.5


class TruthError(CsasError):
    """A truth file cannot be read, or nothing can be compared with it."""


@dataclass(frozen=True, eq=False)
class KnownTruth:
    """What is really there.

    Parameters
    ----------
    path : Path
        The STL file it was read from.
    mesh : trimesh.Trimesh
        The target, scene frame, metres; without faces for an empty seabed.
    record : dict
        What the simulation wrote about it.
    notes : tuple of str
        What was wrong with the mesh and has been put right.
    open_edges : int
        Edges that the mesh ends at; 0: it encloses a volume.
    volume_m3 : float
        Volume of the union of its bodies; NaN where the mesh encloses none.
    unusable : str
        Why nothing may be compared with it; empty if it may.
    """

    path: Path
    mesh: trimesh.Trimesh
    record: dict[str, Any]
    notes: tuple[str, ...] = ()
    open_edges: int = 0
    volume_m3: float = 0.0
    unusable: str = ""

    @property
    def has_object(self) -> bool:
        """Whether there is a target at all."""
        return bool(len(self.mesh.faces))

    @property
    def problem(self) -> str:
        """Why it cannot be scored against; empty if it can."""
        if self.unusable:
            return self.unusable
        if self.open_edges:
            return (
                f"truth {self.path} is not closed: it ends at {self.open_edges} edges;"
                " expected a closed surface: without one it has no volume and no IoU"
            )
        return ""

    @property
    def dimensions(self) -> Dimensions | None:
        """Measures of the target, taken as a reconstruction's are; None where there is none.

        The volume is NaN where the mesh is not closed.
        """
        if not self.has_object or self.unusable:
            return None
        return dataclasses.replace(measure(self.mesh), volume_m3=self.volume_m3)


def read_truth(bag: str | Path) -> KnownTruth | None:
    """Read ``<bag>.truth.stl`` and, where it is there too, ``<bag>.truth.json``, and judge the mesh.

    Returns
    -------
    KnownTruth or None
        None if the bag has no truth beside it.

    Raises
    ------
    TruthError
        If it has one that cannot be read.
    """
    base = Path(bag).resolve()
    stl, record_path = (base.with_name(f"{base.name}.truth.{kind}") for kind in ("stl", "json"))
    if not stl.exists():
        return None
    import trimesh  # late: few bags have a truth beside them

    try:
        record: Any = {}
        if record_path.exists():
            record = json.loads(_bounded(record_path, _MOST_RECORD_BYTES).decode("utf-8"))
            if not isinstance(record, dict):
                raise ValueError(f"{record_path.name} holds a {type(record).__name__}; expected an object")
        raw = _bounded(stl, _MOST_BYTES)
        # A binary STL without triangles, an empty seabed, is none to trimesh.
        if len(raw) == 84 and int.from_bytes(raw[80:84], "little") == 0:
            return KnownTruth(stl, trimesh.Trimesh(), record)
        mesh: Any = trimesh.load(str(stl), force="mesh", process=False)
        if not len(mesh.faces):
            raise ValueError("it holds no triangles")
        from ..simulation.hull import enclosed_volume  # late: few bags have a truth

        solid = judge_solid(mesh)
        volume = math.nan if solid.open_edges else enclosed_volume(solid.mesh)
    except Exception as error:  # trimesh raises whatever its readers raise
        raise TruthError(f"truth {stl} cannot be read: {error}; repair it or take it away") from error
    return KnownTruth(stl, solid.mesh, record, solid.notes, solid.open_edges, volume)


def _bounded(path: Path, most: int) -> bytes:
    """Read a file of at most so many bytes; a pipe, which may never end, is no file."""
    if not path.is_file():
        raise ValueError(f"{path.name} is not a plain file")
    if (size := path.stat().st_size) > most:
        raise ValueError(f"{path.name} has {size} bytes; expected at most {most}")
    return path.read_bytes()


def placed(truth: KnownTruth, extent_m: tuple[float, float, float, float], voxel_size_m: float) -> KnownTruth:
    """Say whether a truth can be of a scene: a mesh in other units or another frame is of none.

    Parameters
    ----------
    truth : KnownTruth
        As it was read.
    extent_m : (float, float, float, float)
        Left, right, bottom and top of what was imaged.
    voxel_size_m : float
        Edge of a voxel of the reconstruction.

    Returns
    -------
    KnownTruth
        With the reason in `unusable` where it cannot.
    """
    if not truth.has_object or truth.unusable:
        return truth
    left, right, bottom, top = extent_m
    low, high = truth.mesh.bounds
    size = high - low
    scene = f"the scene x {left:.4g} to {right:.4g} m, y {bottom:.4g} to {top:.4g} m"
    text = " x ".join(f"{side:.4g}" for side in size)
    why = ""
    if size.max() > _OTHER_UNITS * max(right - left, top - bottom):
        why = f"is {text} m, {scene}; expected a mesh in metres"
        for unit, metres in (("cm", 1e-2), ("mm", 1e-3)):
            if size.max() * metres <= max(right - left, top - bottom):
                why += f" (in {unit} it would be {' x '.join(f'{side * metres:.3g}' for side in size)} m)"
                break
    elif size.max() < voxel_size_m:
        why = f"is {text} m, less than a voxel of {voxel_size_m:g} m; expected a mesh in metres"
    elif low[0] > right or high[0] < left or low[1] > top or high[1] < bottom:
        middle = (low + high) / 2.0
        why = f"lies at ({middle[0]:.6g}, {middle[1]:.6g}) m, {scene}; expected the scene frame"
    if not why:
        return truth
    return dataclasses.replace(truth, unusable=f"truth {truth.path} {why}")


def of_objects(
    truth: KnownTruth, found: Sequence[Dimensions], voxel_size_m: float
) -> list[KnownTruth | None]:
    """Say what each object is in truth: of a scene of several bodies, its own ones alone.

    Bodies whose plans touch, or are within a voxel, are one thing. A thing belongs to the object that shares
    most of its plan with it; an object that covers two is both. Of a single thing the truth is the target's,
    wherever that was found.

    Parameters
    ----------
    truth : KnownTruth
        Of the scene.
    found : sequence of Dimensions
        The objects, the target first.
    voxel_size_m : float
        Edge of a voxel of the reconstruction.

    Returns
    -------
    list of KnownTruth or None
        One an object; None where it is none of the bodies, or they cannot be told apart: several that touch,
        found as several objects.

    Examples
    --------
    >>> import trimesh
    >>> from csas_shadow_ros.core.shape.mesh import measure
    >>> boxes = [trimesh.creation.box((0.8, 0.4, 0.4)), trimesh.creation.box((0.5, 0.4, 0.4))]
    >>> _ = boxes[1].apply_translation((1.5, 0.0, 0.0))
    >>> scene = KnownTruth(Path("bag.truth.stl"), trimesh.util.concatenate(boxes))
    >>> own = of_objects(scene, [measure(boxes[1]), measure(boxes[0])], 0.02)
    >>> [round(one.dimensions.length_m, 3) for one in own]
    [0.5, 0.8]
    """
    if not found:
        return []
    alone: list[KnownTruth | None] = [truth, *[None] * (len(found) - 1)]
    if not truth.has_object or truth.unusable:
        return alone
    things = _things(truth.mesh, voxel_size_m)
    if len(things) == 1 and len(found) == 1:
        return alone
    rectangles = [_rectangle(d) for d in found]
    own: list[list[_Thing]] = [[] for _ in found]
    for thing in things:
        shared = np.array([_shared(thing.plan, rectangle) for rectangle in rectangles])
        claimed = int(np.count_nonzero(shared >= _SAME_PLAN))
        if claimed == 1 or (claimed and thing.bodies == 1):
            own[int(shared.argmax())].append(thing)
    if len(things) == 1:
        if any(own):
            return [truth if mine else None for mine in own]
        return alone if things[0].bodies == 1 else [None] * len(found)
    return [_part(truth, mine) if mine else None for mine in own]


def of_nothing(truth: KnownTruth, voxel_size_m: float) -> KnownTruth | None:
    """Return the truth where no object was found: None where it is several, of which none is to be named."""
    several = truth.has_object and not truth.unusable and len(_things(truth.mesh, voxel_size_m)) > 1
    return None if several else truth


@dataclass(frozen=True, eq=False)
class _Thing:
    """Bodies that are one thing: their faces, how many they are, and the hull of their plan."""

    faces: NDArray[np.bool_]
    bodies: int
    plan: NDArray[np.float32]


def _things(mesh: trimesh.Trimesh, gap_m: float) -> list[_Thing]:
    faces, corners = np.asarray(mesh.faces), np.asarray(mesh.vertices)[:, :2]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    edges = coo_matrix((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(len(corners),) * 2)
    body_of = connected_components(edges, directed=False)[1][faces[:, 0]]
    bodies = [np.flatnonzero(body_of == body) for body in np.unique(body_of)]
    # Grown by half of the gap, plans that are nearer than it overlap.
    grown = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * gap_m / 2
    plans = [_hull((corners[np.unique(faces[body])][:, None] + grown).reshape(-1, 2)) for body in bodies]
    low, high = (np.array([edge(plan, axis=0) for plan in plans]) for edge in (np.min, np.max))
    near = (low[:, None] <= high[None]).all(axis=2)
    pairs = [
        (one, other)
        for one, other in np.argwhere(np.triu(near & near.T, 1))
        if cv2.intersectConvexConvex(plans[one], plans[other])[0] > 0
    ]
    together = np.array(pairs, int).reshape(-1, 2)
    links = coo_matrix((np.ones(len(together), bool), tuple(together.T)), shape=(len(bodies),) * 2)
    thing_of = connected_components(links, directed=False)[1]
    things = []
    for thing in np.unique(thing_of):
        members = np.flatnonzero(thing_of == thing)
        mine = np.isin(body_of, np.unique(body_of)[members])
        things.append(_Thing(mine, len(members), _hull(np.concatenate([plans[i] for i in members]))))
    return things


def _hull(points: NDArray[Any]) -> NDArray[np.float32]:
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], np.float32)


def _rectangle(d: Dimensions) -> NDArray[np.float32]:
    along = np.array([math.cos(d.heading_rad), math.sin(d.heading_rad)]) * d.length_m / 2
    across = np.array([-math.sin(d.heading_rad), math.cos(d.heading_rad)]) * d.width_m / 2
    corners = (along + across, along - across, -along - across, across - along)
    return _hull(np.asarray(d.position_m) + np.array(corners))


def _shared(plan: NDArray[np.float32], rectangle: NDArray[np.float32]) -> float:
    """Return the share of the smaller one's area that lies in the other."""
    area = min(cv2.contourArea(plan), cv2.contourArea(rectangle))
    return float(cv2.intersectConvexConvex(plan, rectangle)[0]) / area if area > 0 else 0.0


def _part(truth: KnownTruth, things: Sequence[_Thing]) -> KnownTruth:
    import trimesh

    from ..simulation.hull import enclosed_volume  # late: few bags have a truth

    faces = np.asarray(truth.mesh.faces)[np.any([thing.faces for thing in things], axis=0)]
    mesh = trimesh.Trimesh(truth.mesh.vertices, faces, process=False)
    mesh.remove_unreferenced_vertices()
    left = open_edges(mesh.faces)
    volume = math.nan if left else enclosed_volume(mesh)
    return dataclasses.replace(truth, mesh=mesh, open_edges=left, volume_m3=volume)


def score(
    truth: KnownTruth, grid: VoxelGrid, sonar_m: ArrayLike, matter: NDArray[np.bool_] | None = None
) -> dict[str, float]:
    """Compare a reconstruction with the truth and with the truth's shadow hull.

    The shadow hull, which perfect silhouettes from the same sonar positions would leave, is the best that
    carving can do; its own IoU against the truth says how good that is.

    Parameters
    ----------
    truth : KnownTruth
        A target with faces.
    grid : VoxelGrid
        The reconstruction.
    sonar_m : array_like, shape (n, 3)
        Where the sonar was for the views in the grid.
    matter : ndarray of bool, shape (nz, ny, nx), optional
        The reconstruction without its hollows.

    Returns
    -------
    dict
        ``iou_truth``, ``iou_hull``, ``iou_hull_truth``; with matter also ``iou_matter``.

    Raises
    ------
    TruthError
        If the truth is not one to compare with, or it would take more memory than a run does.
    GeometryError
        If it reaches as high as the sonar.
    """
    from ..simulation.hull import iou, shadow_hull, voxelise_truth  # late: few bags have a truth

    if truth.problem:
        raise TruthError(truth.problem)
    volume, before = _widened(truth, grid)
    nz, ny, nx = grid.volume.shape
    z, y, x = before

    def widened(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
        out = np.zeros(volume.shape, bool)
        out[z : z + nz, y : y + ny, x : x + nx] = voxels
        return out

    occupied = widened(grid.occupied)
    solid = voxelise_truth(truth.mesh, volume)
    positions = np.asarray(sonar_m, dtype=np.float64)
    # Half a voxel is far finer than what the hull is compared with.
    hull = shadow_hull(truth.mesh, positions, volume, spacing_m=min(grid.volume.voxel_size_m / 2, 10.0))
    scores = {
        "iou_truth": iou(occupied, solid),
        "iou_hull": iou(occupied, hull),
        "iou_hull_truth": iou(hull, solid),
    }
    if matter is not None:
        scores["iou_matter"] = iou(widened(matter), solid)
    return scores


def _widened(truth: KnownTruth, grid: VoxelGrid) -> tuple[Volume, tuple[int, int, int]]:
    """Return the lattice grown to hold the truth, and how many voxels were put before (z, y, x)."""
    volume, d = grid.volume, grid.volume.voxel_size_m
    low, high = truth.mesh.bounds
    before, after = [], []
    for axis, n in zip(range(3), volume.shape[::-1], strict=True):
        first = volume.origin_m[axis]
        margin = _MARGIN_VOXELS * d
        missing = math.ceil((first - d / 2 - (low[axis] - margin)) / d)
        before.append(max(0, missing) if axis < 2 else 0)
        after.append(max(0, math.ceil((high[axis] + margin - (first + (n - 0.5) * d)) / d)))
    nx, ny, nz = (n + b + a for n, b, a in zip(volume.shape[::-1], before, after, strict=True))
    most = max(_MOST_VOXELS, 2 * math.prod(volume.shape))
    if nx * ny * nz > most:
        raise TruthError(
            f"truth {truth.path} and the grid take {nx} x {ny} x {nz} voxels of {d:g} m together;"
            f" expected at most {most}"
        )
    x, y, z = (volume.origin_m[i] - before[i] * d for i in range(3))
    return Volume((x, y, z), d, (nz, ny, nx)), (before[2], before[1], before[0])
