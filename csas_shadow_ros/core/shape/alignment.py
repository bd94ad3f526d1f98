"""How far views lie beside one another across range, by the sides of their shadows.

A view that is misplaced (navigation, chips that were cut out one by one) shows both sides of the shadow
shifted alike: it misses the plan that all views bound by as much on the right as it exceeds it on the left.
Its width stays right. Carving keeps what nearly all views keep, and so takes from such a body twice what its
views scatter by.

A shift down-range cannot be told from another height, and stays. So does a view that lies more than three
cells beside its place: its sides count as those of another body.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .measurement import MIN_EDGES, PlanFit, SilhouetteSides, agreed_sides
from .volume import VoxelGrid

#: Sides that scatter about one plan by more than this (1σ, cross-range cells) may be those of views that lie
#: beside one another: edges alone scatter by 0.2 to 0.6. Of simulated vehicles whose views are shifted by 0.7
#: cells, five are 0.4 to 1.0 cells wider than unshifted at double, and within 0.4 so. Half was not measured.
SCATTER_CELLS = 0.5
#: Shifts and plan are told by one another so often. Half and double were not measured.
_ROUNDS = 3
#: Shifts are believed if the sides of views that show both then scatter by less than this share of what they
#: did. Where edges alone scatter, one shift for two sides leaves 1/√2. Carved again, all sides of the
#: vehicles above scatter by 0.3 to 0.5 of what they did, and by 0.2 to 0.3 where views are shifted by 1.2
#: cells: at half some would stay. Double was not measured.
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
    sides, told = agreed_sides(sides, grid)
    if not len(told):
        return {}
    view = np.array([n for n, side in enumerate(sides) for _ in side.direction_rad])
    right = np.array([sign for side in sides for sign in side.signs])
    cell_m = float(np.median([side.info.resolution_m[1] for side in sides]))
    shift = np.zeros(len(sides))
    scatter_m: list[float] = []
    for _ in range(_ROUNDS + 1):
        used = shift
        fit = PlanFit(sides, grid, told - right * used[view])
        fit.solve()
        if fit.spread_m <= SCATTER_CELLS * cell_m and not scatter_m:
            return {}
        counts = np.flatnonzero(fit.kept)[fit.counts]
        beyond = np.bincount(counts, fit.beyond_m[fit.counts], minlength=len(told))
        shown = np.bincount(view[counts], minlength=len(sides))
        both = counts[shown[view[counts]] == 2]
        if len(both) < MIN_EDGES:
            return {}
        scatter_m.append(float(np.median(np.abs(beyond[both]))))
        shift = used + np.bincount(view, right * beyond, minlength=len(sides)) / np.maximum(shown, 1)
    if scatter_m[-1] > _LEFT_SHARE * scatter_m[0]:
        return {}
    return {side.info.stamp_ns: float(moved) for side, moved in zip(sides, used, strict=True)}


__all__ = ["shifts_across"]
