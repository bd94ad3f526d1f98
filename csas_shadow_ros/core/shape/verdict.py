"""Verdict and quality of a result, with the reasons."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from ..geometry import place_text
from .measurement import LEAST_ENDS, ONE_PLAN_CELLS, sides_apart
from .mesh import Dimensions
from .result import OTHER_SIGN, Quality, Result
from .volume import VoxelGrid

#: A result of less of the circle is limited: what is not seen from the other side is bounded by the volume
#: alone (share of the circle). At half of it sides are missing without a word; at double none would be good.
_WHOLE_ARC = 0.75
#: So many of the views (share) may be refused before the result counts as limited. Consensus carving removes
#: a voxel that 3 % of its views contradict, so losing a tenth of them hardly moves an edge; a gap in the
#: circle is told by the arc as well. Where most were refused, what is wrong with them may be wrong with the
#: rest.
_MOST_REJECTED = 0.1
#: Segmented shadow that what was found does not cast (share, mean over the views), above which a result is
#: limited, and above which it is not to be trusted. Five simulated boxes and a ramp left 0.2 to 2.5 % (8 to
#: 15 dB), one of two bodies whose shadows touch 45 %, a measured vehicle 20 %. Chosen on these few.
#: What the verdicts are worth on scenes that chose nothing: docs/population.md, "By verdict".
_UNEXPLAINED, _MOST_UNEXPLAINED = 0.1, 0.25
#: Likewise of the shadow that it casts and that is lit in the views: 0 to 0.2 % for the same shapes.
#: The limits are reasoned, not measured.
_LIT, _MOST_LIT = 0.05, 0.15
#: Opposite views see more than this share of the sides at different places (`opposed.APART_CELLS`): another
#: shadow touches the body's, or a part of it casts none from one side. Of 75 good results (single bodies of
#: the development half and of ten tapering families) 7 are above it, 2 of the 3 wrong ones among them; above
#: half of it 16, all 3; above double 2, one of the wrong.
_MOST_APART = 0.1
#: Shadows that leave the image in more than this share of the views: heights are then told by the fewer views
#: that see a tip. Those alone bound the top, so that a quarter of the circle without tips changes no height
#: (the benchmark's frame, 28 %); with none the top is unknown.
_MOST_CUT = 0.5
#: So many sides `cut_sides` looks at: the bottom is the seabed.
_ALL_SIDES = 5


def judge(result: Result) -> None:
    """Set a result's verdict and quality.

    Parameters
    ----------
    result : Result
        Everything else of it is there.
    """
    reasons: list[str] = []
    worst = _decide(result, reasons)
    cut, told = sum(side.cut for side in result.sides), len(result.sides)
    if told and cut > _MOST_CUT * told:
        nothing = ": none tells the height" if told - cut < LEAST_ENDS else ""
        reasons.append(
            f"the shadow leaves the image in {cut} of {told} views{nothing}; expected {_needed_image(result)}"
        )
        worst = max(worst, 2 if nothing else 1)
        if result.verdict == "no object":
            result.verdict, worst = "undecided", 2
    if result.mesh is not None and result.grid is not None:
        sides = cut_sides(result.grid)
        if len(sides) == _ALL_SIDES:
            reasons.append("the carved volume lies inside the object, which reaches past all its sides")
        else:
            reasons += [f"the carved volume cuts the object at its {side}" for side in sides]
        worst = 2 if sides else worst
    if result.views_used:
        worst = max(worst, _views_of(result, reasons))
    if beside := [*_pieces(result), *_in_shadow(result)]:
        reasons += beside
        worst = max(worst, 1)
    # Semicolons separate reasons where they travel as one text: none may hold one.
    told_reasons = tuple(reason.replace(";", ",") for reason in reasons)
    result.quality = Quality(("good", "limited", "not trustworthy")[worst], told_reasons)


def _needed_image(result: Result) -> str:
    """Return what image would hold the shadows of what was carved."""
    grid = result.grid
    if grid is None or not grid.occupied.any():
        return "a larger image"
    volume, d = grid.volume, grid.volume.voxel_size_m
    k, j, i = np.nonzero(grid.occupied)
    top = float(volume.z_m[k.max()]) + d / 2.0
    place = np.array([volume.x_m[i].mean(), volume.y_m[j].mean()])
    sonars = np.array([side.info.camera.sonar_m for side in result.sides])
    behind = top * np.hypot(*(sonars[:, :2] - place).T) / np.maximum(sonars[:, 2] - top, top)
    half = float(np.hypot(volume.x_m[i], volume.y_m[j]).max()) + d / 2.0 + float(behind.max())
    return f"an image of at least {2.0 * half:.1f} m"


def _decide(result: Result, reasons: list[str]) -> int:
    """Set the verdict; say how bad what speaks against it is: 0, 1 or 2."""
    worst = 0
    refused = len(result.rejected)
    first = next(iter(result.rejected.values()), "")
    if result.objects:
        result.verdict = "object"
        if doubts := [left.reason for left in result.left_out if left.reason.startswith(OTHER_SIGN)]:
            reasons += [f"spectrum_sign may be wrong: {doubt}" for doubt in doubts]
            worst = 2
        elif beside := _candidates(result):
            reasons += beside
            worst = 1
    elif result.target is not None and not result.views_used:
        result.verdict = "undecided"
        reasons.append(f"no view of the target was usable{': ' if first else ''}{first}")
        worst = 2
    elif result.composites is None and refused:
        result.verdict = "undecided"
        reasons.append(f"none of {refused} views could be made: {first}")
        worst = 2
    else:
        result.verdict = "no object"
        reasons += _candidates(result)
        if reasons:
            result.verdict, worst = "undecided", 2
        # Of empty seabeds 3 in 40 have such a faint body too, as many as under the stated sign.
        elif faint := [one for one in result.left_out if one.reason.startswith(OTHER_SIGN)]:
            told = "nothing tells the spectrum_sign"
            reasons += [f"{told}: {one.reason}, at {place_text(one.position_m)}" for one in faint]
            worst = 1
        if not reasons and result.detectable is not None and not result.detectable.is_enough:
            reasons.append(f"the seabed hides bodies: {result.detectable}")
            worst = 1
    return worst


def _views_of(result: Result, reasons: list[str]) -> int:
    """Say what the views lack, and how bad that is: 0, 1 or 2."""
    worst = 0
    refused = len(result.rejected)
    arc = math.degrees(result.arc_rad)
    if arc < 360.0 * _WHOLE_ARC:
        reasons.append(f"the views cover {arc:.0f}° of the circle")
        worst = max(worst, 1)
    if refused > _MOST_REJECTED * (refused + result.views_used):
        first = next(iter(result.rejected.values()))
        reasons.append(f"{refused} of {refused + result.views_used} views were not used: {first}")
        worst = max(worst, 2 if refused > result.views_used else 1)
    if result.views_lost:
        of = result.views_used + refused + result.views_lost
        reasons.append(f"{result.views_lost} of {of} views were lost on their way")
        worst = max(worst, 1)
    worst = max(worst, _fit_of(result, reasons))
    if result.by_likelihood_alone:
        reasons.append(
            "its shadow is too thin or too faint to segment in single views: carved from the mean"
            " likelihood of all views, sizes are rough"
        )
        worst = max(worst, 1)
    if result.final and result.dimensions is not None and not result.dimensions.intervals:
        reasons.append("too few sides of shadows were seen for intervals")
        worst = max(worst, 1)
    return worst


def _pieces(result: Result) -> list[str]:
    """Name the further objects that silhouettes do not measure: pieces of what was carved as one body."""
    if not result.final:
        return []
    return [
        f"object {number} has no intervals and rough sizes: it is a piece of a body carved as one"
        for number, one in enumerate(result.further, start=2)
        if not one.dimensions.intervals
    ]


def _in_shadow(result: Result) -> list[str]:
    """Name the objects of which one stands in the other's shadow from some aspect.

    That shadow then ends on a body, not on the seabed: both are carved and measured with what is left.
    """
    sonars = np.array([one.sonar_m for one in result.evidence.values()])
    found = result.objects
    if not result.final or not len(sonars) or len(found) < 2:
        return []
    place = np.asarray(found[0].dimensions.position_m)
    away = np.hypot(*(sonars[:, :2] - place).T)
    reach = float(np.median(away / sonars[:, 2]))  # of a shadow, for each metre of height
    named: set[int] = set()
    for (m, one), (n, two) in itertools.combinations(enumerate((o.dimensions for o in found), start=1), 2):
        between = np.subtract(two.position_m, one.position_m)
        gap = float(np.hypot(*between)) - _half_along(one, between) - _half_along(two, between)
        if gap < reach * max(one.height_m, two.height_m):
            named |= {m, n}
    if not named:
        return []
    *first, last = map(str, sorted(named))
    return [f"objects {', '.join(first)} and {last} stand in one another's shadow from some aspects"]


def _half_along(size: Dimensions, way: NDArray[np.float64]) -> float:
    """Return how far a plan's rectangle reaches from its middle that way, m."""
    turned = math.atan2(way[1], way[0]) - size.heading_rad
    return 0.5 * (size.length_m * abs(math.cos(turned)) + size.width_m * abs(math.sin(turned)))


def _candidates(result: Result) -> list[str]:
    """Name what may be an object and could not be carved, outside of what was carved round objects."""
    found = [
        f"a candidate at {place_text(left.position_m)}: {left.reason}"
        for left in result.left_out
        if left.strong and not any(one.target.covers(left.position_m) for one in result.objects)
    ]
    target = result.target
    # A volume that was given tells nothing of a shadow in it; one that the search found does.
    lost = result.mesh is None and result.final
    if lost and target is not None and not math.isnan(target.evidence):
        found.insert(
            0,
            f"a candidate at {place_text(target.position_m)}: its shadow is too thin or too faint to carve"
            " from single views, expected finer resolution or more contrast",
        )
    return found


def _fit_of(result: Result, reasons: list[str]) -> int:
    """Say where what was found does not fit the views, and how bad that is: 0, 1 or 2."""
    worst = 0
    unexplained, lit = (
        _mean([getattr(one, name) for one in result.evidence.values()]) for name in ("unexplained", "lit")
    )
    for share, some, most, text in (
        (unexplained, _UNEXPLAINED, _MOST_UNEXPLAINED, "of the shadow is unexplained"),
        (lit, _LIT, _MOST_LIT, "of the shadow that it would cast is lit in the views"),
    ):
        if share > some:
            reasons.append(f"{100.0 * share:.0f} % {text}")
            worst = max(worst, 2 if share > most else 1)
    scatter = math.nan if result.dimensions is None else result.dimensions.scatter_cells
    if scatter > ONE_PLAN_CELLS:
        reasons.append(
            f"the shadow's sides scatter by {scatter:.1f} cells about one plan: the views are shifted against"
            " one another, or there are several bodies"
        )
        worst = max(worst, 1)
    if shifts := [one.shift_m for one in result.evidence.values() if one.shift_m]:
        reasons.append(
            f"the views lay {float(np.std(shifts)):.2g} m (rms) beside one another across range, and were put"
            " together by the sides of their shadows: check the navigation"
        )
        worst = max(worst, 1)
    grid = result.grid if result.dimensions is not None else None
    apart, beside = sides_apart(result.sides, grid) if grid is not None and result.sides else (0.0, 0.0)
    if apart > _MOST_APART:
        reasons.append(
            f"opposite views see {100.0 * apart:.0f} % of the sides at different places: another shadow"
            " touches its own, or a part of it casts none from one side"
        )
        worst = max(worst, 1)
    if beside > _MOST_APART:
        reasons.append(
            f"shadow or echo tell {100.0 * beside:.0f} % of the sides beside its plan: a low foot that casts"
            " no shadow, bright seabed round it, or another shadow that touches its own"
        )
        worst = max(worst, 1)
    return worst


def explained_share(result: Result) -> float | None:
    """Return the mean explained share of the segmented shadow over the views; None if unknown."""
    known = [one.unexplained for one in result.evidence.values() if math.isfinite(one.unexplained)]
    return 1.0 - float(np.mean(known)) if known else None


def _mean(values: list[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else 0.0


def cut_sides(grid: VoxelGrid) -> list[str]:
    """Return the sides of a carved volume that its object reaches through."""
    body = grid.occupied
    ends = {
        "west side": body[:, :, 0],
        "east side": body[:, :, -1],
        "south side": body[:, 0],
        "north side": body[:, -1],
        "top": body[-1],
    }
    return [name for name, end in ends.items() if np.any(end)]


def no_object_reason(result: Result) -> str:
    """Say why there is no object."""
    if result.target is None:
        told = "" if result.detectable is None else f"; {result.detectable}"
        return f"nothing casts a shadow of its own from all sides{told}"
    if not result.views_used:
        return "no view of the target was usable"
    return "no voxel of the carved volume lies in shadow from all sides"
