"""How far views lie beside one another across range, by the sides of their shadows.

A view that is misplaced (navigation, chips that were cut out one by one) shows both sides of the shadow
shifted alike: it misses the plan that all views bound by as much on the right as it exceeds it on the left.
Its width stays right. Carving keeps what nearly all views keep, and so takes from such a body twice what its
views scatter by.

A shift down-range cannot be told from another height, and stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .measurement import MIN_EDGES, PlanFit, SilhouetteSides, agreed_support
from .volume import VoxelGrid

#: Sides that scatter about one plan by more than this (1σ, cross-range cells) may be those of views that lie
#: beside one another: edges alone scatter by 0.2 to 0.6. At half nothing more is moved, as shifts must explain
#: most of it. At double vehicles whose views are shifted by 0.7 cells come out 0.7 to 2 cells too wide.
SCATTER_CELLS = 0.5
#: Shifts and plan are told by one another so often.
_ROUNDS = 3
#: Shifts are believed if the sides then scatter by less than this share of what they did. On simulated
#: vehicles whose views are shifted by 0.7 and 1.2 cells they leave 0.2 to 0.5 of it, on the measured one of
#: docs/examples.md 0.25; where edges alone scatter, 0.7.
_LEFT_SHARE = 0.5


def shifts_across(sides: Sequence[SilhouetteSides], grid: VoxelGrid) -> dict[int, float]:
    """Return how far each view lies beside its place across range.

    Parameters
    ----------
    sides : sequence of SilhouetteSides
        Of all views.
    grid : VoxelGrid
        What was carved of them.

    Returns
    -------
    dict of int to float
        By stamp, along e_c, m. Empty where the sides are those of one plan as they are, or where shifts do
        not make them so.
    """
    sides = sorted(sides, key=lambda side: side.info.stamp_ns)
    told = agreed_support(sides)
    if not len(told):
        return {}
    view = np.array([n for n, side in enumerate(sides) for _ in side.direction_rad])
    right = np.array([sign for side in sides for sign in side.signs])
    cell_m = float(np.median([side.info.resolution_m[1] for side in sides]))
    shift = np.zeros(len(sides))
    scatter = []
    for _ in range(_ROUNDS + 1):
        fit = PlanFit(sides, grid, told - right * shift[view])
        fit.solve()
        scatter.append(fit.spread_m)
        if fit.count < MIN_EDGES or scatter[0] <= SCATTER_CELLS * cell_m:
            return {}
        counts = np.zeros(len(told), np.bool_)
        counts[fit.kept] = fit.counts
        beyond = np.zeros(len(told))
        beyond[fit.kept] = fit.beyond_m
        found = np.bincount(view[counts], minlength=len(sides))
        total = np.bincount(view[counts], (right * beyond)[counts], minlength=len(sides))
        applied = shift.copy()
        shift += total / np.maximum(found, 1)
    if scatter[-1] > _LEFT_SHARE * scatter[0]:
        return {}
    return {side.info.stamp_ns: float(moved) for side, moved in zip(sides, applied, strict=True)}


__all__ = ["shifts_across"]
