#!/usr/bin/env python3
"""Measure the figures that ``docs/method.md`` states, on simulated runs.

    python docs/measure.py fast            # the fast path against the literal steps of the paper
    python docs/measure.py search [TARGET]  # target search and spectrum sign
    python docs/measure.py carve [TARGET]  # what enhancement, echo, support and threshold each do
    python docs/measure.py weak [TARGET]   # what segmentation and levels do at a contrast of 6 dB
    python docs/measure.py hollows [TARGET]  # what echoes tell of hollows, and two ways that were not taken
    python docs/measure.py sizes [TARGET]   # what each step of the measures does for length, width and height
    python docs/measure.py wrong [TARGET]   # what wrong geometry costs: the most that an estimate could gain

Every run is of the `standard` profile, seed 1, of 180 views (2° steps) but for
`fast`, `search`, `weak` (seed 2, turned by 33°, 90 views) and `sizes` (the accuracy benchmark's three seeds
and poses, and four more; 120 views); IoU is
against the shadow hull, the voxels that perfect silhouettes would leave, where nothing else is said.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import scipy.ndimage
import trimesh
from numpy.typing import NDArray

from csas_shadow_ros.core import reconstruction, reference
from csas_shadow_ros.core.geometry import ShadowCamera, Track, View, ViewInfo
from csas_shadow_ros.core.imaging import likelihood, segmentation
from csas_shadow_ros.core.imaging.enhancement import enhance, focus_range
from csas_shadow_ros.core.imaging.likelihood import Levels, box_mean
from csas_shadow_ros.core.imaging.local_means import LocalMeans
from csas_shadow_ros.core.imaging.mask_codes import MASK_COVERED, MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN
from csas_shadow_ros.core.imaging.subaperture import Spectrum, SubApertures
from csas_shadow_ros.core.later_stages import run_views
from csas_shadow_ros.core.parameters import (
    CarvingParameters,
    PipelineParameters,
    ShadowParameters,
    SubApertureParameters,
    TargetParameters,
)
from csas_shadow_ros.core.pipeline import ProcessedView, run
from csas_shadow_ros.core.search.bodies import SignEvidence, spectrum_sign_evidence
from csas_shadow_ros.core.shape import cap, measurement
from csas_shadow_ros.core.shape.carving import Carver
from csas_shadow_ros.core.shape.hollows import EchoLook, _looks, _surface
from csas_shadow_ros.core.shape.layover import layover_per_metre
from csas_shadow_ros.core.shape.measurement import SilhouetteSides
from csas_shadow_ros.core.shape.mesh import measure
from csas_shadow_ros.core.shape.threshold import occupied_voxels, supported
from csas_shadow_ros.core.shape.volume import Target, Volume, VoxelGrid
from csas_shadow_ros.simulation import Faults, simulate
from csas_shadow_ros.simulation.hull import iou, shadow_hull, voxelise_truth
from csas_shadow_ros.simulation.scene import SceneModel
from csas_shadow_ros.simulation.targets import box, cone, join_bodies

TARGETS = ("box", "cone", "tyre", "sphere", "cylinder", "rock", "frame", "l_shape")
SEED = 1
#: What `hollows` looks at if nothing is named: what is hollow, then what is not, then what returns nothing.
HOLLOW = ("tyre", "ring", "tub", "open_box", "frame", "frame_grid", "l_shape")
SOLID = ("box", "cone", "cylinder", "sphere", "rock", "smooth_box", "smooth_cone")
FINE = 4  # pixels of the literal path, and of the image, in one of the fast path's


def fast() -> None:
    """Time one view both ways, and compare them."""
    made = simulate("standard", "box", seed=SEED)
    image, track, target = made.image, made.track, (0.0, 0.0)
    start = time.perf_counter()
    spectrum = Spectrum.of_image(image, workers=1)
    print(f"spectrum of {image.grid.shape}, once a run: {(time.perf_counter() - start) * 1e3:.0f} ms")

    default = SubApertures(image, track, spectrum=spectrum)
    enhance(default.view_of_aspect(0.0), target)  # compiles
    aspects = np.radians(np.arange(5.0, 360.0, 15.0))
    start = time.perf_counter()
    views = [default.view_of_aspect(a) for a in aspects]
    middle = time.perf_counter()
    shadows = [enhance(v, target) for v in views]
    end = time.perf_counter()
    each = (middle - start) / len(aspects), (end - middle) / len(aspects)
    print(f"views of {default.size}² pixels of {default.spacing_m * 1e3:.2f} mm, one thread:")
    print(f"  sub-aperture {each[0] * 1e3:.1f} ms, enhancement {each[1] * 1e3:.1f} ms")
    before, after = (float(np.mean([np.isfinite(v.pixels).mean() for v in vs])) for vs in (views, shadows))
    print(f"  known pixels: {before:.1%} of a view before enhancement, {after:.1%} after (valid margins)")

    parameters = SubApertureParameters(spacing_m=FINE * image.grid.spacing_m)
    sub_apertures = SubApertures(image, track, parameters, spectrum=spectrum)
    view = sub_apertures.view_of_aspect(math.radians(33.0))
    shadow = enhance(view, target)
    info = view.info
    finer = info.camera.ground_to_pixel.copy()
    finer[:2] *= FINE
    camera = ShadowCamera.from_ground(finer, info.camera.sonar_m, *(FINE * n for n in info.camera.shape))
    start = time.perf_counter()
    literal = reference.sub_aperture(image, info.aspect_rad, info.aperture_rad)
    literal = reference.rotate_to_view(literal, image, camera, info.aspect_rad)
    focused = reference.enhance(literal, image, camera, info.aspect_rad, focus_range(info, target))
    seconds = time.perf_counter() - start
    print(f"literal steps at full size: {seconds:.2f} s, {seconds / sum(each):.0f} times the fast path")
    inside = scipy.ndimage.binary_erosion(np.isfinite(shadow.pixels), iterations=20)
    for name, ours, theirs in (("sub-aperture", view, literal), ("enhanced", shadow, focused)):
        a, b = np.abs(ours.pixels), np.abs(theirs[::FINE, ::FINE])
        error = math.sqrt(np.mean((a - b)[inside] ** 2) / np.mean(b[inside] ** 2))
        print(f"  {name}: amplitudes differ by {error:.1e} of their rms, 20 pixels off the borders")
    print(f"  kernel interpolation: {_kernel_error(sub_apertures, view):.1e} of the rms, against exact sums")


def _kernel_error(sub_apertures: SubApertures, view: View) -> float:
    """Compare 400 pixels of a baseband view with the exact sum over the wedge's wavenumbers."""
    spectrum, grid = sub_apertures.spectrum, sub_apertures.grid
    rows, cols = spectrum.values.shape
    ky = -2 * math.pi * np.fft.fftfreq(rows, grid.spacing_m)[:, None]
    kx = 2 * math.pi * np.fft.fftfreq(cols, grid.spacing_m)[None, :]
    k, angle = np.hypot(kx, ky), np.arctan2(ky, kx)
    low, high = sub_apertures.wedge_edges(view.info.aspect_rad)
    wedge = (k >= sub_apertures.band[0]) & (k <= sub_apertures.band[1]) & (angle >= low) & (angle < high)
    values = spectrum.values[wedge].astype(np.complex128)
    k_x, k_y = np.broadcast_to(kx, k.shape)[wedge], np.broadcast_to(ky, k.shape)[wedge]
    v, u = np.nonzero(np.isfinite(view.pixels))
    some = np.random.default_rng(SEED).choice(len(u), 400, replace=False)
    ground = view.info.camera.pixel_to_ground[:2] @ np.stack([u[some], v[some], np.ones(400)])
    x, y = ground
    phase = np.outer(x - grid.x_min_m, k_x) + np.outer(y - grid.y_max_m, k_y)
    carrier = view.info.carrier_rad_m
    exact = (np.exp(1j * phase) @ values) * np.exp(-1j * (carrier[0] * x + carrier[1] * y))
    error = view.pixels[v[some], u[some]] - exact
    return float(np.sqrt(np.mean(np.abs(error) ** 2) / np.mean(np.abs(exact) ** 2)))


def search(names: tuple[str, ...]) -> None:
    """Print what the search finds, and the evidence for either spectrum sign."""
    for name in names:
        made = simulate("standard", name, seed=SEED)
        start = time.perf_counter()
        evidence, found = spectrum_sign_evidence(made.image, made.track)
        print(f"{name}: {time.perf_counter() - start:.1f} s")
        _print_search(evidence, found.best if found else None, made.truth.dims_m)


def _print_search(evidence: SignEvidence, best: Target | None, true_m: tuple[float, ...]) -> None:
    stated, other = evidence.stated_evidence, evidence.other_evidence
    print(f"  sign: evidence {stated:.1e} m⁴ as stated, {other:.1e} m⁴ the other way: {evidence.verdict}")
    if best is None:
        print("  no object")
        return
    size, true = (" × ".join(f"{s:.2f}" for s in sizes) for sizes in (best.size_m, true_m))
    print(f"  target {math.hypot(*best.position_m):.2f} m off its place, volume {size} m for {true} m")


def _mixture(local: LocalMeans, start_db: float) -> tuple[float, float] | None:
    """Fit two exponentials to the powers of a view (Rayleigh amplitudes) by expectation-maximisation.

    In place of `likelihood.fit_contrast`: refused where the contrast is more than 6 dB off the hypothesis, or
    the shadow takes less than a thousandth of the view.
    """
    values = local.power[local.known][::7].astype(np.float64)
    values = values[values < 6.0]  # the rest is echoes
    share, shadow, seabed = 0.1, 10.0 ** (-start_db / 10.0), 1.0
    for _ in range(100):
        dark = share / shadow * np.exp(-values / shadow)
        dark /= dark + (1.0 - share) / seabed * np.exp(-values / seabed)
        share = float(dark.mean())
        shadow = max(float((dark * values).sum() / dark.sum()), 1e-6)
        seabed = float(((1.0 - dark) * values).sum() / (1.0 - dark).sum())
    contrast_db = 10.0 * math.log10(seabed / shadow)
    if abs(contrast_db - start_db) > 6.0 or share < 1e-3:
        return None
    return 10.0 ** (contrast_db / 20.0), share


#: What segmentation and levels do, each left out or done otherwise in turn.
VIEWS_WITHOUT: dict[str, tuple[Any, dict[str, Any]]] = {
    "  square averaging box": (segmentation, {"_HALF_CELLS": (1.0, 1.0)}),
    "  far end not put back": (segmentation, {"_drawn_down": lambda dark, _: dark}),
    "  contrast hypothesis alone": (likelihood, {"fit_contrast": lambda *_: None}),
    "  levels by a mixture fit": (likelihood, {"fit_contrast": _mixture}),
}


@contextlib.contextmanager
def patched(module: Any, **values: Any) -> Iterator[None]:
    """Replace names of a module for a while."""
    before = {name: getattr(module, name) for name in values}
    for name, value in values.items():
        setattr(module, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(module, name, value)


class _Variants:
    """Carvers of one volume, each fed another reading of the same views."""

    def __init__(self) -> None:
        self.views: list[tuple[View, View, NDArray[np.bool_]]] = []

    def __call__(self, view: ProcessedView) -> None:
        levels = view.levels
        self.views.append((view.mask, view.likelihood, levels.known))

    def masks(self, unknown: str) -> list[View]:
        """Return the masks as they are, with the bright echo alone unknown, or nothing but off-image."""
        out = []
        for mask, _, known in self.views:
            pixels = mask.pixels.copy()
            if unknown != "zone":
                pixels[pixels == MASK_COVERED] = MASK_OUTSIDE
            if unknown == "none":
                pixels[(pixels == MASK_UNKNOWN) & known] = MASK_OUTSIDE
            out.append(replace(mask, pixels=pixels))
        return out


def _carve(views: list[View], volume: Volume, method: str) -> Carver:
    carver = Carver(volume, CarvingParameters(method=method))
    for view in views:
        if view.pixels.dtype != np.uint8 or (view.pixels == MASK_SHADOW).any():
            carver.integrate(view)
    return carver


def carve(names: tuple[str, ...]) -> None:
    """Print IoU with the shadow hull for the default and with one thing changed at a time."""
    table: dict[str, list[str]] = {}
    for name in names:
        made = simulate("standard", name, seed=SEED)
        keep = _Variants()
        parameters = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=2.0))
        result = run(made.image, made.track, parameters, on_view=keep)
        if result.grid is None or result.target is None or result.sign is None:
            raise SystemExit(f"nothing was found of {name}")
        print(f"{name}: {result.views_used} views")
        _print_search(result.sign, result.target, made.truth.dims_m)
        volume = result.grid.volume
        hull = shadow_hull(made.truth.target, [v[0].info.camera.sonar_m for v in keep.views], volume)
        grid = result.grid
        rows: dict[str, float] = {"default (consensus)": iou(grid.occupied, hull)}
        both = _carve(keep.masks("zone"), volume, "consensus")
        rows["  one look only"] = iou(both.first_look().occupied, hull)
        enough = grid.views >= 0.25 * grid.views.max()
        known = np.where(enough, grid.likelihood, np.float32(np.nan))
        rows["  high tops unknown"] = iou(occupied_voxels(known, grid.threshold, "consensus"), hull)
        for label, unknown in (("  echo alone unknown", "echo"), ("  echo read as outside", "none")):
            rows[label] = iou(_carve(keep.masks(unknown), volume, "consensus").grid().occupied, hull)
        with np.errstate(invalid="ignore"):
            dark = grid.likelihood < grid.threshold
        rows["  no support"] = iou(_largest(dark), hull)
        rows["  supported whatever is seen"] = iou(_largest(supported(dark, grid.likelihood, 2.0)), hull)
        rows["  best threshold"] = max(
            iou(occupied_voxels(grid.likelihood, t, "consensus"), hull) for t in np.arange(0.005, 0.15, 0.005)
        )
        rows["hard"] = iou(_carve(keep.masks("zone"), volume, "hard").grid().occupied, hull)
        soft = _carve([v[1] for v in keep.views], volume, "soft")
        rows["soft"] = iou(soft.grid().occupied, hull)
        mean = soft.likelihood()
        rows["  best threshold (soft)"] = max(
            iou(occupied_voxels(mean, t, "soft"), hull) for t in np.arange(0.02, 0.4, 0.02)
        )
        bare = run(made.image, made.track, _given(result.target, "none"))
        if bare.grid is None:
            raise SystemExit(f"nothing was found of {name} without enhancement")
        rows["no enhancement (consensus)"] = iou(bare.grid.occupied, hull)
        for label, (module, patch) in VIEWS_WITHOUT.items():
            with patched(module, **patch):
                views = run(made.image, made.track, _given(result.target))
            rows[label] = 0.0 if views.grid is None else iou(views.grid.occupied, hull)
        for label, value in rows.items():
            table.setdefault(label, []).append(f"{value:10.2f}")
    print(f"{'IoU with the shadow hull':28}" + "".join(f"{n:>10}" for n in names))
    for label, values in table.items():
        print(f"{label:28}" + "".join(values))


def weak(names: tuple[str, ...]) -> None:
    """Print IoU with the shadow hull at a contrast of 6 dB, with one thing done otherwise at a time."""
    variants = {"default": (segmentation, {}), **VIEWS_WITHOUT}
    print(f"{'IoU with the shadow hull':28}" + "".join(f"{n:>10}" for n in names))
    found: dict[str, list[float]] = {label: [] for label in variants}
    for name in names:
        faults = Faults(contrast_db=6.0)
        made = simulate("standard", name, seed=2, position_m=(0.15, -0.1), heading_deg=33.0, faults=faults)
        every = max(1, len(made.truth.sonar_m) // 360)
        for label, (module, patch) in variants.items():
            with patched(module, **patch):
                parameters = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=4.0))
                grid = run(made.image, made.track, parameters).grid
            value = 0.0
            if grid is not None:
                hull = shadow_hull(made.truth.target, made.truth.sonar_m[::every], grid.volume)
                value = iou(grid.occupied, hull)
            found[label].append(value)
    for label, values in found.items():
        print(f"{label:28}" + "".join(f"{value:10.3f}" for value in values))


def _given(target: Target, enhancement: str = "exact") -> PipelineParameters:
    """Return parameters that carve the same volume again."""
    return PipelineParameters(
        sub_aperture=SubApertureParameters(step_deg=2.0, check_sign=False),
        shadow=ShadowParameters(enhancement=enhancement),
        target=TargetParameters("given", target.position_m, target.size_m),
    )


def _walls(floor_m: float) -> trimesh.Trimesh:
    """Make a box of 0.8 × 0.5 × 0.35 m that is open above, with walls of 5 cm and a floor of that height."""
    length, width, height, wall = 0.8, 0.5, 0.35, 0.05
    inner = length - 2 * wall, width - 2 * wall
    parts = [((length, wall, height), (0.0, s * (width - wall) / 2)) for s in (-1, 1)]
    parts += [((wall, inner[1], height), (s * (length - wall) / 2, 0.0)) for s in (-1, 1)]
    if floor_m:
        parts.append(((*inner, floor_m), (0.0, 0.0)))
    bodies = []
    for size, (x, y) in parts:
        body = trimesh.creation.box(size)
        body.apply_translation((x, y, size[2] / 2))
        bodies.append(body)
    return join_bodies(bodies)


def _hollow_target(name: str) -> trimesh.Trimesh | str:
    """Return a target of `hollows`: some that the simulation does not name."""
    own = {
        "ring": lambda: trimesh.creation.torus(0.4, 0.08, major_sections=96, minor_sections=24),
        "tub": lambda: _walls(0.24),
        "open_box": lambda: _walls(0.0),
        "smooth_box": box,
        "smooth_cone": cone,
    }
    return own[name]() if name in own else name


def _without_top_echoes(model: SceneModel, *arguments: Any) -> None:
    """Scatter as the simulation does, but from faces that look up: a smooth top returns nothing."""
    _SCATTER(model, *arguments)
    model._amplitudes = np.where(model._normals[:, 2] > 0.95, 0, model._amplitudes)


_SCATTER = SceneModel._scatter_on


def _brightness(grid: VoxelGrid, views: list[tuple[ViewInfo, Levels]]) -> NDArray[np.float64]:
    """Return the mean power (4 at most) over all views where each voxel is imaged, in view or not."""
    volume, at = grid.volume, np.argwhere(grid.occupied)
    x, y, z = volume.x_m[at[:, 2]], volume.y_m[at[:, 1]], volume.z_m[at[:, 0]]
    total, count = np.zeros(len(at)), np.zeros(len(at))
    for info, levels in views:
        power = np.minimum(box_mean(levels.power, levels.known, (1, 1)), 4.0)
        shift = layover_per_metre(info)
        place = np.stack([x + z * shift[0], y + z * shift[1], np.ones_like(x)])
        u, v, _ = np.floor(info.camera.ground_to_pixel @ place + 0.5).astype(int)
        inside = (u >= 0) & (v >= 0) & (u < power.shape[1]) & (v < power.shape[0])
        inside[inside] &= levels.known[v[inside], u[inside]]
        total[inside] += power[v[inside], u[inside]]
        count += inside
    return np.asarray(total / np.maximum(count, 1.0))


def _open_columns(grid: VoxelGrid, matter: NDArray[np.bool_], looks: list[EchoLook]) -> NDArray[np.bool_]:
    """Take hollows for open down to the first voxel that is seen: no view sees further down."""
    voxels = np.argwhere(_surface(matter)).astype(np.int32)
    seen, _ = _looks(voxels, matter, grid.volume, looks)
    lit = np.zeros_like(matter)
    lit[tuple(voxels[seen >= 0.1 * len(looks)].T)] = True
    gone = grid.occupied & ~matter
    column = scipy.ndimage.binary_opening(gone.sum(axis=0) >= 2, np.ones((3, 3), bool))
    out, opened = matter.copy(), np.zeros_like(column)
    for k in range(matter.shape[0] - 1, -1, -1):
        opened = (opened | (gone[k] & column)) & ~lit[k]
        out[k] &= ~opened
    return out


def hollows(names: tuple[str, ...]) -> None:
    """Print IoU with the truth before and after hollows are opened, and for two ways that were not taken."""
    levels = np.arange(0.1, 1.01, 0.1)
    print(
        f"{'IoU with the truth':14}{'hull':>8}{'matter':>8}{'columns':>9}{'brightness 0.3':>16}"
        f"{'its best':>10}   opened, time, memory; IoU with the shadow hull"
    )
    for name in names:
        SceneModel._scatter_on = _without_top_echoes if name.startswith("smooth") else _SCATTER  # type: ignore
        made = simulate("standard", _hollow_target(name), seed=SEED)
        seen: list[tuple[ViewInfo, Levels]] = []

        def keep(view: ProcessedView, seen: list[tuple[ViewInfo, Levels]] = seen) -> None:
            seen.append((view.shadow.info, view.levels))

        parameters = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=2.0))
        result = run(made.image, made.track, parameters, on_view=keep)
        grid, matter = result.grid, result.matter
        if grid is None or matter is None:
            raise SystemExit(f"nothing was found of {name}")
        truth = voxelise_truth(made.truth.target, grid.volume)
        hull = shadow_hull(made.truth.target, [info.camera.sonar_m for info, _ in seen], grid.volume)
        looks = list(result.looks.values())
        columns = _open_columns(grid, matter, looks)
        bright, scores = _brightness(grid, seen), {}
        for level in levels:
            kept = grid.occupied.copy()
            kept[grid.occupied] = bright >= level
            scores[round(float(level), 1)] = iou(kept, truth)
        best = max(scores, key=lambda level: scores[level])
        opened = int(np.count_nonzero(grid.occupied & ~matter))
        kilobytes = float(np.mean([len(look.packed) for look in looks])) / 1e3
        print(
            f"{name:18}{iou(grid.occupied, truth):8.3f}{iou(matter, truth):8.3f}{iou(columns, truth):9.3f}"
            f"{scores[0.3]:16.3f}{scores[best]:10.3f}   {opened} voxels,"
            f" {result.timings_s['hollows']:.2f} s, {len(looks)} looks of {kilobytes:.1f} kB;"
            f" {iou(grid.occupied, hull):.3f} -> {iou(matter, hull):.3f}, best at {best}",
            flush=True,
        )


def _reported(track: Track, tilt_deg: float = 0.0, offset_m: float = 0.0) -> Track:
    """Return what a track reports over a seabed that is tilted along x, or lies deeper, unknown to it."""
    positions = np.array(track.positions_m, dtype=np.float64)
    positions[:, 2] -= offset_m + math.tan(math.radians(tilt_deg)) * positions[:, 0]
    return Track(track.stamps_ns, positions)


#: What is wrong with a run, and nothing else: faults of the simulation, and what the track reports.
WRONG: dict[str, tuple[Faults, dict[str, float]]] = {
    "nothing": (Faults(), {}),
    "sound speed 1 % too high": (Faults(sound_speed_error=0.01), {}),
    "sound speed 1 % too low": (Faults(sound_speed_error=-0.01), {}),
    "seabed tilted by 1 deg": (Faults(), {"tilt_deg": 1.0}),
    "seabed tilted by 2 deg": (Faults(), {"tilt_deg": 2.0}),
    "seabed 0.5 m deeper": (Faults(), {"offset_m": 0.5}),
    "seabed 1 m deeper": (Faults(), {"offset_m": 1.0}),
    "phase error of 1 rad": (Faults(phase_error_rad=1.0), {}),
}


def wrong(names: tuple[str, ...]) -> None:
    """Print IoU with the true geometry's shadow hull when the geometry that is told is wrong."""
    print(f"{'IoU with the shadow hull':28}" + "".join(f"{n:>10}" for n in names) + "      mean   height")
    for label, (faults, seabed) in WRONG.items():
        found, heights = [], []
        for name in names:
            made = simulate("standard", name, seed=SEED, faults=faults)
            parameters = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=2.0))
            result = run(made.image, _reported(made.track, **seabed), parameters)
            if result.grid is None or result.dimensions is None:
                found.append(0.0)
                continue
            every = max(1, len(made.truth.sonar_m) // 360)
            hull = shadow_hull(made.truth.target, made.truth.sonar_m[::every], result.grid.volume)
            found.append(iou(result.grid.occupied, hull))
            heights.append(result.dimensions.height_m / made.truth.dims_m[2] - 1.0)
        print(
            f"{label:28}" + "".join(f"{value:10.3f}" for value in found) + f"{np.mean(found):10.3f}"
            f"{100.0 * float(np.mean(heights or [math.nan])):+7.1f} %",
            flush=True,
        )


#: Seed of a run, where its target lies and how it is turned: the first three are the accuracy benchmark's.
POSES = {
    1: ((0.0, 0.0), 0.0),
    2: ((0.15, -0.1), 33.0),
    3: ((-0.2, 0.25), 71.0),
    4: ((0.1, 0.2), 17.0),
    5: ((-0.12, -0.22), 118.0),
    6: ((0.22, -0.05), 52.0),
    7: ((-0.07, 0.16), 143.0),
}
_BENCHMARK_SEEDS = (1, 2, 3)


def _own_support(sides: Sequence[SilhouetteSides]) -> NDArray[np.float64]:
    return np.array([support for side in sides for support in side.support_m], dtype=np.float64)


#: The measures with one step left out or taken otherwise.
MEASURES: dict[str, dict[Any, dict[str, Any]]] = {
    "default": {},
    "  each view alone": {measurement: {"agreed_support": _own_support}},
    "  the sides beside alone": {measurement: {"_ALL_SIDES": 0.0}},
    "  no foot": {measurement: {"_FLARE_CELLS": math.inf}},
    "  no upright walls": {measurement: {"_MOST": 1.0}},
    "  every top flat": {measurement: {"_MOST": 1.0}, cap: {"_DOME_SLACK": (1.0, 1.0 + 1e-9)}},
}


def sizes(names: tuple[str, ...]) -> None:
    """Print how many dimensions are within 5 % or a voxel, with one step of measuring changed at a time."""
    errors: dict[tuple[str, bool], list[list[float]]] = {}
    within: dict[tuple[str, bool], list[bool]] = {}
    for name in names:
        for seed, (position, heading) in POSES.items():
            made = simulate("standard", name, seed=seed, position_m=position, heading_deg=heading)
            parameters = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=3.0))
            result = run(made.image, made.track, parameters, max_objects=1)
            if result.grid is None or result.mesh is None:
                raise SystemExit(f"nothing was found of {name}, seed {seed}")
            true = measure(made.truth.target)
            found = {"surface": measure(result.mesh)}
            for label, patches in MEASURES.items():
                with contextlib.ExitStack() as stack:
                    for module, patch in patches.items():
                        stack.enter_context(patched(module, **patch))
                    found[label] = measurement.measure_object(result.grid, result.mesh, result.sides)
            for label, sizes_found in found.items():
                off = [
                    getattr(sizes_found, extent) - getattr(true, extent)
                    for extent in ("length_m", "width_m", "height_m")
                ]
                allowed = [
                    max(0.05 * getattr(true, extent), result.grid.volume.voxel_size_m)
                    for extent in ("length_m", "width_m", "height_m")
                ]
                key = label, seed in _BENCHMARK_SEEDS
                errors.setdefault(key, []).append(off)
                within.setdefault(key, []).extend(
                    abs(error) <= bound for error, bound in zip(off, allowed, strict=True)
                )
                if label == "default":
                    print(f"{name:10} seed {seed}" + "".join(f"{100 * e:+7.2f}" for e in off), flush=True)
    for of_benchmark in (True, False):
        runs = "the benchmark's runs" if of_benchmark else "further runs"
        print(f"{runs}: within 5 % or a voxel; mean absolute errors of L, W, H in cm")
        for label in ("surface", *MEASURES):
            key = label, of_benchmark
            mean = 100.0 * np.abs(errors[key]).mean(axis=0)
            print(
                f"{label:28}{sum(within[key]):4} of {len(within[key])}"
                + "".join(f"{value:8.2f}" for value in mean)
            )


def _misplaced(views: list[View], cells: float) -> list[View]:
    """Return views of which each lies beside its place, down-range and across, by so many cells (1σ)."""
    rng, out = np.random.default_rng(SEED), []
    for view in views:
        camera, cell_px = view.info.camera, view.info.cell_px
        to_pixel = camera.ground_to_pixel.copy()
        to_pixel[:2, 2] += rng.normal(0.0, cells, 2) * cell_px[::-1]
        moved = ShadowCamera.from_ground(to_pixel, camera.sonar_m, *camera.shape)
        out.append(replace(view, info=replace(view.info, camera=moved)))
    return out


def _take_shadow(views: list[View], view: ProcessedView) -> None:
    views.append(view.require("shadow"))


def misplaced(names: tuple[str, ...]) -> None:
    """Print shapes of views that lie beside one another, as they are and put together across range."""
    print(f"{'IoU with the hull, L, W, H in m':36}" + "".join(f"{name:>28}" for name in names))
    told: dict[str, list[str]] = {}
    for name in names:
        made = simulate("standard", name, seed=SEED)
        parameters = PipelineParameters(sub_aperture=SubApertureParameters(step_deg=3.0))
        views: list[View] = []
        take = partial(_take_shadow, views)
        found = run(made.image, made.track, parameters, max_objects=1, on_view=take)
        hull = partial(shadow_hull, made.truth.target, made.truth.sonar_m[::6])
        results = {"as they are": found}
        for cells in (0.7, 1.2):
            moved = _misplaced(views, cells)
            again = partial(run_views, partial(list, moved), "shadow", parameters, decision=found.decision)
            with patched(reconstruction, shifts_across=lambda *_: {}):
                results[f"beside by {cells} cells"] = again()
            results[f"beside by {cells} cells, put together"] = again()
        for label, result in results.items():
            d, grid = result.dimensions, result.grid
            if d is None or grid is None:
                told.setdefault(label, []).append("no object")
                continue
            share = iou(grid.occupied, hull(grid.volume))
            text = f"{share:.2f}  {d.length_m:.2f} {d.width_m:.2f} {d.height_m:.2f}"
            told.setdefault(label, []).append(text)
    for label, texts in told.items():
        print(f"{label:36}" + "".join(f"{text:>28}" for text in texts))


def _largest(dark: NDArray[np.bool_]) -> NDArray[np.bool_]:
    labels, count = scipy.ndimage.label(dark, np.ones((3, 3, 3), bool))
    if not count:
        return dark
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.asarray((sizes >= 0.05 * sizes.max())[labels] & dark)


def main(argv: list[str] | None = None) -> int:
    """Run one of the measurements."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument(
        "what", choices=("fast", "search", "carve", "weak", "hollows", "sizes", "wrong", "misplaced")
    )
    parser.add_argument("target", nargs="*", help="for all but fast (default: all)")
    options = parser.parse_args(argv)
    if options.what == "fast":
        fast()
    elif options.what == "search":
        search(tuple(options.target) or (*TARGETS, "empty"))
    elif options.what == "hollows":
        hollows(tuple(options.target) or (*HOLLOW, *SOLID))
    elif options.what == "weak":
        weak(tuple(options.target) or ("box", "tyre", "frame", "cylinder"))
    elif options.what == "sizes":
        sizes(tuple(options.target) or TARGETS)
    elif options.what == "wrong":
        wrong(tuple(options.target) or TARGETS)
    elif options.what == "misplaced":
        misplaced(tuple(options.target) or ("box", "cone", "rock", "frame", "l_shape"))
    else:
        carve(tuple(options.target) or TARGETS)
    return 0


if __name__ == "__main__":
    sys.exit(main())
