"""The whole method: a circular run in, a 3-D shape out.

Read this first. Each line of `process_view` is a section of the paper, and the module it calls holds
the equations. The node graph calls the same functions and leaves the same grid.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .carving import Carver
from .composites import Composites
from .errors import ViewError, check_range
from .geometry import CoherentImage, Track, View
from .hollows import EchoLook, matter_mesh, matter_of
from .likelihood import Levels, outside_likelihood, view_levels
from .measurement import SilhouetteSides, measure_object, silhouette_sides
from .mesh import Dimensions, mesh_from_grid
from .objects import (
    MAX_OBJECTS,
    MOST_OBJECTS,
    FurtherBody,
    FurtherView,
    LeftOut,
    ObjectResult,
    further_targets,
)
from .parameters import CarvingParameters, PipelineParameters
from .segmentation import require_silhouette, segment_shadow
from .shadow import enhance
from .subaperture import Spectrum, SubApertures
from .target import SignEvidence, choose_target, find_target_and_others, spectrum_sign_evidence
from .threads import in_order
from .volume import Target, Volume, VoxelGrid

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class ProcessedView:
    """One view through all stages."""

    sub_aperture: View
    shadow: View
    levels: Levels
    likelihood: View
    mask: View
    sides: SilhouetteSides | None
    look: EchoLook

    def carves(self, parameters: CarvingParameters) -> View:
        """Return what a method carves with.

        Raises
        ------
        ViewError
            If the method takes silhouettes, and the view has none.
        """
        if parameters.takes_masks:
            return require_silhouette(self.mask)  # 4.1 space carving
        return self.likelihood  # 4.2 soft carving


@dataclass(eq=False)
class Result:
    """What a run leaves.

    Attributes
    ----------
    target : Target or None
        The volume that was carved; None: there is no object.
    sign : SignEvidence or None
        Whether the shadows fit the spectrum sign; None if it was not checked.
    grid, other_grid : VoxelGrid or None
        By the chosen method, and by the other one.
    mesh, dimensions : trimesh.Trimesh, Dimensions or None
        Surface and measures of the object.
    matter : ndarray of bool, shape (nz, ny, nx), or None
        The grid's object without the hollows that its echoes show; None where no echo was looked at.
    matter_mesh : trimesh.Trimesh or None
        Its surface: `mesh` itself where there is no hollow.
    composites : Composites
        Multi-look and colour-by-aspect images.
    views_used : int
        Views in the grid.
    rejected : dict
        Reason for each aspect (degrees) whose view was not used.
    levels : dict
        (σ_r, contrast, estimated) of each view, by stamp.
    sides : list of SilhouetteSides
        Where the shadow ends in each view: what the dimensions are measured on.
    looks : dict of EchoLook
        Where each view is dark round the target, by stamp: what hollows are told by.
    further : list of ObjectResult
        What else stands on the seabed, in the order of the search's evidence.
    left_out : list of LeftOut
        Bodies of the search that are no objects, and why.
    timings_s : dict
        Seconds of wall time by step.
    """

    target: Target | None = None
    sign: SignEvidence | None = None
    grid: VoxelGrid | None = None
    other_grid: VoxelGrid | None = None
    mesh: trimesh.Trimesh | None = None
    dimensions: Dimensions | None = None
    matter: NDArray[np.bool_] | None = None
    matter_mesh: trimesh.Trimesh | None = None
    composites: Composites | None = None
    views_used: int = 0
    rejected: dict[float, str] = field(default_factory=dict)
    levels: dict[int, tuple[float, float, bool]] = field(default_factory=dict)
    sides: list[SilhouetteSides] = field(default_factory=list)
    looks: dict[int, EchoLook] = field(default_factory=dict)
    further: list[ObjectResult] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    timings_s: dict[str, float] = field(default_factory=dict)

    @property
    def objects(self) -> list[ObjectResult]:
        """Every object, the target first (unless its carving left none)."""
        if self.target is None or self.grid is None or self.mesh is None or self.dimensions is None:
            return list(self.further)
        main = ObjectResult(self.target, self.grid, self.mesh, self.dimensions, self.views_used)
        return [main, *self.further]


def process_view(
    sub_apertures: SubApertures, aspect_rad: float, target: Target, p: PipelineParameters
) -> ProcessedView:
    """Take one aspect through every stage of the paper."""
    sub_aperture = sub_apertures.view_of_aspect(aspect_rad)  # 3.1 spectral masking
    shadow = enhance(sub_aperture, target.position_m, p.shadow)  # 3.2 fixed focus shadow enhancement
    levels = view_levels(shadow, p.likelihood)  # 4.2 σ_r and σ_s
    likelihood = outside_likelihood(shadow, p.likelihood, levels)  # 4.2 l_out
    mask = segment_shadow(
        shadow, target.position_m, p.likelihood, levels, reach_m=target.reach_m
    )  # 4.1 silhouette
    sides = silhouette_sides(levels, mask, target.position_m)
    volume = Volume.around(target.position_m, target.size_m, p.carving.voxel_size_m)
    look = EchoLook.of(levels, shadow.info, volume)  # beyond the paper: hollows
    return ProcessedView(sub_aperture, shadow, levels, likelihood, mask, sides, look)


def run(
    image: CoherentImage,
    track: Track,
    parameters: PipelineParameters | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
    on_view: Callable[[ProcessedView], None] | None = None,
    workers: int = 2,
    max_objects: int = MAX_OBJECTS,
    spectrum: Spectrum | None = None,
) -> Result:
    """Reconstruct the target of a circular run, and what else stands there, from their shadows.

    Parameters
    ----------
    image : CoherentImage
        Full-circle coherent image.
    track : Track
        Where the sonar was.
    parameters : PipelineParameters
        Every stage's parameters.
    progress : callable, optional
        Called with (views done, views in all).
    on_view : callable, optional
        Called with every processed view, in order of aspect, to keep or show it.
    workers : int
        Threads.
    max_objects : int
        At most so many bodies of the search are carved, the target among them; nothing of the target's
        result depends on it. A target whose position is given is the only one.
    spectrum : Spectrum, optional
        The image's spectrum, if it was made before: of a run that came as sectors it is what was summed.

    Returns
    -------
    Result
        `result.target` is None where the scene holds no object.

    Raises
    ------
    ParameterError
        If `max_objects` is out of range.
    SpectrumSignError
        If the shadows contradict the stated spectrum sign.
    NoTargetError
        If a target position was given and nothing is there.
    """
    p = parameters or PipelineParameters()
    check_range("max_objects", max_objects, 1, MOST_OBJECTS)
    result, start = Result(), time.perf_counter()

    def lap(step: str) -> None:
        result.timings_s[step] = time.perf_counter() - start - sum(result.timings_s.values())

    spectrum = spectrum or Spectrum.of_image(image, workers)
    lap("spectrum")
    if p.sub_aperture.check_sign:
        result.sign, search = spectrum_sign_evidence(image, track, spectrum=spectrum)
        result.sign.check()
        result.target = choose_target(search, p.target)
    else:
        result.target, search = find_target_and_others(image, track, p.target, spectrum=spectrum)
    others: list[Target] = []
    if search is not None and p.target.target == "auto":
        others, result.left_out = further_targets(search, max_objects)
    further = [FurtherBody(body, p) for body in others]
    lap("target")
    sub_apertures = SubApertures(image, track, p.sub_aperture, spectrum=spectrum)
    target = result.target
    carvers = _carvers(target, p.carving) if target else []

    def make(aspect: float) -> tuple[ProcessedView | View | ViewError, list[FurtherView | ViewError]]:
        try:
            if target is None:
                return sub_apertures.view_of_aspect(aspect), []
            view = process_view(sub_apertures, aspect, target, p)
        except ViewError as error:
            return error, []
        return view, [body.process(view.sub_aperture) for body in further]

    aspects = [float(a) for a in sub_apertures.aspects_rad]
    for done, (aspect, (view, of_others)) in enumerate(in_order(make, aspects, workers), start=1):
        if isinstance(view, ViewError):
            result.rejected[round(math.degrees(aspect), 6)] = str(view)
        elif isinstance(view, View):
            compose(result, view)
        else:
            compose(result, view.sub_aperture)
            _integrate(result, carvers, view)
            for body, one in zip(further, of_others, strict=True):
                body.integrate(one)
            if on_view:
                on_view(view)
        if progress:
            progress(done, len(aspects))
    lap("views")
    if carvers and result.views_used:
        result.grid, result.other_grid = (carver.grid() for carver in carvers)
        correct_heights(result)
        if result.grid.occupied.any():
            result.mesh = mesh_from_grid(result.grid)
            result.dimensions = measure_object(result.grid, result.mesh, result.sides)
    lap("shape")
    open_hollows(result)
    lap("hollows")
    if further:
        _add_objects(result, further)
        lap("objects")
    return result


def correct_heights(result: Result) -> None:
    """Give what was kept of the views the sonar's height over the seabed that the grid was carved over."""
    slope = result.grid.seabed if result.grid is not None else None
    if slope is not None:
        result.sides = [replace(side, info=slope.corrected(side.info)) for side in result.sides]
        looks = result.looks.items()
        result.looks = {stamp: replace(look, info=slope.corrected(look.info)) for stamp, look in looks}


def open_hollows(result: Result) -> None:
    """Tell the matter in a result's grid from hollows that no shadow shows; the grid stays as it is."""
    grid = result.grid
    if grid is None or result.mesh is None or not result.looks:
        return
    result.matter = matter_of(grid, result.looks.values())
    hollow = bool((grid.occupied & ~result.matter).any())
    result.matter_mesh = matter_mesh(grid, result.matter) if hollow else result.mesh


def _add_objects(result: Result, further: list[FurtherBody]) -> None:
    """Add what the further bodies turned out to be, each without what was reported before it."""
    for body in further:
        found, left_out = body.objects([o.grid for o in result.objects])
        result.further += found
        result.left_out += left_out


def _carvers(target: Target, parameters: CarvingParameters) -> list[Carver]:
    """Make the chosen method's carver and the other one's, for comparison (figure 8)."""
    volume = Volume.around(target.position_m, target.size_m, parameters.voxel_size_m)
    return [Carver(volume, parameters), Carver(volume, parameters.other())]


def compose(result: Result, view: View) -> None:
    """Add a view to the run's composites."""
    if result.composites is None:
        result.composites = Composites.for_view(view)
    result.composites.integrate(view)


def _integrate(result: Result, carvers: list[Carver], view: ProcessedView) -> None:
    used = False
    for carver in carvers:
        try:
            integrated = carver.integrate(view.carves(carver.parameters))
        except ViewError as error:
            if carver is carvers[0]:
                result.rejected[round(math.degrees(view.shadow.info.aspect_rad), 6)] = str(error)
            continue
        used |= integrated and carver is carvers[0]
    result.views_used += used
    if used and view.sides is not None:
        result.sides.append(view.sides)
    levels = view.levels
    result.levels[view.shadow.info.stamp_ns] = (levels.seabed_level, levels.contrast, levels.estimated)
    result.looks[view.shadow.info.stamp_ns] = view.look
