"""What a program calls: a run in, a result out, with the parameters by name."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any, Literal, Protocol

from .bags import Run
from .core.errors import InputTypeError, ParameterError, check_type, check_whole
from .core.geometry import CoherentImage, Track
from .core.parameters import MAX_OBJECTS, MOST_OBJECTS, PipelineParameters, StartFrom
from .core.pipeline import Result
from .from_bag import reconstruct_run
from .parameter_file import pipeline_parameters, read_parameter_file
from .progress import ProgressOption, progress_bar

_LOG = logging.getLogger("csas_shadow_ros")
#: More threads than this are a slip: no machine that processes one image has as many processors.
_MOST_WORKERS = 1024


class ImageAndTrack(Protocol):
    """What a run is made of in memory, as `simulate` gives it."""

    @property
    def image(self) -> CoherentImage:
        """The full-circle image."""

    @property
    def track(self) -> Track:
        """Where the sonar was."""


def reconstruct(
    run: Run | ImageAndTrack,
    parameters: PipelineParameters | None = None,
    *,
    start_from: StartFrom = "auto",
    spectrum_sign: Literal[1, -1] | None = None,
    max_objects: int = MAX_OBJECTS,
    workers: int = 2,
    progress: ProgressOption = None,
) -> Result:
    """Reconstruct the shape of what a run shows, from the first thing that it holds.

    An image or sectors with a track go through the whole method; views of a stage (``sub_aperture``,
    ``shadow``, ``likelihood``, ``shadow_mask``) through what follows it. Doubts about the run go to the
    logger ``csas_shadow_ros``.

    Parameters
    ----------
    run : Run, or anything with an image and a track
        As `read_run`, `simulate` or `Run.of` give it.
    parameters : PipelineParameters, optional
        See `parameters`.
    start_from : str
        ``auto``, ``image``, or the stage whose views are taken.
    spectrum_sign : {1, -1}, optional
        Replace the sign that the run states.
    max_objects : int
        Carve at most so many bodies, the target among them.
    workers : int
        Threads.
    progress : bool or callable, optional
        False: no bar. True: a bar. A callable takes (views done, views in all). By default there is a bar
        in a terminal or a notebook.

    Returns
    -------
    Result
        Shape, dimensions and how far they can be trusted.

    Raises
    ------
    CsasError
        If the run or an argument is not usable, as an image whose stamp the track does not cover; also a
        ValueError or a TypeError.

    Examples
    --------
    >>> import csas_shadow_ros as csas
    >>> run = csas.read_run("box_run")
    >>> result = csas.reconstruct(run, csas.parameters(step_deg=5))
    >>> result
    Result: object, quality limited
      the shadow leaves the image in ... of 72 views, expected an image of at least ... m
      0... × 0... × 0... m, 0... m³, heading ...°, at x ..., y ... m
      72 views used, 0 refused, 360° of the circle
    >>> result.mesh.is_watertight
    True
    """
    if not isinstance(run, Run):
        image, track = getattr(run, "image", None), getattr(run, "track", None)
        if not isinstance(image, CoherentImage) or not isinstance(track, Track):
            raise InputTypeError(f"run is a {type(run).__name__}; expected what read_run or simulate returns")
        run = Run.of(image, track)
    check_type("parameters", parameters, (PipelineParameters, type(None)), "what csas.parameters() returns")
    if spectrum_sign not in (None, 1, -1):
        raise ParameterError(f"spectrum_sign is {spectrum_sign!r}; expected 1, -1 or None")
    with progress_bar(progress, "views") as bar:
        return reconstruct_run(
            run,
            parameters or PipelineParameters(),
            start_from=start_from,
            spectrum_sign=spectrum_sign,
            workers=check_whole("workers", workers, 1, _MOST_WORKERS),
            max_objects=check_whole("max_objects", max_objects, 1, MOST_OBJECTS),
            progress=bar,
            notice=_say,
        )


def parameters(file: str | Path | None = None, **values: Any) -> PipelineParameters:
    """Make the parameters of all stages of values by name; the others keep their defaults.

    Parameters
    ----------
    file : path-like, optional
        A parameter file in ROS 2's layout, as ``config/csas_shadow.yaml``; `values` override it.
    **values
        Any parameter that ``csas-shadow run --help`` names, with underscores. A `position_m` is that of a
        given target.

    Returns
    -------
    PipelineParameters
        One set a stage.

    Raises
    ------
    ParameterError
        If a name is unknown or a value is out of range.

    Examples
    --------
    >>> import csas_shadow_ros as csas
    >>> chosen = csas.parameters(step_deg=5, method="soft", voxel_size_m=0.03)
    >>> chosen.carving.method, chosen.sub_aperture.step_deg
    ('soft', 5.0)
    >>> csas.parameters(step_deg=500)
    Traceback (most recent call last):
    csas_shadow_ros.core.errors.ParameterError: step_deg is 500 deg; expected a number in [0.1, 90] deg
    """
    check_type("file", file, (str, os.PathLike, type(None)), "the path of a parameter file")
    chosen = {**({} if file is None else read_parameter_file(file)), **values}
    if "position_m" in chosen and "target" not in chosen:
        chosen["target"] = "given"  # a position is given for no other purpose
    return pipeline_parameters(chosen)


def _say(line: str) -> None:
    (_LOG.warning if line.startswith("warning: ") else _LOG.info)("%s", line.removeprefix("warning: "))
