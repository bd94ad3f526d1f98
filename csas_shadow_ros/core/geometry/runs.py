"""Which run a piece of a track, an image or a view belongs to: runs are named by their track's first pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import GeometryError, TrackError, check_range
from ..frame_name import SCENE_FRAME, check_frame
from .frames import FloatArray, one_frame, wrap_angle
from .pixels import positions_of, stamps_of
from .track import Track

IntArray = NDArray[np.int64]

#: Two records of one time are of the same run if the sonar is, at the median, within this share of its range
#: in the same place: 0.6 m at 30 m, what smoothed navigation differs from raw. At half of it a corrected
#: track begins a new run; at double another circle at 4 % more range is taken for the same.
_SAME_PLACE = 0.02
#: A piece goes on from another within so many of their usual steps, in time and in place. At half of it five
#: poses lost at the seam begin a new run; at double a vehicle that pauses for 20 poses goes on in the old.
_SEAM_STEPS = 10.0


@dataclass(frozen=True, eq=False)
class TrackPiece:
    """Poses of one message: a whole track, a longer version of it, or a part.

    Parameters
    ----------
    stamps_ns : array_like of int, shape (n,)
        Strictly rising, n > 0.
    positions_m : array_like, shape (n, 3)
        Positions in the scene frame, metres.
    header_ns : int, optional
        Stamp of the message itself.
    notes : tuple of str
        Poses that were left out as not usable, one line each.
    frame : str
        Name of the scene frame that it is in: one for all of a run.

    Raises
    ------
    TrackError
        If there is no pose, shapes differ or stamps do not rise.
    """

    stamps_ns: IntArray
    positions_m: FloatArray
    header_ns: int | None = None
    notes: tuple[str, ...] = ()
    frame: str = field(default=SCENE_FRAME, kw_only=True)

    def __post_init__(self) -> None:
        check_frame("frame of the piece of a track", self.frame)
        stamps = stamps_of("piece of a track", self.stamps_ns)
        positions = positions_of("piece of a track", self.positions_m)
        if stamps.ndim != 1 or not len(stamps) or positions.shape != (len(stamps), 3):
            raise TrackError(
                f"piece of a track has stamps {stamps.shape} and positions {positions.shape}; expected (n,),"
                " (n, 3) with n > 0"
            )
        if np.any(np.diff(stamps) <= 0):
            i = int(np.argmax(np.diff(stamps) <= 0)) + 1
            raise TrackError(
                f"piece of a track: pose {i} ({stamps[i]} ns) is not after pose {i - 1} ({stamps[i - 1]} ns)"
            )
        object.__setattr__(self, "stamps_ns", stamps)
        object.__setattr__(self, "positions_m", positions)

    @property
    def first_ns(self) -> int:
        """Stamp of the first pose."""
        return int(self.stamps_ns[0])

    @property
    def last_ns(self) -> int:
        """Stamp of the last pose."""
        return int(self.stamps_ns[-1])


@dataclass(eq=False)
class _Run:
    stamps: IntArray
    positions: FloatArray
    #: Stamps that this run goes by: of its first pose, and of what were first poses before others came.
    names: set[int]
    frame: str
    notes: list[str] = field(default_factory=list)
    _track: Track | None = None
    _margin_ns: int | None = None

    @property
    def first(self) -> int:
        return int(self.stamps[0])

    @property
    def last(self) -> int:
        return int(self.stamps[-1])

    def take(self, stamps: IntArray, positions: FloatArray, most: int) -> None:
        """Take poses; those of the time that they span are replaced, as newer messages know better."""
        before, after = self.stamps < stamps[0], self.stamps > stamps[-1]
        self.stamps = np.concatenate([self.stamps[before], stamps, self.stamps[after]])
        self.positions = np.concatenate([self.positions[before], positions, self.positions[after]])
        self.limit(most)

    def limit(self, most: int) -> None:
        """Keep every other pose where there are too many, the first and last one among them."""
        while len(self.stamps) > most:
            kept = np.arange(len(self.stamps)) % 2 == 0
            kept[-1] = True
            self.stamps, self.positions = self.stamps[kept], self.positions[kept]
        self._track = self._margin_ns = None

    def margin(self, max_gap_rad: float) -> int:
        """Return the time (ns) in which the sonar passes `max_gap_rad`; 0 if it passes nothing."""
        if self._margin_ns is None:
            turned = np.abs(wrap_angle(np.diff(np.arctan2(self.positions[:, 1], self.positions[:, 0]))))
            took = np.diff(self.stamps).astype(np.float64)
            # The rate at which half of the arc is passed: time spent far away or standing does not count.
            order = np.argsort(turned / took) if len(took) else np.empty(0, np.int64)
            arc = np.cumsum(turned[order])
            if not arc.size or arc[-1] <= 0.0:
                return 0
            middle = order[int(np.searchsorted(arc, arc[-1] / 2.0))]
            # No more than the track itself takes, whatever the rate.
            self._margin_ns = int(min(max_gap_rad * took[middle] / turned[middle], self.last - self.first))
        return self._margin_ns

    def apart(self, stamps: IntArray, positions: FloatArray) -> float | None:
        """Return how far poses are from this run at their time, as a share of range; None if never."""
        common = (stamps >= self.first) & (stamps <= self.last)
        if not common.any():
            return None
        when = (stamps[common] - self.first).astype(np.float64)
        own = (self.stamps - self.first).astype(np.float64)
        there = np.column_stack([np.interp(when, own, self.positions[:, i]) for i in range(3)])
        off = np.linalg.norm(positions[common] - there, axis=1)
        reach = np.linalg.norm(there, axis=1)
        return float(np.median(off / np.maximum(reach, 1e-9)))


class TrackBook:
    """The runs with known poses, from pieces of tracks in any order.

    Parameters
    ----------
    max_gap_rad : float
        See `Track`; the margin of `run_of` is the time in which the sonar passes it.
    max_poses : int
        Of a run with more poses every other one is forgotten.
    max_runs : int
        Of more runs the one that has been given nothing for longest is forgotten.

    Notes
    -----
    A piece belongs to a run if its first pose's stamp or its header's stamp is the run's name; if it was
    recorded in the run's time and agrees with it in place there (sliding windows); or if it goes on from the
    run's last pose, or ends before its first one, in time and place. Every other piece begins a run, also in
    the time of another. Pieces that come between two runs make one of them.

    Examples
    --------
    >>> angle = np.radians(np.arange(0, 360, 0.5))
    >>> circle = np.c_[30 * np.cos(angle), 30 * np.sin(angle), np.full(720, 12.0)]
    >>> stamps = np.arange(720) * 10**8
    >>> book = TrackBook()
    >>> book.add(TrackPiece(stamps[360:], circle[360:]))
    36000000000
    >>> book.add(TrackPiece(stamps[:361], circle[:361]))
    0
    >>> book.renamed, len(book.track(0)), book.run_of(72 * 10**9)
    ({36000000000: 0}, 720, 0)
    """

    def __init__(
        self, *, max_gap_rad: float = math.radians(3.0), max_poses: int = 1_000_000, max_runs: int = 8
    ) -> None:
        self.max_gap_rad = max_gap_rad
        self._max_poses = int(check_range("max_poses", max_poses, 3, 1e9))
        self._max_runs = int(check_range("max_runs", max_runs, 1, 1e9))
        #: Least recently changed first.
        self._runs: list[_Run] = []
        #: What runs were called before an earlier pose of theirs came, and are called now.
        self.renamed: dict[int, int] = {}

    @classmethod
    def of(cls, track: Track) -> TrackBook:
        """Make the book of a lone track."""
        book = cls(max_poses=max(len(track), 3))
        book.add(TrackPiece(track.stamps_ns, track.positions_m, frame=track.frame))
        return book

    @property
    def names(self) -> tuple[int, ...]:
        """Names of the known runs (stamps of their first poses, ns), in time."""
        return tuple(sorted(run.first for run in self._runs))

    def __len__(self) -> int:
        return len(self._runs)

    def add(self, piece: TrackPiece) -> int:
        """Add a piece and return the name of its run.

        A run that is called otherwise now, as an earlier pose came or two runs became one, is in `renamed`.

        Raises
        ------
        TrackError
            If the piece goes by the name of a run in another frame.
        """
        run = self._find(piece)
        if run is None:
            run = _Run(piece.stamps_ns, piece.positions_m, {piece.first_ns}, piece.frame)
            run.limit(self._max_poses)
        else:
            what = f"piece of a track from {piece.first_ns} to {piece.last_ns} ns"
            try:
                one_frame(what, piece.frame, run.frame, f"its run, {run.first} ns")
            except GeometryError as error:
                raise TrackError(str(error)) from error
            self._runs.remove(run)
            run.take(piece.stamps_ns, piece.positions_m, self._max_poses)
        run.notes += [note for note in piece.notes if note not in run.notes]
        self._join(run)
        while any(other.first == run.first for other in self._runs):
            # Another circle with the very same first stamp cannot have the same name: the newer one has it.
            self._runs.remove(next(other for other in self._runs if other.first == run.first))
        self._runs.append(run)
        for name in run.names - {run.first}:
            self.renamed[name] = run.first
        self.renamed.pop(run.first, None)
        run.names.add(run.first)
        for forgotten in self._runs[: -self._max_runs]:
            self.renamed = {old: new for old, new in self.renamed.items() if new != forgotten.first}
        del self._runs[: -self._max_runs]
        return run.first

    def run_of(self, stamp_ns: int) -> int | None:
        """Return the name of the run with a track over this stamp; None if there is none.

        A run covers as much time before its first and after its last pose as the sonar takes for
        `max_gap_rad`: views between the last pose of a closed circle and its first are stamped there. Of
        several runs it is the one that covers the stamp without that, then the one that changed last.
        """
        runs = self.runs_of(stamp_ns)
        return runs[0] if runs else None

    def runs_of(self, stamp_ns: int) -> tuple[int, ...]:
        """Return the names of all runs with tracks over this stamp, `run_of` first."""
        found = []
        for age, run in enumerate(reversed(self._runs)):
            beyond = max(run.first - stamp_ns, stamp_ns - run.last, 0)
            if beyond <= run.margin(self.max_gap_rad):
                found.append((beyond, age, run.first))
        return tuple(name for _, _, name in sorted(found))

    def span(self, run_ns: int) -> tuple[int, int]:
        """Return the stamps of a run's first and last pose."""
        run = self._run(run_ns)
        return run.first, run.last

    def not_covered(self, stamp_ns: int | None = None, what: str = "its stamp") -> str:
        """State that no track covers a stamp, what the tracks cover, and how far off it is."""
        spans = [self.span(name) for name in self.names]
        named = ", ".join(f"{first} to {last} ns" for first, last in spans[:4])
        named += f" and {len(spans) - 4} more" if len(spans) > 4 else ""
        tracks = "the track covers" if len(spans) == 1 else "the tracks cover"
        text = f"no track covers {what}: {tracks} {named}"
        if stamp_ns is None:
            return text
        # By which a clock of other units, or a track that ends early, is known.
        early = [(first - stamp_ns, "before the first pose") for first, _ in spans if stamp_ns < first]
        late = [(stamp_ns - last, "after the last pose") for _, last in spans if stamp_ns > last]
        off, way = min(early + late, default=(0, ""))
        return f"{text}; it lies {off / 1e9:.6g} s {way}" if way else text

    def track(self, run_ns: int) -> Track:
        """Return all poses of a run; the same object until another piece arrives.

        Raises
        ------
        TrackError
            If the run is not known, or its poses make no track.
        """
        run = self._run(run_ns)
        if run._track is None:
            run._track = Track(
                run.stamps.copy(), run.positions, max_gap_rad=self.max_gap_rad, frame=run.frame
            )
        return run._track

    def frame(self, run_ns: int) -> str:
        """Return the name of a run's frame."""
        return self._run(run_ns).frame

    def notes(self, run_ns: int) -> tuple[str, ...]:
        """Return the pieces' notes on poses that were left out."""
        return tuple(self._run(run_ns).notes)

    def _run(self, run_ns: int) -> _Run:
        name = self.renamed.get(run_ns, run_ns)
        for run in self._runs:
            if run.first == name:
                return run
        known = ", ".join(map(str, self.names)) or "none"
        raise TrackError(f"run {run_ns} is not known; known are: {known}")

    def _find(self, piece: TrackPiece) -> _Run | None:
        """Return the run that a piece belongs to."""
        for run in reversed(self._runs):
            if piece.first_ns in run.names or piece.header_ns in run.names:
                return run
        agreeing = []
        # What is near in one frame is anywhere in another.
        alike = [run for run in self._runs if run.frame == piece.frame]
        for run in alike:
            apart = run.apart(piece.stamps_ns, piece.positions_m)
            if apart is None:
                # A window that spans the run has no pose in its time where that is one pose long.
                other = _Run(piece.stamps_ns, piece.positions_m, set(), piece.frame)
                apart = other.apart(run.stamps, run.positions)
            if apart is not None and apart <= _SAME_PLACE:
                agreeing.append((apart, run))
        if agreeing:
            return min(agreeing, key=lambda one: one[0])[1]
        for run in reversed(alike):
            other = _Run(piece.stamps_ns, piece.positions_m, set(), piece.frame)
            if self._goes_on(run, other) or self._goes_on(other, run):
                return run
        return None

    def _goes_on(self, first: _Run, second: _Run) -> bool:
        """Say whether the second poses go on from the last of the first: soon after it, and near it."""
        wait = second.first - first.last
        if wait <= 0:
            return False
        stamps = [np.diff(run.stamps) for run in (first, second) if len(run.stamps) > 1]
        if not stamps:
            return False
        usual = max(float(np.median(s)) for s in stamps)
        steps = [
            float(np.median(np.linalg.norm(np.diff(run.positions, axis=0), axis=1)))
            for run in (first, second)
            if len(run.stamps) > 1
        ]
        at = first.positions[-1]
        far = float(np.linalg.norm(second.positions[0] - at))
        near = max(_SEAM_STEPS * max(steps), self.max_gap_rad * float(np.hypot(at[0], at[1])))
        return wait <= _SEAM_STEPS * usual and far <= near

    def _join(self, run: _Run) -> None:
        """Take in every other run that the run now meets."""
        again = True
        while again:
            again = False
            for other in [one for one in self._runs if one.frame == run.frame]:
                apart = other.apart(run.stamps, run.positions)
                meets = apart is not None and apart <= _SAME_PLACE
                if not (meets or self._goes_on(run, other) or self._goes_on(other, run)):
                    continue
                newer = run.stamps, run.positions
                run.stamps, run.positions = other.stamps, other.positions
                run.take(*newer, self._max_poses)
                run.names |= other.names
                run.notes = [*other.notes, *(n for n in run.notes if n not in other.notes)]
                self._runs.remove(other)
                again = True
