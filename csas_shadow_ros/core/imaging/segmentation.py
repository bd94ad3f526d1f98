"""Segment the target's shadow in a view; the paper does this by hand (section 4.1, figure 7).

The silhouette that hard carving needs is everything that the target hides: its shadow, and its own
echo laid over the near end of it. The shadow is found by contrast; echo is marked as "knows nothing", and
whatever lies between it and the shadow as "covered": carving decides what it is once it knows the shape.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ViewError
from ..geometry import View, ViewInfo
from ..kernels import kernel
from ..parameters import LikelihoodParameters
from .likelihood import Levels, view_levels
from .local_means import LocalMeans
from .mask_codes import MASK_COVERED, MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN
from .masks import beside_px, flank_px

#: Shadow where the local mean power is less than this far from the shadow's level to the seabed's. At a
#: straight edge half of the box lies on seabed and the mean is 0.5 of the way. Less than that, as beside a
#: flat side seen along it some looks of the aperture see past its near end, and others past its far end.
_DARK = 0.37
#: The box's half-size in resolution cells, down-range and across. A shadow is several times as long as
#: the target is high: down-range, averaging costs little resolution in height.
_HALF_CELLS = (1.8, 0.75)
#: That box is too coarse for shadow that is thinner than so many of it, either way, or that juts out so far
#: of what is not (resolution cells, down-range and across). Of 34 bodies of the population's development half
#: and 38 of ten tapering families beside it, the mean IoU with the hull is 0.006 lower for two boxes; without
#: the distinction boxes lose 0.03, as speckle is dark beside flat sides too.
_THIN_BOXES, _JUTS_CELLS = 3.0, 1.5
#: Around thin shadow, so far (resolution cells), nothing is said of what is dark in a box of half its size:
#: nearer to the shadow's level than to the seabed's. For 2 or 4 cells the mean of these bodies is 0.777 and
#: 0.779 instead of 0.776, but of a box seen by 24 views a wing is left that only two of them deny.
_UNSURE_AROUND_CELLS = 1.0
_UNSURE_HALF_CELLS = (0.9, 0.4)
_UNSURE_DARK = 0.5
#: How far around the target is looked at first (pixels), and how much farther down-range, where shadows lie:
#: patches that lead out of it are followed.
_MARGIN_PX = 16
_LONGER = 8
#: Smaller dark patches are speckle (resolution cells).
_LEAST_CELLS = 5.6


def dark_pixels(
    levels: Levels, rows: slice = slice(None), cols: slice = slice(None)
) -> NDArray[np.bool_]:
    """Mark pixels whose local mean power belongs to shadow rather than to seabed.

    Parameters
    ----------
    levels : Levels
        The view relative to its seabed level.
    rows, cols : slice
        The part of the view to look at, without steps: all of it.
    """
    down_px, _ = levels.local.box_px(_HALF_CELLS)
    shadow_power = 1.0 / levels.contrast**2
    # A threshold below one half draws a straight edge across the box in by a known part of it: the far end
    # of the shadow, which tells the height, is put back.
    drawn_in = round((0.5 - _DARK) * (2 * down_px + 1))
    first, last, _ = rows.indices(levels.known.shape[0])
    begin = max(0, first - drawn_in)
    threshold = shadow_power + _DARK * (1.0 - shadow_power)
    dark = levels.local.under(_HALF_CELLS, threshold, slice(begin, last), cols)
    return np.asarray(_drawn_down(dark, drawn_in)[first - begin :] & levels.known[rows, cols])


def _drawn_down(dark: NDArray[np.bool_], rows: int) -> NDArray[np.bool_]:
    """Extend dark pixels down-range by some rows."""
    out = dark.copy()
    for shift in range(1, rows + 1):
        out[shift:] |= dark[:-shift]
    return out


def segment_shadow(
    view: View,
    target_m: tuple[float, float],
    parameters: LikelihoodParameters | None = None,
    levels: Levels | None = None,
    *,
    reach_m: float = 0.0,
) -> View:
    """Segment the shadow of the target.

    Parameters
    ----------
    view : View
        float32 amplitude after enhancement, NaN where unknown.
    target_m : (float, float)
        Ground position (x, y) of the target.
    parameters : LikelihoodParameters
        Levels and echo threshold.
    levels : Levels, optional
        Levels that were estimated before.
    reach_m : float
        The target's shadow begins within this distance of `target_m`; 0: a tenth of the view.

    Returns
    -------
    View
        uint8: 255 target's shadow, 0 outside, 128 where the view knows nothing (off the image, in an echo,
        and beside thin shadow where it is too dark for seabed),
        64 between the target's echo and its shadow: the target covers it, or is open below.

    Raises
    ------
    ViewError
        If the levels cannot be estimated.
    """
    p = parameters or LikelihoodParameters()
    levels = levels or view_levels(view, p)
    echo = levels.unknown_echoes(p)
    mask = np.empty(levels.known.shape, np.uint8)
    _compose(levels.known.ravel(), echo.ravel(), mask.ravel())
    shadow, (top, left) = _of_target(levels, view.info, target_m, reach_m)
    if shadow.size:
        # What is covered begins on the target, and is told by echoes beside it too.
        near_end = _near_end(view.info, target_m, reach_m)
        begin = max(0, min(top - len(shadow), near_end))
        beside = beside_px(view.info)
        before = max(0, left - beside)
        rows, cols = slice(begin, top + len(shadow)), slice(left, left + shadow.shape[1])
        shadow = np.pad(shadow, ((top - begin, 0), (0, 0)))
        covered = np.zeros_like(shadow)
        if p.echo_unknown:
            echoes = echo[rows, before : cols.stop + beside]
            _before_shadow(shadow, echoes, left - before, view.info, near_end - begin, covered)
        _add_shadow(shadow, covered, mask[rows, cols])
        _leave_open(levels, mask, rows, cols)
    return replace(view, pixels=mask)


def _leave_open(levels: Levels, mask: NDArray[np.uint8], rows: slice, cols: slice) -> None:
    """Let pixels beside thin shadow that are too dark for seabed say nothing.

    The shadow thins out towards the end of a body that tapers, and single views lose it there, each at
    another place. Carving would keep what all of them show: less than any of them.
    """
    local = levels.local
    down, across = (math.ceil(_UNSURE_AROUND_CELLS * px) for px in local.cell_px)
    where = (
        slice(max(0, rows.start - down), min(mask.shape[0], rows.stop + down)),
        slice(max(0, cols.start - across), min(mask.shape[1], cols.stop + across)),
    )
    part = mask[where]
    shadow = (part == MASK_SHADOW).view(np.uint8)
    wide = cv2.morphologyEx(shadow, cv2.MORPH_OPEN, _box(local, _THIN_BOXES, _HALF_CELLS))
    thin = shadow & (cv2.dilate(wide, _box(local, _JUTS_CELLS)) == 0)
    if not thin.any():
        return
    near = cv2.dilate(thin, np.ones((2 * down + 1, 2 * across + 1), np.uint8))
    shadow_power = 1.0 / levels.contrast**2
    threshold = shadow_power + _UNSURE_DARK * (1.0 - shadow_power)
    dark = local.under(_UNSURE_HALF_CELLS, threshold, *where)
    part[(part == MASK_OUTSIDE) & dark & near.view(np.bool_)] = MASK_UNKNOWN


def _box(
    local: LocalMeans, times: float, half_cells: tuple[float, float] = (1.0, 1.0)
) -> NDArray[np.uint8]:
    """Return a box of so many times a half-size (resolution cells) to either side, all ones."""
    down, across = (round(times * half * px) for half, px in zip(half_cells, local.cell_px, strict=True))
    return np.ones((2 * down + 1, 2 * across + 1), np.uint8)


def _near_end(info: ViewInfo, target_m: tuple[float, float], reach_m: float) -> int:
    """Return the row up-range of which no part of the target stands."""
    camera = info.camera
    row = (camera.ground_to_pixel @ np.array([target_m[0], target_m[1], 1.0]))[1]
    return int(row - _reach(info, reach_m) / camera.spacing_m[0])


def _reach(info: ViewInfo, reach_m: float) -> float:
    """Return how far from its position the target may reach (m); by default a tenth of the view."""
    return reach_m or 0.1 * info.camera.cols * info.camera.spacing_m[1]


@kernel()
def _compose(
    known: NDArray[np.bool_], echo: NDArray[np.bool_], mask: NDArray[np.uint8]
) -> None:  # pragma: no cover
    """Say of every pixel what it is where there is no shadow of the target."""
    outside, unknown = np.uint8(MASK_OUTSIDE), np.uint8(MASK_UNKNOWN)
    for i in range(mask.size):
        mask[i] = outside if known[i] & (not echo[i]) else unknown


@kernel()
def _add_shadow(
    shadow: NDArray[np.bool_], covered: NDArray[np.bool_], mask: NDArray[np.uint8]
) -> None:  # pragma: no cover
    """Put known pixels of the target's shadow, and those that the target covers, into a part of a mask."""
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            if shadow[i, j]:
                mask[i, j] = MASK_SHADOW
            elif covered[i, j] and mask[i, j] == MASK_OUTSIDE:
                mask[i, j] = MASK_COVERED


def _of_target(
    levels: Levels, info: ViewInfo, target_m: tuple[float, float], reach_m: float
) -> tuple[NDArray[np.bool_], tuple[int, int]]:
    """Find the dark patches that begin at the target: a part that just holds them, and where it begins."""
    camera = info.camera
    u, v, _ = camera.ground_to_pixel @ np.array([target_m[0], target_m[1], 1.0])
    rows_m, cols_m = camera.spacing_m
    reach = _reach(info, reach_m)
    # A patch belongs to the target if any of it lies in the box that the target's near shadow must cross.
    top, bottom = v - reach / rows_m, v + (reach + reach / math.tan(camera.grazing_rad) / 4.0) / rows_m
    left, right = u - reach / cols_m, u + reach / cols_m
    rows = max(0, int(top)), min(camera.rows, max(0, int(bottom) + 1))
    cols = max(0, int(left)), min(camera.cols, max(0, int(right) + 1))
    # Most of a view is far from the target. Where a patch leads out of the part looked at, more is.
    margin = _MARGIN_PX
    while True:
        begin, end = max(0, rows[0] - margin), min(camera.rows, rows[1] + _LONGER * margin)
        first, last = max(0, cols[0] - margin), min(camera.cols, cols[1] + margin)
        dark = dark_pixels(levels, slice(begin, end), slice(first, last))
        out = np.zeros(dark.shape, np.bool_)
        open_sides = begin > 0, end < camera.rows, first > 0, last < camera.cols
        found = _patches_in_box(
            dark,
            (rows[0] - begin, rows[1] - begin),
            (cols[0] - first, cols[1] - first),
            levels.local.pixels(_LEAST_CELLS),
            open_sides,
            out,
        )
        if found[0] >= 0:
            a, b, c, d = found
            return out[a:b, c:d], (begin + a, first + c)
        margin *= 2


@kernel()
def _patches_in_box(
    dark: NDArray[np.bool_],
    rows: tuple[int, int],
    cols: tuple[int, int],
    least: int,
    open_sides: tuple[bool, bool, bool, bool],
    out: NDArray[np.bool_],
) -> tuple[int, int, int, int]:  # pragma: no cover
    """Mark the dark patches (8-connected) of `least` pixels or more that reach into a box.

    Returns between which rows and columns they lie, (0, 0, 0, 0) if there are none, and -1s if a patch leads
    to a side (first and last row, first and last column) beyond which the view goes on.
    """
    n_rows, n_cols = dark.shape
    seen = np.zeros(dark.shape, np.bool_)
    patch = np.empty((dark.size, 2), np.int32)
    top, bottom, left, right = n_rows, 0, n_cols, 0
    for i in range(rows[0], rows[1]):
        for j in range(cols[0], cols[1]):
            if not dark[i, j] or seen[i, j]:
                continue
            seen[i, j] = True
            patch[0, 0], patch[0, 1] = i, j
            size, done = 1, 0
            while done < size:
                a, b = patch[done, 0], patch[done, 1]
                done += 1
                if (
                    (open_sides[0] and a == 0)
                    or (open_sides[1] and a == n_rows - 1)
                    or (open_sides[2] and b == 0)
                    or (open_sides[3] and b == n_cols - 1)
                ):
                    return -1, -1, -1, -1
                for c in range(max(0, a - 1), min(n_rows, a + 2)):
                    for d in range(max(0, b - 1), min(n_cols, b + 2)):
                        if dark[c, d] and not seen[c, d]:
                            seen[c, d] = True
                            patch[size, 0], patch[size, 1] = c, d
                            size += 1
            if size >= least:
                for k in range(size):
                    a, b = patch[k, 0], patch[k, 1]
                    out[a, b] = True
                    top, bottom = min(top, a), max(bottom, a + 1)
                    left, right = min(left, b), max(right, b + 1)
    if bottom <= top:
        return 0, 0, 0, 0
    return top, bottom, left, right


@kernel()
def _mark_before(
    shadow: NDArray[np.bool_],
    edge: NDArray[np.bool_],
    inside: NDArray[np.int32],
    rows_a_column: float,
    near_end: int,
    flank: int,
    out: NDArray[np.bool_],
) -> None:  # pragma: no cover
    """Mark, up-range of every stretch of shadow in every column, what an echo leads up to."""
    rows, cols = shadow.shape
    # Row by row, as they lie in memory: where each column's stretch began, if it is in one, and how deep.
    starts, depth = np.full(cols, -1, np.int32), np.zeros(cols, np.int32)
    for i in range(rows + 1):
        for j in range(cols):
            start = starts[j]
            if i < rows and shadow[i, j]:
                if start < 0:
                    starts[j], depth[j] = i, 0
                depth[j] = max(depth[j], inside[i, j])
                continue
            if start < 0:
                continue
            far = max(near_end, start - int(depth[j] * rows_a_column))
            reach = max(0, min(start - (i - start), far))
            begin = max(0, start - flank)
            for k in range(reach, start):
                if edge[k, j]:
                    begin = min(begin, k)
                    break
            for k in range(begin, start):
                out[k, j] = True
            starts[j] = -1


@kernel()
def _columns_inside(shadow: NDArray[np.bool_], out: NDArray[np.int32]) -> None:  # pragma: no cover
    """Count, for each dark pixel, the columns to the nearer end of its row's dark run; 0 elsewhere."""
    rows, cols = shadow.shape
    for i in range(rows):
        run = 0
        for j in range(cols):
            run = run + 1 if shadow[i, j] else 0
            out[i, j] = run
        run = 0
        for j in range(cols - 1, -1, -1):
            run = run + 1 if shadow[i, j] else 0
            out[i, j] = min(out[i, j], run)


def _before_shadow(
    shadow: NDArray[np.bool_],
    echo: NDArray[np.bool_],
    beside: int,
    info: ViewInfo,
    near_end: int,
    out: NDArray[np.bool_],
) -> None:
    """Mark the pixels between the target's echo and its shadow: the target covers them.

    The shadow hides the seabed from the target's foot on. Between the foot and where the view turns
    dark lies the target's own echo: a bright edge towards the sonar, then often a top as faint as the
    seabed. In each column, up-range of each stretch of shadow, all from the farthest echo on the target is
    left open; where no echo is seen, only the shadow's flank is.

    A side along range, g long, is seen g/2 tan(w/2) to either side of its mean place by the looks of the
    aperture w. A stretch that lies no farther inside of the shadow than that may be dark in some looks only,
    and what is lit before it seabed beside the target. There g bounds what is left open, or the stretch's own
    length where that is more.

    The echoes are those of as many rows, and of `beside` columns more on the left. No part of the target
    stands up-range of row `near_end`.
    """
    # An edge that glitters has dark columns in it: its neighbours speak for them.
    edge = cv2.dilate(echo.astype(np.uint8), np.ones((1, 2 * beside_px(info) + 1), np.uint8)).view(bool)
    inside = np.empty(shadow.shape, np.int32)
    _columns_inside(shadow, inside)
    row_m, col_m = info.camera.spacing_m
    rows_a_column = 2.0 * col_m / (row_m * max(math.tan(info.aperture_rad / 2.0), 1e-4))
    own = np.ascontiguousarray(edge[:, beside : beside + shadow.shape[1]])
    _mark_before(np.ascontiguousarray(shadow), own, inside, rows_a_column, near_end, flank_px(info), out)


def silhouette_found(mask: View) -> bool:
    """Say whether a mask holds any shadow of the target."""
    return bool((mask.pixels == MASK_SHADOW).any())


def require_silhouette(mask: View) -> View:
    """Return the mask, or refuse a view without a shadow of the target.

    Raises
    ------
    ViewError
        If the mask is empty.
    """
    if not silhouette_found(mask):
        raise ViewError("no shadow of the target was segmented; expected dark pixels behind the target")
    return mask
