"""Segment the target's shadow in a view, which the paper did by hand (section 4.1, figure 7).

The silhouette that hard carving needs is everything that the target hides: its shadow, and its own
echo laid over the near end of it. The shadow is found by contrast; echo is marked as "knows nothing", and
whatever lies between it and the shadow as "covered": carving decides what it is once it knows the shape.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from .carving import MASK_COVERED, MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN
from .errors import ViewError
from .geometry import View, ViewInfo
from .likelihood import Levels, view_levels
from .parameters import LikelihoodParameters

#: Shadow where the local mean power is less than this far from the shadow's level to the seabed's. At a
#: straight edge half of the box lies on seabed and the mean is 0.5 of the way. Less than that, as beside a
#: flat side seen along it some looks of the aperture see past its near end, and others past its far end.
_DARK = 0.37
#: The box's half-size in resolution cells, down-range and across. A shadow is several times as long as
#: the target is high: down-range, averaging costs little resolution in height.
_HALF_CELLS = (1.8, 0.75)
#: The averaging box reaches no farther than this (pixels).
_MAX_RADIUS = 8
#: The flank of a shadow without an echo before it (pixels).
_FLANK_PX = 2
#: Smaller dark patches are speckle.
_MIN_SHADOW_PIXELS = 25


def dark_pixels(levels: Levels, info: ViewInfo) -> NDArray[np.bool_]:
    """Mark pixels whose local mean power belongs to shadow rather than to seabed.

    Parameters
    ----------
    levels : Levels
        The view relative to its seabed level.
    info : ViewInfo
        Its resolution sets the box that the mean is taken over.
    """
    cells = zip(_HALF_CELLS, info.resolution_m, info.camera.spacing_m, strict=True)
    rows, cols = (int(min(max(round(half * cell / pixel), 1), _MAX_RADIUS)) for half, cell, pixel in cells)
    shadow_power = 1.0 / levels.contrast**2
    dark = levels.local.under((rows, cols), shadow_power + _DARK * (1.0 - shadow_power))
    # A threshold below one half draws a straight edge across the box in by a known part of it: the far end
    # of the shadow, which tells the height, is put back.
    dark = _drawn_down(dark, round((0.5 - _DARK) * (2 * rows + 1)))
    return np.asarray(dark & levels.known)


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
        uint8: 255 target's shadow, 0 outside, 128 where the view knows nothing (off the image, and in an
        echo), 64 between the target's echo and its shadow: the target covers it, or is open below.

    Raises
    ------
    ViewError
        If the levels cannot be estimated.
    """
    p = parameters or LikelihoodParameters()
    levels = levels or view_levels(view, p)
    shadow = _of_target(dark_pixels(levels, view.info), view, target_m, reach_m)
    echo = levels.echoes(p.echo_db) if p.echo_unknown else np.zeros_like(shadow)
    covered = _before_shadow(shadow, echo) if p.echo_unknown else echo
    mask = np.empty(shadow.shape, np.uint8)
    _compose(levels.known.ravel(), shadow.ravel(), echo.ravel(), covered.ravel(), mask.ravel())
    return replace(view, pixels=mask)


@numba.njit(cache=True, nogil=True)
def _compose(
    known: NDArray[np.bool_],
    shadow: NDArray[np.bool_],
    echo: NDArray[np.bool_],
    covered: NDArray[np.bool_],
    mask: NDArray[np.uint8],
) -> None:  # pragma: no cover
    """Say of every pixel what it is."""
    outside, unknown = np.uint8(MASK_OUTSIDE), np.uint8(MASK_UNKNOWN)
    dark, hidden = np.uint8(MASK_SHADOW), np.uint8(MASK_COVERED)
    for i in range(mask.size):
        value = hidden if covered[i] else outside
        value = unknown if echo[i] else value
        value = dark if shadow[i] else value
        mask[i] = value if known[i] else unknown


def _of_target(
    dark: NDArray[np.bool_], view: View, target_m: tuple[float, float], reach_m: float
) -> NDArray[np.bool_]:
    """Keep the dark patches that begin at the target."""
    camera = view.info.camera
    u, v, _ = camera.ground_to_pixel @ np.array([target_m[0], target_m[1], 1.0])
    rows_m, cols_m = camera.spacing_m
    reach = reach_m or 0.1 * camera.cols * cols_m
    # A patch belongs to the target if any of it lies in the box that the target's near shadow must cross.
    top, bottom = v - reach / rows_m, v + (reach + reach / math.tan(camera.grazing_rad) / 4.0) / rows_m
    left, right = u - reach / cols_m, u + reach / cols_m
    out = np.zeros(dark.shape, np.bool_)
    _patches_in_box(
        dark,
        (max(0, int(top)), min(camera.rows, max(0, int(bottom) + 1))),
        (max(0, int(left)), min(camera.cols, max(0, int(right) + 1))),
        _MIN_SHADOW_PIXELS,
        out,
    )
    return out


@numba.njit(cache=True, nogil=True)
def _patches_in_box(
    dark: NDArray[np.bool_], rows: tuple[int, int], cols: tuple[int, int], least: int, out: NDArray[np.bool_]
) -> None:  # pragma: no cover
    """Mark the dark patches (8-connected) of `least` pixels or more that reach into a box."""
    n_rows, n_cols = dark.shape
    seen = np.zeros(dark.shape, np.bool_)
    patch = np.empty((dark.size, 2), np.int32)
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
                for c in range(max(0, a - 1), min(n_rows, a + 2)):
                    for d in range(max(0, b - 1), min(n_cols, b + 2)):
                        if dark[c, d] and not seen[c, d]:
                            seen[c, d] = True
                            patch[size, 0], patch[size, 1] = c, d
                            size += 1
            if size >= least:
                for k in range(size):
                    out[patch[k, 0], patch[k, 1]] = True


@numba.njit(cache=True, nogil=True)
def _mark_before(
    shadow: NDArray[np.bool_], edge: NDArray[np.bool_], flank: int, out: NDArray[np.bool_]
) -> None:  # pragma: no cover
    """Mark, up-range of every stretch of shadow in every column, what an echo leads up to."""
    rows, cols = shadow.shape
    # Row by row, as they lie in memory: where each column's stretch began, if it is in one.
    starts = np.full(cols, -1, np.int32)
    for i in range(rows + 1):
        for j in range(cols):
            start = starts[j]
            dark = i < rows and shadow[i, j]
            if dark == (start >= 0):
                continue
            if dark:
                starts[j] = i
                continue
            reach = max(0, start - (i - start))
            begin = max(reach, start - flank)
            for k in range(reach, start):
                if edge[k, j]:
                    begin = min(begin, k)
                    break
            for k in range(begin, start):
                out[k, j] = True
            starts[j] = -1


def _before_shadow(shadow: NDArray[np.bool_], echo: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the pixels between the target's echo and its shadow: the target covers them.

    The shadow hides the seabed from the target's foot on. Between the foot and where the view turns
    dark lies the target's own echo: a bright edge towards the sonar, then often a top as faint as the
    seabed. In each column, up-range of each stretch of shadow, all from the farthest echo (no farther than
    the stretch is long) is left open; where no echo is seen, only the shadow's flank is.
    """
    # An edge that glitters has dark columns in it: its neighbours speak for them.
    edge = cv2.dilate(echo.view(np.uint8), np.ones((1, 5), np.uint8)).view(bool)
    unknown = np.zeros(shadow.shape, bool)
    _mark_before(shadow, edge, _FLANK_PX, unknown)
    return unknown


def silhouette_found(mask: View) -> bool:
    """Say whether a mask holds any shadow of the target."""
    return bool((mask.pixels == MASK_SHADOW).any())


def require_silhouette(mask: View) -> View:
    """Return the mask, or refuse a view in which no shadow of the target was found.

    Raises
    ------
    ViewError
        If the mask is empty.
    """
    if not silhouette_found(mask):
        raise ViewError("no shadow of the target was segmented; expected dark pixels behind the target")
    return mask
