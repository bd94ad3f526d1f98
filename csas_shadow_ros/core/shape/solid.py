"""Meshes of solids from elsewhere: check that they enclose a volume, and repair what can be.

What encloses a volume is told by counting each edge's faces with their direction: a surface is closed where
each edge is passed as often one way as the other. So bodies may touch along faces, edges and corners, or
overlap, which "two faces an edge" does not allow; and each place has a winding number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import GeometryError

if TYPE_CHECKING:
    import trimesh

#: Bodies that are inside out, times faces: so many solid angles are a second's work and 1 GB is far off.
_MOST_ANGLES = 20_000_000
#: Bodies that touch are written so many of float32's steps apart: rounding must not join them again.
_APART_STEPS = 8


@dataclass(frozen=True, eq=False)
class Solid:
    """A mesh, judged.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        As it can be used: corners joined, doubled faces dropped, normals outward.
    notes : tuple of str
        What was wrong with it and has been put right.
    open_edges : int
        Edges that it ends at; 0: it encloses a volume.
    """

    mesh: trimesh.Trimesh
    notes: tuple[str, ...] = ()
    open_edges: int = 0


def open_edges(faces: NDArray[Any]) -> int:
    """Count the edges that faces pass more often in one direction than in the other.

    Parameters
    ----------
    faces : ndarray of int, shape (n, 3)
        Corners by number.

    Examples
    --------
    >>> import numpy as np
    >>> tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    >>> open_edges(tetrahedron), open_edges(tetrahedron[1:])
    (0, 3)
    """
    if not len(faces):
        return 0
    f = np.asarray(faces, dtype=np.int64)
    ends = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    low, high = ends.min(axis=1), ends.max(axis=1)
    _, edge = np.unique(low * (int(f.max()) + 1) + high, return_inverse=True)
    way = np.sign(ends[:, 1] - ends[:, 0])
    return int(np.count_nonzero(np.bincount(edge, weights=way.astype(np.float64))))


def judge_solid(mesh: trimesh.Trimesh) -> Solid:
    """Judge a mesh as a solid, and repair faults that leave no doubt about its shape.

    Doubled faces are dropped, faces that are turned the other way than their neighbours and bodies that are
    inside out are turned. A surface with holes stays as it is.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Is not changed.

    Raises
    ------
    GeometryError
        If a corner is not finite.
    """
    import trimesh

    if not np.isfinite(mesh.vertices).all():
        wrong = int(np.count_nonzero(~np.isfinite(mesh.vertices).all(axis=1)))
        raise GeometryError(f"mesh has {wrong} corners that are not finite; expected finite metres")
    joined = trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False)
    joined.merge_vertices()  # formats such as STL repeat the corners for each triangle
    f = joined.faces
    whole = (f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])
    joined.update_faces(whole)
    notes: list[str] = []
    joined = _without_doubled(joined, notes)
    left = open_edges(joined.faces)
    if left:
        turned = _alike(joined)
        if open_edges(turned.faces) == 0:
            count = int(np.count_nonzero((turned.faces != joined.faces).any(axis=1)))
            notes.append(f"{count} faces were turned the other way than their neighbours: turned round")
            joined, left = turned, 0
    if not left and len(joined.faces):
        joined = _outward(joined, notes)
    return Solid(joined, tuple(notes), left)


def _without_doubled(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Drop faces of the same corners, as far as that leaves a closed surface.

    Two that look opposite ways are a wall inside, which changes nothing. Two that look the same way are one
    written twice; or, where one alone leaves holes, the wall between a body and one that is inside out; or
    bodies of which one lies in the other.
    """
    f = np.asarray(mesh.faces)
    if not len(f):
        return mesh
    corners = np.sort(f, axis=1)
    _, first, which, counts = np.unique(
        corners, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    if (counts == 1).all():
        return mesh
    which = which.reshape(-1)
    # A face looks the one way or the other as it goes round its corners in growing order or not.
    place = np.argsort(f, axis=1)
    forth = (place[:, 1] - place[:, 0]) % 3 == 1
    net = np.bincount(which, weights=np.where(forth, 1.0, -1.0)).astype(int)
    if not net.any():
        net[:] = np.where(forth[first], 1, -1)

    def having(times: NDArray[np.int64]) -> trimesh.Trimesh:
        """Return a mesh that has each face so often, the way it looks on the whole."""
        chosen = []
        for way in (True, False):
            mine = np.flatnonzero(forth == way)
            _, one = np.unique(which[mine], return_index=True)
            mine = mine[one]
            wanted = np.where((net[which[mine]] > 0) == way, times[which[mine]], 0)
            chosen.append(np.repeat(mine, wanted))
        out = mesh.copy()
        out.update_faces(np.sort(np.concatenate(chosen)))
        return out

    once = having(np.minimum(np.abs(net), 1))
    dropped = len(f) - len(once.faces) - int((counts - np.abs(net)).sum())
    if dropped <= 0:
        return once
    if open_edges(once.faces) == 0:
        notes.append(f"{dropped} faces are there twice: counted once")
        return once
    between = _alike(having(np.abs(net) % 2))
    best = [one for one in (having(np.abs(net)), between) if open_edges(one.faces) == 0]
    return max(best, key=lambda one: abs(_signed_volumes(np.asarray(one.triangles)).sum()), default=once)


def _alike(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh whose neighbouring faces look to the same side."""
    import trimesh

    turned = mesh.copy()
    trimesh.repair.fix_winding(turned)
    return turned


def bodies_of(mesh: trimesh.Trimesh) -> NDArray[np.int64]:
    """Return each face's body, from 0: faces hang together at edges of two faces, not at those of more."""
    import trimesh

    count = len(mesh.faces)
    labels = trimesh.graph.connected_component_labels(
        mesh.face_adjacency, node_count=count
    )
    return np.asarray(labels, dtype=np.int64)


def _signed_volumes(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each triangle's part of the volume it helps to enclose."""
    a, b, c = (triangles[:, i] for i in range(3))
    return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0)


def _outward(mesh: trimesh.Trimesh, notes: list[str]) -> trimesh.Trimesh:
    """Turn what is inside out: all of it, or bodies that are not hollows of others."""
    corners = np.asarray(mesh.triangles) - mesh.bounds.mean(axis=0)
    volumes, body = _signed_volumes(corners), bodies_of(mesh)
    each = np.bincount(body, weights=volumes)
    out = mesh.copy()
    flip = np.zeros(len(each), bool)
    if volumes.sum() < 0:
        flip[:] = True
        corners, each = corners[:, ::-1], -each
    # A body of negative volume is a hollow where it lies in another, and inside out where it does not.
    negative = np.flatnonzero(each < 0)
    if len(negative) * len(corners) <= _MOST_ANGLES:
        for number in negative:
            own = corners[body == number]
            if open_edges(mesh.faces[body == number]):
                continue  # it closes only together with others
            normals = np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0])
            largest = int(np.argmax(np.linalg.norm(normals, axis=1)))
            size = float(np.linalg.norm(normals[largest]))
            if not size:
                continue
            # Beside its largest face, on the side that the body encloses.
            point = own[largest].mean(axis=0) + 1e-4 / np.sqrt(size) * normals[largest]
            if abs(_winding(point, corners[body != number])) < 0.5:
                flip[number] = not flip[number]
    if flip.any():
        turned = flip[body]
        faces = np.array(out.faces)
        faces[turned] = faces[turned][:, ::-1]
        out.faces = faces
        notes.append(
            "it was inside out: turned" if flip.all() else f"{flip.sum()} bodies were inside out: turned"
        )
    return out


def _winding(point: NDArray[np.float64], triangles: NDArray[np.float64]) -> float:
    """Return how often triangles go round a point, by their solid angles (Van Oosterom and Strackee 1983)."""
    a, b, c = (triangles[:, i] - point for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    above = np.einsum("ij,ij->i", a, np.cross(b, c))
    below = (
        la * lb * lc
        + np.einsum("ij,ij->i", a, b) * lc
        + np.einsum("ij,ij->i", b, c) * la
        + np.einsum("ij,ij->i", c, a) * lb
    )
    return float(np.arctan2(above, below).sum() / (2.0 * np.pi))


def apart(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh with separate corners for each body even as float32, since readers join corners.

    Bodies that touch are drawn in about their middles by a few of float32's steps, some micrometres at
    coordinates of metres. A mesh of which each edge has two faces is returned as it is.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Closed bodies.

    Raises
    ------
    GeometryError
        If it is not closed.
    """
    import trimesh

    def as_read(triangles: NDArray[Any]) -> trimesh.Trimesh:
        rounded = np.asarray(triangles, np.float32).astype(np.float64).reshape(-1, 3)
        read = trimesh.Trimesh(rounded, np.arange(len(rounded)).reshape(-1, 3), process=False)
        read.merge_vertices()
        return read

    if not len(mesh.faces):
        return mesh
    read = as_read(mesh.triangles)
    if read.is_watertight:
        return mesh
    if left := open_edges(read.faces):
        raise GeometryError(f"mesh is not closed: it ends at {left} edges; expected closed bodies")
    body = bodies_of(read)
    step = _APART_STEPS * float(np.spacing(np.float32(np.abs(read.vertices).max())))
    triangles = np.asarray(mesh.triangles, dtype=np.float64).copy()
    for number in range(int(body.max()) + 1):
        own = triangles[body == number]
        low, high = own.min(axis=(0, 1)), own.max(axis=(0, 1))
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        scale = np.maximum(1.0 - step / np.maximum(half, step), 0.5)
        triangles[body == number] = middle + (own - middle) * scale
    corners = triangles.reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
