"""Ground that a carved body encloses: a lit top that carved the body's middle away, or a hollow.

Lit pixels inside a ring of walls may be the top of a low body, as of a slab under a table, or the floor of
a tray. The walls themselves tell the two apart: on a floor their own shadow falls, and a top is lit there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..geometry import View
from ..imaging.mask_codes import MASK_SHADOW, MASK_UNKNOWN
from .explained import about, cast_shadow
from .volume import VoxelGrid

BoolArray = NDArray[np.bool_]

#: The walls' shadow counts clear of its edges by so much (resolution cells), which speckle roughens. Neither
#: half nor double changes what is filled below.
_CLEAR_CELLS = 1.0
#: Walls have gaps, where a view or two see past them, of up to twice this (cross-range cells). A slab of
#: 0.9 x 0.7 x 0.1 m under a table has 0.87 and 0.86 of its hull with it (steps of 3 and 6 degrees); at half
#: 0.86 and 0.60, at double 0.90 and 0.83.
_GAP_CELLS = 1.0
#: What is enclosed is a hollow if this share of the walls' shadow on its ground is dark: 0.13 over that slab,
#: 0.38 to 0.47 in a cage of bars. Chosen on these two. At half the slab's shape
#: is the same; at double too, and the cage is filled.
_HOLLOW = 0.3


def enclosed(occupied: BoolArray, gap_voxels: float = 0.0) -> BoolArray:
    """Mark the free voxels that walls enclose in each layer from the seabed up, shape (nz, ny, nx).

    Parameters
    ----------
    occupied : ndarray of bool, shape (nz, ny, nx)
        The body.
    gap_voxels : float
        Gaps in the walls up to twice this count as closed.

    Examples
    --------
    >>> ring = np.ones((2, 3, 3), bool)
    >>> ring[:, 1, 1] = False
    >>> ring[1, 0, 1] = False
    >>> enclosed(ring)[:, 1, 1].tolist()
    [True, False]
    >>> enclosed(ring, gap_voxels=1.0)[:, 1, 1].tolist()
    [True, True]
    """
    out = np.zeros_like(occupied)
    below = np.ones(occupied.shape[1:], np.bool_)
    for k, layer in enumerate(occupied):
        out[k] = below = scipy.ndimage.binary_fill_holes(_closed(layer, gap_voxels)) & ~layer & below
        if not below.any():
            break
    return out


def _closed(layer: BoolArray, radius: float) -> BoolArray:
    """Close gaps in a layer up to twice a radius, voxels."""
    if radius <= 0.0 or not layer.any():
        return layer
    room = 1 + math.ceil(radius)
    padded = np.pad(layer, room)
    grown = scipy.ndimage.distance_transform_edt(~padded) <= radius
    closed = scipy.ndimage.distance_transform_edt(grown) > radius
    return np.asarray(layer | closed[room:-room, room:-room])


def filled_rings(body: VoxelGrid, masks: Iterable[View], cell_m: float) -> BoolArray:
    """Return a body's voxels with those that its walls enclose, where their shadow is not seen in there.

    Parameters
    ----------
    body : VoxelGrid
        The body.
    masks : iterable of View
        Shadow masks; none is taken where the walls enclose nothing.
    cell_m : float
        Cross-range resolution of the views, m.

    Returns
    -------
    ndarray of bool, shape (nz, ny, nx)
        The body's own array where nothing is filled.
    """
    free = enclosed(body.occupied, _GAP_CELLS * cell_m / body.volume.voxel_size_m)
    labels, count = scipy.ndimage.label(free[0])
    if not count:
        return body.occupied
    rows, cols = np.nonzero(labels)
    ground = np.stack([body.volume.x_m[cols], body.volume.y_m[rows], np.ones(len(rows))])
    ring = labels[rows, cols]
    fallen, dark = np.zeros(count + 1), np.zeros(count + 1)
    for mask in masks:
        shaded, seen_dark = _shade_at(mask, body, ground)
        fallen += np.bincount(ring, shaded, count + 1)
        dark += np.bincount(ring, shaded & seen_dark, count + 1)
    top = (fallen > 0.0) & (dark <= _HOLLOW * fallen)
    return np.asarray(body.occupied | (free & top[labels])) if top.any() else body.occupied


def _shade_at(mask: View, body: VoxelGrid, ground: NDArray[np.float64]) -> tuple[BoolArray, BoolArray]:
    """Say of places (x, y, 1) whether the body's shadow falls there in a view, and whether they are dark."""
    clear = ~about(~cast_shadow(mask, body.volume, body.occupied), mask.info, _CLEAR_CELLS)
    u, v = np.rint(mask.info.camera.ground_to_pixel[:2] @ ground).astype(np.intp)
    inside = (u >= 0) & (u < clear.shape[1]) & (v >= 0) & (v < clear.shape[0])
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    pixels = mask.pixels[v, u]
    return inside & clear[v, u] & (pixels != MASK_UNKNOWN), pixels == MASK_SHADOW


__all__ = ["enclosed", "filled_rings"]
