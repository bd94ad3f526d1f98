"""The sonar's track: where it was at an aspect, and arcs without poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import TrackError, check_range
from ..frame_name import SCENE_FRAME, check_frame
from .frames import TWO_PI, FloatArray, wrap_angle
from .pixels import indices_of, positions_of, stamps_of


@dataclass(frozen=True)
class AspectGap:
    """An arc without sonar positions, from `start_rad` counter-clockwise over `width_rad`."""

    start_rad: float
    width_rad: float

    def __str__(self) -> str:
        if self.width_rad > TWO_PI - 1e-9:
            return "the whole circle"
        start = math.degrees(self.start_rad) % 360.0
        end = start + math.degrees(self.width_rad)
        return f"{start:.1f}° to {end - 360.0 if end > 360.0 + 1e-9 else end:.1f}°"


@dataclass(frozen=True)
class DoubtfulArc(AspectGap):
    """An arc that the track passes more than once, at different places.

    Parameters
    ----------
    start_rad, width_rad : float
        The arc, counter-clockwise.
    times : int
        How often the track passes it.
    apart_m : float
        How far apart these passages are at most.
    """

    times: int
    apart_m: float

    def why(self, aspect_rad: float) -> str:
        """Say why there is no position at an aspect of this arc."""
        return (
            f"the track passes aspect {math.degrees(aspect_rad) % 360.0:.1f}° {self.times} times, up to"
            f" {self.apart_m:.1f} m apart, and no stamp tells which passage counts"
        )

    def contains(self, aspect_rad: float) -> bool:
        """Say whether the aspect lies in this arc."""
        return float(np.mod(aspect_rad - self.start_rad, TWO_PI)) <= self.width_rad


class Track:
    """Sonar poses along the circle.

    Parameters
    ----------
    stamps_ns : array_like of int, shape (n,)
        Strictly increasing time stamps, ns.
    positions_m : array_like, shape (n, 3)
        Positions in the scene frame, metres.
    max_gap_rad : float
        An arc between neighbouring poses wider than this is a gap: no view is made in it.
    breaks : array_like of int
        Poses i that the sonar did not go on from to pose i + 1: what lay between was left out, and they are
        no neighbours (see `passage`).
    doubtful : sequence of DoubtfulArc
        Arcs where it is not known which of several passages counts: they count as gaps.
    frame : str
        Name of the scene frame that it is in: one for all of a run.

    Raises
    ------
    TrackError
        If there are fewer than three poses, stamps do not increase, a number is not finite, the
        sonar is not above the seabed, or passes over the scene's origin.
    InputTypeError
        If a stamp is no whole number, a position no number, or the frame no name.
    """

    def __init__(
        self,
        stamps_ns: ArrayLike,
        positions_m: ArrayLike,
        *,
        max_gap_rad: float = math.radians(3.0),
        breaks: ArrayLike = (),
        doubtful: Sequence[DoubtfulArc] = (),
        frame: str = SCENE_FRAME,
    ) -> None:
        check_frame("frame of the track", frame)
        stamps, positions = stamps_of("track", stamps_ns), positions_of("track", positions_m)
        if positions.ndim != 2 or positions.shape[1] != 3 or stamps.shape != positions.shape[:1]:
            raise TrackError(
                f"track has stamps {stamps.shape} and positions {positions.shape}; expected (n,), (n, 3)"
            )
        if len(stamps) < 3:
            raise TrackError(f"track has {len(stamps)} poses; expected at least 3")
        bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
        if bad.size:
            raise TrackError(f"track pose {bad[0]} is {positions[bad[0]].tolist()}; expected finite metres")
        back = np.flatnonzero(np.diff(stamps) <= 0)
        if back.size:
            i = int(back[0])
            raise TrackError(
                f"track stamps are out of order: pose {i + 1} ({stamps[i + 1]} ns) is not after pose {i}"
                f" ({stamps[i]} ns)"
            )
        low = np.flatnonzero(positions[:, 2] <= 0)
        if low.size:
            raise TrackError(
                f"track pose {low[0]} is at z = {positions[low[0], 2]:g} m; expected above the seabed (z > 0)"
            )
        ground = np.hypot(positions[:, 0], positions[:, 1])
        if ground.min() < 1e-9:
            raise TrackError(f"track pose {int(ground.argmin())} is over the scene's origin: no aspect there")
        self.stamps_ns = stamps
        self.frame = frame
        self.positions_m = positions
        self.max_gap_rad = check_range("max_gap_rad", max_gap_rad, 0, math.pi, "rad", open_low=True)
        #: Aspect of each pose, unwrapped along the track (rad).
        self.aspects_rad = np.unwrap(np.arctan2(positions[:, 1], positions[:, 0]))
        self.breaks = indices_of("breaks of the track", breaks)
        if self.breaks.size and not 0 <= self.breaks.min() <= self.breaks.max() < len(stamps) - 1:
            raise TrackError(
                f"track breaks are {self.breaks.tolist()}; expected poses 0 to {len(stamps) - 2}"
            )
        self.doubtful = tuple(doubtful)
        for array in (self.stamps_ns, self.positions_m, self.aspects_rad):
            array.flags.writeable = False

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        _, _, radius, height = self.circle
        return (
            f"Track: {len(self)} poses over {math.degrees(self.coverage_rad):.1f}° of the circle,"
            f" radius {radius:.2f} m, height {height:.2f} m, {len(self.gaps)} gaps"
        )

    @cached_property
    def circle(self) -> tuple[float, float, float, float]:
        """Least-squares circle (centre x, centre y, radius, mean height), metres.

        Algebraic (Kåsa) fit: x² + y² = 2ax + 2by + c.
        """
        x, y, z = self.positions_m.T
        design = np.column_stack([2 * x, 2 * y, np.ones_like(x)])
        (a, b, c), *_ = np.linalg.lstsq(design, x * x + y * y, rcond=None)
        return float(a), float(b), math.sqrt(max(c + a * a + b * b, 0.0)), float(z.mean())

    @cached_property
    def grazing_rad(self) -> float:
        """Mean grazing angle ψ = atan2(height, ground range), seen from the scene's origin."""
        x, y, z = self.positions_m.T
        return float(np.arctan2(z, np.hypot(x, y)).mean())

    def _steps(self) -> FloatArray:
        return np.diff(self.aspects_rad)

    def _connected(self) -> NDArray[np.bool_]:
        """Say of each pose but the last whether the arc to the next one was passed."""
        connected = np.abs(self._steps()) <= self.max_gap_rad
        connected[self.breaks] = False
        return connected

    @cached_property
    def gaps(self) -> tuple[AspectGap, ...]:
        """Arcs of the full circle that no pair of neighbouring poses spans."""
        steps = self._steps()
        lo = np.minimum(self.aspects_rad[:-1], self.aspects_rad[1:])
        covered = self._connected()
        arcs = [(float(s % TWO_PI), float(abs(w))) for s, w in zip(lo[covered], steps[covered], strict=True)]
        closing = float(wrap_angle(self.aspects_rad[0] - self.aspects_rad[-1]))
        if abs(self.aspects_rad[-1] - self.aspects_rad[0]) > math.pi and 0 < abs(closing) <= self.max_gap_rad:
            # A circle recorded as n poses of 360/n degrees ends one step before it closes.
            start = self.aspects_rad[-1] if closing > 0 else self.aspects_rad[0]
            arcs.append((float(start % TWO_PI), abs(closing)))
        if not arcs:
            return (AspectGap(0.0, TWO_PI),)
        # An arc across 0 covers the beginning of the circle as well.
        arcs += [(start - TWO_PI, width) for start, width in arcs if start + width > TWO_PI]
        arcs.sort()
        gaps = []
        first = reach = arcs[0][0]
        for start, width in arcs:
            if start > reach + 1e-9:
                gaps.append(AspectGap(reach, start - reach))
            reach = max(reach, start + width)
        if first + TWO_PI > reach + 1e-9:
            gaps.append(AspectGap(reach % TWO_PI, first + TWO_PI - reach))
        return tuple(gaps) if not self.doubtful else _union([*gaps, *self.doubtful])

    @property
    def coverage_rad(self) -> float:
        """Arc of the circle that the track covers, up to 2π."""
        return TWO_PI - sum(gap.width_rad for gap in self.gaps)

    def covered_fraction(self, aspect_rad: float, width_rad: float) -> float:
        """Return the fraction of the aperture [θ - w/2, θ + w/2] that the track covers."""
        lost = 0.0
        for gap in self.gaps:
            start = float(np.mod(gap.start_rad - (aspect_rad - width_rad / 2.0), TWO_PI))
            for begin in (start, start - TWO_PI):
                lost += max(0.0, min(begin + gap.width_rad, width_rad) - max(begin, 0.0))
        return max(0.0, 1.0 - lost / width_rad) if width_rad > 0 else float(not lost)

    def at_aspect(self, aspect_rad: float) -> tuple[int, FloatArray]:
        """Return when and where the sonar was at an aspect (first passage).

        Parameters
        ----------
        aspect_rad : float
            Aspect θ, any number of turns.

        Returns
        -------
        stamp_ns : int
        sonar_m : ndarray, shape (3,)

        Raises
        ------
        TrackError
            If the track has a gap there, or it is not known which of several passages counts.
        """
        for arc in self.doubtful:
            if arc.contains(aspect_rad):
                raise TrackError(arc.why(aspect_rad))
        a = self.aspects_rad
        # Number of whole turns between the wanted aspect and each pose: it changes where the track
        # crosses the aspect, whatever the direction and however the track wobbles.
        turns = np.floor((a - aspect_rad) / TWO_PI + 1e-12)
        crossing = np.flatnonzero((np.diff(turns) != 0) & self._connected())
        # A pose may sit exactly on the aspect without a crossing: at the track's start, or beside a gap.
        exact = np.flatnonzero(np.abs(wrap_angle(a - aspect_rad)) < 1e-9)
        if exact.size and (not crossing.size or exact[0] <= crossing[0]):
            i = int(exact[0])
            return int(self.stamps_ns[i]), self.positions_m[i].copy()
        if crossing.size:
            i = int(crossing[0])
            target = aspect_rad + TWO_PI * max(turns[i], turns[i + 1])
            f = (target - a[i]) / (a[i + 1] - a[i])
            f = min(max(float(f), 0.0), 1.0)
            position = (1.0 - f) * self.positions_m[i] + f * self.positions_m[i + 1]
            stamp = int(self.stamps_ns[i]) + round(f * int(self.stamps_ns[i + 1] - self.stamps_ns[i]))
            return stamp, position
        # A circle of n poses closes on itself.
        closing = float(wrap_angle(a[0] - a[-1]))
        beyond = float(wrap_angle(aspect_rad - a[-1]))
        if (
            abs(a[-1] - a[0]) > math.pi
            and abs(closing) <= self.max_gap_rad
            and beyond * closing >= 0
            and abs(beyond) <= abs(closing)
        ):
            f = beyond / closing
            step = int(np.median(np.diff(self.stamps_ns)))
            return (
                int(self.stamps_ns[-1]) + round(f * step),
                (1.0 - f) * self.positions_m[-1] + f * self.positions_m[0],
            )
        raise TrackError(f"the track has no pose at aspect {math.degrees(aspect_rad) % 360.0:.2f}°")


def _union(arcs: Sequence[AspectGap]) -> tuple[AspectGap, ...]:
    """Return arcs of the circle without overlaps."""
    ends = sorted((arc.start_rad % TWO_PI, arc.start_rad % TWO_PI + arc.width_rad) for arc in arcs)
    joined: list[list[float]] = []
    for start, end in ends:
        if joined and start <= joined[-1][1] + 1e-9:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([start, end])
    # The last may reach over 0 into the first ones.
    while len(joined) > 1 and joined[-1][1] >= joined[0][0] + TWO_PI - 1e-9:
        joined[-1][1] = max(joined[-1][1], joined.pop(0)[1] + TWO_PI)
    return tuple(AspectGap(start, min(end - start, TWO_PI)) for start, end in joined)
