"""The cap that carving leaves on a top, and the height that it tells.

The far ends of shadows cannot tell a flat top from one that rises towards its middle at up to the grazing
angle, and carving leaves that cap. How gradually it begins tells a dome.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..equality import equal_where_nan
from ..methods import method_named
from .volume import VoxelGrid

FloatArray = NDArray[np.float64]

#: Slack under the cap's top is told in voxels, or in so much of the height that casts a cell of shadow where
#: that is more: edges of layers are no surer, however fine the voxels. Two tables of 0.32 and 0.33 m, in
#: voxels of a fifth of a cell, are 0.36 m high, 0.44 and 0.43 m by voxels alone; at half 0.43 and 0.40 m, at
#: double a tyre of 0.34 m is 0.52 m (0.44). On the population, with coarser voxels, half changes nothing.
_CAP_CELLS = 2.0
#: Where the cap begins: the mean of these two, in that unit under the cap's top.
_CAP_SLACK = (0.2, 0.3)
#: A layer of which no place is so many voxels from its edge, and none a third as far as of the widest, says
#: nothing of the cap: one voxel too many on its tip lifts where it begins by two layers (a box of 0.40 m:
#: 0.46 m for 0.42 m). A pole's layers are all as thin.
_CAP_TIP, _CAP_TIP_SHARE = 2.0, 1.0 / 3.0
#: A hole in a layer of up to this radius (cross-range cells) is speckle: in the middle of a low top it makes
#: the layer as thin as what is round it, and the cap seems to begin at its own top. A wider hole is a
#: hollow. Of 108 extents of 36 low bodies (docs/method.md) 71 are within 5 % or a voxel and 3 outside of
#: their intervals; at half 68 and 10, at double 71 and 3.
HOLE_CELLS = 1.0
#: How gradually it begins tells a dome: between these two, voxels under the cap's top.
_DOME_SLACK = (0.5, 2.0)
#: Carving keeps of a top what nearly all views keep, and views scatter. Half of them keep more, on the
#: columns of the tip and so many voxels around: the height of a round or pointed top takes this share of the
#: difference, that of a flat one less, and its interval all of it. Chosen on 19 bodies of the development
#: half and 52 of ten tapering families whose height no shadow tells otherwise: 47 and 69 % of them are within
#: 5 % or a voxel without it, 47 and 75 % with it, 42 and 73 % at half, 47 and 58 % at double of the share.
_TIP_VOXELS, TIP_SHARE = 2, 0.5
#: A view does not segment a tip that is narrower than one to two cells. Flanks that go on to the carved top
#: meet above it. They are looked at up to where their inscribed radius is so large (cross-range cells; of a
#: thinner body: this share of its own), from this share of that on. And they lead to a narrow top, of less
#: than this share of it: what hardly narrows is a wall. Over fewer layers nothing is told.
_FLANK_CELLS, _FLANK_NEARLY_ALL = 3.0, 0.9
_FLANK_FROM, _FLANK_TO, _FLANK_LAYERS = 0.4, 0.6, 3
#: They rise so many times as steeply as the sonar looks down: as steep alone is the cap of a flat top.
_FLANK_STEEP = 1.3
#: Their layers have less than so many times the area of their inscribed circle (a square 1.3). A ridge ends
#: in a line: views from beside it see how high it is.
_ELONGATED = 2.0
#: If the carved top is narrower than where they lead by more than this (inscribed radius, cross-range cells),
#: it is flat.
_BLUNT_CELLS = 0.6
#: The edge of a carved layer lies so far inside of the body there (cross-range cells).
_INSIDE_CELLS = 0.25


@equal_where_nan
@dataclass(frozen=True)
class Cap:
    """The top of a carved shape, which shadows show only in part.

    Parameters
    ----------
    begins_m : float
        Height (m) at which the cap begins that shadows leave on a flat top: the top, if it is flat.
    dome_m : float
        Height (m) of the top, if it is round.
    top_m : float
        Height (m) of the cap's own top.
    half_m : float
        Height (m) that half of the views keep there: at least the cap's top.
    apex_m : float
        Height (m) of the top if it is a point, where its flanks meet; NaN if they do not go on to it.
    """

    begins_m: float
    dome_m: float
    top_m: float
    half_m: float
    apex_m: float = math.nan


def cap_of(
    grid: VoxelGrid, grazing_rad: float, hole_m: float = 0.0, cell_m: float = 0.0, across_m: float = math.nan
) -> Cap:
    """Find the cap that carving leaves on the top of a shape.

    Parameters
    ----------
    grid : VoxelGrid
        Carved grid with an object.
    grazing_rad : float
        ψ: a layer of inscribed radius R carries a cap tan ψ · R high.
    hole_m : float
        Holes in a layer that are less than twice as wide are speckle, m.
    cell_m : float
        How high what casts a cell of shadow is, m: a layer's edge is no surer than a share of it.
    across_m : float
        Cross-range resolution, m; NaN: the top is not looked at for a point.

    Notes
    -----
    The cap that layer z carries reaches z + tan ψ · R(z). Under a flat top that grows by a metre a metre, and
    stops at the top. A dome of height H and radius of curvature r has R² = 2 r (H - z), the cap's top lies at
    H + t with t = r tan² ψ / 2, and a layer whose cap ends s lower lies at z(s) = H - (√t + √s)²: two of
    these give H.
    """
    d = grid.volume.voxel_size_m
    layers = np.flatnonzero(grid.occupied.any(axis=(1, 2)))
    faces = grid.volume.z_m[layers] + d / 2.0
    inside = np.array([_inscribed(grid.occupied[k], hole_m / d) for k in layers])
    areas = grid.occupied[layers].sum(axis=(1, 2))
    reach = faces + math.tan(grazing_rad) * (inside - 0.5) * d
    top = float(reach[inside >= min(_CAP_TIP, _CAP_TIP_SHARE * inside.max())].max())

    unit = max(d, _CAP_CELLS * cell_m)

    def lowest(slack: float) -> float:
        # The lowest layer from which the cap alone reaches so near the top, interpolated between layers.
        limit = top - slack * unit
        first = int(np.argmax(reach >= limit))
        below = max(first - 1, 0)
        rise = max(float(reach[first] - reach[below]), 1e-9)
        share = float(np.clip((limit - reach[below]) / rise, 0.0, 1.0))
        return float(faces[below] + share * (faces[first] - faces[below]))

    begins = float(np.mean([lowest(slack) for slack in _CAP_SLACK]))
    near, far = (slack * unit for slack in _DOME_SLACK)
    z_near, z_far = (lowest(slack) for slack in _DOME_SLACK)
    root_t = max(0.0, (z_near - z_far - (far - near)) / (2.0 * (math.sqrt(far) - math.sqrt(near))))
    dome = z_near + (root_t + math.sqrt(near)) ** 2
    return Cap(
        begins,
        float(np.clip(dome, begins, max(begins, faces[-1]))),
        float(faces[-1]),
        float(faces[-1]) + _kept_above(grid, int(layers[-1])),
        _apex(faces, (inside - 0.5) * d, areas * d**2, grazing_rad, across_m),
    )


def _apex(
    faces: FloatArray, radii: FloatArray, areas: FloatArray, grazing_rad: float, across_m: float
) -> float:
    """Return how high a carved top is if it is a point (m); NaN if it is none.

    Parameters
    ----------
    faces, radii, areas : ndarray, shape (n,)
        Height of each layer's top (m), its inscribed radius (m) and its area (m²), upwards.
    grazing_rad, across_m : float
        ψ, and cross-range resolution, m; NaN: nothing is told.
    """
    if math.isnan(across_m):
        return math.nan
    # From the top down, as far as it widens.
    wide = min(_FLANK_CELLS * across_m, _FLANK_NEARLY_ALL * float(radii.max()))
    down = radii[::-1]
    over = (down > wide) | (down < np.maximum.accumulate(down) - 0.1 * wide)
    first = len(radii) - (int(over.argmax()) if over.any() else len(radii))
    z, r = faces[first:], radii[first:]
    flank = r >= _FLANK_FROM * wide
    if np.count_nonzero(flank) < _FLANK_LAYERS or r[-1] > _FLANK_TO * wide:
        return math.nan
    if float(np.median(areas[first:][flank] / r[flank] ** 2)) > math.pi * _ELONGATED:
        return math.nan
    narrows, level = np.polyfit(z[flank], r[flank], 1)
    if narrows >= 0.0 or -1.0 / narrows < _FLANK_STEEP * math.tan(grazing_rad):
        return math.nan
    blunt = float(narrows * z[-1] + level - r[-1])
    if blunt > _BLUNT_CELLS * across_m:
        return math.nan
    return float(-(level + _INSIDE_CELLS * across_m) / narrows)


def _inscribed(layer: NDArray[np.bool_], room: float) -> float:
    """Return the radius (voxels) of the largest circle in a layer, holes of a radius up to `room` filled."""
    padded = np.pad(layer, 1)
    holes, count = scipy.ndimage.label(~padded)
    if room > 0.0 and count > 1:
        radius = scipy.ndimage.maximum(scipy.ndimage.distance_transform_edt(~padded), holes, range(count + 1))
        small = np.asarray(radius) <= room
        small[[0, holes[0, 0]]] = False  # the layer itself, and what is round it
        padded |= small[holes]
    return float(scipy.ndimage.distance_transform_edt(padded).max())


def _kept_above(grid: VoxelGrid, last: int) -> float:
    """Return how much more (m) half of the views keep of an object's top, `last` its highest layer.

    0 where the grid does not count views.
    """
    if not method_named(grid.method).takes_masks or not grid.threshold < 0.5:
        return 0.0
    tip = scipy.ndimage.binary_dilation(grid.occupied[last], iterations=_TIP_VOXELS)
    above = grid.likelihood[last:, tip]
    # Unknown voxels are not kept.
    least = np.where(np.isnan(above), 1.0, above).min(axis=1)

    def reaches(share: float) -> float:
        where = int(np.argmax(least >= share)) if (least >= share).any() else len(least) - 1
        if where == 0 or least[where] < share:
            return float(where)
        low, high = least[where - 1], least[where]
        return where - 1 + float((share - low) / (high - low))

    return (reaches(0.5) - reaches(grid.threshold)) * grid.volume.voxel_size_m


def cap_height(cap: Cap, cell_m: float, tip_share: float) -> float:
    """Return the height (m) that a cap tells, between flat and round; a cell of shadow is `cell_m` high."""
    # A flat top says by how abruptly its cap begins that half of the views err there.
    rounded = (cap.dome_m - cap.begins_m + cell_m) / (cap.top_m - cap.begins_m + cell_m)
    tip = tip_share * min(rounded, 1.0) * (cap.half_m - cap.top_m)
    return 0.5 * (cap.begins_m + cap.dome_m) + tip


__all__ = ["HOLE_CELLS", "TIP_SHARE", "Cap", "cap_height", "cap_of"]
