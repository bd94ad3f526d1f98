"""Arcs of the circle, and how much of it several cover together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import TWO_PI

#: Ends of arcs that are nearer than that are one.
TOLERANCE_RAD = 1e-6


@dataclass(frozen=True)
class Arc:
    """An arc of aspects from `start_rad` counter-clockwise over `width_rad`."""

    start_rad: float
    width_rad: float

    def widened(self, by_rad: float) -> Arc:
        """Return the arc extended by this angle at both ends."""
        return Arc(self.start_rad - by_rad, self.width_rad + 2.0 * by_rad)

    def touches(self, other: Arc) -> bool:
        """Say whether two arcs have any aspect in common."""
        ahead = (other.start_rad - self.start_rad) % TWO_PI
        return ahead <= self.width_rad or TWO_PI - ahead <= other.width_rad

    def pieces(self) -> list[tuple[float, float]]:
        """Return (start, end) within [0, 2π]: two where an arc of less than the circle passes 0."""
        start = self.start_rad % TWO_PI
        end = start + self.width_rad
        return [(start, min(end, TWO_PI)), (0.0, end - TWO_PI)] if end > TWO_PI else [(start, end)]

    def __str__(self) -> str:
        start = math.degrees(self.start_rad) % 360.0
        return f"{start:.1f}° to {start + math.degrees(self.width_rad):.1f}°"


class Arcs:
    """A union of arcs of the circle."""

    def __init__(self) -> None:
        #: Disjoint pieces within [0, 2π], in order.
        self._pieces: list[tuple[float, float]] = []

    def add(self, arc: Arc) -> None:
        """Add an arc."""
        if arc.width_rad >= TWO_PI - TOLERANCE_RAD:
            self._pieces = [(0.0, TWO_PI)]
            return
        merged: list[tuple[float, float]] = []
        for low, high in sorted([*self._pieces, *arc.pieces()]):
            if merged and low <= merged[-1][1] + TOLERANCE_RAD:
                merged[-1] = (merged[-1][0], max(high, merged[-1][1]))
            else:
                merged.append((low, high))
        self._pieces = merged

    @property
    def covered_rad(self) -> float:
        """Covered part of the circle (rad)."""
        return sum(high - low for low, high in self._pieces)

    @property
    def whole(self) -> bool:
        """Whether they close the circle."""
        return self.covered_rad >= TWO_PI - 10.0 * TOLERANCE_RAD

    def cover(self, arc: Arc) -> bool:
        """Say whether they cover all of an arc."""
        if self.whole:
            return True
        if arc.width_rad >= TWO_PI:
            return False
        return all(
            any(low <= a + TOLERANCE_RAD and b <= high + TOLERANCE_RAD for low, high in self._pieces)
            for a, b in arc.pieces()
        )

    def contains(self, aspects_rad: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Say for each aspect whether it is covered."""
        a = np.mod(aspects_rad, TWO_PI)
        inside = np.zeros(a.shape, bool)
        for low, high in self._pieces:
            inside |= (a >= low - TOLERANCE_RAD) & (a <= high + TOLERANCE_RAD)
        return inside

    def missing(self) -> list[Arc]:
        """Return the arcs between them."""
        if not self._pieces:
            return [Arc(0.0, TWO_PI)]
        first = self._pieces[0][0]
        ends = [(high, low) for (_, high), (low, _) in zip(self._pieces, self._pieces[1:], strict=False)]
        ends.append((self._pieces[-1][1], TWO_PI + first))
        return [Arc(a, b - a) for a, b in ends if b - a > 10.0 * TOLERANCE_RAD]
