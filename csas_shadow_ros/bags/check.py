"""Check whether a bag can be processed; list its faults and remedies."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from csas_shadow_ros.core.errors import BagError, CsasError, check_type
from csas_shadow_ros.core.geometry import (
    Acoustics,
    CoherentImage,
    GroundGrid,
    Track,
    View,
    place_text,
    wrap_angle,
)
from csas_shadow_ros.core.geometry.pixels import check_finite_pixels
from msg_adapters.camera_info import SectorInfo
from msg_adapters.pairs import (
    coherent_image_from_msgs,
    ground_picture_from_msgs,
    sector_from_msgs,
    view_from_msgs,
    voxel_grid_from_msgs,
)
from msg_adapters.topics import (
    STREAMS,
    TOPICS,
    VIEW_STREAMS,
    VOXEL_STREAMS,
    absolute_name,
    is_topic,
    split_prefix,
)

from .bag import BagReader
from .pairs import Problem, first_of_alike, iterate_pairs
from .run import Run, read_run
from .tracks import BagRuns

ERROR, WARNING, INFO = "error", "warning", "info"
#: What a run is made from, with a track, and the topics of it.
_IMAGES = ("image", "sector")
_INPUTS = frozenset(t for name in _IMAGES for t in (STREAMS[name].image_topic, STREAMS[name].info_topic))

#: Band edges are widened by this much before energy is counted inside them.
BAND_MARGIN = 0.1
#: Less of an image's energy inside its stated band than this contradicts the band.
MIN_BAND_ENERGY = 0.5
#: An image whose energy is off by more band widths, and not inside, was not seen from there, or in that band:
#: heights are wrong by more than a third. At half of it a sound speed that is wrong by 8 % is refused; at
#: double, z that is a depth (28 m for 12) makes a box of 0.4 m 1.03 m high.
REFUSED_BAND_SHIFT = 0.5
#: Less than this is worth a word.
GOOD_BAND_ENERGY = 0.8
#: The middle of an image's energy may lie this far from that of the stated band, in band widths.
MAX_BAND_SHIFT = 0.15
#: A track that covers less than this leaves no room for a view: 0.75 of an aperture of 12 degrees.
MIN_COVERAGE_RAD = math.radians(9.0)
#: More exact zeros than this in an amplitude view are no measurement.
MAX_ZEROS = 0.01
#: A view's sonar may be this fraction of its range away from the track at the view's stamp.
SONAR_TOLERANCE = 0.02
_MAX_FFT_SIDE = 1024
#: A pixel that is so far (dB) over all its neighbours was imaged from no echo: a point's response in a band
#: that the pixels can hold falls by 20 dB from one pixel to all eight round it nowhere.
STUCK_OVER_NEIGHBOURS_DB = 20.0
#: Such a pixel is told of from so far over the image's median on (dB): speckle stays under 22 dB.
STUCK_DB = 40.0
#: From so far on (dB) an image is refused for it. Of a box whose volume is known to 25 % one pixel of 40 dB
#: takes 4 to 14 % off, depending on where it is, of 50 dB 9 to 30 %, of 60 dB 23 to 58 %, of 80 dB all.
REFUSED_STUCK_DB = 45.0
#: Values of an image that its median is taken from.
_MEDIAN_OF = 1 << 20
#: No vehicle circles within less: positions that are all within it are no metres.
_LEAST_CIRCLE_M = 0.5
#: No sonar's circle is so far from its scene: positions beyond it are of another frame.
_MAP_M = 10_000.0
_ONE_CLOCK = (
    "Stamp images and poses by one clock, an image with the time when its last data came, and record the"
    " track until then."
)
#: A stated aspect may be so far off from what the track has, beyond half a sector.
_ASPECT_SLACK_RAD = math.radians(3.0)


@dataclass(frozen=True)
class Finding:
    """One thing worth knowing about a bag.

    Parameters
    ----------
    level : str
        ``error``: the bag does not honour the contract; ``warning``: it can be processed, with a
        loss; ``info``.
    topic : str
        Absolute name; empty if it concerns the bag itself.
    number : int or None
        Which message of that topic, from 0.
    stamp_ns : int or None
        The message's stamp.
    problem : str
        What is wrong.
    remedy : str
        What to do about it.
    """

    level: str
    topic: str
    number: int | None
    stamp_ns: int | None
    problem: str
    remedy: str = ""

    def __str__(self) -> str:
        text = f"{self.level}: {Problem(self.topic, self.number, self.stamp_ns, self.problem)}"
        return f"{text}\n    {self.remedy}" if self.remedy else text


@dataclass
class CheckReport:
    """The findings of `check_bag`.

    Parameters
    ----------
    path : str
        The bag.
    namespace : str
        Namespace of its topics.
    topics : dict
        Number of messages by topic.
    usable : dict
        Number of messages (pairs, for images) by stream that honour the contract.
    findings : list of Finding
        Errors first.
    """

    path: str
    namespace: str = ""
    topics: dict[str, int] = field(default_factory=dict)
    usable: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether there is no error."""
        return not any(f.level == ERROR for f in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dataclasses.asdict(self) | {"ok": self.ok}

    def to_json(self) -> str:
        """Return the report as JSON text."""
        return json.dumps(self.as_dict(), indent=2, allow_nan=False)

    def __str__(self) -> str:
        head = f"{self.path}: {'usable' if self.ok else 'not usable as it is'}"
        counts = [f"  {topic}: {n}" for topic, n in sorted(self.topics.items())]
        return "\n".join([head, *counts, *self._told_once()])

    def _told_once(self) -> list[str]:
        """Return the findings as text; what is said of many messages alike, of the first of them."""
        alike = first_of_alike(self.findings, lambda f: (f.level, f.topic, f.problem))
        return [str(dataclasses.replace(first, problem=first.problem + more)) for first, more in alike]


def check_bag(path: str | Path, namespace: str | None = None, run: int | None = None) -> CheckReport:
    """Read a whole bag and report everything that breaks the contract or contradicts itself.

    Parameters
    ----------
    path : path-like
        A rosbag2 directory or a lone storage file.
    namespace : str, optional
        Namespace of its topics; found by itself if not given.
    run : int, optional
        Which of several runs is judged, as in `read_run`.

    Returns
    -------
    CheckReport
        Never raises for a bad bag: that is what the report is for.

    Raises
    ------
    InputTypeError
        If the path is none.

    Examples
    --------
    >>> import csas_shadow_ros as csas
    >>> report = csas.check_bag("box_run")
    >>> report.ok
    True
    """
    check_type("path", path, (str, os.PathLike), "the path of a bag")
    report = CheckReport(str(path))
    try:
        reader = BagReader(path, namespace)
    except BagError as error:
        report.findings.append(
            Finding(ERROR, "", None, None, str(error), "Name a rosbag2 directory, an .mcap or a .db3 file.")
        )
        return report
    _Check(reader, report, run).run()
    # Damage comes first: what is missing elsewhere follows from it.
    report.findings.sort(
        key=lambda f: ((ERROR, WARNING, INFO).index(f.level), f.problem not in reader.problems)
    )
    return report


class _Check:
    def __init__(self, reader: BagReader, report: CheckReport, run: int | None = None) -> None:
        self.reader = reader
        self.report = report
        self.chosen = run
        self.runs: BagRuns | None = None
        self.track: Track | None = None

    def say(self, level: str, topic: str, problem: str, remedy: str = "", **place: int | None) -> None:
        finding = Finding(level, topic, place.get("number"), place.get("stamp_ns"), problem, remedy)
        if finding not in self.report.findings:
            self.report.findings.append(finding)

    def problem(self, problem: Problem) -> None:
        """Turn what reading refused into a finding with a remedy."""
        relative = problem.topic.removeprefix(f"{self.reader.namespace}/")
        topic = TOPICS.get(relative)
        level = ERROR
        if problem.number is None and problem.stamp_ns is not None:
            remedy = "Let all sectors share one band, hold it, and cover the same ground: they are added up."
        elif problem.number is None:
            remedy = f"Publish {problem.topic} as {topic.type_name}." if topic else ""
        elif "of the same stamp" in problem.reason and "has no" in problem.reason:
            remedy = "Give an image and its camera_info the very same header.stamp, and record both topics."
            # ros2 bag record loses views: nothing needs them where the run can be made from its start.
            if self.start_images() and "track" in self.report.usable and relative not in _INPUTS:
                level = WARNING
        elif "differs from an earlier" in problem.reason:
            remedy = "The stamp identifies a view: give every view a stamp of its own."
        else:
            remedy = f"Let the publisher of {problem.topic} send what docs/conventions.md expects."
        self.say(
            level, problem.topic, problem.reason, remedy, number=problem.number, stamp_ns=problem.stamp_ns
        )

    def start_images(self) -> list[str]:
        """Name the streams that a run can be made from with a track, as far as the bag was read."""
        return [name for name in _IMAGES if self.report.usable.get(name)]

    def name(self, relative: str) -> str:
        return absolute_name(relative, self.reader.namespace)

    def run(self) -> None:
        reader, report = self.reader, self.report
        report.namespace = reader.namespace
        report.topics = {name: info.count for name, info in reader.topics.items()}
        if reader.message_count == 0:
            self.say(
                ERROR, "", "the bag holds no messages", "Record it while the topics are being published."
            )
        self.find_track()
        self.find_origin()
        for stream_name in STREAMS:
            self.check_stream(stream_name)
        self.check_start()
        for line in reader.problems:
            self.say(
                ERROR,
                "",
                line,
                "Copy or record the bag again. Otherwise processing uses the readable part.",
            )
        if not reader.has_checksums and reader.message_count:
            self.say(INFO, "", "parts of the bag carry no checksum: changed bits would go unnoticed")
        below = f"{reader.namespace}/"
        if others := sorted(t for t in reader.topics if not is_topic(t.removeprefix(below))):
            self.say(INFO, "", f"{len(others)} topics are not part of the contract: {', '.join(others[:8])}")

    def find_origin(self) -> None:
        """Say where on earth the run is, or what is wrong with what the bag says of it."""
        if self.runs is None:
            return
        topic = self.name("origin")

        def report(problem: Problem) -> None:
            remedy = "Without it objects have no latitude and longitude: see docs/conventions.md, or give"
            remedy += " origin_lat_deg and origin_lon_deg."
            place = {"number": problem.number, "stamp_ns": problem.stamp_ns}
            self.say(WARNING, topic, problem.reason, remedy, **place)

        said = self.runs.origin(report)
        if said is not None:
            self.say(INFO, topic, str(said[0].datum))

    def find_track(self) -> None:
        topic = self.name("track")

        def report(problem: Problem) -> None:
            if problem.number is None and problem.reason.startswith("the bag holds"):
                self.say(WARNING, topic, problem.reason, "Or record each run into a bag of its own.")
            else:
                self.problem(problem)

        try:
            self.runs = BagRuns(self.reader, report, self.chosen)
        except BagError as error:
            self.say(ERROR, topic, str(error), "Name a run of this bag.")
            return
        images = [s for s in self.runs.stamps("image") if self.runs.covers(s)]
        infos = [] if images else self.run_without_pixels(self.runs).sector_infos()
        self.track, notes = self.runs.track(images[0] if images else None, infos)
        for note in notes:
            remedy = "Views use the remaining poses. Check that this is the circle that was flown."
            self.say(ERROR if self.track is None else WARNING, topic, note, remedy)
        if self.track is None:
            return
        self.report.usable["track"] = len(self.track)
        for level, problem, remedy in judge_coverage(self.track):
            self.say(level, topic, problem, remedy)

    def run_without_pixels(self, runs: BagRuns) -> Run:
        path, namespace = Path(self.reader.path), self.reader.namespace
        return Run(path, namespace, None, None, {}, [], runs.name, runs.names, runs, self.reader)

    def is_mine(self, stream_name: str, topic: str, number: int, stamp_ns: int) -> bool:
        """Say whether a message is of the run that is judged; name one that no track covers."""
        if self.runs is None or self.runs.covers(stamp_ns):
            if self.runs is not None and stream_name == "image" and (doubt := self.runs.doubt(stamp_ns)):
                self.say(WARNING, topic, doubt, _ONE_CLOCK, number=number, stamp_ns=stamp_ns)
            return True
        if self.runs.is_of_another(stamp_ns):
            return False
        if stream_name in _IMAGES:
            # A run goes on without a sector, but not without its image.
            level = ERROR if stream_name == "image" else WARNING
            problem = self.runs.not_covered(stamp_ns)
            self.say(level, topic, problem, _ONE_CLOCK, number=number, stamp_ns=stamp_ns)
            return False
        return len(self.runs.names) < 2 or stream_name not in VIEW_STREAMS

    def check_stream(self, stream_name: str) -> None:
        usable = 0
        for pair in iterate_pairs(self.reader, stream_name, self.problem):
            try:
                item = _read(stream_name, pair.image, pair.info)
            except CsasError as error:
                self.problem(Problem(pair.topic, pair.number, pair.stamp_ns, str(error)))
                continue
            if not self.is_mine(stream_name, pair.topic, pair.number, pair.stamp_ns):
                continue
            usable += 1
            place = {"number": pair.number, "stamp_ns": pair.stamp_ns}
            if stream_name == "image" and usable > 1:
                self.say(
                    WARNING,
                    pair.topic,
                    "is a second image; only the first is processed",
                    "One bag holds one run: record each into a bag of its own.",
                    **place,
                )
            if stream_name == "shadow":
                for level, problem, remedy in judge_amplitude(item):
                    self.say(level, pair.topic, problem, remedy, **place)
            for level, problem, remedy in self.judge(item):
                self.say(level, pair.topic, problem, remedy, **place)
        if usable and stream_name == "sector":
            usable = self.check_sector_sum()
        if usable:
            self.report.usable[stream_name] = usable

    def check_sector_sum(self) -> int:
        """Judge the image that the sectors add up to; return how many of them it holds."""
        run = read_run(self.reader.path, self.reader.namespace, self.chosen)
        try:
            total = run.sector_sum()
        except CsasError:
            return 0  # named one by one
        finally:
            topic = self.name("sector/image")
            for problem in run.problems:
                if problem.topic == topic and "no track covers" not in problem.reason:
                    self.problem(problem)
        if self.track is not None:
            image = total.image()
            for level, text, remedy in (
                *judge_sectors(run, self.track),
                *judge_image(image, self.track),
                *check_spectrum_sign(image, self.track),
            ):
                self.say(level, topic, text, remedy)
        return len(total.stamps)

    def judge(self, item: Any) -> Iterator[tuple[str, str, str]]:
        if self.track is None:
            return
        if isinstance(item, CoherentImage):
            yield from judge_image(item, self.track)
            yield from check_spectrum_sign(item, self.track)
        elif isinstance(item, View):
            yield from judge_view(item, self.track)

    def check_start(self) -> None:
        usable = self.report.usable
        images = self.start_images()
        views = [s for s in VIEW_STREAMS if usable.get(s)]
        if images and "track" in usable:
            self.say(INFO, "", f"processing can start from {images[0]} and track")
        elif views:
            self.say(INFO, "", f"processing can start from {views[0]} ({usable[views[0]]} views)")
        elif images:
            self.say(
                ERROR,
                self.name("track"),
                "there is an image but no usable track",
                f"Record {self.name('track')} (nav_msgs/Path) with the image: it places the shadows.",
            )
        else:
            wanted = ", ".join(self.name(s) for s in ("image", "camera_info", "track"))
            self.say(
                ERROR,
                "",
                "there is nothing to start from: no usable image, sectors or views",
                f"Record {wanted}; or sectors and the track; or a later stage's image and camera_info.",
            )


def _read(stream_name: str, image: Any, info: Any) -> Any:
    if stream_name == "image":
        return coherent_image_from_msgs(image, info)
    if stream_name == "sector":
        return sector_from_msgs(image, info)
    if split_prefix(stream_name)[1] in VOXEL_STREAMS:
        return voxel_grid_from_msgs(image, info, stream_name)
    if stream_name in VIEW_STREAMS:
        return view_from_msgs(image, info, stream_name)
    return ground_picture_from_msgs(image, info, stream_name)


def judge_coverage(track: Track) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) if the track does not go all the way round."""
    gaps = track.gaps
    if not gaps:
        return
    arcs = ", ".join(str(g) for g in gaps[:8])
    arcs += f" and {len(gaps) - 8} more" if len(gaps) > 8 else ""
    problem = f"the track covers {math.degrees(track.coverage_rad):.1f} of 360 degrees; missing: {arcs}"
    if track.coverage_rad < MIN_COVERAGE_RAD:
        why = track.doubtful[0].why(track.doubtful[0].start_rad) if track.doubtful else ""
        why = why or _not_round(track) or _sparse(track)
        yield (
            ERROR,
            f"{problem}: no view can be made{why and f'; {why}'}",
            "Record the track round the origin of csas_scene, in metres, with poses at most"
            f" {math.degrees(track.max_gap_rad):g} degrees apart.",
        )
        return
    yield (
        WARNING,
        problem,
        "These arcs get no views. Record the track round the whole circle if it was flown.",
    )


def _sparse(track: Track) -> str:
    """Say how far apart the poses are, if most are too far from one another to connect; else empty."""
    steps = np.abs(wrap_angle(np.diff(track.aspects_rad)))
    step = float(np.median(steps)) if steps.size else 0.0
    if step <= track.max_gap_rad:
        return ""
    return f"its poses lie {math.degrees(step):.1f}° of aspect apart (median of {steps.size} steps)"


def _not_round(track: Track) -> str:
    """Say where a track is that does not go round the origin; empty if it is not far from it."""
    x, y = track.positions_m[:, 0], track.positions_m[:, 1]
    low, high = track.positions_m.min(axis=0), track.positions_m.max(axis=0)
    away = float(np.hypot(x, y).min())
    size = float(np.hypot(high[0] - low[0], high[1] - low[1]))
    # From where it is, a circle would have to be as large as it is far away to go round the origin.
    if size > away:
        return ""
    text = (
        f"its poses lie at x = {low[0]:.6g} to {high[0]:.6g} and y = {low[1]:.6g} to {high[1]:.6g}, at least"
        f" {away:.6g} m from the scene's origin, and do not go round it"
    )
    if size < _LEAST_CIRCLE_M and np.abs(x).max() <= 180.0 and np.abs(y).max() <= 180.0:
        return f"{text}: these look like degrees of latitude and longitude, not metres"
    if away > _MAP_M:
        return f"{text}: these look like map coordinates (UTM); take the scene's origin off them"
    return text


def judge_image(image: CoherentImage, track: Track) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) for contradictions between image, camera_info and track.

    Raises
    ------
    ParameterError
        If a pixel is not finite, though it was when the image was made.
    """
    check_finite_pixels("image", image.pixels)
    if not image.pixels.any():
        yield ERROR, "the image holds only zeros", "Give the image that the sonar's processor made."
        return
    if track.frame != image.frame:
        yield (
            ERROR,
            f"the track is in frame {track.frame!r}, the image in {image.frame!r}",
            "Every message of a run carries one frame_id: correct that of the track or of the image.",
        )
        return
    yield from judge_geometry(image.grid, track)
    folded = [*judge_band(image.grid, image.acoustics, track)]
    yield from folded
    yield from judge_stuck(image)
    if not folded:  # or its energy lies where it was folded to
        yield from judge_energy(image, track)


def judge_sectors(run: Run, track: Track) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) for arcs that no sector, or more than one, covers."""
    # Late: it needs the FFT and the compiler.
    from csas_shadow_ros.core.sectors.streaming import uncovered

    total = run.sector_sum()
    if arcs := uncovered(total.arcs, track):
        named = ", ".join(str(arc) for arc in arcs[:8])
        named += f" and {len(arcs) - 8} more" if len(arcs) > 8 else ""
        missing = math.degrees(sum(arc.width_rad for arc in arcs))
        yield (
            WARNING,
            f"no sectors came of {named}: {missing:.0f} of 360 degrees are missing",
            "Views in these arcs see little or nothing, and the shape may be wrong: record every sector.",
        )
    infos = [info for info in run.sector_infos() if info.stamp_ns in total.stamps]
    yield from judge_sector_aspects(infos, track)
    for n, info in enumerate(infos):
        near = 0.01 * info.aperture_rad
        for other in infos[:n]:
            turn = abs(math.remainder(info.aspect_rad - other.aspect_rad, math.tau))
            if turn <= near and abs(info.aperture_rad - other.aperture_rad) <= near:
                yield (
                    WARNING,
                    f"sectors at {other.stamp_ns} ns and {info.stamp_ns} ns are of the same arc,"
                    f" {math.degrees(info.aperture_rad):g} degrees round {math.degrees(info.aspect_rad):.1f}:"
                    " it counts twice",
                    "Resend a sector with its original stamp: it then counts once.",
                )


def judge_sector_aspects(infos: Sequence[SectorInfo], track: Track) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) if the track has the sonar elsewhere at a sector's stamp."""
    there = [i for i in infos if track.stamps_ns[0] <= i.stamp_ns <= track.stamps_ns[-1]]
    was = np.interp([i.stamp_ns for i in there], track.stamps_ns, track.aspects_rad)

    def off(stated: float, aspect: float, info: SectorInfo) -> float:
        # A sector may be stamped at its beginning, in its middle or at its end.
        return abs(math.remainder(stated - aspect, math.tau)) - info.aperture_rad / 2.0 - _ASPECT_SLACK_RAD

    wrong = [(i, float(a)) for i, a in zip(there, was, strict=True) if off(i.aspect_rad, a, i) > 0.0]
    if not wrong:
        return
    info, aspect = max(wrong, key=lambda one: off(one[0].aspect_rad, one[1], one[0]))
    remedy = "Give the aspect of the sector's middle in radians, counter-clockwise from +x, and its stamp."
    if all(off(math.radians(i.aspect_rad), a, i) <= 0.0 for i, a in wrong):
        remedy = f"They look like degrees. {remedy}"
    yield (
        WARNING,
        f"{len(wrong)} of {len(infos)} sectors state another aspect than the track has at their stamp, the"
        f" one at {info.stamp_ns} ns {info.aspect_rad:.6g} rad instead of {aspect % math.tau:.6g}: it is not"
        " known which arcs were seen",
        remedy,
    )


def judge_amplitude(view: View) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) if an amplitude view is filled with 0 where it knows nothing."""
    pixels = view.pixels
    corners = pixels[[0, 0, -1, -1], [0, -1, 0, -1]]
    zeros = float(np.mean(pixels == 0))
    if zeros > MAX_ZEROS and (corners == 0).any():
        yield (
            WARNING,
            f"{100 * zeros:.0f} % of the pixels are exactly 0, out to a corner: shadow that nothing casts",
            "Write NaN where the view knows nothing, as off the image.",
        )


def judge_geometry(grid: GroundGrid, track: Track) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) if the track does not go round the image."""
    left, right, bottom, top = grid.extent_m
    x, y = track.positions_m[:, 0], track.positions_m[:, 1]
    over = (left <= x) & (x <= right) & (bottom <= y) & (y <= top)
    if over.any():
        i = int(over.argmax())
        yield (
            ERROR,
            f"track pose {i} at ({x[i]:.2f}, {y[i]:.2f}) m is over the image, which covers x = {left:.2f} to"
            f" {right:.2f} m and y = {bottom:.2f} to {top:.2f} m",
            "Track and image must share one frame, csas_scene, in metres: check both origins and units.",
        )
        return
    centre_x, centre_y, radius, _ = track.circle
    if radius > _MAP_M:
        yield (
            WARNING,
            f"the track's circle has a radius of {radius:.6g} m; expected less than {_MAP_M:g} m of a sonar",
            "Give positions in metres.",
        )
    middle = grid.centre_m
    off = math.hypot(middle[0] - centre_x, middle[1] - centre_y)
    if math.degrees(track.coverage_rad) > 300 and off > radius:
        yield (
            ERROR,
            f"the image's middle is {off:.1f} m from the centre of the track's circle (radius {radius:.1f})",
            "The track must go round the image: check that both are in csas_scene.",
        )


def judge_band(grid: GroundGrid, acoustics: Acoustics, track: Track) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) if the pixels cannot hold the stated band."""
    if too_coarse := acoustics.folds(grid.spacing_m, track.grazing_rad):
        yield (
            ERROR,
            too_coarse,
            "Form the image on finer pixels, or correct the frequencies, the sound speed (camera_info.d) or"
            f" the pixel spacing (p). The track's grazing angle is {math.degrees(track.grazing_rad):.1f}°.",
        )


def judge_stuck(image: CoherentImage) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) if single pixels outshine the image: sidelobes fill the shadows."""
    peak = max(float(np.abs(image.pixels.real).max()), float(np.abs(image.pixels.imag).max()))
    if not peak > 0.0:
        return
    # Relative to the peak: squares of what a driver may send (1e20, 1e-22) are beyond float32.
    power = (image.pixels.real / peak).astype(np.float32) ** 2
    power += (image.pixels.imag / peak).astype(np.float32) ** 2
    sample = power.reshape(-1)[:: max(1, power.size // _MEDIAN_OF)]
    lit = sample[sample > 0]
    if not lit.size:
        return
    median = float(np.median(lit))
    row, col = np.nonzero(power > median * 10.0 ** (STUCK_DB / 10.0))
    if not row.size:
        return
    around = np.zeros(row.size, np.float32)
    for down, right in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        r, c = row + down, col + right
        inside = (r >= 0) & (r < power.shape[0]) & (c >= 0) & (c < power.shape[1])
        around[inside] = np.maximum(around[inside], power[r[inside], c[inside]])
    own = power[row, col]
    stuck = own > around * 10.0 ** (STUCK_OVER_NEIGHBOURS_DB / 10.0)
    if not stuck.any():
        return
    worst = int(np.argmax(np.where(stuck, own, 0.0)))
    over = 10.0 * math.log10(float(own[worst]) / median)
    count = int(stuck.sum())
    more = f" (and {count - 1} more like it)" if count > 1 else ""
    share = float(own[stuck].sum(dtype=np.float64)) / float(power.sum(dtype=np.float64))
    refused = over > REFUSED_STUCK_DB
    used = "" if refused else "; it is used as it is"
    yield (
        ERROR if refused else WARNING,
        f"the pixel in row {row[worst]}, column {col[worst]}{more} is {over:.0f} dB over the median, and"
        f" {STUCK_OVER_NEIGHBOURS_DB:.0f} dB or more over all round it, with {100 * share:.0f} % of all"
        f" energy: it is stuck, and its sidelobes lie over the shadows{used}",
        "Set it to 0, or to its neighbours' level: one pixel less changes no shadow.",
    )


@dataclass(frozen=True)
class BandEnergy:
    """Where an image's energy lies.

    Parameters
    ----------
    fraction : float
        Share of the energy inside the stated band, widened by `BAND_MARGIN`.
    low_rad_m, high_rad_m : float
        Wavenumbers between which the middle 90 % of the energy lies.
    """

    fraction: float
    low_rad_m: float
    high_rad_m: float


def band_energy(image: CoherentImage, grazing_rad: float) -> BandEnergy:
    """Measure how much of an image's energy lies inside its stated wavenumber band.

    Parameters
    ----------
    image : CoherentImage
        The image; of a large one the middle is taken.
    grazing_rad : float
        Mean grazing angle, which turns frequencies into ground wavenumbers.
    """
    # Late: a third of a second to import, which whoever only reads bags need not pay.
    import scipy.fft

    rows, cols = (min(n, _MAX_FFT_SIDE) for n in image.grid.shape)
    r, c = (image.grid.rows - rows) // 2, (image.grid.cols - cols) // 2
    tile = image.pixels[r : r + rows, c : c + cols]
    spectrum = scipy.fft.fft2(tile)
    power = spectrum.real.astype(np.float64) ** 2 + spectrum.imag.astype(np.float64) ** 2
    d = image.grid.spacing_m
    k_row = 2 * np.pi * scipy.fft.fftfreq(rows, d)
    k_col = 2 * np.pi * scipy.fft.fftfreq(cols, d)
    bins = 512
    edge = math.sqrt(2) * math.pi / d
    index = np.minimum((np.hypot(k_row[:, None], k_col[None, :]) * (bins / edge)).astype(np.int64), bins - 1)
    radial = np.bincount(index.ravel(), weights=power.ravel(), minlength=bins)
    share = np.cumsum(radial) / radial.sum()
    k = (np.arange(bins) + 1) * edge / bins
    low, _, high = image.acoustics.ground_band(grazing_rad)
    inside = np.interp([low * (1 - BAND_MARGIN), high * (1 + BAND_MARGIN)], k, share, left=0.0)
    return BandEnergy(
        float(inside[1] - inside[0]),
        float(k[np.searchsorted(share, 0.05)]),
        float(k[np.searchsorted(share, 0.95)]),
    )


def judge_energy(image: CoherentImage, track: Track) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) if the image's energy lies outside its stated band."""
    energy = band_energy(image, track.grazing_rad)
    low, _, high = image.acoustics.ground_band(track.grazing_rad)
    # Of an annulus that is filled evenly, 5 and 95 % of the energy lie below these.
    inner, outer = (math.sqrt(low**2 + share * (high**2 - low**2)) for share in (0.05, 0.95))
    found, expected = (energy.low_rad_m + energy.high_rad_m) / 2, (inner + outer) / 2
    shift = abs(found - expected) / (high - low)
    shifted = shift > MAX_BAND_SHIFT
    # A wrong frequency or height scales the band; without its carrier it begins near K = 0.
    whole = energy.low_rad_m / energy.high_rad_m > 0.5 * inner / outer
    place = _height_of_band(track, found / expected) if shifted and whole else ""
    if energy.fraction >= GOOD_BAND_ENERGY and not shifted:
        return
    if energy.fraction >= GOOD_BAND_ENERGY:
        yield (
            WARNING,
            f"the image's energy is centred on K {found:.1f} rad/m,"
            f" {100 * (found / expected - 1):+.0f} % from the stated band's {expected:.1f}{place}",
            f"Is the centre frequency {image.acoustics.centre_frequency_hz * found / expected:.0f} Hz? Check"
            " it and the sound speed (camera_info.d), and the pixel spacing (p), which scales all lengths.",
        )
        return
    to_hz = image.acoustics.sound_speed_mps / (4 * math.pi * math.cos(track.grazing_rad))
    yield (
        ERROR if energy.fraction < MIN_BAND_ENERGY or shift > REFUSED_BAND_SHIFT else WARNING,
        f"{100 * energy.fraction:.0f} % of the image's energy lies in its stated band, K {low:.1f} to"
        f" {high:.1f} rad/m; 90 % of it lies at K {energy.low_rad_m:.1f} to {energy.high_rad_m:.1f}"
        f" rad/m{place}",
        f"With the stated sound speed that is {energy.low_rad_m * to_hz:.0f} to"
        f" {energy.high_rad_m * to_hz:.0f} Hz: check centre frequency, bandwidth and sound speed"
        " (camera_info.d[0:3]), and the pixel spacing (p)."
        if whole
        else "An image on its carrier has no energy near K = 0. Give complex pixels with their phase, not"
        " amplitudes, and not at baseband.",
    )


def _height_of_band(track: Track, ratio: float) -> str:
    """Say which height of the sonar fits a band `ratio` times the stated one; empty if none does.

    On the ground K is 4 pi f cos(psi) / c: what is wrong may be f, c, or the grazing angle psi.
    """
    reach = float(np.hypot(track.positions_m[:, 0], track.positions_m[:, 1]).mean())
    height = float(track.positions_m[:, 2].mean())
    cosine = ratio * math.cos(track.grazing_rad)
    if not 0.0 < cosine < 1.0:
        return ""
    fits = reach * math.tan(math.acos(cosine))
    # A depth for a height is a factor of some; beyond five it is another thing that is wrong.
    if not height / 5.0 <= fits <= 5.0 * height:
        return ""
    return (
        f"; it fits a sonar {fits:.1f} m above the seabed, but the track has z = {height:.1f} m: is z the"
        " height above the seabed, not a depth?"
    )


def judge_view(view: View, track: Track) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) if a view's sonar is not where the track says."""
    if view.info.frame != track.frame:
        yield (
            ERROR,
            f"the view is in frame {view.info.frame!r}, the track in {track.frame!r}",
            "Every message of a run carries one frame_id: correct that of the track or of the views.",
        )
        return
    stamps = track.stamps_ns - track.stamps_ns[0]
    when = view.info.stamp_ns - int(track.stamps_ns[0])
    step = int(np.median(np.diff(track.stamps_ns)))
    if not -step <= when <= int(stamps[-1]) + step:
        yield (
            WARNING,
            "the view's stamp is outside the track's time",
            "Stamp a view with the time when the sonar was at its aspect.",
        )
        return
    expected = np.array([np.interp(when, stamps, track.positions_m[:, i]) for i in range(3)])
    sonar = view.info.camera.sonar_m
    off = float(np.linalg.norm(sonar - expected))
    if off > SONAR_TOLERANCE * float(np.linalg.norm(expected)):
        yield (
            WARNING,
            f"its camera_info puts the sonar at {np.round(sonar, 2).tolist()} m, {off:.2f} m from the track"
            f" at that stamp ({np.round(expected, 2).tolist()} m)",
            "Make camera_info.p from the sonar's true position at the view's stamp.",
        )


def check_spectrum_sign(image: CoherentImage, track: Track) -> Iterator[tuple[str, str, str]]:
    """Yield (level, problem, remedy) if the image contradicts its stated spectrum sign."""
    if image.acoustics.folds(image.grid.spacing_m, track.grazing_rad):
        return  # said already
    # Imported here: a bag of views is checked without the weight of the whole method.
    from csas_shadow_ros.core.search.bodies import LEAVES, spectrum_sign_evidence
    from csas_shadow_ros.core.shape.result import OTHER_SIGN

    try:
        evidence, search = spectrum_sign_evidence(image, track)
    except CsasError as error:
        yield WARNING, f"the spectrum sign cannot be checked: {error}", ""
        return
    if evidence.verdict == "wrong":
        yield (
            ERROR,
            str(evidence),
            f"Set spectrum_sign (camera_info.d[3]) to {-evidence.stated:+d}.",
        )
    else:
        yield INFO, str(evidence), ""
    for left in () if search is None else search.left_out:
        remedies = []
        if LEAVES in left.reason:
            remedies.append("Process a larger scene: a body with its shadows off the image cannot be judged.")
        if left.reason.startswith(OTHER_SIGN):
            remedies.append("Check spectrum_sign (camera_info.d[3]).")
        if remedies:
            where = place_text(left.position_m)
            yield WARNING, f"something stands at {where}: {left.reason}", " ".join(remedies)
