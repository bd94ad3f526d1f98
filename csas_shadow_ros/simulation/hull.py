"""Scores of a reconstruction: the target's own voxels, and the best that carving its shadows can leave.

Carving can only remove a voxel whose shadow point falls outside the target's shadow in some view. What
perfect silhouettes of the true mesh leave, the *shadow hull*, is therefore the fair measure of a
reconstruction; it contains the target, and fills what no shadow shows, such as hollows in the top.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from ..core.errors import GeometryError, check_range
from ..core.shape.solid import judge_solid, open_edges
from ..core.shape.volume import Volume
from .raster import add_windings, fill_triangles, keep_shadowed
from .scene import project_shadow

BoolArray = NDArray[np.bool_]

# Voxel columns through an edge shared by two triangles would be counted twice, and edges of simple targets
# lie on round numbers: look a little beside the centres, in voxels.
_COLUMN_OFFSET = (1.1e-6, 1.7e-6, 0.0)

#: Lattice that overlaps are counted on: 13 MB, and 1 % of a body's side.
_OVERLAP_VOXELS = 1 << 21
_OVERLAP_SIDE = 1 << 9
#: Columns through an edge may miscount: so much of a body's voxels, an edge of a column in a hundred.
_WRONG_SHARE = 1e-3
#: Lattice points of a silhouette, a byte each: a shadow reaches far behind a target as high as the sonar.
_MOST_POINTS = 1 << 28


def voxelise_truth(mesh: trimesh.Trimesh, volume: Volume) -> BoolArray:
    """Return the voxels whose centres lie inside a mesh.

    Each centre's winding number is summed along the vertical above it: +1 where the line leaves a body, -1
    where it enters one. Bodies may be non-convex, touch or overlap.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Closed bodies with outward normals, scene frame; may be without faces.
    volume : Volume
        Voxel lattice.

    Returns
    -------
    ndarray of bool, shape (nz, ny, nx)

    Raises
    ------
    GeometryError
        If the mesh has faces but is not closed.
    """
    return np.asarray(_windings(mesh, volume) > 0)


def enclosed_volume(mesh: trimesh.Trimesh) -> float:
    """Return the volume (m³) of the union of closed bodies: where they overlap it counts once.

    The sum of the bodies is exact; what overlaps is counted on a lattice of at most 2²¹ voxels and taken off.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Closed bodies with outward normals.

    Raises
    ------
    GeometryError
        If the mesh has faces but is not closed, or bodies of it are inside out.

    Examples
    --------
    >>> import trimesh
    >>> round(enclosed_volume(trimesh.creation.box((0.8, 0.4, 0.4))), 6)
    0.128
    """
    if not len(mesh.faces):
        return 0.0
    low, high = mesh.bounds
    size = np.maximum(high - low, 1e-9)
    voxel = max(float(np.cbrt(size.prod() / _OVERLAP_VOXELS)), float(size.max()) / _OVERLAP_SIDE)
    shape = [max(1, int(np.ceil(s / voxel))) for s in size]
    volume = Volume(tuple(low + voxel / 2.0), voxel, (shape[2], shape[1], shape[0]))
    windings = _windings(mesh, volume)
    wrong = int(np.count_nonzero(windings < 0))
    if wrong > _WRONG_SHARE * np.count_nonzero(windings):
        raise GeometryError(
            f"mesh is inside out in {wrong * voxel**3:.3g} m³ of it; expected normals that point outward"
        )
    twice = int(np.maximum(windings - 1, 0).sum(dtype=np.int64))
    return float(mesh.volume) - twice * voxel**3


def _windings(mesh: trimesh.Trimesh, volume: Volume) -> NDArray[np.int32]:
    """Return how often the surface goes round each voxel's centre."""
    crossings = np.zeros(volume.shape, dtype=np.int16)
    if len(mesh.faces):
        if open_edges(mesh.faces):  # by its corners' numbers: they may have to be joined first
            solid = judge_solid(mesh)
            if left := solid.open_edges:
                raise GeometryError(
                    f"mesh is not closed: it ends at {left} edges; expected a closed surface, or no faces"
                )
            mesh = solid.mesh
        corners = np.asarray(mesh.triangles, dtype=np.float64)
        corners = (corners - volume.origin_m) / volume.voxel_size_m + _COLUMN_OFFSET
        add_windings(np.ascontiguousarray(corners), crossings)
    return np.cumsum(crossings[::-1], axis=0, dtype=np.int32)[::-1]


def shadow_hull(
    mesh: trimesh.Trimesh, sonar_positions_m: ArrayLike, volume: Volume, *, spacing_m: float = 0.0025
) -> BoolArray:
    """Return the voxels that perfect shadow silhouettes of a mesh leave standing.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        True target, scene frame; may be without faces.
    sonar_positions_m : array_like, shape (n, 3)
        Sonar position of each view.
    volume : Volume
        Voxel lattice.
    spacing_m : float
        Lattice of the silhouettes. A shadow point counts as inside if one of the four lattice points around
        it is: the hull may be too large by this much, never too small at a smooth edge.

    Returns
    -------
    ndarray of bool, shape (nz, ny, nx)

    Raises
    ------
    GeometryError
        If there are no positions, or one is not above the mesh and the volume.
    """
    check_range("silhouette spacing", spacing_m, 0.0, 10.0, "m", open_low=True)
    positions = np.asarray(sonar_positions_m, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3 or not len(positions):
        raise GeometryError(f"sonar positions have shape {positions.shape}; expected (n, 3), n > 0")
    low = int(positions[:, 2].argmin())
    if not positions[low, 2] > volume.z_m[-1]:
        raise GeometryError(
            f"sonar position {low} is at z = {positions[low, 2]:g} m; expected above the volume, which"
            f" reaches {volume.z_m[-1]:g} m"
        )
    alive = np.ones(volume.shape, dtype=bool)
    if not len(mesh.faces):
        alive[:] = False
        return alive
    axes = (volume.x_m, volume.y_m, volume.z_m)
    for sonar in positions:
        shadow = project_shadow(np.asarray(mesh.triangles, dtype=np.float64), sonar)
        corner = shadow.min(axis=(0, 1)) - 2.0 * spacing_m
        cells = np.ceil((shadow.max(axis=(0, 1)) - corner) / spacing_m) + 3
        if not cells.prod() <= _MOST_POINTS:
            raise GeometryError(
                f"target's shadow takes {cells[0]:.3g} x {cells[1]:.3g} points of {spacing_m:g} m;"
                f" expected at most {_MOST_POINTS:.1g}"
            )
        cols, rows = cells.astype(int)
        silhouette = np.zeros((rows, cols), dtype=np.uint8)
        fill_triangles((shadow - corner) / spacing_m, silhouette)
        keep_shadowed(alive, axes, sonar, silhouette, (float(corner[0]), float(corner[1])), spacing_m)
    return alive


def iou(a: ArrayLike, b: ArrayLike) -> float:
    """Return the intersection of two voxel sets over their union; 1 if both are empty.

    Raises
    ------
    GeometryError
        If their shapes differ.
    """
    first, second = np.asarray(a, dtype=bool), np.asarray(b, dtype=bool)
    if first.shape != second.shape:
        raise GeometryError(f"voxel sets have shapes {first.shape} and {second.shape}; expected the same")
    union = int(np.count_nonzero(first | second))
    return int(np.count_nonzero(first & second)) / union if union else 1.0
