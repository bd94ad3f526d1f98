"""The point where the last ray leaves the target: a height from a single view.

The ray that grazes the target's top meets the seabed at the shadow's far end. The last echo before the shadow
comes from where the ray left the target. Both ends of the shadow lie on that ray, so that its length in slant
range gives the height of that point, whatever the plan is:

    z = s_z (r_end - r_begin) / r_end

with the sonar s_z above the seabed. Carving uses the far end alone, and leaves a cap on a flat top that rises
at the grazing angle. The near end tells the two apart.

A top that is as dark as the shadow moves the near end towards the sonar, a gap under the target away from it.
Then the views do not agree, and nothing is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..geometry import ViewInfo, down_range_axis
from ..kernels import kernel

FloatArray = NDArray[np.float64]

#: Lit gaps in a column's shadow up to this are speckle (resolution cells down-range).
_GAP_CELLS = 1.0
#: Heights of a view are smoothed by a running median over so much (resolution cells across).
_SMOOTH_CELLS = 1.9
#: The height of a view is so high a percentile of its columns: the ends of a flat top see less of it.
_PERCENTILE = 90.0
#: The segmented shadow begins so far behind the end of the top's echo (resolution cells down-range): the
#: echo's response and the averaging box of the segmentation reach into the shadow. Measured on eleven shapes
#: of the population's development half: 0.5 to 1.4. Half or double moves a height by 0.4 tan ψ cells.
_BEGIN_CELLS = 0.8
#: Fewer columns than this tell no height (resolution cells across).
_LEAST_CELLS = 2.0
#: The views tell a height if this share of them tells the same, to a cell or `_SAME`. Of the shapes above,
#: those that agree so are right to 1.8 tan ψ cells; below 0.9 some are wrong by 20.
_AGREE, _SAME = 0.9, 0.05
#: No contour lies before the middle of its plan all round the circle: shadow that begins there shows through
#: a hole, or covers a dark top, and its length tells too much. More than so many resolution cells
#: down-range before it, in the median of the views, tell no height. On the population's development half it
#: does so of 13 bodies, whose heights all came out too high, by 1.3 to 14 tan ψ cells (σ: 1). At half the
#: same; at double a keg that is too high by 12 tan ψ cells has a height again.
_BEFORE_CELLS = 0.5
#: A top is flat if its contour drops from its middle to its sides by less than this share of what a sphere
#: with a contour there does: boxes, kegs and half discs by -0.1 to 0.5. At half a box is taken for round and
#: comes out too high by 6 tan ψ cells.
_FLAT = 0.8
#: It is round if it drops by so much: measured spheres and eggs by 1.5 to 3.2 (their near end, and so their
#: contour, is told too far behind). Between the two it may be either: an exact sphere drops by 1, the corner
#: of a triangle too. Above, it is none: what is wider at its top, or stands on a wider foot, drops by 3.9 to
#: 24, and its contour tells nothing. Of nine such tops, read as round, seven came out 3 to 20 % too high.
#: Chosen on these shapes; half and double were not measured.
_ROUND = (1.25, 3.5)
#: A contour that is not round has a height of its own if so many of its columns (share, median of the views)
#: are as high as its top, to a cell or `_SAME`. Boxes, kegs and L plans have 0.45 to 0.77, blunt cones 0.36
#: to 0.46. Of seven cones, ridges, ovals and tyres below, five came out 3 to 16 % wrong by theirs. At half
#: only one is below; at double boxes and kegs tell nothing.
_TOP_SHARE = 1.0 / 3.0
#: Where a sphere would drop by less than this (tan ψ cells) the top may be either.
_TELLS_CELLS = 0.8
#: The middle of a contour, and its sides from here to there (shares of how far behind the middle it lies).
_MIDDLE, _SIDES = 0.3, (0.5, 0.9)
#: 1σ of the height of a round top, in the height that is added to the contour's.
_ROUND_SIGMA = 1.0 / 3.0


@dataclass(frozen=True)
class Contour:
    """The target's last shadow in one view, column by column: the source of its contour.

    Parameters
    ----------
    across_m : tuple of float
        Cross-range of each column from the scene's origin, m.
    begin_m, end_m : tuple of float
        Down-range e_r · p of the shadow's ends, m.
    """

    across_m: tuple[float, ...]
    begin_m: tuple[float, ...]
    end_m: tuple[float, ...]

    def points(self, info: ViewInfo) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return cross-range, down-range and height (m) where the last rays leave the target."""
        sonar = info.camera.sonar_m
        origin = -float(down_range_axis(info.aspect_rad) @ sonar[:2])
        begin, end = origin + np.asarray(self.begin_m), origin + np.asarray(self.end_m)
        share = np.hypot(begin, sonar[2]) / np.hypot(end, sonar[2])
        # The median of as many columns: a speckle moves an end by a cell.
        columns = np.diff(self.across_m).min(initial=math.inf)
        smooth = max(3, round(_SMOOTH_CELLS * info.resolution_m[1] / columns)) | 1
        height = scipy.ndimage.median_filter(sonar[2] * (1.0 - share), smooth, mode="nearest")
        return np.asarray(self.across_m), end * share - origin, height


def contour_of(shadow: NDArray[np.bool_], info: ViewInfo) -> Contour | None:
    """Find the contour that a segmented shadow implies.

    Parameters
    ----------
    shadow : ndarray of bool, shape (rows, cols)
        The target's shadow, without its echo.
    info : ViewInfo
        The view.

    Returns
    -------
    Contour or None
        None where the shadow is too narrow, or leaves the image everywhere.
    """
    row_m, col_m = info.camera.spacing_m
    stretch = np.empty((2, shadow.shape[1]), np.int32)
    _last_stretch(np.ascontiguousarray(shadow), max(1, round(_GAP_CELLS * info.cell_px[0])), stretch)
    columns = np.flatnonzero((stretch[0] >= 0) & (stretch[1] < len(shadow)))
    if len(columns) < max(3.0, _LEAST_CELLS * info.cell_px[1]):
        return None
    down = info.down_range_of_rows()
    u0 = float((info.camera.ground_to_pixel @ np.array([0.0, 0.0, 1.0]))[0])
    begin = down[stretch[0, columns]] - row_m / 2.0 - _BEGIN_CELLS * info.resolution_m[0]
    end = down[stretch[1, columns] - 1] + row_m / 2.0
    return Contour(tuple(((columns - u0) * col_m).tolist()), tuple(begin.tolist()), tuple(end.tolist()))


@kernel()
def _last_stretch(shadow: NDArray[np.bool_], gap: int, out: NDArray[np.int32]) -> None:  # pragma: no cover
    """Find where the last dark stretch of each column begins, over lit gaps, and ends; -1 where none is."""
    rows, cols = shadow.shape
    out[:] = -1
    for j in range(cols):
        lit = 0
        for i in range(rows - 1, -1, -1):
            if shadow[i, j]:
                if out[1, j] < 0:
                    out[1, j] = i + 1
                out[0, j], lit = i, 0
            elif out[1, j] >= 0:
                lit += 1
                if lit > gap:
                    break


@dataclass(frozen=True)
class ContourHeight:
    """The height that the contours of all views imply.

    Parameters
    ----------
    height_m : float
        Height of the top, m.
    sigma_m : float
        Its standard deviation, m.
    round_top : bool or None
        Whether the top is round; None where it may be either.
    """

    height_m: float
    sigma_m: float
    round_top: bool | None


def contour_height(
    contours: Sequence[tuple[ViewInfo, Contour]], position_m: tuple[float, float], highest_m: float
) -> ContourHeight | None:
    """Return the height that the views' contours imply, None if they disagree.

    Parameters
    ----------
    contours : sequence of (ViewInfo, Contour)
        Of all views.
    position_m : (float, float)
        Middle of the target's plan.
    highest_m : float
        Top of the carved shape: no shadow lets the target be higher. Contours that are, by more than a cell
        of shadow, are not the target's.

    Notes
    -----
    A sphere of radius R has its contour at R sin ψ behind its middle, R (1 - cos ψ) = R sin ψ tan(ψ/2) under
    its top; an edge has its own height.
    """
    tops, cells, behind, profiles, shares = [], [], [], [], []
    for info, contour in contours:
        across, down, height = contour.points(info)
        cell = info.resolution_m[0] * math.tan(info.camera.grazing_rad)
        tops.append(float(np.percentile(height, _PERCENTILE)))
        high = height >= tops[-1] - cell
        profiles.append((across - across[high].mean(), height))
        shares.append(float(np.mean(height >= tops[-1] - max(_SAME * tops[-1], cell))))
        axis = down_range_axis(info.aspect_rad)
        behind.append(float(np.median(down[high]) - axis @ np.asarray(position_m)))
        cells.append(cell)
    if not tops:
        return None
    cell, height_m = float(np.median(cells)), float(np.median(tops))
    same = np.abs(np.array(tops) - height_m) <= max(_SAME * height_m, cell)
    if float(same.mean()) < _AGREE:
        return None
    grazing = float(np.median([info.camera.grazing_rad for info, _ in contours]))
    middle = float(np.median(behind))
    if middle < -_BEFORE_CELLS * float(np.median([info.resolution_m[0] for info, _ in contours])):
        return None
    radius = max(middle, 0.0)
    added = radius * math.tan(grazing / 2.0)
    drop = 0.0 if added <= cell / 2.0 else _drop(profiles, radius, grazing, cell)
    if drop is not None and drop > _ROUND[1]:
        return None
    if drop is None or _FLAT < drop < _ROUND[0]:
        round_top, share, unsure = None, 0.5, 0.5
    elif drop <= _FLAT:
        round_top, share, unsure = False, 0.0, 0.0
    else:
        round_top, share, unsure = True, 1.0, _ROUND_SIGMA
    if not round_top and float(np.median(shares)) < _TOP_SHARE:
        return None
    top = height_m + share * added
    if top > highest_m + cell:
        return None
    return ContourHeight(min(top, highest_m), math.hypot(cell, unsure * added), round_top)


def _drop(
    profiles: Sequence[tuple[FloatArray, FloatArray]], radius_m: float, grazing_rad: float, cell_m: float
) -> float | None:
    """Return how far contours (m off their middle, height in m) drop to their sides, in what a sphere's do.

    None where no view is fine enough to tell.
    """
    own = radius_m / math.sin(grazing_rad)
    found = []
    for off, height in profiles:
        part = np.abs(off) / radius_m
        middle, sides = part < _MIDDLE, (part >= _SIDES[0]) & (part < _SIDES[1])
        if middle.any() and sides.any():
            sphere = own * math.cos(grazing_rad) * np.sqrt(1.0 - np.clip(off / own, -1.0, 1.0) ** 2)
            drop = float(np.median(height[middle]) - np.median(height[sides]))
            found.append((drop, float(sphere[middle].mean() - sphere[sides].mean())))
    if not found:
        return None
    dropped, expected = np.median(found, axis=0)
    return None if expected < _TELLS_CELLS * cell_m else float(dropped / expected)


__all__ = ["Contour", "ContourHeight", "contour_height", "contour_of"]
