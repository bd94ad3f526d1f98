"""Bodies made of closed convex parts, which can be tilted, sunk into the seabed and cut off there.

A part stays convex whatever is done to it, so what is left above the seabed is the hull of its corners above
and of where its edges cross z = 0. Shapes that are not convex are several parts that touch or overlap:
shadows are unions, and occupancy counts windings.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from ..core.errors import GeometryError

FloatArray = NDArray[np.float64]
Parts = list[trimesh.Trimesh]

#: What is left of a part is dropped where it is thinner than this share of the body: a sliver of it casts
#: no shadow that any image holds, and its hull is not closed to rounding.
_SLIVER = 1e-4


def convex(points: ArrayLike) -> trimesh.Trimesh:
    """Return the convex hull of points, shape (n, 3), as a closed mesh."""
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(np.asarray(points, dtype=np.float64))
    return hull


def brick(size: Sequence[float], centre: Sequence[float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """Make a box of a size (x, y, z) whose foot is centred on a point."""
    mesh: trimesh.Trimesh = trimesh.creation.box(extents=size)
    mesh.apply_translation([centre[0], centre[1], centre[2] + size[2] / 2.0])
    return mesh


def frustum(
    base: float, top: float, height: float, *, sections: int = 40, centre: Sequence[float] = (0.0, 0.0, 0.0)
) -> trimesh.Trimesh:
    """Make a standing round body of two diameters (top 0: a cone); its foot is centred on a point."""
    turn = np.arange(sections) * (2.0 * math.pi / sections)
    ring = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(sections)])
    upper = ring * (top / 2.0) + [0.0, 0.0, height] if top > 0 else np.array([[0.0, 0.0, height]])
    return convex(np.vstack([ring * (base / 2.0), upper]) + np.asarray(centre, dtype=np.float64))


def bar(start: ArrayLike, stop: ArrayLike, diameter: float, *, sections: int = 24) -> trimesh.Trimesh:
    """Make a round bar between two points."""
    a, b = (np.asarray(p, dtype=np.float64) for p in (start, stop))
    mesh = frustum(diameter, diameter, float(np.linalg.norm(b - a)), sections=sections)
    mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], b - a))
    mesh.apply_translation(a)
    return mesh


def ellipsoid(size: Sequence[float]) -> trimesh.Trimesh:
    """Make an ellipsoid of a size (x, y, z) about the origin."""
    ball = trimesh.creation.icosphere(subdivisions=3).vertices
    return convex(ball / np.ptp(ball, axis=0) * np.asarray(size, dtype=np.float64))


def ring(outer: float, tube: float, *, sections: int = 40) -> Parts:
    """Make a flat-lying ring of a round tube: convex slices that touch one another."""
    middle, turn = (outer - tube) / 2.0, np.arange(16) * (2.0 * math.pi / 16)
    step = 2.0 * math.pi / sections
    circles = []
    for k in range(sections):
        out = np.array([math.cos(k * step), math.sin(k * step), 0.0])
        radius = middle + tube / 2.0 * np.cos(turn)
        circles.append(radius[:, None] * out + np.outer(tube / 2.0 * np.sin(turn), [0.0, 0.0, 1.0]))
    return [convex(np.vstack([circles[k], circles[(k + 1) % sections]])) for k in range(sections)]


def transformed(parts: Iterable[trimesh.Trimesh], matrix: ArrayLike) -> Parts:
    """Return copies of parts, moved by a 4×4 matrix."""
    moved = []
    for part in parts:
        copy = part.copy()
        copy.apply_transform(np.asarray(matrix, dtype=np.float64))
        moved.append(copy)
    return moved


def bounds_of(parts: Iterable[trimesh.Trimesh]) -> FloatArray:
    """Return the lowest and the highest corner of parts, shape (2, 3)."""
    each = np.array([part.bounds for part in parts])
    return np.stack([each[:, 0].min(axis=0), each[:, 1].max(axis=0)])


def above_seabed(parts: Sequence[trimesh.Trimesh]) -> Parts:
    """Return what of convex parts is above z = 0, each closed there by its section.

    Raises
    ------
    GeometryError
        If nothing is.
    """
    least = _SLIVER * float(np.ptp(bounds_of(parts), axis=0).max())
    kept = []
    for part in parts:
        points = np.asarray(part.vertices, dtype=np.float64)
        if points[:, 2].min() >= 0.0:
            kept.append(part)
            continue
        if points[:, 2].max() <= least:
            continue
        a, b = (points[part.edges_unique[:, i]] for i in (0, 1))
        cut = (a[:, 2] > 0.0) != (b[:, 2] > 0.0)
        share = a[cut, 2] / (a[cut, 2] - b[cut, 2])
        section = a[cut] + share[:, None] * (b[cut] - a[cut])
        section[:, 2] = 0.0
        kept.append(convex(np.vstack([points[points[:, 2] > 0.0], section])))
    if not kept:
        raise GeometryError("the body is buried whole; expected a part of it above the seabed")
    return kept


def settled(parts: Sequence[trimesh.Trimesh], *, tilt_rad: float, about_rad: float, buried: float) -> Parts:
    """Tilt a body about a horizontal axis, let it rest on the seabed, and sink it in.

    Parameters
    ----------
    parts : sequence of trimesh.Trimesh
        Convex parts.
    tilt_rad, about_rad : float
        How far, and about which axis (from +x).
    buried : float
        Share of the height that is under the seabed.

    Returns
    -------
    list of trimesh.Trimesh
        What is above the seabed, its plan centred on the origin.
    """
    axis = (math.cos(about_rad), math.sin(about_rad), 0.0)
    moved = transformed(parts, trimesh.transformations.rotation_matrix(tilt_rad, axis))
    low, high = bounds_of(moved)
    down = np.eye(4)
    down[2, 3] = -low[2] - buried * (high[2] - low[2])
    left = above_seabed(transformed(moved, down))
    low, high = bounds_of(left)
    centre = np.eye(4)
    centre[:2, 3] = -(low[:2] + high[:2]) / 2.0
    return transformed(left, centre)
