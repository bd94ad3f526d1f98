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

from .measurement import MIN_EDGES, ONE_PLAN_CELLS, PlanFit, SilhouetteSides, agreed_support
from .volume import VoxelGrid

#: Shifts and plan are told by one another so often. On 8 simulated vehicles whose views were shifted by 1.2
#: cells (1σ) the second round changes sizes by up to 0.3 cells, the third by less than 0.1.
_ROUNDS = 3
#: Shifts are believed if the sides then scatter by less than this share of what they did, and like those of
#: one plan. On the same vehicles they leave 0.2 to 0.3, on the measured one of docs/examples.md 0.25.
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
        if fit.count < MIN_EDGES or scatter[0] <= ONE_PLAN_CELLS * cell_m:
            return {}
        counts = np.zeros(len(told), np.bool_)
        counts[fit.kept] = fit.counts
        beyond = np.zeros(len(told))
        beyond[fit.kept] = fit.beyond_m
        found = np.bincount(view[counts], minlength=len(sides))
        total = np.bincount(view[counts], (right * beyond)[counts], minlength=len(sides))
        applied = shift.copy()
        shift += total / np.maximum(found, 1)
    if scatter[-1] > min(ONE_PLAN_CELLS * cell_m, _LEFT_SHARE * scatter[0]):
        return {}
    return {side.info.stamp_ns: float(moved) for side, moved in zip(sides, applied, strict=True)}


__all__ = ["shifts_across"]
