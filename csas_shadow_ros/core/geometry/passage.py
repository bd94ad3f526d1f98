"""Which poses of a track count: the passage round the circle that the image or the sectors name.

A vehicle's track holds more than the circle: approach and departure, survey lines, standing still,
several laps. Everything here is judged by the arc that poses contribute, seen from the scene's origin,
not by their number, and in shares of range and height, so that it does not depend on the circle's size.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import TrackError
from .frames import TWO_PI, FloatArray, wrap_angle
from .track import DoubtfulArc, Track

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

#: Motion is looked at over steps of this share of the range, 6° of arc: 3 m at 30 m. Positions that scatter
#: by 0.5 m turn such a step by 13°. At half of it they turn it by 26°, and circles fall to pieces; at double
#: an approach that ends in a sharp turn is cut 6 m instead of 3 m beside it.
_STEP_SHARE = 0.1
#: A step that turns by more shows no motion round the origin: it is five usual ones. At half of it poses 15°
#: apart are no circle; at double a way over the target is one.
_LARGEST_STEP_RAD = math.radians(30.0)
#: Motion goes round where so much of it is across the line of sight: within 60° of the tangent. A circle
#: that is off centre by half its radius, or an ellipse of 2:1, stays within 37°. At 0.25 a line abeam counts
#: as an arc of 150° and an approach from far away as part of the circle; at 1 nothing counts.
_LEAST_TANGENTIAL = 0.5
#: What adjoins the circle within its band counts to it within 37° of the tangent: a vehicle settles on its
#: circle at less. At half of it the last 1 m of a straight approach stays; at 1 nothing is settling.
_ADJOINING_TANGENTIAL = 0.8
#: By that measure a straight line passes at most 120°, and a step of 6° more at both ends; what passes more
#: goes round. At half of it every line abeam were a circle, at double a circle with a missing arc were none.
_MORE_THAN_A_LINE_RAD = math.radians(145.0)
#: A shorter arc is told from a line by its turn: a circle turns as far as its aspect goes (share 1), a line
#: not at all (0). An ellipse of 1.3:1 has at least 0.6. At half of it lines that are steered with 15 % of a
#: circle's turn count as arcs; at double flat sides of an ellipse of 1.3:1 do not.
_LEAST_TURN = 0.3
#: Less arc than this is too short to tell a turn by.
_LEAST_ARC_RAD = math.radians(20.0)
#: The circle's band is six times the track's own spread about it (of a normal spread, one pose in 5e8 is
#: beyond), and not less than these shares of its radius: for what adjoins the circle, and for what is cut
#: off at its ends. Within 5 % a vehicle settles on its circle; a tangent leaves that band after 18° of arc.
#: At half of it, 12°, but a circle that closes 1 m beside its start loses its end; at double, 25°.
_SPREADS, _TIGHT_SHARE, _BAND_SHARE = 6.0, 0.01, 0.05
#: What comes after a pause of the record goes on with the circle if one circle passes both within this share
#: of its radius. An ellipse whose axes differ by 16 % lies within 8 % of its circle, but the circle of one
#: half of it is 40 % off the other's end. At half such an ellipse loses what comes after a pause; at double
#: half a circle at 1.6 times the range would go on with the other half. Both are reasoned.
_ONE_CIRCUIT_SHARE = 0.15
#: Two passages of an aspect are in the same place within this share of range and height. A height is
#: measured by its shadow in proportion to the sonar's: 3 % is 12 mm of 0.4 m, a third of a voxel of 4 cm.
#: At half of it laps flown with 0.5 m of spread at 30 m differ, and a stamp must tell; at double a height may
#: be wrong by 6 % without a word.
_SAME_PLACE = 0.03
#: A step that takes longer than this many usual ones is standing still. At half or double, slow turns
#: are thinned out (nothing is lost but poses), or a stand of a minute counts as part of the circle.
_STILL = 10.0
#: A jump: so many usual steps, and more than a gap. At half of it spread positions jump by themselves.
_JUMP_STEPS = 6.0
#: At most this share of the poses (but one) may jump together and come back; more is a way that was gone.
_JUMP_SHARE = 0.01
#: Aspects are compared on this raster, half of the usual step between poses.
_BINS = 1440
_BIN_RAD = TWO_PI / _BINS


@dataclass(frozen=True, eq=False)
class Passage:
    """The part of a track that counts.

    Parameters
    ----------
    track : Track
        Its poses on the circle; the very track that was given where nothing is left out.
    notes : tuple of str
        What was left out and why, one line each.
    """

    track: Track
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Stretch:
    """Poses first to last (inclusive), which go round by `arc_rad`; sense +1 is counter-clockwise."""

    first: int
    last: int
    sense: int
    arc_rad: float
    round: bool
    nodes: tuple[int, ...]


@dataclass(frozen=True)
class _Circle:
    x_m: float
    y_m: float
    radius_m: float
    spread_m: float

    def off(self, xy: FloatArray) -> FloatArray:
        """Return how far each position (n, 2) is off the circle, positive outside."""
        return np.hypot(xy[:, 0] - self.x_m, xy[:, 1] - self.y_m) - self.radius_m

    def band_m(self, share: float) -> float:
        return max(_SPREADS * self.spread_m, share * self.radius_m)


def passage(
    track: Track, *, image_ns: int | None = None, sectors: Sequence[tuple[int, float, float]] = ()
) -> Passage:
    """Select the poses of a track that count: those on the circle, in the lap that a stamp names.

    Parameters
    ----------
    track : Track
        All poses of a run.
    image_ns : int, optional
        Stamp of the full-circle image. Of aspects that are passed several times, the last passage until then
        counts; the first one after it where there is none before.
    sectors : sequence of (int, float, float)
        Stamp (ns), start (rad) and width (rad) of each sector, or of the aperture of each view. Of an aspect
        that is passed several times, the passage counts that is nearest in time to a sector which covers it.

    Returns
    -------
    Passage
        Aspects that are passed from places more than 3 % of range or height apart, and no stamp tells which
        counts, are the track's `doubtful` arcs: refused one by one.

    Notes
    -----
    A track that nowhere goes round the origin by 20° or more is returned as it is: what is wrong with it, its
    gaps tell.

    Examples
    --------
    >>> angle = np.radians(np.arange(0, 360, 0.5))
    >>> circle = np.c_[30 * np.cos(angle), 30 * np.sin(angle), np.full(720, 12.0)]
    >>> line = np.c_[np.full(400, 120.0), np.linspace(-200, 200, 400), np.full(400, 12.0)]
    >>> whole = Track(np.arange(1120) * 10**8, np.vstack([line, circle]))
    >>> found = passage(whole, image_ns=1119 * 10**8)
    >>> len(found.track), len(found.notes)
    (720, 1)
    """
    return _Selection(track, image_ns, sectors).select()


class _Selection:
    def __init__(
        self, track: Track, image_ns: int | None, sectors: Sequence[tuple[int, float, float]]
    ) -> None:
        self.track, self.image_ns, self.sectors = track, image_ns, sectors
        self.xy = track.positions_m[:, :2]
        self.z = track.positions_m[:, 2]
        self.range = np.hypot(self.xy[:, 0], self.xy[:, 1])
        self.kept = np.ones(len(track), bool)
        #: Poses that were left out because the sonar was elsewhere: no neighbours across them.
        self.elsewhere = np.zeros(len(track), bool)
        #: Median distance between poses, standing still apart.
        self.usual_m = 0.0
        self.doubtful: list[DoubtfulArc] = []
        self.notes: list[str] = []

    def select(self) -> Passage:
        self._leave_out_jumps()
        nodes = self._nodes()
        stretches = self._stretches(nodes)
        candidates = [s for s in stretches if s.round]
        if candidates:
            main = self._main(candidates)
            circle = _fit(self.xy[list(main.nodes)])
            sections = self._on_circle(stretches, main, circle)
            if sections:
                self._leave_out(sections, circle)
                self._thin_out(nodes, sections)
                self._choose_laps(sections)
        return self._result()

    def _result(self) -> Passage:
        kept = np.flatnonzero(self.kept)
        if len(kept) < 3:
            return Passage(self.track, tuple(self.notes))
        if len(kept) == len(self.track) and not self.doubtful:
            track = self.track
        else:
            track = Track(
                self.track.stamps_ns[kept],
                self.track.positions_m[kept],
                max_gap_rad=self.track.max_gap_rad,
                breaks=self._breaks(kept),
                doubtful=self.doubtful,
                frame=self.track.frame,
            )
        self._tell_height(track)
        return Passage(track, tuple(self.notes))

    def _breaks(self, kept: IntArray) -> IntArray:
        """Return which kept poses have no neighbour in the next one, as the sonar was elsewhere between."""
        counts = np.concatenate([[0], np.cumsum(self.elsewhere)])
        a, b = kept[:-1], kept[1:]
        between = counts[b] > counts[a]
        apart = np.abs(self.range[b] / self.range[a] - 1.0) > _SAME_PLACE
        apart |= np.abs(self.z[b] / self.z[a] - 1.0) > _SAME_PLACE
        return np.flatnonzero(between & apart)

    def _leave_out_jumps(self) -> None:
        """Leave out poses that jump away and come back: the sonar cannot have been there."""
        positions, n = self.track.positions_m, len(self.track)
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        if not (steps > 0).any():
            return
        self.usual_m = usual = float(np.median(steps[steps > 0]))
        gap = self.track.max_gap_rad * np.minimum(self.range[:-1], self.range[1:])
        limit = np.maximum(_JUMP_STEPS * usual, gap)
        edges = np.flatnonzero(steps > limit)
        most = max(1, int(_JUMP_SHARE * n))
        jumped: list[int] = []
        before = -1
        for a, b in itertools.pairwise(edges.tolist()):
            # Poses a + 1 to b are away; a block whose first edge closed another one is the way back.
            if b - a > most or a == before:
                continue
            back = float(np.linalg.norm(positions[b + 1] - positions[a]))
            if back <= limit[a] + usual * (b - a + 1) and back < 0.5 * min(steps[a], steps[b]):
                jumped += range(a + 1, b + 1)
                before = b
        if not jumped:
            return
        self.kept[jumped] = False
        i = jumped[0]
        place = ", ".join(f"{c:.2f}" for c in positions[i])
        more = f" and {len(jumped) - 1} more" if len(jumped) > 1 else ""
        self.notes.append(
            f"track pose {i} ({self.track.stamps_ns[i]} ns) at ({place}) m{more} jumps by"
            f" {steps[i - 1]:.1f} m and back: left out"
        )

    def _nodes(self) -> IntArray:
        """Return poses that are a step apart, the first and the last one among them."""
        index = np.flatnonzero(self.kept)
        x, y = self.xy[index].T.tolist()
        near = (np.square(_STEP_SHARE * self.range[index])).tolist()
        found = [0]
        at_x, at_y, least = x[0], y[0], near[0]
        for i in range(1, len(x)):
            dx, dy = x[i] - at_x, y[i] - at_y
            if dx * dx + dy * dy >= least:
                found.append(i)
                at_x, at_y, least = x[i], y[i], near[i]
        if found[-1] != len(x) - 1:
            found.append(len(x) - 1)
        return index[found]

    def _stretches(self, nodes: IntArray) -> list[_Stretch]:
        """Return the stretches of the track in which the sonar goes round the origin in one sense."""
        xy, ranges = self.xy[nodes], self.range[nodes]
        turned = wrap_angle(np.diff(np.arctan2(xy[:, 1], xy[:, 0])))
        lengths = np.hypot(*np.diff(xy, axis=0).T)
        across = np.abs(turned) * (ranges[:-1] + ranges[1:]) / 2.0
        sense = np.where(across >= _LEAST_TANGENTIAL * lengths, np.sign(turned), 0.0).astype(int)
        # Beside the origin itself a step turns by anything; a pause of the record is bridged below.
        sense[np.abs(turned) > _LARGEST_STEP_RAD] = 0
        if len(sense) > 1 and lengths[-1] < _STEP_SHARE * ranges[-2]:
            sense[-1] = sense[-2]  # the rest of a step shows no direction
        gone = np.concatenate([[0.0], np.cumsum(lengths)])
        passed = np.concatenate([[0.0], np.cumsum(turned)])
        runs: list[list[int]] = []  # first node, last node, sense
        for edge, way in enumerate(sense.tolist()):
            if way == 0:
                continue
            if runs and runs[-1][2] == way:
                first, last = runs[-1][1], edge
                # A short way aside, or one that leads on, such as round an obstacle, is part of the circle.
                gain = way * (passed[last] - passed[first])
                aside = (3.0 * _STEP_SHARE + 3.0 * max(gain, 0.0)) * min(ranges[first], ranges[last])
                if gone[last] - gone[first] <= aside:
                    runs[-1][1] = edge + 1
                    continue
            runs.append([edge, edge + 1, way])
        return [self._stretch(nodes, a, b, way, float(abs(passed[b] - passed[a]))) for a, b, way in runs]

    def _stretch(self, nodes: IntArray, a: int, b: int, sense: int, arc: float) -> _Stretch:
        part = nodes[a : b + 1]
        goes_round = arc >= _MORE_THAN_A_LINE_RAD
        if not goes_round and arc >= _LEAST_ARC_RAD and len(part) >= 3:
            # The chords of an arc's halves differ by half its turn.
            aspect = np.unwrap(np.arctan2(self.xy[part, 1], self.xy[part, 0]))
            middle = int(np.abs(aspect - (aspect[0] + aspect[-1]) / 2.0).argmin())
            middle = min(max(middle, 1), len(part) - 2)
            c1 = self.xy[part[middle]] - self.xy[part[0]]
            c2 = self.xy[part[-1]] - self.xy[part[middle]]
            turn = math.atan2(c1[0] * c2[1] - c1[1] * c2[0], float(c1 @ c2))
            goes_round = 2.0 * sense * turn >= _LEAST_TURN * arc
        return _Stretch(int(part[0]), int(part[-1]), sense, arc, goes_round, tuple(part.tolist()))

    def _main(self, candidates: Sequence[_Stretch]) -> _Stretch:
        """Return the stretch that the stamps name; the longest arc if there are none."""
        stamps = self.track.stamps_ns

        def arc(s: _Stretch) -> float:
            return min(s.arc_rad, TWO_PI)

        if self.sectors:
            named = [
                sum(stamps[s.first] <= t <= stamps[s.last] for t, _, _ in self.sectors) for s in candidates
            ]
            return max(zip(named, map(arc, candidates), candidates, strict=True), key=lambda one: one[:2])[2]
        if self.image_ns is None:
            return max(candidates, key=arc)
        begun = [s for s in candidates if stamps[s.first] <= self.image_ns]
        pool = begun or list(candidates)
        longest = max(map(arc, pool))
        # A turn on the way home is no circle: half of the longest arc at least.
        pool = [s for s in pool if arc(s) >= 0.5 * longest]
        return pool[-1] if begun else pool[0]

    def _on_circle(
        self, stretches: Sequence[_Stretch], main: _Stretch, circle: _Circle
    ) -> list[tuple[int, int, int]]:
        """Return the (first, last, sense) of the poses of each stretch that counts, in time."""
        found: list[tuple[int, int, int]] = []
        for number, s in enumerate(stretches):
            # A stretch may be widened by poses of the step to the next one, in which the sonar turns.
            after = stretches[number + 1].nodes[1] if number + 1 < len(stretches) else len(self.track)
            before = stretches[number - 1].nodes[-2] if number else -1
            taken = found[-1][1] if found else -1
            own = circle
            if s is not main:
                off = np.abs(circle.off(self.xy[list(s.nodes)]))
                if float(np.median(off)) > circle.band_m(_BAND_SHARE):
                    # Another circle: only stamps of sectors, or none, leave it open whether it counts.
                    if self.image_ns is not None or s.arc_rad < _MORE_THAN_A_LINE_RAD:
                        continue
                    own = _fit(self.xy[list(s.nodes)])
            first, last = self._ends(s, own, max(before, taken), after)
            first = max(first, taken + 1)
            if last > first:
                found.append((first, last, s.sense))
        return found

    def _ends(self, s: _Stretch, circle: _Circle, before: int, after: int) -> tuple[int, int]:
        """Return the first and last pose of a stretch without what only adjoins the circle.

        Poses up to `before` and from `after` on belong to other stretches.
        """
        off = np.abs(circle.off(self.xy))
        tight, band = circle.band_m(_TIGHT_SHARE), circle.band_m(_BAND_SHARE)
        inside = np.flatnonzero(off[s.first : s.last + 1] <= band)
        if not inside.size:
            return s.last, s.first
        first, last = s.first + int(inside[0]), s.first + int(inside[-1])
        within = self.xy[first : last + 1][self.kept[first : last + 1]]
        if self._leads_round(first, s.first, s.sense, within):
            first = s.first
        if self._leads_round(last, s.last, s.sense, within):
            last = s.last
        if first == s.first:
            while first - 1 > before and off[first - 1] <= tight:
                first -= 1
            first = self._turning_point(first, s.nodes[1], s.sense) if first > 0 else first
        if last == s.last:
            while last + 1 < after and off[last + 1] <= tight:
                last += 1
            last = self._turning_point(last, s.nodes[-2], s.sense) if last + 1 < len(off) else last
        if first > 0:
            first = self._tangential(first, last, s.sense, off, tight)
        if last < len(off) - 1:
            last = self._tangential(last, first, s.sense, off, tight)
        # Where a way to or from the circle adjoins it, its last part within the band passes aspects that the
        # circle itself passes at its other end: a tangent stays inside for this angle.
        most = math.acos(1.0 / (1.0 + band / circle.radius_m))
        if first > 0:
            first = self._without_repeat(first, last, s.sense, most)
        if last < len(off) - 1:
            last = self._without_repeat(last, first, s.sense, most)
        return first, last

    def _leads_round(self, edge: int, end: int, sense: int, within: FloatArray) -> bool:
        """Say whether the poses from the band's edge to a stretch's end go round, too: a circle that is none.

        An ellipse, a spiral, a vehicle that settles on its circle. A straight way past the circle does not
        turn, a way straight at it has little arc, a lost pose is far away at once. What is far away after a
        pause of the record goes on if one circle passes it and the positions within the band.
        """
        if edge == end:
            return True
        index = np.arange(min(edge, end), max(edge, end) + 1)
        index = index[self.kept[index]]
        steps = np.diff(self.xy[index], axis=0)
        lengths = np.hypot(steps[:, 0], steps[:, 1])
        gap = self.track.max_gap_rad * float(self.range[edge])
        if not lengths.size:
            return False
        if lengths.max() > max(_JUMP_STEPS * self.usual_m, gap):
            # On the far side of the pause.
            cut = int(lengths.argmax()) + 1
            ahead = end > edge
            index, lengths = (index[cut:], lengths[cut:]) if ahead else (index[:cut], lengths[: cut - 1])
            if not _one_circuit(within, self.xy[index]):
                return False
        aspect = np.unwrap(np.arctan2(self.xy[index, 1], self.xy[index, 0])) * sense
        arc = float(aspect[-1] - aspect[0])
        if arc * float(self.range[index].mean()) < _LEAST_TANGENTIAL * float(lengths.sum()):
            return False
        if arc < _LEAST_ARC_RAD:
            return True
        middle = len(index) // 2
        c1, c2 = self.xy[index[middle]] - self.xy[index[0]], self.xy[index[-1]] - self.xy[index[middle]]
        return 2.0 * sense * math.atan2(c1[0] * c2[1] - c1[1] * c2[0], float(c1 @ c2)) >= _LEAST_TURN * arc

    def _tangential(self, end: int, other: int, sense: int, off: FloatArray, tight: float) -> int:
        """Move an end of a stretch inwards while the way from there is straight to or from the circle."""
        step = 1 if other > end else -1
        least = _SAME_PLACE * float(self.range[end])
        while abs(other - end) > 2 and off[end] > tight:
            far = end
            while far != other and np.hypot(*(self.xy[far] - self.xy[end])) < least:
                far += step
            gone = float(np.hypot(*(self.xy[far] - self.xy[end])))
            a, b = self.xy[end], self.xy[far]
            turned = sense * step * math.atan2(a[0] * b[1] - a[1] * b[0], float(a @ b))
            if turned * float(self.range[end]) >= _ADJOINING_TANGENTIAL * gone:
                break
            end += step
        return end

    def _turning_point(self, wide: int, end: int, sense: int) -> int:
        """Return the pose furthest back on the circle's course, from its widened end to the first step in it.

        What came to the circle from the other side passes aspects that the circle passes again.
        """
        step = 1 if wide < end else -1
        index = np.arange(wide, end + step, step)
        if len(index) < 2:
            return wide
        aspect = np.unwrap(np.arctan2(self.xy[index, 1], self.xy[index, 0])) * sense * step
        return int(index[len(index) - 1 - int(aspect[::-1].argmin())])

    def _without_repeat(self, end: int, other: int, sense: int, most_rad: float) -> int:
        """Move an end of a stretch inwards while a pose in about the same place passes its aspect again."""
        step = 1 if other > end else -1
        index = np.arange(end, other + step, step)
        index = index[self.kept[index]]
        if len(index) < 3:
            return end
        # Seen from this end, the stretch goes on in rising aspect.
        aspect = np.unwrap(np.arctan2(self.xy[index, 1], self.xy[index, 0])) * sense * step
        reach = np.maximum.accumulate(aspect)
        beyond = reach[-1] - TWO_PI
        move = np.flatnonzero(aspect <= min(beyond, aspect[0] + most_rad))
        if not move.size:
            return end
        limit = int(move[-1])
        again = aspect[: limit + 1] + TWO_PI
        there_r = np.interp(again, reach, self.range[index])
        there_z = np.interp(again, reach, self.z[index])
        here = index[: limit + 1]
        same = np.abs(there_r / self.range[here] - 1.0) <= _BAND_SHARE + _SAME_PLACE
        same &= np.abs(there_z / self.z[here] - 1.0) <= _SAME_PLACE
        if not same.all():
            return end
        # The circle closes by itself from its other end, where that is near enough.
        closes = aspect[limit + 1] - beyond <= self.track.max_gap_rad
        return int(index[limit + 1 if closes else limit])

    def _leave_out(self, sections: Sequence[tuple[int, int, int]], circle: _Circle) -> None:
        on = np.zeros(len(self.track), bool)
        for first, last, _ in sections:
            on[first : last + 1] = True
        out = self.kept & ~on
        if not out.any():
            return
        off = np.abs(circle.off(self.xy[out]))
        index = np.flatnonzero(out)
        before = int((index < sections[0][0]).sum())
        after = int((index > sections[-1][1]).sum())
        parts = [(before, "before it"), (len(index) - before - after, "between"), (after, "after it")]
        where = ", ".join(f"{count} {what}" for count, what in parts if count)
        x, y = (round(c, 1) + 0.0 for c in (circle.x_m, circle.y_m))  # no -0.0
        self.notes.append(
            f"{len(index)} of {len(self.track)} track poses are not on the circle (centre ({x:.1f}, {y:.1f})"
            f" m, radius {circle.radius_m:.1f} m; they are up to {off.max():.1f} m off it): {where}; they are"
            " left out"
        )
        self.kept &= on
        self.elsewhere |= out

    def _thin_out(self, nodes: IntArray, sections: Sequence[tuple[int, int, int]]) -> None:
        """Leave out poses of a sonar that stands still: they pull mean height and circle to one place."""
        stamps = self.track.stamps_ns
        count = 0
        longest = 0.0
        for first, last, sense in sections:
            marks = nodes[(nodes > first) & (nodes < last)]
            marks = np.concatenate([[first], marks, [last]])
            times = np.diff(stamps[marks]) * 1e-9
            usual = float(np.median(times))
            if len(times) < 5:
                continue
            index = np.arange(first, last + 1)[self.kept[first : last + 1]]
            aspect = np.unwrap(np.arctan2(self.xy[index, 1], self.xy[index, 0])) * sense
            step = float(np.median(np.diff(aspect)))
            step = max(step, float(aspect[-1] - aspect[0]) / max(len(aspect) - 1, 1))
            for a, b, time in zip(marks[:-1].tolist(), marks[1:].tolist(), times.tolist(), strict=True):
                # A step without poses is a pause of the record, not of the sonar.
                if time <= _STILL * usual or b - a < _STILL:
                    continue
                low, high = np.searchsorted(index, [a, b])
                # The last pose of a stand stays: the circle goes on from there.
                reached = float(aspect[high])
                here = count
                for k in range(high - 1, low - 1, -1):
                    if reached - aspect[k] >= step / 2.0:
                        reached = float(aspect[k])
                    else:
                        self.kept[index[k]] = False
                        count += 1
                if count > here:
                    longest = max(longest, time)
        if count:
            self.notes.append(
                f"the sonar stands still for up to {longest:.1f} s: {count} of {len(self.track)} track poses"
                " that add no arc are left out"
            )

    def _choose_laps(self, sections: Sequence[tuple[int, int, int]]) -> None:
        """Of aspects that are passed from different places, keep the passage that a stamp names."""
        table = _Passages(self, sections)
        differ = table.differ()
        # Spread where a circle closes on itself is no lap: less than a gap.
        differ &= table.mask([a for a in table.arcs(differ) if a.width_rad >= self.track.max_gap_rad])
        if not differ.any():
            return
        winner, told = table.winners(self.image_ns, self.sectors)
        doubt = differ & ~told
        if told.any():
            keep = table.poses_of(winner, told)
            dropped = self.kept & ~keep
            if dropped.any():
                self._tell_laps(table, differ & told, dropped)
                self.kept &= keep
                self.elsewhere |= dropped
        self.doubtful = table.arcs(doubt)
        if self.doubtful:
            named = ", ".join(str(arc) for arc in self.doubtful[:4])
            named += f" and {len(self.doubtful) - 4} more" if len(self.doubtful) > 4 else ""
            self.notes.append(
                f"the track passes {named} {max(a.times for a in self.doubtful)} times, up to"
                f" {max(a.apart_m for a in self.doubtful):.1f} m apart, and no stamp tells which"
                " passage counts: no views are made there"
            )

    def _tell_laps(self, table: _Passages, chosen: BoolArray, dropped: BoolArray) -> None:
        arcs = table.arcs(chosen)
        if not arcs:
            return
        by = "the image's stamp names" if self.image_ns is not None else "the stamps of sectors or views name"
        used = self.kept & ~dropped
        times = self.track.stamps_ns[used] if used.any() else self.track.stamps_ns
        named = ", ".join(str(arc) for arc in arcs[:4])
        named += f" and {len(arcs) - 4} more" if len(arcs) > 4 else ""
        self.notes.append(
            f"the track passes {named} {max(a.times for a in arcs)} times, up to"
            f" {max(a.apart_m for a in arcs):.1f} m apart: the passage that {by} counts ({int(used.sum())} of"
            f" {len(self.track)} poses, {times[0]} to {times[-1]} ns)"
        )

    def _tell_height(self, track: Track) -> None:
        z = track.positions_m[:, 2]
        if track.coverage_rad < math.pi or float(z.std()) == 0.0:
            return
        few = max(1, len(z) // 50)
        low, high = float(np.median(z[:few])), float(np.median(z[-few:]))
        # Of a height that goes up and down, a line explains little.
        steady = float(np.corrcoef(np.arange(len(z)), z)[0, 1]) ** 2 >= 0.5
        if steady and abs(high - low) > _SAME_PLACE * float(z.mean()):
            how = "climbs" if high > low else "sinks"
            self.notes.append(
                f"the track {how} from {low:.1f} to {high:.1f} m height over the circle: each view has the"
                " height of its aspect, the image's band on the ground that of their mean"
            )


class _Passages:
    """All passages of every aspect of the raster: when, and from where."""

    def __init__(self, owner: _Selection, sections: Sequence[tuple[int, int, int]]) -> None:
        self.owner = owner
        track = owner.track
        self.sections: list[
            tuple[IntArray, IntArray, int]
        ] = []  # poses, their raster numbers, number of section
        section, raster, times, ranges, heights = [], [], [], [], []
        for number, (first, last, sense) in enumerate(sections):
            index = np.arange(first, last + 1)[owner.kept[first : last + 1]]
            if len(index) < 2:
                continue
            aspect = np.unwrap(np.arctan2(owner.xy[index, 1], owner.xy[index, 0])) * sense
            # How far the sonar has got: what goes back and forth by its spread is one passage.
            reach = np.maximum.accumulate(aspect)
            self.sections.append((index, sense * np.round(aspect / _BIN_RAD).astype(np.int64), number))
            marks = np.arange(
                math.ceil(reach[0] / _BIN_RAD - 1e-9), math.floor(reach[-1] / _BIN_RAD + 1e-9) + 1
            )
            at = marks * _BIN_RAD
            after = np.clip(np.searchsorted(reach, at - 1e-12), 1, len(reach) - 1)
            passed = reach[after] - reach[after - 1] <= track.max_gap_rad
            marks, at = marks[passed], at[passed]
            section.append(np.full(len(marks), number))
            raster.append(sense * marks)
            start = int(track.stamps_ns[0])
            times.append(np.interp(at, reach, (track.stamps_ns[index] - start).astype(np.float64)))
            ranges.append(np.interp(at, reach, owner.range[index]))
            heights.append(np.interp(at, reach, owner.z[index]))
        if not section:
            raise TrackError("no stretch of the track has two poses; expected an arc")
        self.section = np.concatenate(section).astype(np.int64)
        self.raster = np.concatenate(raster).astype(np.int64)
        #: Nanoseconds since the track's first pose.
        self.times = np.concatenate(times)
        self.ranges, self.heights = np.concatenate(ranges), np.concatenate(heights)
        self.bins = np.mod(self.raster, _BINS)
        self.counts = np.bincount(self.bins, minlength=_BINS)

    def _spread(self, values: FloatArray) -> FloatArray:
        """Return largest less smallest value of each aspect; 0 where there is none."""
        low, high = np.full(_BINS, np.inf), np.full(_BINS, -np.inf)
        np.minimum.at(low, self.bins, values)
        np.maximum.at(high, self.bins, values)
        return np.where(self.counts > 0, high - low, 0.0)

    def differ(self) -> BoolArray:
        """Say which aspects are passed from different places, shape (bins,)."""
        # Two positions of one aspect differ in range and height alone, both as shares.
        apart = np.hypot(self._spread(np.log(self.ranges)), self._spread(np.log(self.heights)))
        return np.asarray((self.counts > 1) & (apart > _SAME_PLACE))

    def winners(
        self, image_ns: int | None, sectors: Sequence[tuple[int, float, float]]
    ) -> tuple[IntArray, BoolArray]:
        """Return which passage of each aspect counts, and whether a stamp tells so."""
        start = int(self.owner.track.stamps_ns[0])
        best: NDArray[np.float64] = np.full(len(self.times), np.inf)
        told: BoolArray = np.zeros(_BINS, bool)
        if image_ns is not None:
            late = self.times - (image_ns - start)
            # Passages until the stamp by how long ago they are; all later ones come after those.
            end = float(np.abs(late).max()) + 1.0
            best = np.where(late <= 0.5, -late, end + late)
            told = self.counts > 0
        else:
            centres = np.arange(_BINS) * _BIN_RAD
            for stamp, first, width in sectors:
                covers = np.mod(centres - first + 1e-9, TWO_PI) < width
                told |= covers & (self.counts > 0)
                mine = covers[self.bins]
                best[mine] = np.minimum(best[mine], np.abs(self.times[mine] - (stamp - start)))
        order = np.lexsort((self.times, best, self.bins))
        winner = np.full(_BINS, -1, np.int64)
        firsts = np.flatnonzero(np.diff(self.bins[order], prepend=-1))
        winner[self.bins[order][firsts]] = order[firsts]
        return winner, told

    def poses_of(self, winner: IntArray, told: BoolArray) -> BoolArray:
        """Return which poses belong to the passages that count, or to aspects of which no stamp tells."""
        keep = np.zeros(len(self.owner.track), bool)
        for index, raster, number in self.sections:
            bins = np.mod(raster, _BINS)
            best = winner[bins]
            mine = (best < 0) | ~told[bins]
            mine |= (self.section[best] == number) & (self.raster[best] == raster)
            # The pose after a part that counts closes its last step, unless the circle closes there.
            ends = np.flatnonzero(mine[:-1] & ~mine[1:])
            if np.any(~mine[:-1] & mine[1:]) and mine.any():
                mine[(ends if mine[-1] else ends[:-1]) + 1] = True
            keep[index[mine]] = True
        return keep

    @staticmethod
    def mask(arcs: Sequence[DoubtfulArc]) -> BoolArray:
        """Return which aspects of the raster lie in arcs."""
        return np.array([any(arc.contains(b * _BIN_RAD) for arc in arcs) for b in range(_BINS)], dtype=bool)

    def arcs(self, which: BoolArray) -> list[DoubtfulArc]:
        """Return aspects of the raster as arcs; what is less than a gap apart is one arc."""
        if not which.any():
            return []
        apart = np.hypot(self._spread(self.ranges), self._spread(self.heights))
        marked = np.flatnonzero(which)
        join = max(1, round(self.owner.track.max_gap_rad / _BIN_RAD))
        last = np.flatnonzero(np.diff(marked, append=marked[0] + _BINS) > join)
        if last.size:  # begin after a gap, so that no arc is cut at 0
            marked = np.roll(marked, -(int(last[-1]) + 1))
        groups = np.split(marked, np.flatnonzero(np.mod(np.diff(marked), _BINS) > join) + 1)
        arcs = []
        for group in groups:
            width = (int(group[-1] - group[0]) % _BINS + 1) * _BIN_RAD
            whole = width > TWO_PI - self.owner.track.max_gap_rad
            arcs.append(
                DoubtfulArc(
                    0.0 if whole else float((group[0] - 0.5) * _BIN_RAD % TWO_PI),
                    TWO_PI if whole else width,
                    int(self.counts[group].max()),
                    float(apart[group].max()),
                )
            )
        return arcs


def _fit(xy: FloatArray) -> _Circle:
    """Fit a circle round the origin to positions (n, 2) a step apart: least median of residuals.

    Up to half of the positions may be off it. The spread is 1.48 times that median, of a normal spread its
    standard deviation.
    """
    few = xy[np.unique(np.linspace(0, len(xy) - 1, 24).round().astype(int))]
    some = xy[np.unique(np.linspace(0, len(xy) - 1, 120).round().astype(int))]
    ranges = np.hypot(some[:, 0], some[:, 1])
    middle = float(np.median(ranges))
    best = (float(np.median(np.abs(ranges - middle))), 0.0, 0.0, middle)
    triples = np.array(list(itertools.combinations(range(len(few)), 3)), dtype=np.int64).reshape(-1, 3)
    if len(triples):
        a, b, c = few[triples[:, 0]], few[triples[:, 1]], few[triples[:, 2]]
        u, v = b - a, c - a
        cross = 2.0 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
        ok = np.abs(cross) > 1e-9 * middle**2
        a, u, v, cross = a[ok], u[ok], v[ok], cross[ok]
        uu, vv = (u * u).sum(1), (v * v).sum(1)
        x = a[:, 0] + (v[:, 1] * uu - u[:, 1] * vv) / cross
        y = a[:, 1] + (u[:, 0] * vv - v[:, 0] * uu) / cross
        radius = np.hypot(x - a[:, 0], y - a[:, 1])
        # The circle goes round the origin (docs/conventions.md).
        ok = np.hypot(x, y) < 0.9 * radius
        x, y, radius = x[ok], y[ok], radius[ok]
        if len(x):
            off = np.abs(np.hypot(some[:, 0] - x[:, None], some[:, 1] - y[:, None]) - radius[:, None])
            medians = np.median(off, axis=1)
            i = int(medians.argmin())
            best = min(best, (float(medians[i]), float(x[i]), float(y[i]), float(radius[i])))
    median, x0, y0, radius0 = best
    off = np.abs(np.hypot(some[:, 0] - x0, some[:, 1] - y0) - radius0)
    near = some[off <= 2.5 * 1.4826 * median + 1e-9 * radius0]
    if len(near) >= 8 and (fitted := _least_squares(near)) is not None:
        refined = float(np.median(np.abs(fitted.off(some))))
        if refined <= 1.5 * median:
            median, x0, y0, radius0 = refined, fitted.x_m, fitted.y_m, fitted.radius_m
    return _Circle(x0, y0, radius0, 1.4826 * median)


def _least_squares(xy: FloatArray) -> _Circle | None:
    """Fit a circle to positions (n, 2) by least squares; None if it does not go round the origin."""
    design = np.column_stack([2.0 * xy, np.ones(len(xy))])
    (p, q, w), *_ = np.linalg.lstsq(design, (xy * xy).sum(1), rcond=None)
    radius = math.sqrt(max(w + p * p + q * q, 0.0))
    return _Circle(float(p), float(q), radius, 0.0) if math.hypot(p, q) < 0.9 * radius else None


def _one_circuit(a: FloatArray, b: FloatArray) -> bool:
    """Say whether one circle passes two arcs of positions, to `_ONE_CIRCUIT_SHARE` of its radius."""
    if min(len(a), len(b)) < 3:
        return False
    both = np.concatenate([a, b])
    circle = _least_squares(both)
    return circle is not None and bool(
        np.abs(circle.off(both)).max() <= _ONE_CIRCUIT_SHARE * circle.radius_m
    )
