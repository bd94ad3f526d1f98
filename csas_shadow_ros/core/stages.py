"""Start later in the chain: the method on views that were made elsewhere, at any stage.

A bag may hold no image, but views of some stage: sub-apertures of another processor, shadow views that
an outside enhancement made, likelihoods of an outside classifier, silhouettes that were drawn by hand. What
comes after that stage is done here by the very functions that `pipeline.run` calls.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from .carving import Carver
from .errors import NoTargetError, ParameterError, ViewError
from .geometry import TWO_PI, View, fit_target_to_focus, wrap_angle
from .hollows import EchoLook
from .likelihood import Levels, outside_likelihood, view_levels
from .measurement import SilhouetteSides, levels_of_mask, measure_object, silhouette_sides
from .mesh import mesh_from_grid
from .parameters import PipelineParameters, ShadowParameters, TargetParameters
from .pipeline import Result, compose, correct_heights, open_hollows
from .segmentation import require_silhouette, segment_shadow
from .shadow import enhance
from .target import Search, choose_target, search_views
from .threads import in_order
from .volume import Target, Volume

#: Stages that a run can start from, first to last.
STAGES = ("sub_aperture", "shadow", "likelihood", "shadow_mask")
#: How many views from all round look for the target.
_SEARCH_VIEWS = 36


@dataclass(frozen=True, eq=False)
class StagedView:
    """One view from the stage where it came in onwards; what lies before that is None."""

    sub_aperture: View | None = None
    shadow: View | None = None
    levels: Levels | None = None
    likelihood: View | None = None
    mask: View | None = None
    sides: SilhouetteSides | None = None
    look: EchoLook | None = None


def spread_views(views: Iterable[View], count: int, start_rad: float = 0.0) -> list[View]:
    """Keep the views nearest to `count` aspects round the circle, each once; memory holds no more.

    Parameters
    ----------
    views : iterable of View
        Any number, in any order.
    count : int
        Number of aspects.
    start_rad : float
        The first of them; the others follow every 2π/count.
    """
    kept: list[tuple[float, View] | None] = [None] * count
    step = TWO_PI / count
    for view in views:
        aspect = view.info.aspect_rad - start_rad
        slot = round((aspect % TWO_PI) / step) % count
        off = abs(float(wrap_angle(aspect - slot * step)))
        best = kept[slot]
        if best is None or off < best[0]:
            kept[slot] = (off, view)
    return [best[1] for best in kept if best is not None]


def target_of_views(
    views: Callable[[], Iterable[View]], stage: str, parameters: TargetParameters | None = None
) -> Target | None:
    """Find the target in views of a stage, or take the one that is given.

    Parameters
    ----------
    views : callable
        Gives the views from the beginning, each time that it is called.
    stage : str
        One of `STAGES`.
    parameters : TargetParameters
        Position and size, or automatic.

    Returns
    -------
    Target or None
        None: there is no object.

    Raises
    ------
    NoTargetError
        If there is no view, nothing is at the given position, or the stage's views (likelihood, mask) cannot
        tell where the target is and it is not given whole.
    """
    p = parameters or TargetParameters()
    if p.target == "given" and all(s > 0 for s in p.size_m):
        return Target((p.position_m[0], p.position_m[1]), (p.size_m[0], p.size_m[1], p.size_m[2]))
    if stage in ("likelihood", "shadow_mask"):
        chosen = spread_views(views(), _SEARCH_VIEWS)
        try:
            x, y = fit_target_to_focus([view.info for view in chosen])
            hint = f" (its views were focused on ({x:.2f}, {y:.2f}) m)"
        except ValueError:
            hint = ""
        raise NoTargetError(
            f"{stage} views do not tell how large the target is; expected target: given with position_m and"
            f" size_m{hint}"
        )
    chosen = spread_views(views(), _SEARCH_VIEWS)
    unfocused = ShadowParameters(enhancement="none")
    amplitudes = []
    for view in chosen:
        try:
            amplitudes.append(enhance(view, (0.0, 0.0), unfocused) if stage == "sub_aperture" else view)
        except ViewError:
            continue  # named again, with its aspect, when it should be carved with
    search: Search = search_views(amplitudes)
    return choose_target(search, p)


def stage_view(view: View, stage: str, target: Target, p: PipelineParameters) -> StagedView:
    """Take one view through the stages that follow its own.

    Raises
    ------
    ViewError
        If the view is not usable.
    """
    if stage == "likelihood":
        return StagedView(likelihood=view)
    if stage == "shadow_mask":
        return StagedView(mask=view, sides=silhouette_sides(levels_of_mask(view), view, target.position_m))
    sub_aperture = view if stage == "sub_aperture" else None
    shadow = enhance(view, target.position_m, p.shadow) if sub_aperture is not None else view  # 3.2
    levels = view_levels(shadow, p.likelihood)  # 4.2
    likelihood = outside_likelihood(shadow, p.likelihood, levels)
    mask = segment_shadow(shadow, target.position_m, p.likelihood, levels, reach_m=target.reach_m)  # 4.1
    sides = silhouette_sides(levels, mask, target.position_m)
    volume = Volume.around(target.position_m, target.size_m, p.carving.voxel_size_m)
    look = EchoLook.of(levels, shadow.info, volume)
    return StagedView(sub_aperture, shadow, levels, likelihood, mask, sides, look)


def run_views(
    views: Callable[[], Iterable[View]],
    stage: str,
    parameters: PipelineParameters | None = None,
    *,
    total: int = 0,
    progress: Callable[[int, int], None] | None = None,
    on_view: Callable[[StagedView], None] | None = None,
    workers: int = 2,
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
    total : int
        How many views there are, for `progress`; 0: unknown.
    progress : callable, optional
        Called with (views done, views in all).
    on_view : callable, optional
        Called with every processed view, in their order.
    workers : int
        Threads.

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
        See `target_of_views`.
    """
    p = parameters or PipelineParameters()
    if stage not in STAGES:
        raise ParameterError(f"stage is {stage!r}; expected one of: {', '.join(STAGES)}")
    if stage in ("likelihood", "shadow_mask") and (stage == "shadow_mask") != p.carving.takes_masks:
        expected = "consensus or hard" if stage == "shadow_mask" else "soft"
        raise ParameterError(f"method is {p.carving.method!r}; expected {expected} for {stage} views")
    result, start = Result(), time.perf_counter()

    def lap(step: str) -> None:
        result.timings_s[step] = time.perf_counter() - start - sum(result.timings_s.values())

    target = result.target = target_of_views(views, stage, p.target)
    lap("target")
    carvers: list[Carver] = []
    if target is not None:
        volume = Volume.around(target.position_m, target.size_m, p.carving.voxel_size_m)
        methods = [p.carving] if stage in ("likelihood", "shadow_mask") else [p.carving, p.carving.other()]
        carvers = [Carver(volume, each) for each in methods]

    def make(view: View) -> StagedView | ViewError:
        if target is None:
            return StagedView()
        try:
            return stage_view(view, stage, target, p)
        except ViewError as error:
            return error

    done = 0
    for view, staged in in_order(make, views(), workers):
        done += 1
        if stage in ("sub_aperture", "shadow"):
            compose(result, view)
        if isinstance(staged, ViewError):
            result.rejected[_aspect_deg(view)] = str(staged)
        elif carvers:
            _integrate(result, carvers, staged, view)
            if on_view:
                on_view(staged)
        if progress:
            progress(done, max(total, done))
    lap("views")
    if not done:
        raise ViewError(f"there is no usable {stage} view; expected at least one")
    if carvers and result.views_used:
        grids = [carver.grid() for carver in carvers if carver.stamps]
        result.grid, result.other_grid = grids[0], grids[1] if len(grids) > 1 else None
        correct_heights(result)
        if result.grid.occupied.any():
            result.mesh = mesh_from_grid(result.grid)
            result.dimensions = measure_object(result.grid, result.mesh, result.sides)
    lap("shape")
    open_hollows(result)
    lap("hollows")
    return result


def with_spectrum_sign(view: View, spectrum_sign: int) -> View:
    """Return a view whose stated spectrum sign is replaced."""
    acoustics = replace(view.info.acoustics, spectrum_sign=spectrum_sign)
    return replace(view, info=replace(view.info, acoustics=acoustics))


def _aspect_deg(view: View) -> float:
    return round(math.degrees(view.info.aspect_rad), 6)


def _integrate(result: Result, carvers: list[Carver], staged: StagedView, view: View) -> None:
    for carver in carvers:
        pixels = staged.mask if carver.parameters.takes_masks else staged.likelihood
        if pixels is None:
            raise ParameterError(f"method is {carver.parameters.method!r}; its views were not made")
        try:
            if carver.parameters.takes_masks:
                require_silhouette(pixels)
            integrated = carver.integrate(pixels)
        except ViewError as error:
            if carver is carvers[0]:
                result.rejected[_aspect_deg(view)] = str(error)
            continue
        if carver is carvers[0]:
            result.views_used += integrated
            if integrated and staged.sides is not None:
                result.sides.append(staged.sides)
    if staged.levels is not None:
        levels = staged.levels
        stamp = view.info.stamp_ns
        result.levels[stamp] = (levels.seabed_level, levels.contrast, levels.estimated)
    if staged.look is not None:
        result.looks[view.info.stamp_ns] = staged.look
