"""Tell a smooth rise or hollow of the seabed from a body, by how its brightness goes round the circle.

A slope is brighter the more it faces the sonar: by Lambert's rule its power goes as sin² of its own grazing
angle, and so the amplitude at a place goes, once round the circle, as ``a (1 + g cos(θ - φ))``, with g the
slope over tan ψ. All of relief is that, mound and hollow, on any sediment: a level and the first harmonic of
the aspect. A body's shadow is not: a place near it is dark from a sector of aspects and as bright as ever
from all others, and its echo comes from few.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Energy that level and first harmonic may leave (share of the harmonic's): of what is no body, and of what
#: proves no wrong sign. Mounds of the development half leave -0.03 to 0.01, of 45 more random seabeds to
#: 0.03, hollows -0.05 to 0.09; bodies whose shadow is two cells long 0.03 (a brick), 0.046 (a wedge) and
#: more. Of ten mounds and 22 bricks, half of the first changes none, and double makes rises of two bricks. At
#: half of the second one of six hollows in dark sediment proves a wrong sign; at double boxes with bright
#: echoes do not.
_LEFT, _MAY_LEAVE = 0.02, 0.08
#: Round a mound or a body places are bright from their own side of the middle: mounds have 0.83 to 0.99, the
#: weakest 0.68, pipes, whose ends tell no side, 0.14 to 0.5, sediment -0.2 to 0.1. Half of it changes none of
#: the ten mounds and 22 bricks; double is more than there can be.
_OUTWARD = 0.7
#: In hollows they are bright from the other side: -0.65 to -0.8. At half a piece beside a rock (scene 295 of
#: the development half) counts as one; at double the hollow of -0.65 is a body.
_INWARD = -0.35
#: Looks further apart than this (rad; 1.5 steps of the search) say nothing of the speckle between them.
_NEXT_RAD = np.radians(15.0)
#: A place needs so many looks: level, sine and cosine take three.
_LEAST_LOOKS = 9


@dataclass(frozen=True)
class Shading:
    """How the amplitude round a body goes with the aspect.

    Parameters
    ----------
    left : float
        Energy that level and first harmonic leave, over the first harmonic's: 0 for relief on any sediment;
        NaN where there is no first harmonic.
    outward : float
        Whether places are bright from their own side of the middle, as round a body or on a mound (to 1), or
        from the other, as in a hollow (to -1); about 0 on flat sediment.
    """

    left: float
    outward: float

    @property
    def may_be_relief(self) -> bool:
        """Whether a slope of the seabed may explain it."""
        return self.left < _MAY_LEAVE

    @property
    def stands(self) -> bool:
        """Whether it has sides all round, as a body and a rise have; crossing shadows and sediment do not."""
        return self.outward > _OUTWARD

    @property
    def is_rise(self) -> bool:
        """Whether a rise of the seabed explains it."""
        return self.left < _LEFT and self.stands

    @property
    def is_body(self) -> bool:
        """Whether it has sides all round, and no slope of the seabed explains them."""
        return self.stands and self.left >= _MAY_LEAVE

    @property
    def is_hollow(self) -> bool:
        """Whether its far side is bright: that of a body is dark."""
        return self.outward < _INWARD


#: Nothing was looked at.
UNSEEN = Shading(float("nan"), float("nan"))


def shading(
    off_m: NDArray[np.float64], looks: Iterable[tuple[float, NDArray[np.float64], NDArray[np.bool_]]]
) -> Shading:
    """Fit level and first harmonic of the aspect to the amplitudes at some places.

    Parameters
    ----------
    off_m : ndarray, shape (2, places)
        Where they are (x, y), off the middle.
    looks : iterable of (aspect_rad, power, known)
        Of each look: the aspect (rad), the power at each place, the seabed's mean 1, and where it is known;
        both of shape (places,). Unknown where other looks know a place: an echo, whose power is at least
        what is given.

    Returns
    -------
    Shading
        NaN where too few looks know a place, or there is no first harmonic: no relief.

    Examples
    --------
    >>> aspects = np.radians(np.arange(0.0, 360.0, 10.0))
    >>> known = np.ones(1, bool)
    >>> place = np.array([[1.0], [0.0]])
    >>> slope = [(t, np.array([(1 + 0.5 * np.cos(t)) ** 2]), known) for t in aspects]
    >>> shading(place, slope).may_be_relief
    True
    >>> shadow = [(t, np.array([0.1 if abs(t - 3.0) < 0.5 else 1.0]), known) for t in aspects]
    >>> shading(place, shadow).may_be_relief
    False
    """
    ordered = sorted(looks, key=lambda look: look[0])
    aspects = np.array([aspect for aspect, _, _ in ordered])
    count = len(ordered)
    told = np.sum([known for _, _, known in ordered], axis=0) >= _LEAST_LOOKS
    if not told.any():
        return Shading(np.nan, 0.0)
    over = np.sqrt([power[told] for _, power, _ in ordered]) - 1.0
    turn = np.stack([np.cos(aspects), np.sin(aspects), np.ones(count)], axis=1)
    next_to = np.diff(aspects) <= _NEXT_RAD
    speckle = 0.5 * float((np.diff(over, axis=0)[next_to] ** 2).mean()) if next_to.any() else 0.0

    def left(of: int) -> float:
        """Return the energy that so many terms leave, at a place, less that of speckle."""
        fit = turn[:, :of] @ np.linalg.lstsq(turn[:, :of], over, rcond=None)[0]
        return float(((over - fit) ** 2).sum(axis=0).mean()) - (count - of) * speckle

    towards = np.linalg.lstsq(turn, over, rcond=None)[0][:2]
    away = off_m[:, told] / np.maximum(np.hypot(*off_m[:, told]), 1e-9)
    outward = float((towards * away).sum() / max(np.hypot(*towards).sum(), 1e-9))
    harmonic = float((over**2).sum(axis=0).mean()) - count * speckle - left(2)
    if not harmonic > 2.0 * speckle:  # as much as it has of speckle alone
        return Shading(np.nan, outward)
    return Shading(left(3) / harmonic, outward)
