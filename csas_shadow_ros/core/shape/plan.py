"""The ground that a body stands on, by the sides of its shadows, and where its own echo can be on it.

Seen from any aspect the shadow is as wide as the body, whatever the heights are: its sides bound the plan,
also where the body slopes so gently down to the seabed that its side is lit. A lit pixel on that plan, or
before it by the layover of the body's height, may be the body's own echo. Elsewhere it is seabed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..geometry import TWO_PI, View, ViewInfo, cross_range_axis
from ..imaging.mask_codes import MASK_SHADOW
from .explained import about, cast_shadow
from .layover import layover_per_metre
from .volume import MARGIN_SHARE, Volume, VoxelGrid

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]

#: A side's outermost place is found after a running median over so many rows to either side (resolution cells
#: down-range): speckle roughens it, and a body's own corners are broader.
_MEDIAN_HALF_CELLS = 1.2
#: The plan lies so far inside of what the sides bound (resolution cells across): the looks of an aperture see
#: past the ends of a flat side. Of 19 bodies of the population's development half (mean IoU 0.753) none
#: changes by more than 0.04 at half; at double the mean is 0.729, as a pipe loses 0.3.
_INSIDE_CELLS = 0.5
#: The body's echo may show so many resolution cells beyond its plan, down-range and across. At half the mean
#: of the same bodies is 0.747, at double 0.758.
_RESPONSE_CELLS = (3.0, 2.0)
#: Directions that a plan's sides face.
_DIRECTIONS = 120
#: Sides that lie beyond the carved volume are those of other bodies, whose shadows touch this one's. The plan
#: is known if the others bound it in this share of all directions. Of the population's bodies they do so in
#: 0.78 to 1, of a frame in its laying grid in 0.41: at half that swells eightfold, at 0.8 a wedge stays lost
#: (IoU 0.13 for 0.79).
_LEAST_BOUNDED = 0.6


@dataclass(frozen=True)
class ShadowSides:
    """How far a body's shadow reaches to either side in one view, at the body's own range.

    Parameters
    ----------
    direction_rad : float
        Direction on the ground of the side on the right; the other one faces the opposite way.
    right_m, left_m : float
        How far the sides lie from the body's place, each in its own direction, m.
    aperture_rad : float
        Aperture of the view.
    cell_m : float
        Its cross-range resolution, m.
    """

    direction_rad: float
    right_m: float
    left_m: float
    aperture_rad: float
    cell_m: float


def shadow_sides(mask: View, body: VoxelGrid, about_m: tuple[float, float]) -> ShadowSides | None:
    """Find how far the shadow of a body reaches to either side in a view.

    Parameters
    ----------
    mask : View
        Shadow mask, shape (rows, cols).
    body : VoxelGrid
        The body. Of the segmented shadow the connected pieces count that its own shadow falls on.
    about_m : (float, float)
        Its place (x, y), m.

    Returns
    -------
    ShadowSides or None
        None where no shadow of it was segmented.
    """
    shadow = _own_shadow(mask, body)
    rows = np.flatnonzero(shadow.any(axis=1))
    if not len(rows):
        return None
    info = mask.info
    camera = info.camera
    row_m, col_m = camera.spacing_m
    u0, v0, _ = camera.ground_to_pixel @ np.array([about_m[0], about_m[1], 1.0])
    sonar_range = math.hypot(camera.sonar_m[0] - about_m[0], camera.sonar_m[1] - about_m[1])
    # Rays fan out from the sonar: seen at the body's range, the shadow behind it is narrower.
    scale = sonar_range / np.maximum(sonar_range + (rows - v0) * row_m, row_m)
    first = shadow[rows].argmax(axis=1)
    last = shadow.shape[1] - 1 - shadow[rows][:, ::-1].argmax(axis=1)
    smooth = 2 * round(_MEDIAN_HALF_CELLS * info.cell_px[0]) + 1
    right, left = (
        float(scipy.ndimage.median_filter(side * scale, smooth, mode="nearest").max()) * col_m
        for side in (last + 0.5 - u0, u0 - first + 0.5)
    )
    across = cross_range_axis(info.aspect_rad)
    direction = math.atan2(across[1], across[0])
    return ShadowSides(direction, right, left, info.aperture_rad, info.resolution_m[1])


def _own_shadow(mask: View, body: VoxelGrid) -> BoolArray:
    """Mark the pieces of the segmented shadow that a body's shadow falls on."""
    shadow = mask.pixels == MASK_SHADOW
    _, pieces = cv2.connectedComponents(shadow.view(np.uint8), connectivity=8)
    own = np.zeros(int(pieces.max()) + 1, np.bool_)
    own[pieces[shadow & cast_shadow(mask, body.volume, body.occupied)]] = True
    return np.asarray(own[pieces])


def plan_of_sides(sides: Sequence[ShadowSides], volume: Volume) -> FloatArray | None:
    """Return the convex plan that the sides of a body's shadows bound.

    Each direction is bounded by the median over an aperture of neighbouring views. Views from opposite
    aspects see the same two sides; the wider of both counts, as a low end may leave no shadow in one of them.

    Parameters
    ----------
    sides : sequence of ShadowSides
        Of all views.
    volume : Volume
        What is carved: the plan lies within, and the sides are about its middle.

    Returns
    -------
    ndarray of float, shape (n, 2), or None
        Corners (x, y), m, in order round the plan; None where the sides bound none.

    Examples
    --------
    >>> import numpy as np
    >>> volume = Volume.around((0.0, 0.0), (2.0, 2.0, 1.0), 0.1)
    >>> sides = [ShadowSides(t, 0.5, 0.5, 0.2, 0.02) for t in np.radians(np.arange(0.0, 360.0, 3.0))]
    >>> corners = plan_of_sides(sides, volume)
    >>> bool(abs(np.hypot(*corners.T) - 0.49).max() < 0.01)
    True
    """
    if not sides:
        return None
    told = np.array([(s.direction_rad, s.right_m, s.left_m, s.aperture_rad) for s in sides])
    inside = _INSIDE_CELLS * float(np.median([side.cell_m for side in sides]))
    faces: FloatArray = np.arange(_DIRECTIONS, dtype=np.float64) * (TWO_PI / _DIRECTIONS)
    near = _beside(told[:, 0], faces, told[:, 3])
    opposite = _beside(told[:, 0] + math.pi, faces, told[:, 3])
    support = np.fmax(_medians(told[:, 1], near), _medians(told[:, 2], opposite)) - inside
    half_x, half_y = (0.5 * size for size in volume.size_m[:2])
    with np.errstate(invalid="ignore"):
        bounded = support <= half_x * np.abs(np.cos(faces)) + half_y * np.abs(np.sin(faces))
    if float(bounded.mean()) < _LEAST_BOUNDED:
        return None
    return _outline(faces[bounded], support[bounded], volume)


def _beside(directions: FloatArray, faces: FloatArray, apertures: FloatArray) -> BoolArray:
    """Say which of the directions lie within half an aperture of each face, shape (faces, directions)."""
    off = np.mod(directions[None, :] - faces[:, None] + math.pi, TWO_PI) - math.pi
    return np.asarray(np.abs(off) <= apertures[None, :] / 2.0 + 1e-6)


def _medians(values: FloatArray, chosen: BoolArray) -> FloatArray:
    """Return the median of the chosen values of each row; NaN where none is."""
    return np.array([np.median(values[row]) if row.any() else math.nan for row in chosen])


def _outline(faces: FloatArray, support: FloatArray, volume: Volume) -> FloatArray | None:
    """Cut a volume's ground rectangle by half-planes about its middle; None if nothing is left."""
    middle = np.array(volume.centre_m[:2])
    half_x, half_y = (0.5 * size for size in volume.size_m[:2])
    corners = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    for face, limit in zip(faces, support, strict=True):
        beyond = corners @ (math.cos(face), math.sin(face)) - limit
        if (beyond <= 0.0).all():
            continue
        following, after = np.roll(corners, -1, axis=0), np.roll(beyond, -1)
        left = []
        for a in range(len(corners)):
            if beyond[a] <= 0.0:
                left.append(corners[a])
            if (beyond[a] <= 0.0) != (after[a] <= 0.0):
                left.append(corners[a] + (following[a] - corners[a]) * beyond[a] / (beyond[a] - after[a]))
        if len(left) < 3:
            return None
        corners = np.array(left)
    return np.asarray(corners + middle)


@dataclass(frozen=True, eq=False)
class StandingPlan:
    """The convex ground that a body stands on, and how high it is.

    Parameters
    ----------
    corners_m : ndarray of float, shape (n, 2)
        Corners (x, y), m, counter-clockwise.
    height_m : float
        So high what stands there is at most, m.
    """

    corners_m: FloatArray
    height_m: float

    def volume_round(self, volume: Volume) -> Volume:
        """Return the volume if it holds the plan; otherwise one as high, round the plan with margins."""
        low, high = self.corners_m.min(axis=0), self.corners_m.max(axis=0)
        off = np.maximum(np.abs(low - volume.centre_m[:2]), np.abs(high - volume.centre_m[:2]))
        if (off <= 0.5 * np.array(volume.size_m[:2])).all():
            return volume
        (x, y), (along_x, along_y) = (low + high) / 2.0, (1.0 + 2.0 * MARGIN_SHARE) * (high - low)
        size = (float(along_x), float(along_y), volume.size_m[2])
        return Volume.around((float(x), float(y)), size, volume.voxel_size_m)

    def columns(self, volume: Volume) -> BoolArray:
        """Say which columns of a volume stand on it, shape (ny, nx)."""
        x, y = np.meshgrid(volume.x_m, volume.y_m)
        inside = np.ones(x.shape, np.bool_)
        corners = self.corners_m
        for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= -1e-12
        return inside

    def echo(self, info: ViewInfo) -> BoolArray:
        """Mark the pixels of a view that the echo of anything that stands on it may lie on.

        Returns
        -------
        ndarray of bool, shape (rows, cols)

        Notes
        -----
        Layover: (x, y) + z tan ψ û(θ), 0 ≤ z ≤ height. Of a convex plan that is convex too.
        """
        pixels = np.concatenate([self._pixels(info, 0.0), self._pixels(info, self.height_m)])
        down, across = _cells_px(info, _RESPONSE_CELLS)
        room = [(u * across, v * down) for u in (-1.0, 1.0) for v in (-1.0, 1.0)]
        corners = cv2.convexHull(np.concatenate([pixels + one for one in room]).astype(np.float32))
        return _filled(info, np.asarray(corners, dtype=np.float64))

    def top(self, info: ViewInfo) -> BoolArray:
        """Mark the pixels of a view that show the top, clear of its edges, of a body up to the plan's height.

        Returns
        -------
        ndarray of bool, shape (rows, cols)
        """
        foot, top = (_filled(info, self._pixels(info, z)) for z in (0.0, self.height_m))
        return ~about(~(foot & top), info)

    def _pixels(self, info: ViewInfo, height_m: float) -> FloatArray:
        """Return where its corners are imaged at some height, (column, row)."""
        ground = self.corners_m + height_m * layover_per_metre(info)
        affine = info.camera.ground_to_pixel
        return np.asarray(ground @ affine[:2, :2].T + affine[:2, 2])


def _cells_px(info: ViewInfo, cells: tuple[float, float]) -> tuple[float, float]:
    """Return (down-range, across) in pixels for resolution cells."""
    down, across = (
        n * cell / spacing
        for n, cell, spacing in zip(cells, info.resolution_m, info.camera.spacing_m, strict=True)
    )
    return down, across


def _filled(info: ViewInfo, corners_px: FloatArray) -> BoolArray:
    """Mark the pixels within a convex polygon, (column, row) of its corners."""
    out = np.zeros(info.camera.shape, np.uint8)
    cv2.fillConvexPoly(out, np.rint(corners_px * 16.0).astype(np.int32), 1, shift=4)
    return out.view(np.bool_)


__all__ = ["ShadowSides", "StandingPlan", "plan_of_sides", "shadow_sides"]
