"""Which pieces of a carved volume are objects of their own.

A body of the search need not become an object: it may be a phantom of crossing shadows, the part of another
body that reaches into its volume, or nothing once it is looked at sharply. What is left out says why.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..shape.carving import part_around
from ..shape.result import LeftOut
from ..shape.threshold import LEAST_VOXELS
from ..shape.volume import VoxelGrid
from .bodies import stands_on_seabed
from .decision import PHANTOM

#: Why a body is none of which the views leave nothing.
NOTHING_LEFT = "no voxel of its volume lies in shadow from all sides"
_TOO_FEW = f"fewer than {LEAST_VOXELS} voxels are left of it"
#: Two carved objects are the same body where they share this much of the smaller one.
_SAME_BODY = 0.25
#: Voxels round one of several pieces that were carved in one volume.
_MARGIN_VOXELS = 3
#: Pieces whose plans lie farther apart than this (cross-range cells) are different bodies: as far as a side
#: that stands out of a body belongs to something else (`measurement._FOREIGN_CELLS`).
APART_CELLS = 3.0


def nothing_left(place_m: tuple[float, float]) -> LeftOut:
    """Return what is left of a body of the search that no voxel is: a candidate, as it throws a shadow."""
    return LeftOut(place_m, NOTHING_LEFT, strong=True)


def connected_pieces(occupied: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Return the separate pieces of a carved grid, the largest first.

    Parameters
    ----------
    occupied : ndarray of bool, shape (nz, ny, nx)
        Voxels that meet at a corner are connected.

    Returns
    -------
    list of ndarray of bool, each of that shape
    """
    labels, count = scipy.ndimage.label(occupied, np.ones((3, 3, 3), bool))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    return [np.asarray(labels == 1 + i) for i in np.argsort(-sizes, kind="stable")]


def without_neighbours(
    grid: VoxelGrid, apart_m: float, place_m: tuple[float, float] | None = None
) -> tuple[VoxelGrid, VoxelGrid | None]:
    """Tell the body that a volume was carved for from others in it.

    The search may take neighbours for one body. Carved, they stand apart.

    Parameters
    ----------
    grid : VoxelGrid
        Carved round the body.
    apart_m : float
        Pieces whose plans lie farther apart than this are different bodies, m.
    place_m : (float, float), optional
        Where the body is; by default it is the one with most voxels.

    Returns
    -------
    own : VoxelGrid
        `grid` itself where it holds one body.
    others : VoxelGrid or None
        The same lattice with what is not of the body.
    """
    plan = grid.occupied.any(axis=0)
    if not plan.any():
        return grid, None
    reach = apart_m / 2.0 / grid.volume.voxel_size_m
    margin = 1 + math.ceil(reach)
    grown = scipy.ndimage.distance_transform_edt(~np.pad(plan, margin)) <= reach
    labels, count = scipy.ndimage.label(grown, np.ones((3, 3), bool))
    body = labels[margin:-margin, margin:-margin]
    sizes = np.bincount(body.ravel(), grid.occupied.sum(axis=0).ravel(), minlength=count + 1)
    if count == 1:
        return grid, None
    kept = int(sizes[1:].argmax()) + 1
    if place_m is not None:
        j, i = np.nonzero(plan & (sizes[body] >= LEAST_VOXELS))
        if len(j):
            away = np.hypot(grid.volume.x_m[i] - place_m[0], grid.volume.y_m[j] - place_m[1])
            nearest = int(away.argmin())
            kept = int(body[j[nearest], i[nearest]])
    own = grid.occupied & (body == kept)
    return replace(grid, occupied=own), replace(grid, occupied=grid.occupied & ~own)


def overlap_share(a: VoxelGrid, b: VoxelGrid) -> float:
    """Return the overlap of two grids' objects, as a fraction of the smaller one (by volume).

    The lattices may differ: a voxel of `a` is shared where its centre lies in an occupied voxel of `b`.
    """
    if not a.occupied.any() or not b.occupied.any():
        return 0.0
    k, j, i = np.nonzero(a.occupied)
    index = []
    for where, axis, origin, size in zip(
        (k, j, i),
        (a.volume.z_m, a.volume.y_m, a.volume.x_m),
        b.volume.origin_m[::-1],
        b.occupied.shape,
        strict=True,
    ):
        at = np.rint((axis[where] - origin) / b.volume.voxel_size_m).astype(np.intp)
        index.append(np.where((at >= 0) & (at < size), at, -1))
    inside = np.all([at >= 0 for at in index], axis=0)
    shared = np.count_nonzero(b.occupied[tuple(at[inside] for at in index)])
    d_a, d_b = a.volume.voxel_size_m**3, b.volume.voxel_size_m**3
    smaller = min(len(k) * d_a, np.count_nonzero(b.occupied) * d_b)
    return float(shared * d_a / smaller)


def is_same_body(a: VoxelGrid, b: VoxelGrid) -> bool:
    """Say whether two carved objects are the same body."""
    return overlap_share(a, b) >= _SAME_BODY


def objects_of(
    grid: VoxelGrid, place_m: tuple[float, float], reported: Sequence[VoxelGrid], *, cut: bool = False
) -> tuple[list[VoxelGrid], list[LeftOut]]:
    """List the objects in a body's carved volume that were not reported before.

    Parameters
    ----------
    grid : VoxelGrid
        Carved round the body.
    place_m : (float, float)
        Where the search found it.
    reported : sequence of VoxelGrid
        Grids of the objects found so far, in that order.
    cut : bool
        Cut `grid` down to its piece also where it holds one alone.

    Returns
    -------
    objects : list of VoxelGrid
        None to many, the largest first: `grid` itself where it holds one, cut down to each piece otherwise.
    left_out : list of LeftOut
        Pieces, or the whole body, that are no objects.
    """
    pieces = connected_pieces(grid.occupied)
    if not pieces:
        return [], [nothing_left(place_m)]
    if int(np.count_nonzero(pieces[0])) < LEAST_VOXELS:
        return [], [LeftOut(place_m, _TOO_FEW, strong=True)]
    objects: list[VoxelGrid] = []
    left_out = []
    for piece in pieces:
        one = _only(grid, piece, whole=len(pieces) == 1 and not cut)
        if reason := _why_no_object(grid, piece, [*reported, *objects]):
            left_out.append(LeftOut(_middle(one), reason))
        else:
            objects.append(one)
    return objects, left_out


def _why_no_object(grid: VoxelGrid, piece: NDArray[np.bool_], reported: Sequence[VoxelGrid]) -> str:
    """Return why a piece is no object of its own; empty if it is one."""
    if int(np.count_nonzero(piece)) < LEAST_VOXELS:
        return _TOO_FEW
    alone = VoxelGrid(grid.volume, grid.likelihood, grid.views, grid.threshold, piece, grid.method)
    for number, other in enumerate(reported, start=1):
        share = overlap_share(alone, other)
        if share >= _SAME_BODY:
            return f"the same body as object {number}: they share {100.0 * share:.0f} % of the smaller one"
    layers = np.flatnonzero(piece.any(axis=(1, 2)))
    half = grid.volume.voxel_size_m / 2.0
    bottom, top = grid.volume.z_m[layers[0]] - half, grid.volume.z_m[layers[-1]] + half
    if not stands_on_seabed(float(bottom), float(top)):
        return PHANTOM
    plan = np.asarray(piece.any(axis=0))
    if plan[0].any() or plan[-1].any() or plan[:, 0].any() or plan[:, -1].any():
        return "it reaches through the side of its volume: a part of something else"
    return ""


def _only(grid: VoxelGrid, piece: NDArray[np.bool_], *, whole: bool) -> VoxelGrid:
    """Return a grid in which a piece alone is occupied; cut down to the piece unless it is the whole body."""
    if whole:
        return grid
    box, volume = part_around(piece, grid.volume, _MARGIN_VOXELS)
    return VoxelGrid(
        volume, grid.likelihood[box], grid.views[box], grid.threshold, piece[box].copy(), grid.method
    )


def _middle(grid: VoxelGrid) -> tuple[float, float]:
    _, j, i = np.nonzero(grid.occupied)
    return float(grid.volume.x_m[i].mean()), float(grid.volume.y_m[j].mean())
