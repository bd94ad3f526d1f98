"""How far the target's own echo reaches to either side: where its plan ends, also where it casts no shadow.

A flank that slopes gently, and an end that thins out, cast a shadow too short to segment, and shine. An echo
is laid over towards the sonar, never to the side: its outermost columns are those of the plan.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry import View
from ..imaging.likelihood import Levels
from ..imaging.local_means import ECHO_CELLS
from ..imaging.mask_codes import MASK_COVERED

#: Echo is brighter than this (dB over the seabed), which one look in 550 of the seabed is, and than this
#: share of the mean power of the echo itself: its response spreads. Chosen on ten tapering shapes beside both
#: halves of the population. At 0 very bright bodies come out 0.2 cells too wide, at 0.5 limpets 0.4 cells too
#: narrow.
_ECHO_DB, _OWN_SHARE = 8.0, 0.25
#: It belongs to the target if it leads to the beginning of its shadow: over gaps of this (resolution cells),
#: down-range in front of the shadow, and either way within the echo.
_GAP_CELLS, _JOIN_CELLS = 2.0, 0.5
#: A column of it is at least so long (resolution cells).
_LEAST_CELLS = 1.0


def echo_reach_px(
    levels: Levels, mask: View, shadow: NDArray[np.bool_], target_px: tuple[float, float]
) -> tuple[float, float]:
    """Return how far the target's echo reaches to the right and to the left of it, pixels.

    Parameters
    ----------
    levels : Levels
        The view relative to its seabed.
    mask : View
        Its shadow mask.
    shadow : ndarray of bool, shape (rows, cols)
        The target's shadow in it.
    target_px : (float, float)
        The target's place (column, row).

    Returns
    -------
    (float, float)
        NaN where no echo leads to the shadow.
    """
    u0, v0 = target_px
    columns = np.flatnonzero(shadow.any(axis=0))
    first = shadow[:, columns].argmax(axis=0)
    camera, (down_px, across_px) = mask.info.camera, mask.info.cell_px
    wide = int(columns[-1] - columns[0]) + 1
    deep = wide * camera.spacing_m[1] / camera.spacing_m[0]
    top, left = max(0, int(min(v0, first.min()) - deep)), max(0, int(columns[0]) - wide)
    part = slice(top, int(first.max()) + 1), slice(left, int(columns[-1]) + 1 + wide)
    # What lies behind a column's first shadow is something else: it stands in it.
    begins = np.full(shadow.shape[1], part[0].stop)
    begins[columns] = first
    before = np.arange(top, part[0].stop)[:, None] < begins[None, part[1]]

    def brighter(power: float) -> NDArray[np.bool_]:
        under = levels.local.under(ECHO_CELLS, power, *part)
        return np.asarray(~under & levels.known[part] & before)

    least = 10.0 ** (_ECHO_DB / 10.0)
    echo = brighter(least)
    joined = (echo | (mask.pixels[part] == MASK_COVERED) & before).view(np.uint8)
    join = np.ones((2 * round(_JOIN_CELLS * down_px) + 1, 2 * round(_JOIN_CELLS * across_px) + 1), np.uint8)
    count, pieces = cv2.connectedComponents(cv2.dilate(joined, join), connectivity=8)
    leads = np.zeros(count, np.bool_)
    for step in range(round(_GAP_CELLS * down_px) + 1):
        leads[pieces[np.maximum(first - top - step, 0), columns - left]] = True
    leads[0] = False
    own = echo & leads[pieces]
    if not own.any():
        return math.nan, math.nan
    # The median of speckle's power is ln 2 of its mean.
    mean = float(np.median(levels.power[part][own])) / math.log(2.0)
    own &= brighter(max(least, _OWN_SHARE * mean))
    long = np.flatnonzero(own.sum(axis=0) >= _LEAST_CELLS * down_px)
    if not len(long):
        return math.nan, math.nan
    return float(long[-1] + left + 0.5 - u0), float(u0 - (long[0] + left - 0.5))


__all__ = ["echo_reach_px"]
