"""Do all that tell a plan's sides tell them at the same place?

A direction's side is seen from two aspects, half a circle apart. A body's own side lies at one place. Where
the two disagree, another shadow touches the body's in one of them, or a part of it casts none there. Nothing
tells which.

And shadow and echo tell it. A foot that slopes gently shines and casts no shadow, and so does bright seabed
round a body. Nothing tells these two apart either.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..geometry import TWO_PI, wrap_angle

if TYPE_CHECKING:
    from .measurement import SilhouetteSides

FloatArray = NDArray[np.float64]

#: Sides within so much of an aperture look at the same side of the body.
_WITHIN = 0.75
#: So many of them at least, seen from either aspect: one may be a bad silhouette.
_LEAST = 2
_DIRECTIONS = 120
#: Sides lie apart if it is by more than this (cross-range cells): an edge is found to 0.8.
APART_CELLS = 2.0
#: What is found of an edge anyhow (cross-range cells): an interval has it already.
_EDGE_CELLS = 1.0


def opposed_sides(sides: Sequence[SilhouetteSides], support_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far the sides lie apart that opposite views see.

    Parameters
    ----------
    sides : sequence of SilhouetteSides
        Of all views.
    support_m : ndarray of float
        The support of each of their sides, m; NaN for one that does not count.

    Returns
    -------
    direction_rad : ndarray of float, shape (120,)
        Directions of sides.
    apart_cells : ndarray of float, shape (120,)
        Difference of the medians from either aspect, cross-range cells; NaN where one of them sees nothing.
    """
    directions, (right, left) = _by_aspect(sides, support_m)
    return directions, np.abs(right - left)


def _by_aspect(
    sides: Sequence[SilhouetteSides], told_m: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """Return directions, and in each the median of what sides tell from either aspect, cells; NaN of few."""
    directions: FloatArray = np.arange(_DIRECTIONS, dtype=np.float64) * (TWO_PI / _DIRECTIONS)
    medians: tuple[FloatArray, FloatArray] = (
        np.full(_DIRECTIONS, math.nan),
        np.full(_DIRECTIONS, math.nan),
    )
    if not sides:
        return directions, medians
    phi = np.array([angle for side in sides for angle in side.direction_rad])
    right = np.array([sign > 0 for side in sides for sign in side.signs])
    within = _WITHIN * np.array([side.info.aperture_rad for side in sides for _ in side.direction_rad])
    cell_m = float(np.median([side.info.resolution_m[1] for side in sides]))
    for n, direction in enumerate(directions):
        near = (np.abs(wrap_angle(phi - direction)) <= within + 1e-9) & np.isfinite(told_m)
        for median, aspect in zip(medians, (near & right, near & ~right), strict=True):
            if np.count_nonzero(aspect) >= _LEAST:
                median[n] = float(np.median(told_m[aspect])) / cell_m
    return directions, medians


def sides_beyond(
    sides: Sequence[SilhouetteSides], beyond_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how far most views see the sides outside of a plan, from either aspect.

    Parameters
    ----------
    sides : sequence of SilhouetteSides
        Of all views.
    beyond_m : ndarray of float
        How far each of their sides lies outside of it, m; NaN for one that tells nothing.

    Returns
    -------
    direction_rad : ndarray of float, shape (120,)
        Directions of sides.
    beyond_cells : ndarray of float, shape (120,)
        The median of what is seen there, cross-range cells; of both aspects the lesser: where they differ,
        `opposed_sides` says so. NaN where too few views see it.
    """
    directions, medians = _by_aspect(sides, beyond_m)
    return directions, np.fmin(*medians)


def reach_cells(directions: FloatArray, beyond: FloatArray, face_rad: float, aperture_rad: float) -> float:
    """Return by how much an extent grows if its two sides lie where `sides_beyond` says, cross-range cells.

    Parameters
    ----------
    directions, beyond : ndarray of float
        As `sides_beyond` returns them.
    face_rad : float
        Direction that one of the sides faces; the other faces away from it.
    aperture_rad : float
        What lies within half of it tells a side.
    """
    total = 0.0
    for face in (face_rad, face_rad + math.pi):
        near = beyond[(np.abs(wrap_angle(directions - face)) <= aperture_rad / 2.0 + 1e-9)]
        near = near[np.isfinite(near)]
        median = float(np.median(near)) if len(near) else 0.0
        total += median if median > _EDGE_CELLS else 0.0
    return total


def doubt_cells(directions: FloatArray, apart: FloatArray, face_rad: float, aperture_rad: float) -> float:
    """Return how far an extent may be off as its two sides lie apart, cross-range cells.

    Parameters
    ----------
    directions, apart : ndarray of float
        As `opposed_sides` returns them.
    face_rad : float
        Direction that one of the sides faces; the other faces away from it.
    aperture_rad : float
        What lies apart within it counts.
    """
    away = np.abs(np.mod(directions - face_rad + math.pi / 2.0, math.pi) - math.pi / 2.0)
    near = apart[(away <= aperture_rad + 1e-9) & np.isfinite(apart)]
    return max(0.0, float(near.max()) - _EDGE_CELLS) if len(near) else 0.0


def apart_share(apart: FloatArray) -> float:
    """Return the share of the sides that lie apart by more than `APART_CELLS`; 0 where none is seen."""
    known = apart[np.isfinite(apart)]
    return float((known > APART_CELLS).mean()) if len(known) else 0.0
