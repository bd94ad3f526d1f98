"""Whole runs: the image (or its sectors), the track and any later stage's views, from and to a bag."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from csas_shadow_ros.core.errors import BagError, CsasError, check_type
from csas_shadow_ros.core.geometry import (
    CoherentImage,
    Datum,
    GroundGrid,
    GroundLattice,
    Origin,
    Track,
    TrackBook,
    View,
)
from csas_shadow_ros.core.sectors.sector import Sector, scene_of, unfit, unlike
from msg_adapters.camera_info import SectorInfo, sector_info_from_msg
from msg_adapters.image import largest_part, quantise
from msg_adapters.messages import SCENE_FRAME, RosbagsMessages, check_data_stamp
from msg_adapters.origin import origin_to_msg
from msg_adapters.pairs import (
    coherent_image_from_msgs,
    coherent_image_to_msgs,
    sector_from_msgs,
    sector_to_msgs,
    view_from_msgs,
)
from msg_adapters.topics import (
    COMPLEX_ENCODINGS,
    NAMESPACE,
    STREAMS,
    TOPICS,
    VIEW_STREAMS,
    absolute_name,
    stream,
)
from msg_adapters.track import track_to_msg

from .bag import BagReader, whole_bag
from .pairs import Problem, checked_messages, iterate_pairs
from .tracks import BagRuns

if TYPE_CHECKING:
    from csas_shadow_ros.core.search.decision import Decision
    from csas_shadow_ros.core.sectors.streaming import SectorSum

T = TypeVar("T")

#: Where a run is that is in no bag.
IN_MEMORY = Path("in memory")
_NO_IMAGE, _UNUSABLE = "there is no full-circle image", "no full-circle image can be used"


@dataclass
class Run:
    """A run as a bag holds it.

    The full-circle image and the track are read at once, views and sectors as they are iterated. A
    message that breaks the contract is left out and is one entry of `problems`.

    Parameters
    ----------
    path : Path
        The bag.
    namespace : str
        Namespace of its topics.
    image : CoherentImage or None
        The full-circle image, if the bag holds one.
    track : Track or None
        The track, if the bag holds one: of all poses of the run the passage that its image or sectors name.
    counts : dict
        Number of image messages of each stream that the bag holds; of this run, if it holds several.
    problems : list of Problem
        What was wrong so far; grows while views are iterated.
    run_ns : int or None
        Name of the run: the stamp of its track's first pose. None without a track.
    run_names : tuple of int
        Names of all runs of the bag, in time.
    datum : Datum or None
        Where on earth the scene's origin is, if the bag says so.
    """

    path: Path
    namespace: str
    image: CoherentImage | None
    track: Track | None
    counts: dict[str, int]
    problems: list[Problem] = field(default_factory=list)
    run_ns: int | None = None
    run_names: tuple[int, ...] = ()
    _runs: BagRuns | None = None
    _reader: BagReader | None = None
    _sum: SectorSum | None = None
    _infos: list[SectorInfo] | None = None
    datum: Datum | None = None

    @classmethod
    def of(cls, image: CoherentImage, track: Track) -> Run:
        """Make a run from an image and a track in memory, without a bag.

        Parameters
        ----------
        image : CoherentImage
            The full-circle image.
        track : Track
            Where the sonar was.

        Raises
        ------
        BagError
            If the image has a stamp that the track does not cover, as `read_run` leaves such an image out.
        InputTypeError
            If either is something else.

        Examples
        --------
        >>> import csas_shadow_ros as csas
        >>> made = csas.simulate("tiny")
        >>> csas.Run.of(made.image, made.track)
        Run in memory: image, track
          CoherentImage: 512 × 512 pixels (complex64) of 0.005 m, ...
          Track: 720 poses over 360.0° of the circle, radius 30.00 m, height 12.00 m, 0 gaps
        """
        check_type("image", image, CoherentImage, "a CoherentImage")
        check_type("track", track, Track, "a Track")
        book = TrackBook.of(track)
        (name,) = book.names
        run = cls(IN_MEMORY, NAMESPACE, image, track, {"image": 1}, run_ns=name, run_names=(name,))
        if image.stamp_ns and not book.runs_of(image.stamp_ns):
            run.report(Problem("image", None, image.stamp_ns, book.not_covered(image.stamp_ns)))
            raise BagError(run.why(_UNUSABLE))
        return run

    def __repr__(self) -> str:
        where = "in memory" if self.path is IN_MEMORY else f"of {self.path}"
        held = ["image" if name == "image" else f"{n} {name}" for name, n in self.counts.items()]
        held += ["track"] if self.track is not None else []
        lines = [f"Run {where}: {', '.join(held) or 'nothing to start from'}"]
        lines += [f"  {part}".replace("\n", "\n  ") for part in (self.image, self.track) if part is not None]
        if self.datum is not None:
            lines.append(f"  {self.datum}")
        if len(self.run_names) > 1:
            lines.append(f"  one of {len(self.run_names)} runs")
        if self.problems:
            more = f" (and {len(self.problems) - 1} more)" if len(self.problems) > 1 else ""
            lines.append(f"  problem: {self.problems[0]}{more}")
        return "\n".join(lines)

    def views(self, stream_name: str) -> Iterator[View]:
        """Iterate the views of a stage: `sub_aperture`, `shadow`, `likelihood` or `shadow_mask`.

        Raises
        ------
        BagError
            If the stream holds no views.
        """
        if stream_name not in VIEW_STREAMS:
            raise BagError(f"{stream_name!r} holds no views; expected one of: {', '.join(VIEW_STREAMS)}")
        return self._each(stream_name, lambda image, info: view_from_msgs(image, info, stream_name))

    def sectors(self) -> Iterator[Sector]:
        """Iterate the sectors."""
        return self._each("sector", sector_from_msgs)

    def sector_infos(self) -> list[SectorInfo]:
        """Return the legible sectors' infos, each stamp once, read once without pixels."""
        if self._infos is None:
            self._infos = []
            if self._reader is not None:
                for _, message, _ in checked_messages(self._reader, "sector/camera_info", lambda _: None):
                    # What is not legible is named where the sectors are read.
                    with contextlib.suppress(CsasError):
                        info = sector_info_from_msg(message)
                        if self._runs is None or self._runs.covers(info.stamp_ns):
                            self._infos.append(info)
        return self._infos

    def sector_sum(self) -> SectorSum:
        """Return the sum of the sectors, computed once.

        Raises
        ------
        BagError
            If there are none that can be summed.
        """
        # Late: it needs the FFT and the compiler, which a player of bags need not load.
        from csas_shadow_ros.core.sectors.streaming import SectorSum

        if self._sum is None:
            topic = absolute_name(stream("sector").image_topic, self.namespace)
            odd, scene = sectors_of_one_run(self.sector_infos())
            total = SectorSum(scene=scene)
            for sector in self.sectors():
                if sector.stamp_ns in odd:
                    self.report(Problem(topic, None, sector.stamp_ns, odd[sector.stamp_ns]))
                    continue
                try:
                    total.add(sector, None if self.track is None else self.track.grazing_rad)
                except CsasError as error:
                    self.problems.append(Problem(topic, None, sector.stamp_ns, str(error)))
            if not total.stamps:
                raise BagError(self.why("no image can be summed from the sectors"))
            self._sum = total
        return self._sum

    def coherent_image(self) -> CoherentImage:
        """Return the full-circle image; summed from the sectors if the bag has those instead.

        Raises
        ------
        BagError
            If it has neither; the message names what is wrong with them.
        """
        if self.image is not None:
            return self.image
        if self.counts.get("sector"):
            return self.sector_sum().image()
        raise BagError(self.why(_UNUSABLE if self.problems else _NO_IMAGE))

    @property
    def frame(self) -> str:
        """Name of the scene's frame: that of the track, the image, or the first sector or view."""
        for part in (self.track, self.image):
            if part is not None:
                return part.frame
        return SCENE_FRAME if self._runs is None else self._runs.frame

    def require_track(self) -> Track:
        """Return the track.

        Raises
        ------
        BagError
            If there is none; the message names what is wrong with it.
        """
        if self.track is None:
            raise BagError(self.why("there is no track"))
        return self.track

    def why(self, lack: str) -> str:
        """Say what is missing, with the first problem as the reason."""
        # Damage of the bag itself explains what else is missing.
        problems = sorted(self.problems, key=lambda problem: problem.topic != "")
        found = f": {problems[0]}" if problems else ""
        rest = len(problems) - 1
        more = f" (and {rest} more problem{'s' if rest > 1 else ''})" if rest > 0 else ""
        return f"{self.path}: {lack}{found}{more}"

    def decision(self) -> Decision | None:
        """Return the decision behind the bag's views, from topic `search` or `target`; None if neither."""
        # Late: it needs the method, which readers of messages need not load.
        from csas_shadow_ros.core.search.decision import Decision
        from csas_shadow_ros.core.shape.volume import Target
        from msg_adapters.search import decision_from_msg
        from msg_adapters.target import target_from_msg

        if self._reader is None:
            return None
        found: Decision | None = None
        for topic in ("target", "search"):
            for message, decoded, stamp in checked_messages(self._reader, topic, self.report):
                try:
                    if topic == "search":
                        found = decision_from_msg(decoded).decision
                        continue
                    box = target_from_msg(decoded)
                    found = Decision(None if box is None else Target(box.centre_m[:2], box.size_m))
                except CsasError as error:
                    self.report(Problem(message.topic, message.number, stamp, str(error)))
        return found

    def _each(self, stream_name: str, read: Callable[[Any, Any], T]) -> Iterator[T]:
        if self._reader is None:
            return
        uncovered: list[int] = []
        for pair in iterate_pairs(self._reader, stream_name, self.report):
            if self._runs is not None and not self._runs.covers(pair.stamp_ns):
                if self._runs.is_of_another(pair.stamp_ns):
                    continue
                # An outside program may stamp views as it likes, where no other run can be meant.
                if stream_name == "sector" or len(self.run_names) > 1:
                    uncovered.append(pair.stamp_ns)
                    continue
            try:
                yield read(pair.image, pair.info)
            except CsasError as error:
                self.report(Problem(pair.topic, pair.number, pair.stamp_ns, str(error)))
        if uncovered and self._runs is not None:
            what = f"the stamps of {len(uncovered)} {stream_name} messages,"
            what += f" {min(uncovered)} to {max(uncovered)} ns"
            topic = absolute_name(stream(stream_name).image_topic, self.namespace)
            self.report(Problem(topic, None, None, f"{self._runs.not_covered(None, what)}; they are skipped"))

    def report(self, problem: Problem) -> None:
        """Record a problem, each only once."""
        if problem not in self.problems:
            self.problems.append(problem)


def odd_sectors(infos: Iterable[SectorInfo]) -> dict[int, str]:
    """Return, by stamp, how a sector differs from most, so that a wrong one spoils no other."""
    return sectors_of_one_run(infos)[0]


def _kinds_of(infos: Iterable[SectorInfo]) -> list[list[SectorInfo]]:
    """Return the sectors that are alike, together."""
    kinds: list[list[SectorInfo]] = []
    for info in infos:
        for kind in kinds:
            if unlike(info, kind[0]) is None:
                kind.append(info)
                break
        else:
            kinds.append([info])
    return kinds


def sectors_of_one_run(infos: Iterable[SectorInfo]) -> tuple[dict[int, str], GroundGrid | None]:
    """Return the faults of odd sectors, by stamp, and the lattice of the rest's sum."""
    kinds = _kinds_of(infos)
    if not kinds:
        return {}, None
    most = max(kinds, key=len)
    reasons: dict[int, str] = {}
    for kind in kinds:
        if differs := unlike(kind[0], most[0]):
            what, values = differs
            reason = f"has another {what} than {len(most)} other sectors: {values}"
            reasons |= {info.stamp_ns: reason for info in kind}
    scenes: list[tuple[GroundGrid, int]] = []
    for info in most:
        for n, (scene, count) in enumerate(scenes):
            if _same_ground(info, scene):
                scenes[n] = scene, count + 1
                break
        else:
            try:
                scenes.append((scene_of(info), 1))
            except CsasError as error:
                reasons[info.stamp_ns] = str(error)
    if not scenes:
        return reasons, None
    scene, count = max(scenes, key=lambda one: one[1])
    for info in most:
        if info.stamp_ns not in reasons and (fault := unfit(info, scene)):
            reasons[info.stamp_ns] = f"is not like {count} other sectors: {fault}"
    return reasons, scene


def _same_ground(info: SectorInfo, scene: GroundGrid) -> bool:
    """Say whether a sector covers the ground of a scene and no more, to a pixel of its own."""
    lattice = GroundLattice.of(info.grid)
    (ax, ay), (bx, by) = lattice.column_step_m, lattice.row_step_m
    pixel = max(math.hypot(ax, ay), math.hypot(bx, by))
    return all(abs(a - b) <= pixel for a, b in zip(lattice.extent_m, scene.extent_m, strict=True))


def read_run(path: str | Path, namespace: str | None = None, run: int | None = None) -> Run:
    """Read a run from a bag.

    Parameters
    ----------
    path : path-like
        A rosbag2 directory or a lone storage file.
    namespace : str, optional
        Namespace of its topics; found by itself if not given.
    run : int, optional
        Which of several runs: its name (stamp of its track's first pose, ns) or its number in time, from 1.
        The first one that has an image or sectors if not given.

    Returns
    -------
    Run
        With `image` or `track` None where the bag has no usable one; `problems` says why.

    Raises
    ------
    BagError
        If there is no bag to read, or it has no such run.
    InputTypeError
        If the path is none, or the run no whole number.

    Examples
    --------
    >>> import csas_shadow_ros as csas
    >>> csas.read_run("box_run")
    Run of box_run: image, track
      CoherentImage: 512 × 512 pixels (complex64) of 0.005 m, x -1.28 to 1.28 m, y -1.28 to 1.28 m
        60 kHz, bandwidth 24 kHz, sound speed 1500 m/s, spectrum sign +1
      Track: 720 poses over 360.0° of the circle, radius 30.00 m, height 12.00 m, 0 gaps
    """
    check_type("path", path, (str, os.PathLike), "the path of a bag")
    check_type("run", run, (int, np.integer, type(None)), "a number or a name (ns) of a run")
    reader = BagReader(path, namespace)
    found = {name: reader.topic(s.image_topic) for name, s in STREAMS.items()}
    counts = {name: info.count for name, info in found.items() if info is not None and info.count}
    problems: list[Problem] = []
    runs = BagRuns(reader, problems.append, run)
    result = Run(Path(path), reader.namespace, None, None, counts, [], runs.name, runs.names, runs, reader)
    if len(runs.names) > 1:
        mine = {name: sum(map(runs.covers, runs.stamps(name))) for name in counts}
        result.counts = {name: min(count, mine[name]) for name, count in counts.items() if mine[name]}
    result.image = _one_image(result, reader, runs)
    for problem in problems:
        result.report(problem)
    image_ns = None if result.image is None else result.image.stamp_ns
    infos = result.sector_infos() if result.image is None and counts.get("sector") else []
    result.track, notes = runs.track(image_ns, infos)
    for note in notes:
        result.report(Problem(runs.topic, None, None, note))
    said = runs.origin(result.report)
    result.datum = None if said is None else said[0].datum
    for line in reader.problems:
        result.report(Problem("", None, None, line))
    return result


def _one_image(run: Run, reader: BagReader, runs: BagRuns) -> CoherentImage | None:
    image: CoherentImage | None = None
    for pair in iterate_pairs(reader, "image", run.report):
        if not runs.covers(pair.stamp_ns):
            if not runs.is_of_another(pair.stamp_ns):
                run.report(Problem(pair.topic, pair.number, pair.stamp_ns, runs.not_covered(pair.stamp_ns)))
            continue
        if image is not None:
            reason = "is a second image; the first is used"
            run.report(Problem(pair.topic, pair.number, pair.stamp_ns, reason))
            continue
        try:
            image = coherent_image_from_msgs(pair.image, pair.info)
        except CsasError as error:
            run.report(Problem(pair.topic, pair.number, pair.stamp_ns, str(error)))
            continue
        if doubt := runs.doubt(pair.stamp_ns):
            run.report(Problem(pair.topic, pair.number, pair.stamp_ns, doubt))
    return image


def _quantised(sectors: list[Sector], encoding: str) -> list[Sector]:
    """Round all sectors by one scale, so that they still sum."""
    peak = max((largest_part(s.pixels) for s in sectors), default=0.0)
    return [replace(s, pixels=quantise(s.pixels, encoding, peak)) for s in sectors]


def write_run(
    path: str | Path,
    image: CoherentImage | None,
    track: Track | None,
    *,
    encoding: str = "32FC2",
    compress: bool = True,
    overwrite: bool = False,
    namespace: str = NAMESPACE,
    sectors: Iterable[Sector] = (),
    sector_times_ns: Mapping[int, int] | None = None,
    extra: Iterable[tuple[str, Any]] = (),
    datum: Datum | None = None,
) -> Path:
    """Write a run as a rosbag2 directory that any ROS 2 tool can open.

    The directory is there once it is whole: if anything fails, what was there before stays as it was.

    Parameters
    ----------
    path : path-like
        Directory to make.
    image : CoherentImage or None
        The full-circle image.
    track : Track or None
        The track.
    encoding : str
        ``32FC2``, ``64FC2``, or ``16SC2`` and ``8SC2``: then the image is scaled so that its largest
        part fills the integers, and rounded; all sectors by one scale, so that they still sum.
    compress : bool
        zstd chunks.
    overwrite : bool
        Replace a bag that is there.
    namespace : str
        Namespace of the topics.
    sectors : iterable of Sector
        Sectors, instead of the image or besides it.
    sector_times_ns : mapping of int to int, optional
        When each sector was made, by its stamp; its stamp otherwise. A player keeps to it.
    extra : iterable of (str, message)
        More stamped messages (rclpy or rosbags), by relative or absolute topic.
    datum : Datum, optional
        Where on earth the scene's origin is, for topic ``origin``.

    Returns
    -------
    Path
        The directory.

    Raises
    ------
    BagError
        If the path is taken or the encoding is unknown.
    AdapterError
        If something to be written breaks the contract.
    InputTypeError
        If the path, the image or the track is something else.

    Examples
    --------
    >>> import csas_shadow_ros as csas
    >>> run = csas.read_run("box_run")
    >>> csas.write_run("smaller_run", run.image, run.track, encoding="8SC2").name
    'smaller_run'
    """
    check_type("path", path, (str, os.PathLike), "the path of a bag")
    check_type("image", image, (CoherentImage, type(None)), "a CoherentImage or None")
    check_type("track", track, (Track, type(None)), "a Track or None")
    if encoding not in COMPLEX_ENCODINGS:
        raise BagError(f"encoding is {encoding!r}; expected one of: {', '.join(COMPLEX_ENCODINGS)}")
    if image is not None:
        check_data_stamp(image.stamp_ns, "image")  # before a bag that is there is replaced
    integers = encoding in ("8SC2", "16SC2")
    factory = RosbagsMessages()
    # Everything of the run was known when its last pose was: nothing waits when the bag is played.
    when = max(image.stamp_ns if image else 0, int(track.stamps_ns[-1]) if track else 0)

    def name(relative: str) -> str:
        return absolute_name(relative, namespace)

    with whole_bag(path, compress=compress, overwrite=overwrite) as writer:
        for latched in ("image", "camera_info", "track"):
            if track if latched == "track" else image:
                writer.add_topic(name(latched), TOPICS[latched].type_name, depth=1)
        if track is not None:
            writer.write(name("track"), track_to_msg(factory, track), when)
        if datum is not None:
            frame = next((part.frame for part in (track, image) if part is not None), SCENE_FRAME)
            # Said before the run: its track may be cut, and is the earlier then.
            first_ns = int(track.stamps_ns[0]) if track is not None else when
            writer.add_topic(name("origin"), TOPICS["origin"].type_name, depth=1)
            writer.write(name("origin"), origin_to_msg(factory, Origin(first_ns, frame, datum)), when)
        sectors = _quantised(list(sectors), encoding) if integers else sectors
        for sector in sectors:
            a, b = sector_to_msgs(factory, sector, encoding)
            made = (sector_times_ns or {}).get(sector.stamp_ns)
            writer.write(name("sector/camera_info"), b, made)
            writer.write(name("sector/image"), a, made)
        if image is not None:
            if integers:
                image = replace(image, pixels=quantise(image.pixels, encoding))
            a, b = coherent_image_to_msgs(factory, image, encoding)
            writer.write(name("camera_info"), b, when)
            writer.write(name("image"), a, when)
        for topic, message in extra:
            writer.write(name(topic), message)
    return Path(path)
