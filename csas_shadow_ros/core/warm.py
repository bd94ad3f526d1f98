"""Load the compiled kernels of each stage before the first view needs them.

Numba keeps kernels on disk and loads each when it is first called, and some libraries are imported when they
are first used. A stream's first sectors would wait for all of that, one stage after the other. Pixels of
messages cannot be written, those that a stage hands to the next can: numba compiles a kernel for each.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np

from .geometry import (
    Acoustics,
    GroundGrid,
    ShadowCamera,
    Track,
    View,
    ViewInfo,
    unit_to_sonar,
    view_ground_to_pixel,
)
from .methods import method_named
from .parameters import CarvingParameters, SubApertureParameters

if TYPE_CHECKING:
    from .pipeline import ProcessedView

# Stages are imported where they are warmed: no process loads those of another.

_SIDE, _SPACING_M = 96, 0.02
_ACOUSTICS = Acoustics(60e3, 20e3, 1500.0, 1)
_SONAR_M = (20.0, 0.0, 6.0)
_TARGET_M = (0.0, 0.0)


def _speckle(*shape: int) -> np.ndarray[tuple[int, ...], np.dtype[np.complex64]]:
    rng = np.random.default_rng(0)
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)


def sample_view() -> View:
    """Make a small sub-aperture view: a seabed of speckle, and a shadow behind an echo at the origin."""
    to_pixel = view_ground_to_pixel(0.0, _SPACING_M, _SIDE, _SIDE, _TARGET_M)
    camera = ShadowCamera.from_ground(to_pixel, _SONAR_M, _SIDE, _SIDE)
    info = ViewInfo(1, camera, _ACOUSTICS, 0.0, math.radians(12.0), (-100.0, 0.0))
    pixels = _speckle(_SIDE, _SIDE)
    half = _SIDE // 2
    pixels[half - 6 : half, half - 12 : half + 12] *= 20.0
    pixels[half : half + 30, half - 12 : half + 12] *= 0.05
    return View(info, pixels)


def _shadow_view() -> View:
    """Return the sample's amplitudes, as of an enhanced view."""
    view = sample_view()
    return replace(view, pixels=np.abs(view.pixels).astype(np.float32))


def _both(view: View) -> Iterator[View]:
    """Give a view as the stage before hands it over, and as it comes in a message."""
    yield view
    pixels = view.pixels.copy()
    pixels.flags.writeable = False
    yield replace(view, pixels=pixels)


def _sample(**given: View) -> ProcessedView:
    """Begin with a stage of the sample view."""
    from .parameters import PipelineParameters
    from .pipeline import ProcessedView
    from .shape.volume import Target

    return ProcessedView(Target(_TARGET_M, (0.6, 0.6, 0.3)), PipelineParameters(), **given)


def warm_enhancement() -> None:
    """Enhance a sample view."""
    for view in _both(sample_view()):
        _sample(sub_aperture=view).require("shadow")


def warm_likelihood() -> None:
    """Process a sample view through levels, likelihood and segmentation."""
    for view in _both(_shadow_view()):
        made = _sample(shadow=view)
        for part in ("levels", "likelihood", "mask"):
            made.require(part)


def warm_carving(parameters: CarvingParameters | None = None) -> None:
    """Carve a few voxels with a sample view by a method, and finish them as at the end of a run."""
    from .shape.carving import Carver
    from .shape.explained import count_shadow_pixels
    from .shape.hollows import matter_of
    from .shape.measurement import levels_of_mask, silhouette_sides
    from .shape.mesh import measure, mesh_from_grid
    from .shape.volume import Volume

    p = parameters or CarvingParameters()
    shadow = _shadow_view()
    if p.takes_masks:
        pixels = np.where(shadow.pixels < 0.5, np.uint8(255), np.uint8(0))
        pixels[:, : _SIDE // 2] = 64  # covered pixels: carving looks twice
    else:
        pixels = np.clip(shadow.pixels, 0.0, 1.0)
    view = replace(shadow, pixels=pixels)
    if p.takes_masks:
        silhouette_sides(levels_of_mask(view), view, _TARGET_M)
    carver = Carver(Volume.around(_TARGET_M, (0.6, 0.6, 0.3), 0.05), p)
    for stamp, one in enumerate(_both(view), start=1):
        carver.integrate(replace(one, info=replace(one.info, stamp_ns=stamp)))
    grid = carver.grid()
    occupied = np.zeros(grid.volume.shape, bool)
    occupied[:3, 4:8, 4:8] = True
    grid = replace(grid, occupied=occupied, likelihood=np.where(occupied, 0.0, 1.0).astype(np.float32))
    measure(mesh_from_grid(grid))
    if method_named(p.method).looks_twice:
        carver.shadow_fits([grid])
        carver.leaner()
        voxels = np.ascontiguousarray(np.argwhere(occupied), np.int32)
        count_shadow_pixels(view, grid.volume, voxels, pixels > 0, np.zeros(len(voxels), np.int32))
    for one in _both(shadow):
        made = _sample(shadow=one)
        matter_of(grid, [made.require("look")])
        getattr(made, "sides")  # noqa: B009  (made when it is asked for)


def warm_sub_apertures() -> None:
    """Sum two small sectors, and make a view of the sum.

    In one thread: who loads kernels for others forks them, and a pool of threads may not outlive that.
    """
    from .imaging.subaperture import SubApertures
    from .sectors.sector import Sector
    from .sectors.streaming import SectorSum

    theta = np.linspace(0.0, 2.0 * math.pi, 180, endpoint=False)
    circle = np.column_stack([20.0 * np.cos(theta), 20.0 * np.sin(theta), np.full(theta.size, 6.0)])
    track = Track(np.arange(theta.size) * 1_000_000_000, circle)
    spacing = 0.004
    grid = GroundGrid(_SIDE, _SIDE, spacing, -spacing * _SIDE / 2.0, spacing * _SIDE / 2.0)
    total = SectorSum(workers=1)
    for stamp, aspect in enumerate((0.0, math.radians(30.0)), start=1):
        f_c = _ACOUSTICS.centre_frequency_hz
        k = _ACOUSTICS.ground_wavenumber(f_c, track.grazing_rad) * unit_to_sonar(aspect)
        carrier = (float(k[0]), float(k[1]))
        pixels = _speckle(_SIDE, _SIDE)
        pixels.flags.writeable = stamp == 1
        total.add(Sector(pixels, grid, _ACOUSTICS, stamp, aspect, math.radians(30.0), carrier))
    made = SubApertures(
        total.frame, track, SubApertureParameters(), spectrum=total.spectrum, workers=1
    )
    made.view_of_aspect(0.2)


def warm_composites() -> None:
    """Add a sample view to the images of the circle."""
    from .imaging.composites import Composites

    for view in _both(sample_view()):
        Composites.for_view(view).integrate(view)


def warm_all() -> None:
    """Call every stage's kernels, so that they are compiled or loaded."""
    warm_sub_apertures()
    warm_enhancement()
    warm_likelihood()
    (method,) = (f for f in fields(CarvingParameters) if f.name == "method")
    for name in method.metadata["choices"]:
        warm_carving(CarvingParameters(method=name))
    warm_composites()
