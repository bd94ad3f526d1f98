"""Start later in the chain: the method on views from elsewhere, at any stage.

A bag may hold no image, but views of some stage: sub-apertures of another processor, shadow views that
an outside enhancement made, likelihoods of an outside classifier, silhouettes that were drawn by hand. What
comes after that stage is done by what `pipeline.run` does it with.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace

from .errors import ParameterError, ViewError
from .geometry import View
from .methods import method_named, names_that_take
from .parameters import MAX_OBJECTS, VIEW_STAGES, PipelineParameters
from .pipeline import ProcessedView, Result, process
from .reconstruction import Reconstruction
from .search.decision import Decision, decide_by_views

#: Stages that a run can start from, first to last.
STAGES = VIEW_STAGES


def run_views(
    views: Callable[[], Iterable[View]],
    stage: str,
    parameters: PipelineParameters | None = None,
    *,
    decision: Decision | None = None,
    sub_apertures: Callable[[], Iterable[View]] | None = None,
    run_ns: int | None = None,
    total: int = 0,
    progress: Callable[[int, int], None] | None = None,
    on_view: Callable[[ProcessedView], None] | None = None,
    workers: int = 2,
    max_objects: int = MAX_OBJECTS,
) -> Result:
    """Reconstruct the target from views of one stage.

    Parameters
    ----------
    views : callable
        Gives the views from the beginning, each time that it is called: once to find the target, once
        to carve. No more than a few are held at a time.
    stage : str
        What they are: ``sub_aperture`` (complex), ``shadow`` (amplitude, enhanced or not), ``likelihood``
        or ``shadow_mask``. The last two are carved as they are, and need a given target.
    parameters : PipelineParameters
        Parameters of the stages that follow.
    decision : Decision, optional
        What is carved, where it is known already; decided on by the views otherwise.
    sub_apertures : callable, optional
        Gives the sub-aperture views of the same run, where the bag holds them besides: what further bodies
        are made of.
    run_ns : int, optional
        The run's name, where it has one.
    total : int
        How many views there are, for `progress`; 0: unknown.
    progress : callable, optional
        Called with (views done, views in all).
    on_view : callable, optional
        Called with every processed view, in their order.
    workers : int
        Threads.
    max_objects : int
        At most so many bodies are carved; of shadow views, which are focused on one target, that one.

    Returns
    -------
    Result
        As of `pipeline.run`; `sign` is None (views say by themselves where the sonar was), and there are no
        composites of likelihoods and masks.

    Raises
    ------
    ParameterError
        If the stage is unknown, or its views cannot be carved by the chosen method.
    NoTargetError
        See `decide_by_views`.
    """
    p = parameters or PipelineParameters()
    if stage not in STAGES:
        raise ParameterError(f"stage is {stage!r}; expected one of: {', '.join(STAGES)}")
    check_method(stage, p)
    began = time.perf_counter()
    chosen = decision or decide_by_views(views, stage, p.target, max_objects)
    amplitudes = stage in ("sub_aperture", "shadow")
    reconstruction = Reconstruction(chosen, p, compare=amplitudes, compose=amplitudes, run_ns=run_ns)
    reconstruction.timings_s["search"] = time.perf_counter() - began

    def make(view: View) -> list[ProcessedView]:
        return process(view, stage, chosen, p)

    done = reconstruction.feed(views(), make, total, progress=progress, on_view=on_view, workers=workers)
    if stage != "sub_aperture" and chosen.others and sub_apertures is not None:
        for view in sub_apertures():
            reconstruction.add_others(process(view, "sub_aperture", chosen, p))
    if not done:
        raise ViewError(f"there is no usable {stage} view; expected at least one")
    return reconstruction.result()


def check_method(stage: str, parameters: PipelineParameters) -> None:
    """Refuse a method that cannot carve the views of a stage.

    Raises
    ------
    ParameterError
        Naming both.
    """
    carving = parameters.carving
    if stage in ("likelihood", "shadow_mask") and stage != method_named(carving.method).takes:
        expected = names_that_take(stage)
        raise ParameterError(f"method is {carving.method!r}; expected {expected} for {stage} views")


def with_spectrum_sign(view: View, spectrum_sign: int) -> View:
    """Return the view with another stated spectrum sign."""
    acoustics = replace(view.info.acoustics, spectrum_sign=spectrum_sign)
    return replace(view, info=replace(view.info, acoustics=acoustics))
