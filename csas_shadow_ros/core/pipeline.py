"""The whole method: a circular run in, a 3-D shape out.

Read this first. Steps of the paper, and what holds their equations: 3.1 `SubApertures.view_of_aspect`, 3.2
`enhance`, 4.1 `segment_shadow`, 4.2 `likelihood.l_out`; carving, 4.1 and 4.2, `carving.Carver.integrate`, to
which `Reconstruction.feed` leads; 4.2 threshold, `threshold.object_threshold`; 4.1 surface,
`mesh.mesh_from_grid`. `reference.py` has all but these two literally. `run` strings them together; the node
graph takes its views through the same properties and feeds the same `Reconstruction`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property
from typing import Any

from .errors import ViewError
from .geometry import CoherentImage, Track, View, passage
from .imaging.enhancement import enhance
from .imaging.likelihood import Levels, outside_likelihood, view_levels
from .imaging.segmentation import segment_shadow
from .imaging.subaperture import Spectrum, SubApertures
from .parameters import MAX_OBJECTS, PipelineParameters
from .reconstruction import Reconstruction
from .search.decision import Decision, decide_by_image
from .shape.hollows import EchoLook
from .shape.measurement import SilhouetteSides, silhouette_sides
from .shape.result import Result
from .shape.volume import Target


class ProcessedView:
    """One view on its way through the stages: each stage is computed once, when first requested.

    Parameters
    ----------
    target : Target or None
        The body that it is focused on; None: no stage that depends on one can be asked for.
    p : PipelineParameters
        Of all stages.
    sub_aperture, shadow, likelihood, shadow_mask : View, optional
        The stages that are there; one before the first of them is None.
    """

    def __init__(self, target: Target | None, p: PipelineParameters, **given: View) -> None:
        self.target, self.p = target, p
        #: Of the first view that is there.
        self.info = next((view.info for view in given.values()), None)
        self.sub_aperture = given.pop("sub_aperture", None)
        # A stage that is given is never made.
        self.__dict__.update({stage.removeprefix("shadow_"): view for stage, view in given.items()})

    def require(self, part: str) -> Any:
        """Return a part, or raise a ViewError if its input is missing."""
        if (made := getattr(self, part)) is None:
            raise ViewError(f"a view's {part} cannot be made: its input is missing")
        return made

    @cached_property
    def shadow(self) -> View | None:
        """Fixed focus shadow enhancement (3.2): amplitude, shape (rows, cols)."""
        if self.sub_aperture is None or self.target is None:
            return None
        return enhance(self.sub_aperture, self.target.position_m, self.p.shadow)

    @cached_property
    def levels(self) -> Levels | None:
        """σ_r and σ_s of the view (4.2)."""
        return None if self.shadow is None else view_levels(self.shadow, self.p.likelihood)

    @cached_property
    def likelihood(self) -> View | None:
        """l_out = (p_r / (p_r + p_s))² (4.2)."""
        return self.shadow and outside_likelihood(self.shadow, self.p.likelihood, self.levels)

    @cached_property
    def mask(self) -> View | None:
        """Return the silhouette (4.1)."""
        if self.shadow is None or self.target is None:
            return None
        position, reach_m = self.target.position_m, self.target.reach_m
        return segment_shadow(self.shadow, position, self.p.likelihood, self.levels, reach_m=reach_m)

    @cached_property
    def sides(self) -> SilhouetteSides | None:
        """Edges of the silhouette, to a fraction of a pixel (beyond the paper: dimensions)."""
        if self.levels is None or self.mask is None or self.target is None:
            return None
        return silhouette_sides(self.levels, self.mask, self.target.position_m)

    @cached_property
    def look(self) -> EchoLook | None:
        """Dark pixels of the view round the target (beyond the paper: hollows)."""
        if self.levels is None or self.shadow is None or self.target is None:
            return None
        return EchoLook.of(self.levels, self.shadow.info, self.target.volume(self.p.carving.voxel_size_m))


def process(view: View, stage: str, decision: Decision, p: PipelineParameters) -> list[ProcessedView]:
    """Process one view from its stage on, for the target and, from sub-apertures, the other bodies."""
    return [ProcessedView(body, p, **{stage: view}) for body in decision.bodies_of(view.info, stage)]


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
    run_ns: int | None = None,
) -> Result:
    """Reconstruct the target of a circular run, and further objects, from their shadows.

    `progress` is called with (views done, views in all), `on_view` with every view in order of aspect. At
    most `max_objects` bodies are carved, each knowing where the others' echoes lie. `spectrum` is the
    image's, if it was made before; `run_ns` names the run (by default: stamp of the track's first pose).

    Raises
    ------
    ParameterError, SpectrumSignError, NoTargetError
        If `max_objects` is out of range, the shadows contradict the stated spectrum sign, or nothing is at
        a target position that was given.
    """
    p = parameters or PipelineParameters()
    began = time.perf_counter()
    name = int(track.stamps_ns[0]) if run_ns is None else run_ns
    track = passage(track, image_ns=image.stamp_ns or None).track  # what lies off the circle tells nothing
    spectrum = spectrum or Spectrum.of_image(image, workers)
    decision = decide_by_image(image, track, p, spectrum=spectrum, max_objects=max_objects)
    views = SubApertures(image, track, p.sub_aperture, spectrum=spectrum)  # 3.1 spectral masking
    reconstruction = Reconstruction(decision, p, run_ns=name)
    reconstruction.timings_s["search"] = time.perf_counter() - began
    reconstruction.feed(
        [float(aspect) for aspect in views.aspects_rad],
        lambda aspect: process(views.view_of_aspect(aspect), "sub_aperture", decision, p),
        len(views.aspects_rad),
        progress=progress,
        on_view=on_view,
        workers=workers,
    )
    return reconstruction.result()  # 4 carving, surface extraction; sizes and hollows


__all__ = ["ProcessedView", "Result", "process", "run"]
