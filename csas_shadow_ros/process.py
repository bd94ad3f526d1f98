"""A bag in, a results folder out, in one process."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters.topics import absolute_name, stream

from .bags import BagReader, Problem, Run, read_run
from .bags.check import ERROR, judge_amplitude, judge_coverage, judge_image, judge_sectors
from .bags.metadata import read_metadata
from .core.arcs import Arc, Arcs
from .core.errors import BagError, CsasError, ParameterError, SpectrumSignError
from .core.geometry import CoherentImage, Track, View, looks_at
from .core.parameters import MAX_OBJECTS, START_FROM, PipelineParameters
from .core.pipeline import Result
from .core.pipeline import run as run_pipeline
from .core.search.decision import Decision, decide_by_views
from .core.stages import STAGES, run_views, with_spectrum_sign
from .results import Context, ResultsWriter

Progress = Callable[[int, int], None]
Notice = Callable[[str], None]


def _ignore(_: str) -> None:
    return None


def process_bag(
    bag: str | Path,
    out: str | Path,
    parameters: PipelineParameters | None = None,
    *,
    start_from: str = "auto",
    spectrum_sign: int | None = None,
    namespace: str | None = None,
    run_of_bag: int | None = None,
    overwrite: bool = False,
    write_bag: bool = True,
    figures: bool = True,
    durable: bool = True,
    workers: int = 2,
    max_objects: int = MAX_OBJECTS,
    command: Sequence[str] = (),
    progress: Progress | None = None,
    notice: Notice = _ignore,
) -> dict[str, Any]:
    """Reconstruct what a bag shows and write its results folder.

    Parameters
    ----------
    bag : path-like
        A rosbag2 directory or a lone storage file.
    out : path-like
        Results folder to make.
    parameters : PipelineParameters
        Parameters of every stage.
    start_from : str
        ``image`` (or sectors) with the track, views of a stage, or ``auto``: the first that is there.
    spectrum_sign : int, optional
        +1 or -1 instead of what the bag states; said in a notice and in the report.
    namespace : str, optional
        Namespace of the topics; found by itself if not given.
    run_of_bag : int, optional
        Which of several runs of the bag, as in `read_run`.
    overwrite, write_bag, figures, durable
        See `ResultsWriter`.
    workers : int
        Threads.
    max_objects : int
        At most so many bodies are carved, the target among them (see `pipeline.run`). Shadow views and what
        follows them were made for one target.
    command : sequence of str
        Command line, for the report.
    progress : callable, optional
        Called with (views done, views in all).
    notice : callable
        Called with each line that a user should see.

    Returns
    -------
    dict
        The report.

    Raises
    ------
    CsasError
        If the bag, a parameter or the folder is not usable.
    """
    p = parameters or PipelineParameters()
    with ResultsWriter(
        out, overwrite=overwrite, bag=write_bag, figures=figures, durable=durable, notice=notice
    ) as writer:
        began = time.perf_counter()
        run = read_run(bag, namespace, run_of_bag)
        stage = choose_start(run, start_from)
        context = Context(p, command, stage=stage, spectrum_sign_override=spectrum_sign)
        context.read_truth(bag)
        context.timings_s["read"] = time.perf_counter() - began
        if stage == "image":
            result = _from_image(run, context, writer, workers, max_objects, progress, notice)
        else:
            result = _from_views(run, context, writer, workers, max_objects, progress, notice)
        context.timings_s["write_views"] = writer.view_seconds
        result.timings_s["views"] = max(result.timings_s.get("views", 0.0) - writer.view_seconds, 0.0)
        context.problems = told_once(run.problems)
        for line in context.problems:
            notice(f"problem: {line}")
        context.describe(lambda: describe_run(run))
        return writer.finish(result, context)


def replay_bag(
    bag: str | Path,
    out: str | Path,
    parameters: PipelineParameters | None = None,
    *,
    start_from: str = "auto",
    rate: float = 0.0,
    domain_id: int | None = None,
    run_of_bag: int | None = None,
    max_objects: int = MAX_OBJECTS,
    overwrite: bool = False,
    write_bag: bool = True,
    figures: bool = True,
    durable: bool = True,
    command: Sequence[str] = (),
    progress: Progress | None = None,
    notice: Notice = _ignore,
) -> dict[str, Any]:
    """Reconstruct the target of a bag through the node graph and write the same results folder.

    Parameters
    ----------
    bag, out, parameters, start_from, run_of_bag, max_objects, overwrite, write_bag, figures, durable
    command, progress, notice
        See `process_bag`.
    rate : float
        Views: times the recorded speed; 0: as fast as the nodes take them.
    domain_id : int, optional
        ROS domain, to look on with other tools; a free one otherwise.

    Returns
    -------
    dict
        The report, and as ``not_recorded`` what of the run its bag lacks. The nodes' logs are in the
        folder's ``log/``.

    Raises
    ------
    CsasError
        As `process_bag`; and if ROS 2 is not there, or the graph does not get to its end.
    """
    from .results.recording import adopt_replay, node_table, unplaced

    try:
        import rclpy  # noqa: F401  (asked for here, to say so in one line)
    except ImportError as error:
        raise CsasError(
            f"replay needs ROS 2, which is not there ({error}); source it, or pip install"
            " 'csas_shadow_ros[ros]', or use `csas-shadow run`"
        ) from error
    from .replay import replay

    p = parameters or PipelineParameters()
    with ResultsWriter(
        out, overwrite=overwrite, bag=write_bag, figures=figures, durable=durable, notice=notice
    ) as writer:
        began = time.perf_counter()
        run = read_run(bag, None, run_of_bag)
        context = Context(p, command)
        context.read_truth(bag)
        image = None
        stage = start_from
        if choose_start(run, start_from) == "image":
            image = run.coherent_image()
            refuse_contradictions(image, run.require_track(), notice, run)
            if run.image is None:
                stage = "sector"  # also where there is an image that cannot be used
                tell_of_sectors(run, notice)
        context.timings_s["read"] = time.perf_counter() - began
        scratch = writer.work / ".replay"
        replayed = replay(
            bag,
            scratch,
            p,
            stage=stage,
            rate=rate,
            domain_id=domain_id,
            record=True,
            max_objects=max_objects,
            overrides={
                # The results folder that takes the recording is written out to the disk as a whole.
                "bag_recorder": {"compression": "lz4", "sync": False},
                "bag_player": {} if run.run_ns is None else {"run": run.run_ns},
            },
            progress=progress or False,
            notice=notice,
        )
        context.stage = "image" if replayed.stage == "sector" else replayed.stage
        if context.stage == "image":
            context.image = image
        context.track = run.track
        context.nodes, context.views_lost = node_table(replayed), replayed.lost
        context.views_in = replayed.views_total
        result = adopt_replay(writer, replayed, p, whole=rate == 0.0)
        writer.attempt("log", lambda: (scratch / "log").rename(writer.work / "log"), None)
        shutil.rmtree(scratch, ignore_errors=True)
        context.problems = [*told_once(run.problems), *unplaced(replayed)]
        context.problems += [f"the recording is not whole: {line}" for line in replayed.not_recorded]
        context.describe(lambda: describe_run(run))
        report = writer.finish(result, context)
        return report | {"not_recorded": replayed.not_recorded} if write_bag else report


def choose_start(run: Run, start_from: str = "auto") -> str:
    """Say what a run starts from: ``image`` or one of the stages.

    Raises
    ------
    BagError
        If the bag does not hold it, or holds nothing to start from.
    ParameterError
        If `start_from` is unknown.
    """
    if start_from not in START_FROM:
        raise ParameterError(f"start_from is {start_from!r}; expected one of: {', '.join(START_FROM)}")
    has_image = run.image is not None or bool(run.counts.get("sector"))
    stages = [stage for stage in STAGES if run.counts.get(stage)]
    if start_from == "auto":
        if has_image and run.track is not None:
            return "image"
        if stages:
            return stages[0]
        if not has_image:
            run.coherent_image()  # raises, naming what is wrong with the image
        run.require_track()
    if start_from != "image" and start_from not in stages:
        held = ", ".join(stages) or "none"
        raise BagError(f"{run.path} holds no {start_from} views; stages that it holds: {held}")
    return start_from


def _from_image(
    run: Run,
    context: Context,
    writer: ResultsWriter,
    workers: int,
    max_objects: int,
    progress: Progress | None,
    notice: Notice,
) -> Result:
    began = time.perf_counter()
    image, track = run.coherent_image(), run.require_track()
    refuse_contradictions(image, track, notice, run)
    if run.image is None:
        tell_of_sectors(run, notice)
    context.timings_s["read"] += time.perf_counter() - began
    sign = context.spectrum_sign_override
    if sign is not None:
        notice(
            f"spectrum sign overridden: the bag states {image.acoustics.spectrum_sign:+d}, {sign:+d} is used"
        )
        image = replace(image, acoustics=replace(image.acoustics, spectrum_sign=sign))
    context.image, context.track = image, track
    as_recorded = sign is None and run.image is not None
    writer.write_source(image, track, BagReader(run.path, run.namespace) if as_recorded else None)
    try:
        result = run_pipeline(
            image,
            track,
            context.parameters,
            progress=progress,
            on_view=writer.add_view,
            workers=workers,
            max_objects=max_objects,
            spectrum=None if run.image is not None else run.sector_sum().spectrum,
            run_ns=run.run_ns,
        )
    except SpectrumSignError as error:
        raise SpectrumSignError(
            f"{error}; correct camera_info.d[3], or run with --spectrum-sign"
            f" {-image.acoustics.spectrum_sign:+d}"
        ) from error
    if result.composites is None and result.rejected:
        # Nothing was looked at: that is no finding that there is no object.
        raise BagError(
            f"{run.path}: none of {len(result.rejected)} views could be made:"
            f" {next(iter(result.rejected.values()))}"
        )
    return result


def _from_views(
    run: Run,
    context: Context,
    writer: ResultsWriter,
    workers: int,
    max_objects: int,
    progress: Progress | None,
    notice: Notice,
) -> Result:
    stage, sign = context.stage, context.spectrum_sign_override
    context.track = run.track
    notice(f"starting from the bag's {stage} views ({run.counts[stage]})")
    if sign is not None:
        notice(f"spectrum sign of the views overridden: {sign:+d} is used")
    writer.write_source(None, run.track)

    warned: set[str] = set()

    def views() -> Iterator[View]:
        usable = False
        for view in run.views(stage):
            usable = True
            for _, problem, remedy in judge_amplitude(view) if stage == "shadow" else ():
                if not warned:
                    notice(f"warning: view stamped {view.info.stamp_ns} ns: {problem}. {remedy}")
                    warned.add(problem)
            yield view if sign is None else with_spectrum_sign(view, sign)
        if not usable:
            raise BagError(run.why(f"none of the {run.counts[stage]} {stage} views is usable"))

    decision = decision_of_views(run, stage, context.parameters, max_objects, views)
    return run_views(
        views,
        stage,
        context.parameters,
        decision=decision,
        sub_apertures=(lambda: run.views("sub_aperture")) if run.counts.get("sub_aperture") else None,
        run_ns=run.run_ns,
        total=run.counts[stage],
        progress=progress,
        on_view=writer.add_view,
        workers=workers,
    )


def decision_of_views(
    run: Run,
    stage: str,
    parameters: PipelineParameters,
    max_objects: int,
    views: Callable[[], Iterator[View]] | None = None,
) -> Decision:
    """Say what is carved of a bag's views: what they were made for, where the bag tells, or what they show.

    Parameters
    ----------
    run : Run
        The bag.
    stage : str
        What its views are.
    parameters : PipelineParameters
        A target that is given there comes first.
    max_objects : int
        At most so many bodies are carved.
    views : callable, optional
        Gives the views, if not as they are in the bag.

    Raises
    ------
    CsasError
        See `core.search.decision.decide_by_views`.
    """
    each = views or (lambda: run.views(stage))
    recorded = run.decision() if parameters.target.target == "auto" else None
    if recorded is not None and recorded.target is not None:
        first = next(iter(each()), None)
        if first is not None and looks_at(first.info, recorded.target.position_m):
            if stage != "sub_aperture" and not run.counts.get("sub_aperture"):
                return replace(recorded, others=())
            return recorded
    return decide_by_views(each, stage, parameters.target, max_objects)


def refuse_contradictions(
    image: CoherentImage, track: Track, notice: Notice = _ignore, run: Run | None = None
) -> None:
    """Refuse an image, band and track that cannot belong together: "no object" would be a false answer.

    Parameters
    ----------
    image : CoherentImage
        The image, with its band.
    track : Track
        The track.
    notice : callable
        Called with each doubt that is no reason to refuse.
    run : Run, optional
        Takes each such doubt as a problem, for the report.

    Raises
    ------
    BagError
        With what is wrong and what to do about it.
    """
    judged = [("track", found) for found in judge_coverage(track)]
    judged += [("image", found) for found in judge_image(image, track)]
    for relative, (level, problem, remedy) in judged:
        if level == ERROR:
            raise BagError(f"{problem}. {remedy}")
        notice(f"{level}: {problem}. {remedy}")
        if run is not None:
            run.report(Problem(absolute_name(relative, run.namespace), None, None, problem))


def tell_of_sectors(run: Run, notice: Notice = _ignore) -> None:
    """Tell of arcs that no sector covers, or two: as it goes, and in the report's problems."""
    topic = absolute_name(stream("sector").image_topic, run.namespace)
    for level, problem, remedy in judge_sectors(run, run.require_track()):
        notice(f"{level}: {problem}. {remedy}")
        run.report(Problem(topic, None, None, problem))


def told_once(problems: Sequence[Problem]) -> list[str]:
    """Return problems as lines; what is wrong with many messages alike is one line."""
    alike: dict[tuple[str, str], list[Problem]] = {}
    for problem in problems:
        alike.setdefault((problem.topic, problem.reason), []).append(problem)
    return [
        str(same[0]) + (f" ({len(same)} messages alike)" if len(same) > 1 else "") for same in alike.values()
    ]


def describe_image(image: CoherentImage) -> dict[str, Any]:
    """Return an image's size and band."""
    grid, acoustics = image.grid, image.acoustics
    return {
        "rows": grid.rows,
        "cols": grid.cols,
        "spacing_m": grid.spacing_m,
        "extent_m": {
            "left": grid.extent_m[0],
            "right": grid.extent_m[1],
            "bottom": grid.extent_m[2],
            "top": grid.extent_m[3],
        },
        "centre_frequency_hz": acoustics.centre_frequency_hz,
        "bandwidth_hz": acoustics.bandwidth_hz,
        "sound_speed_mps": acoustics.sound_speed_mps,
        "spectrum_sign": acoustics.spectrum_sign,
        "stamp_ns": image.stamp_ns,
    }


def describe_track(track: Track) -> dict[str, Any]:
    """Return a track's size, circle and coverage."""
    x, y, radius, height = track.circle
    return {
        "poses": len(track),
        "centre_m": [x, y],
        "radius_m": radius,
        "height_m": height,
        "grazing_deg": math.degrees(track.grazing_rad),
        "coverage_deg": math.degrees(track.coverage_rad),
        "gaps": [str(gap) for gap in track.gaps],
        "duration_s": float(track.stamps_ns[-1] - track.stamps_ns[0]) * 1e-9,
        "direction": "counter-clockwise" if track.aspects_rad[-1] > track.aspects_rad[0] else "clockwise",
    }


def describe_run(run: Run) -> dict[str, Any]:
    """Describe a bag: its topics with counts, its files, image, band and track.

    Returns
    -------
    dict
        Ready for JSON.
    """
    reader = BagReader(run.path, run.namespace)
    files = [run.path] if run.path.is_file() else sorted(p for p in run.path.iterdir() if p.is_file())
    track = run.track
    return {
        "path": str(run.path.resolve()),
        "namespace": run.namespace,
        "messages": reader.message_count,
        "topics": {
            name: {"type": info.type_name, "messages": info.count}
            for name, info in sorted(reader.topics.items())
        },
        "files": {p.name: p.stat().st_size for p in files},
        "bytes": sum(p.stat().st_size for p in files),
        "checksums": reader.has_checksums,
        "metadata": _bag_metadata(run.path),
        "image": None if run.image is None else describe_image(run.image),
        "sectors": describe_sectors(run),
        "track": None if track is None else describe_track(track),
    }


def describe_sectors(run: Run) -> dict[str, Any] | None:
    """Describe the sectors of a bag by what they say of themselves; None if there is none."""
    infos = run.sector_infos()
    if not infos:
        return None
    arcs = Arcs()
    for info in infos:
        arcs.add(Arc(info.aspect_rad - info.aperture_rad / 2.0, info.aperture_rad))
    first = infos[0]
    blank = np.broadcast_to(np.complex64(0), first.grid.shape)
    return {
        "count": len(infos),
        "covered_deg": math.degrees(arcs.covered_rad),
        "missing": [str(arc) for arc in arcs.missing()],
        "image": describe_image(CoherentImage(blank, first.grid, first.acoustics, first.stamp_ns)),
    }


def _bag_metadata(path: Path) -> dict[str, Any] | None:
    """Return the bag's own metadata without its lists of topics, which are told elsewhere."""
    try:
        information = read_metadata(path).information
    except BagError:
        return None
    return {k: v for k, v in information.items() if k not in ("topics_with_message_count", "files")}


def topic_sizes(run: Run) -> dict[str, int]:
    """Return the bytes of the messages of each topic; reads the whole bag."""
    sizes: dict[str, int] = {}
    reader = BagReader(run.path, run.namespace)
    for message in reader.messages():
        sizes[message.topic] = sizes.get(message.topic, 0) + len(message.cdr)
    return sizes


def stages_of(run: Run) -> list[str]:
    """Return what a run of this bag could start from."""
    found = []
    try:
        found.append(choose_start(run))
    except CsasError:
        return []
    return found + [stage for stage in STAGES if run.counts.get(stage) and stage not in found]
