"""The part of the segmented shadow that a carved body explains: its own shadow, cast back into the views.

A body is a set of voxels; P · X of each is the pixel that it darkens. Dark pixels of the target's silhouette
that no voxel of it darkens are unexplained: the body lacks something, and the voxels that would supply it are
those that darken them. Pixels that it darkens and that are lit say that it has too much.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry import View, ViewInfo
from ..imaging.mask_codes import MASK_OUTSIDE, MASK_SHADOW
from ..kernels import kernel
from .volume import Volume, VoxelGrid

BoolArray = NDArray[np.bool_]

#: Segmented shadow counts as unexplained where it lies more than this outside of the cast one (resolution
#: cells): a silhouette's own edge is that rough. At half of it a measured vehicle (docs/examples.md) grows
#: from 7.3 to 8.1 m of length (6.95 in truth); at double a slab under a table falls from 0.60 to 0.46 of its
#: hull.
ROUGH_CELLS = 1.5


@kernel()
def _cast(
    occupied: BoolArray, affines: NDArray[np.float64], x0: float, y0: float, step: float, out: BoolArray
) -> None:  # pragma: no cover
    """Mark the pixels whose middles the voxels' shadows cover, as boxes round their middles."""
    nz, ny, nx = occupied.shape
    rows, cols = out.shape
    for k in range(nz):
        a = affines[k]
        half_u = 0.5 * step * (abs(a[0, 0]) + abs(a[0, 1]))
        half_v = 0.5 * step * (abs(a[1, 0]) + abs(a[1, 1]))
        for j in range(ny):
            for i in range(nx):
                if not occupied[k, j, i]:
                    continue
                x, y = x0 + i * step, y0 + j * step
                u = a[0, 0] * x + a[0, 1] * y + a[0, 2]
                v = a[1, 0] * x + a[1, 1] * y + a[1, 2]
                for q in range(max(0, math.ceil(v - half_v)), min(rows, math.floor(v + half_v) + 1)):
                    for p in range(max(0, math.ceil(u - half_u)), min(cols, math.floor(u + half_u) + 1)):
                        out[q, p] = True


@kernel()
def _count(
    voxels: NDArray[np.int32],
    affines: NDArray[np.float64],
    x0: float,
    y0: float,
    step: float,
    marked: BoolArray,
    counts: NDArray[np.int32],
) -> None:  # pragma: no cover
    """Count the voxels whose shadow pixel is marked."""
    rows, cols = marked.shape
    for m in range(voxels.shape[0]):
        k, j, i = voxels[m, 0], voxels[m, 1], voxels[m, 2]
        a = affines[k]
        x, y = x0 + i * step, y0 + j * step
        u = math.floor(a[0, 0] * x + a[0, 1] * y + a[0, 2] + 0.5)
        v = math.floor(a[1, 0] * x + a[1, 1] * y + a[1, 2] + 0.5)
        if u >= 0 and v >= 0 and u < cols and v < rows:
            counts[m] += marked[v, u]


@dataclass(frozen=True)
class ShadowFit:
    """How a body's shadow fits the segmented one of a view.

    Parameters
    ----------
    unexplained : float
        Share of the segmented shadow that lies clear of the cast one; NaN where none was segmented.
    lit : float
        Share of the cast shadow that is lit seabed, clear of the segmented one; NaN where none is cast.
    """

    unexplained: float
    lit: float


def cast_shadow(mask: View, volume: Volume, occupied: BoolArray) -> BoolArray:
    """Mark the pixels of a view that the shadow of a body falls on.

    Parameters
    ----------
    mask : View
        The view.
    volume : Volume
        The body's lattice.
    occupied : ndarray of bool, shape (nz, ny, nx)
        The body.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
    """
    cast = np.zeros(mask.info.camera.shape, np.bool_)
    affines = mask.info.camera.height_slice_affines(volume.z_m)
    x0, y0, _ = volume.origin_m
    _cast(np.ascontiguousarray(occupied), affines, x0, y0, volume.voxel_size_m, cast)
    return cast


def about(pixels: BoolArray, info: ViewInfo, cells: float = ROUGH_CELLS) -> BoolArray:
    """Extend pixels by so many resolution cells; by default by what a silhouette's edge is rough."""
    rows, cols = (
        math.ceil(cells * cell / spacing)
        for cell, spacing in zip(info.resolution_m, info.camera.spacing_m, strict=True)
    )
    box = np.ones((2 * rows + 1, 2 * cols + 1), np.uint8)
    return np.asarray(cv2.dilate(pixels.view(np.uint8), box).view(np.bool_))


def unexplained_shadow(mask: View, grids: Sequence[VoxelGrid]) -> BoolArray:
    """Mark the segmented shadow of a view that no body casts.

    Parameters
    ----------
    mask : View
        Shadow mask, shape (rows, cols).
    grids : sequence of VoxelGrid
        The bodies.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
    """
    cast = np.logical_or.reduce([cast_shadow(mask, grid.volume, grid.occupied) for grid in grids])
    return np.asarray((mask.pixels == MASK_SHADOW) & ~about(cast, mask.info))


def shadow_fit(mask: View, grids: Sequence[VoxelGrid]) -> ShadowFit:
    """Compare the segmented shadow with the shadows that a scene's bodies cast.

    Parameters
    ----------
    mask : View
        Shadow mask of the first body, shape (rows, cols); shadows of others that touch its own may be in it.
    grids : sequence of VoxelGrid
        The bodies.
    """
    dark = np.asarray(mask.pixels == MASK_SHADOW)
    own, *others = (cast_shadow(mask, grid.volume, grid.occupied) for grid in grids)
    lit = own & (mask.pixels == MASK_OUTSIDE) & ~about(dark, mask.info)
    cast = np.logical_or.reduce([own, *others])
    return ShadowFit(_share(dark & ~about(cast, mask.info), dark), _share(lit, own))


def mean_fit(fits: Iterable[ShadowFit]) -> ShadowFit:
    """Return the mean shares of those views that tell them; NaN where none does."""
    shares = np.array([(fit.unexplained, fit.lit) for fit in fits]).reshape(-1, 2).T
    known = [row[np.isfinite(row)] for row in shares]
    return ShadowFit(*(float(row.mean()) if len(row) else math.nan for row in known))


def _share(part: BoolArray, whole: BoolArray) -> float:
    count = int(np.count_nonzero(whole))
    return float(np.count_nonzero(part)) / count if count else math.nan


def count_shadow_pixels(
    mask: View, volume: Volume, voxels: NDArray[np.int32], marked: BoolArray, counts: NDArray[np.int32]
) -> None:
    """Count each voxel with its shadow on a marked pixel.

    Parameters
    ----------
    mask : View
        The view.
    volume : Volume
        Lattice.
    voxels : ndarray of int32, shape (n, 3)
        (k, j, i).
    marked : ndarray of bool, shape (rows, cols)
        Pixels of the view.
    counts : ndarray of int32, shape (n,)
        Added to.
    """
    affines = mask.info.camera.height_slice_affines(volume.z_m)
    _count(voxels, affines, volume.origin_m[0], volume.origin_m[1], volume.voxel_size_m, marked, counts)
