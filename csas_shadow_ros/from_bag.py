"""From what a bag holds to a result: which part of the method it starts with, and what it is told first.

The command line, `csas_shadow_ros.reconstruct` and the replay all start here: an image (or its sectors)
with a track goes through the whole method, views of a stage through what follows that stage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

from msg_adapters.topics import absolute_name, stream

from .bags import Problem, Run
from .bags.check import ERROR, judge_amplitude, judge_coverage, judge_image, judge_sectors
from .core.errors import BagError, ParameterError, SpectrumSignError
from .core.geometry import CoherentImage, Track, View, looks_at
from .core.later_stages import STAGES, run_views, with_spectrum_sign
from .core.parameters import MAX_OBJECTS, START_FROM, PipelineParameters, Stage
from .core.pipeline import ProcessedView, Result
from .core.pipeline import run as run_pipeline
from .core.search.decision import Decision, decide_by_views

Progress = Callable[[int, int], None]
Notice = Callable[[str], None]


def ignore(_: object) -> None:
    """Take something that nobody wants."""


@dataclass(frozen=True, eq=False)
class Source:
    """What a run starts from.

    Parameters
    ----------
    stage : str
        ``image``, or a stage of views.
    image, track : CoherentImage, Track or None
        What is processed.
    as_recorded : bool
        Whether the image is the bag's own message, unchanged.
    """

    stage: Literal["image"] | Stage
    image: CoherentImage | None
    track: Track | None
    as_recorded: bool = False


def reconstruct_run(
    run: Run,
    parameters: PipelineParameters,
    *,
    start_from: str = "auto",
    spectrum_sign: int | None = None,
    workers: int = 2,
    max_objects: int = MAX_OBJECTS,
    on_source: Callable[[Source], None] = ignore,
    on_view: Callable[[ProcessedView], None] | None = None,
    progress: Progress | None = None,
    notice: Notice = ignore,
) -> Result:
    """Reconstruct what a run shows, from the first thing that it holds.

    Parameters
    ----------
    run : Run
        The run.
    parameters : PipelineParameters
        Of every stage.
    start_from : str
        One of `START_FROM`.
    spectrum_sign : int, optional
        +1 or -1 instead of what the run states.
    workers : int
        Threads.
    max_objects : int
        At most so many bodies are carved.
    on_source : callable
        Called with what the run starts from, before any view is made.
    on_view, progress : callable, optional
        Called with every processed view, and with (views done, views in all).
    notice : callable
        Called with each line that a user should see.

    Raises
    ------
    CsasError
        If the run or a parameter is not usable.
    """
    stage = choose_start(run, start_from)
    how: dict[str, Any] = {
        "workers": workers,
        "max_objects": max_objects,
        "on_view": on_view,
        "progress": progress,
    }
    if stage == "image":
        result = _from_image(run, parameters, spectrum_sign, on_source, notice, **how)
    else:
        result = _from_views(run, stage, parameters, spectrum_sign, on_source, notice, **how)
    result.datum = parameters.place.datum(run.datum)
    return result


def choose_start(run: Run, start_from: str = "auto") -> Literal["image"] | Stage:
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
    if start_from == "image":
        return "image"
    for stage in stages:
        if stage == start_from:
            return stage
    held = ", ".join(stages) or "none"
    raise BagError(f"{run.path} holds no {start_from} views; stages that it holds: {held}")


def _from_image(
    run: Run,
    p: PipelineParameters,
    sign: int | None,
    on_source: Callable[[Source], None],
    notice: Notice,
    **how: Any,
) -> Result:
    image, track = run.coherent_image(), run.require_track()
    refuse_contradictions(image, track, notice, run)
    if run.image is None:
        tell_of_sectors(run, notice)
    if sign is not None:
        notice(
            f"spectrum sign overridden: the bag states {image.acoustics.spectrum_sign:+d}, {sign:+d} is used"
        )
        image = replace(image, acoustics=replace(image.acoustics, spectrum_sign=sign))
    on_source(Source("image", image, track, as_recorded=sign is None and run.image is not None))
    try:
        result = run_pipeline(
            image,
            track,
            p,
            spectrum=None if run.image is not None else run.sector_sum().spectrum,
            run_ns=run.run_ns,
            **how,
        )
    except SpectrumSignError as error:
        raise SpectrumSignError(
            f"{error}; correct camera_info.d[3], or run with --spectrum-sign"
            f" {-image.acoustics.spectrum_sign:+d} (spectrum_sign={-image.acoustics.spectrum_sign:+d})"
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
    stage: Stage,
    p: PipelineParameters,
    sign: int | None,
    on_source: Callable[[Source], None],
    notice: Notice,
    *,
    max_objects: int,
    **how: Any,
) -> Result:
    notice(f"starting from the bag's {stage} views ({run.counts[stage]})")
    if sign is not None:
        notice(f"spectrum sign of the views overridden: {sign:+d} is used")
    on_source(Source(stage, None, run.track))

    warned: set[str] = set()

    def views() -> Iterator[View]:
        usable = False
        for view in run.views(stage):
            usable = True
            if view.info.frame != run.frame:
                raise BagError(
                    f"{run.path}: the {stage} view stamped {view.info.stamp_ns} ns is in frame"
                    f" {view.info.frame!r}; expected that of the run, {run.frame!r}"
                )
            for _, problem, remedy in judge_amplitude(view) if stage == "shadow" else ():
                if not warned:
                    notice(f"warning: view stamped {view.info.stamp_ns} ns: {problem}. {remedy}")
                    warned.add(problem)
            yield view if sign is None else with_spectrum_sign(view, sign)
        if not usable:
            raise BagError(run.why(f"none of the {run.counts[stage]} {stage} views is usable"))

    decision = decision_of_views(run, stage, p, max_objects, views)
    return run_views(
        views,
        stage,
        p,
        decision=decision,
        sub_apertures=(lambda: run.views("sub_aperture")) if run.counts.get("sub_aperture") else None,
        run_ns=run.run_ns,
        total=run.counts[stage],
        **how,
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
    image: CoherentImage, track: Track, notice: Notice = ignore, run: Run | None = None
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


def tell_of_sectors(run: Run, notice: Notice = ignore) -> None:
    """Tell of arcs that no sector covers, or two: as it goes, and in the report's problems."""
    topic = absolute_name(stream("sector").image_topic, run.namespace)
    for level, problem, remedy in judge_sectors(run, run.require_track()):
        notice(f"{level}: {problem}. {remedy}")
        run.report(Problem(topic, None, None, problem))
