"""The plan of a rectangle, a circle or an ellipse, where the sides of shadows tell one.

Any convex plan can be fitted to the sides (`measurement.PlanFit`). With their errors that is too free. Where
two faces of a box meet, it cuts the corner, and the faces move out instead: a box comes out half a cell too
wide to either side. And of a round plan the smallest rectangle lies where the errors make it narrowest: a
drum comes out half a cell too narrow. So what a simple shape tells as well is one: three or five numbers
instead of dozens.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

FloatArray = NDArray[np.float64]

#: A shape tells the sides as well as any convex plan if they scatter about it by so many times as much at
#: most (rms), and better than another shape if they scatter about that by so many times as much: nothing that
#: is round and a few cells wide is a box. What other limits change: docs/method.md.
_AS_WELL, _BETTER = 1.5, 1.1
#: Looks over an aperture.
_LOOKS = 9
#: A fit begins at so many headings (rad) about that of the smallest rectangle.
_STARTS_RAD = (-0.1, 0.0, 0.1)


@dataclass(frozen=True)
class Rectangle:
    """A rectangle on the ground; of another plan, the smallest one round it.

    Parameters
    ----------
    length_m, width_m : float
        Its sides, m.
    heading_rad : float
        Direction of the longer one.
    position_m : (float, float)
        Its middle (x, y).
    """

    length_m: float
    width_m: float
    heading_rad: float
    position_m: tuple[float, float]


@dataclass(frozen=True)
class SupportSamples:
    """Where a plan ends in some directions.

    Parameters
    ----------
    direction_rad : ndarray of float, shape (n,)
        Directions on the ground.
    aperture_rad : ndarray of float, shape (n,)
        Each is a mean over so much about it.
    support_m : ndarray of float, shape (n,)
        How far from the origin the plan ends.
    weight : ndarray of float, shape (n,)
        Weight of each error.
    sides : int
        So many of them, the first ones, are sides of shadows; the others stand in where these tell little.
    """

    direction_rad: FloatArray
    aperture_rad: FloatArray
    support_m: FloatArray
    weight: FloatArray
    sides: int

    def scatter_m(self, beyond_m: FloatArray) -> float:
        """Return how far the sides scatter about a plan, m (rms), given how far outside of it each lies."""
        weight = self.weight[: self.sides] ** 2
        return math.sqrt(float((weight * beyond_m[: self.sides] ** 2).sum() / max(weight.sum(), 1e-12)))


def looks_over(direction_rad: FloatArray, aperture_rad: FloatArray) -> FloatArray:
    """Return the directions of looks spread over an aperture about each direction, shape (n, looks)."""
    looks = (np.arange(_LOOKS) + 0.5) / _LOOKS - 0.5
    return np.asarray(direction_rad[:, None] + looks * aperture_rad[:, None])


def _box(angle: FloatArray, along: float, across: float) -> FloatArray:
    return 0.5 * (along * np.abs(np.cos(angle)) + across * np.abs(np.sin(angle)))


def _oval(angle: FloatArray, along: float, across: float) -> FloatArray:
    return 0.5 * np.hypot(along * np.cos(angle), across * np.sin(angle))


def _round(angle: FloatArray, along: float, _: float) -> FloatArray:
    return np.full(angle.shape, 0.5 * along)


#: How far a shape reaches from its middle, by the angle to its length.
_SHAPES: dict[str, Callable[[FloatArray, float, float], FloatArray]] = {
    "rectangle": _box,
    "ellipse": _oval,
    "circle": _round,
}


def _fitted(
    shape: str, samples: SupportSamples, start: Rectangle, turns: tuple[float, ...] = (0.0,)
) -> tuple[Rectangle, float]:
    """Fit a shape: return the smallest rectangle round it, and how far the sides scatter about it, m."""
    angles = looks_over(samples.direction_rad, samples.aperture_rad)
    east, north = np.cos(angles).mean(axis=1), np.sin(angles).mean(axis=1)
    count = 3 if shape == "circle" else 5

    def beyond(x: FloatArray) -> FloatArray:
        along, across, heading = x[2:] if count == 5 else (x[2], x[2], 0.0)
        ends = _SHAPES[shape](angles - heading, abs(along), abs(across)).mean(axis=1)
        return np.asarray(samples.support_m - x[0] * east - x[1] * north - ends)

    firsts = (
        [*start.position_m, start.length_m, start.width_m, start.heading_rad + turn][:count] for turn in turns
    )
    best = min(
        (least_squares(lambda x: samples.weight * beyond(x), first) for first in firsts),
        key=lambda found: float(found.cost),
    )
    scatter_m = samples.scatter_m(beyond(np.asarray(best.x)))
    x, y, along, *more = (float(value) for value in best.x)
    across, heading = more or (along, start.heading_rad)
    along, across = abs(along), abs(across)
    if along < across:
        along, across, heading = across, along, heading + math.pi / 2.0
    return Rectangle(along, across, heading % math.pi, (x, y)), scatter_m


def shape_of_plan(samples: SupportSamples, start: Rectangle, scatter_m: float) -> str | None:
    """Return the shape that tells the sides as well as any convex plan does, and better than the others.

    Parameters
    ----------
    samples : SupportSamples
        The sides.
    start : Rectangle
        The smallest rectangle round the convex plan that fits them best.
    scatter_m : float
        How far they scatter about that plan, m (rms).

    Returns
    -------
    {"rectangle", "ellipse", "circle"} or None
        A circle where an ellipse tells the sides no better.
    """
    box, oval = (_fitted(shape, samples, start, _STARTS_RAD)[1] for shape in ("rectangle", "ellipse"))
    if min(box, oval) > _AS_WELL * scatter_m:
        return None
    if oval >= _BETTER * box:
        return "rectangle"
    if box < _BETTER * oval:
        return None
    return "ellipse" if _fitted("circle", samples, start)[1] >= _BETTER * oval else "circle"


def fitted_plan(shape: str, samples: SupportSamples, start: Rectangle) -> Rectangle:
    """Fit a shape to samples; return the smallest rectangle round it. `start` is near it.

    Parameters
    ----------
    shape : {"rectangle", "ellipse", "circle"}
        As `shape_of_plan` tells.
    samples : SupportSamples
        The sides.
    start : Rectangle
        Of its heading is the rectangle round a circle.

    Examples
    --------
    >>> import numpy as np
    >>> phi = np.radians(np.arange(0.0, 360.0, 3.0))
    >>> box = 0.4 * np.abs(np.cos(phi)) + 0.2 * np.abs(np.sin(phi))
    >>> samples = SupportSamples(phi, np.zeros(120), box, np.ones(120), 120)
    >>> start = Rectangle(0.9, 0.5, 0.1, (0.0, 0.0))
    >>> shape_of_plan(samples, start, 0.01)
    'rectangle'
    >>> found = fitted_plan("rectangle", samples, start)
    >>> round(found.length_m, 3), round(found.width_m, 3)
    (0.8, 0.4)
    """
    return _fitted(shape, samples, start)[0]


__all__ = ["Rectangle", "SupportSamples", "fitted_plan", "looks_over", "shape_of_plan"]
