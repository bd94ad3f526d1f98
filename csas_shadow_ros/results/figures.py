"""The paper's figures, of a run: PNG files that are drawn from what the method leaves.

Lengths are metres in the scene frame, levels dB over the median of what is shown. Everything is drawn on
objects of its own, without pyplot's global state, so that any thread may draw.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, hsv_to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from ..core.errors import CsasError
from ..core.geometry import (
    TWO_PI,
    GroundGrid,
    View,
    unit_to_sonar,
)
from ..core.imaging.enhancement import enhance
from ..core.imaging.mask_codes import MASK_COVERED, MASK_SHADOW, MASK_UNKNOWN
from ..core.imaging.subaperture import Spectrum, SubApertures
from ..core.methods import method_named
from ..core.pipeline import ProcessedView
from ..core.shape.mesh import surface_field
from ..core.shape.picture import view_extent
from ..core.shape.volume import VoxelGrid
from .subject import SIX_ASPECTS_DEG, Subject

#: Levels shown, dB over the median.
_DB_LOW, _DB_HIGH = -20.0, 20.0
#: Aperture of figure 5's reduced sub-aperture, as in the paper.
_REDUCED_DEG = 4.0
#: More triangles than this are drawn from a coarser surface.
_MAX_FACES = 30_000
_GREEN = "#1fd655"
_STYLE: Any = {
    "font.size": 11.0,
    "axes.titlesize": 12.0,
    "axes.labelsize": 11.0,
    "figure.facecolor": "white",
    "image.interpolation": "nearest",
}


class _MissingError(CsasError):
    """A figure cannot be drawn of this run; the message says what is missing."""


def draw_all(subject: Subject, folder: Path) -> tuple[list[str], dict[str, str], dict[str, str]]:
    """Draw every figure that the run allows.

    Parameters
    ----------
    subject : Subject
        The run.
    folder : Path
        Where to, made if needed.

    Returns
    -------
    files : list of str
        Names of the files written.
    left_out : dict
        Reason for each figure that the run does not allow.
    failed : dict
        What went wrong with each that could not be drawn or written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files, left_out, failed = [], {}, {}
    with mpl.rc_context(_STYLE):
        for name, draw in FIGURES.items():
            path = folder / f"{name}.png"
            try:
                figure = draw(subject)
                FigureCanvasAgg(figure)
                figure.savefig(path, dpi=120)
            except CsasError as error:
                left_out[name] = str(error)
            except Exception as error:  # one figure is not to cost the others
                failed[f"{folder.name}/{path.name}"] = f"{type(error).__name__}: {error}"
                path.unlink(missing_ok=True)
            else:
                files.append(path.name)
    return files, left_out, failed


# -- pictures ---------------------------------------------------------------------------------------


def north_up(view: View, grid: GroundGrid) -> NDArray[np.float32]:
    """Turn a view's amplitude to a north-up grid (linear interpolation of power); NaN off the view."""
    power = np.square(np.abs(view.pixels)).astype(np.float32)
    to_view = view.info.camera.ground_to_pixel @ np.linalg.inv(grid.ground_to_pixel)
    warped = cv2.warpAffine(
        power,
        to_view[:2],
        (grid.cols, grid.rows),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=math.nan,
    )
    return np.sqrt(np.asarray(warped, dtype=np.float32))


def decibels(amplitude: NDArray[Any]) -> NDArray[np.float32]:
    """Return levels in dB over the median of the known pixels, NaN where unknown."""
    magnitude = np.abs(amplitude).astype(np.float32)
    known = magnitude[np.isfinite(magnitude) & (magnitude > 0)]
    if not known.size:
        raise _MissingError("no pixel is known")
    floor = np.float32(1e-6) * known.max()
    with np.errstate(invalid="ignore"):
        return np.asarray(20.0 * np.log10(np.maximum(magnitude, floor) / np.median(known)), np.float32)


def _scene_circle(subject: Subject) -> tuple[tuple[float, float], float]:
    """Middle and radius (m) of the largest circle on the image."""
    if subject.image is not None:
        left, right, bottom, top = subject.image.grid.extent_m
        return subject.image.grid.centre_m, 0.5 * min(right - left, top - bottom)
    views = subject.keeper.of("shadow") or subject.keeper.of("sub_aperture")
    if not views:
        raise _MissingError("there is no view that shows the scene")
    camera = views[0].info.camera
    middle = camera.pixel_to_ground[:2] @ np.array([(camera.cols - 1) / 2.0, (camera.rows - 1) / 2.0, 1.0])
    known = float(np.isfinite(views[0].pixels).sum()) * camera.spacing_m[0] * camera.spacing_m[1]
    return (float(middle[0]), float(middle[1])), 0.5 * math.sqrt(known)


def _degrees(view: View) -> float:
    return math.degrees(view.info.aspect_rad) % 360.0


def _new(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained")


def _metres(axes: Any) -> None:
    axes.set_xlabel("x, east (m)")
    axes.set_ylabel("y, north (m)")
    axes.set_aspect("equal")


def _scale_bar(axes: Any, length_m: float) -> None:
    """Draw a bar of a round length at the lower left."""
    x0, x1 = sorted(axes.get_xlim())
    y0, y1 = axes.get_ylim()
    x = x0 + 0.06 * (x1 - x0)
    y = y0 + 0.06 * (y1 - y0)
    axes.plot([x, x + length_m], [y, y], color="white", lw=5, solid_capstyle="butt")
    axes.plot([x, x + length_m], [y, y], color="black", lw=3, solid_capstyle="butt")
    axes.text(
        x + length_m / 2,
        y + 0.03 * (y1 - y0),
        f"{length_m:g} m",
        ha="center",
        va="bottom",
        color="black",
        bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5},
    )


def _round_length(extent_m: float) -> float:
    """Return 1, 2 or 5 times a power of ten, about a fifth of an extent."""
    wanted = extent_m / 5.0
    power = 10.0 ** math.floor(math.log10(wanted))
    return max((f * power for f in (1.0, 2.0, 5.0) if f * power <= wanted), default=power)


# -- figures ----------------------------------------------------------------------------------------


def figure_1b(subject: Subject) -> Figure:
    """Draw the multi-look image."""
    composites = subject.result.composites
    if composites is None:
        raise _MissingError("there are no composites: the run starts after the sub-apertures")
    db = decibels(composites.multilook())
    figure = _new(7.4, 6.2)
    axes = figure.add_subplot()
    shown = axes.imshow(db, cmap="gray", vmin=-12, vmax=_DB_HIGH, extent=composites.grid.extent_m)
    figure.colorbar(shown, ax=axes, label="level over the median (dB)", shrink=0.9)
    axes.set_title(f"Multi-look image ({len(composites.stamps)} views)")
    _crop_known(axes, db, composites.grid)
    _metres(axes)
    return figure


def _crop_known(axes: Any, pixels: NDArray[Any], grid: GroundGrid) -> None:
    """Show only the rows and columns in which something is known."""
    known = np.isfinite(pixels)
    rows, cols = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    x, y, half = grid.x_of_columns(), grid.y_of_rows(), grid.spacing_m / 2
    axes.set_xlim(x[cols[0]] - half, x[cols[-1]] + half)
    axes.set_ylim(y[rows[-1]] - half, y[rows[0]] + half)


def figure_1c(subject: Subject) -> Figure:
    """Draw the colour-by-aspect image with its wheel of colours."""
    composites = subject.result.composites
    if composites is None:
        raise _MissingError("there are no composites: the run starts after the sub-apertures")
    figure = _new(8.2, 6.2)
    parts = figure.add_gridspec(1, 2, width_ratios=[4.2, 1.2])
    axes = figure.add_subplot(parts[0])
    axes.imshow(composites.color_by_aspect(), extent=composites.grid.extent_m)
    axes.set_title("Colour by aspect")
    _crop_known(axes, composites.multilook(), composites.grid)
    _metres(axes)
    wheel = figure.add_subplot(parts[1], projection="polar")
    angle = np.linspace(0.0, TWO_PI, 361)
    colours = np.stack([angle[:-1] / TWO_PI, np.ones(360), np.ones(360)], axis=-1)
    rgb = hsv_to_rgb(colours)
    wheel.pcolormesh(angle, [0.6, 1.0], np.arange(360)[None, :], cmap=ListedColormap(rgb), shading="flat")
    wheel.set_ylim(0, 1)
    wheel.set_yticks([])
    wheel.grid(False)
    wheel.spines["polar"].set_visible(False)
    wheel.set_xticks(np.radians([0, 90, 180, 270]), ["0°", "90°", "180°", "270°"])
    wheel.set_title("aspect from which\nthe echo came", fontsize=11)
    return figure


def figure_2a(subject: Subject) -> Figure:
    """Draw the image's 2-D spectrum with the wedge of one sub-aperture."""
    image, track = subject.image, subject.track
    if image is None or track is None:
        raise _MissingError("there is no full-circle image, so no spectrum")
    spectrum = Spectrum.of_image(image)
    power = np.fft.fftshift(np.square(np.abs(spectrum.values)))
    # Averaged to a size that a figure shows: speckle of single bins would only look grey.
    block = max(1, min(power.shape) // 512)
    rows, cols = (n // block * block for n in power.shape)
    power = power[:rows, :cols].reshape(rows // block, block, cols // block, block).mean(axis=(1, 3))
    step_y, step_x = spectrum.step_rad_m
    left = -(spectrum.values.shape[1] // 2) * step_x
    top = (spectrum.values.shape[0] // 2) * step_y
    extent = (left, left + cols * step_x, top - rows * step_y, top)
    kept = subject.keeper.of("sub_aperture")
    aspect = kept[0].info.aspect_rad if kept else math.radians(SIX_ASPECTS_DEG[0])
    aperture = math.radians(subject.parameters.sub_aperture.aperture_deg)
    sign = image.acoustics.spectrum_sign
    low, _, high = image.acoustics.ground_band(track.grazing_rad)
    turn = 0.0 if sign > 0 else math.pi
    angles = aspect + turn + np.linspace(-aperture / 2, aperture / 2, 33)
    rim = np.concatenate([low * np.exp(1j * angles), high * np.exp(1j * angles[::-1])])
    figure = _new(7.6, 6.4)
    axes = figure.add_subplot()
    in_band = power[power > 0]
    reference = float(np.percentile(in_band, 99.0)) if in_band.size else 1.0
    db = 10.0 * np.log10(np.maximum(power, 1e-12 * reference) / reference)
    shown = axes.imshow(db, cmap="gray", vmin=-40, vmax=3, extent=extent)
    figure.colorbar(shown, ax=axes, label="power (dB, 0 at the 99th percentile)", shrink=0.9)
    axes.fill(rim.real, rim.imag, facecolor=_GREEN, alpha=0.35)
    axes.plot(np.append(rim.real, rim.real[0]), np.append(rim.imag, rim.imag[0]), color=_GREEN, lw=1.8)
    middle = high * np.exp(1j * (aspect + turn)) * 1.07
    axes.plot([0, middle.real], [0, middle.imag], color=_GREEN, lw=1, ls=":")
    axes.annotate("θ₀", (middle.real, middle.imag), color=_GREEN, ha="center", va="center", fontsize=14)
    axes.set_title(
        f"Spectrum and the wedge of θ₀ = {math.degrees(aspect) % 360:.0f}°, {math.degrees(aperture):g}° wide"
        f" (spectrum sign {sign:+d})"
    )
    axes.set_xlabel("$K_x$ (rad/m)")
    axes.set_ylabel("$K_y$ (rad/m)")
    axes.set_aspect("equal")
    return figure


def _slider(axes: Any, view: View, centre: tuple[float, float], radius: float, title: str) -> Any:
    """Draw a view, north up, inside the circular slider with its cursor."""
    spacing = float(np.mean(view.info.camera.spacing_m))
    side = min(max(int(2 * radius / spacing), 64), 900)
    grid = GroundGrid.centred(side, side, 2 * radius / side, centre)
    db = decibels(north_up(view, grid))
    shown = axes.imshow(db, cmap="gray", vmin=_DB_LOW, vmax=_DB_HIGH, extent=grid.extent_m)
    shown.set_clip_path(Circle(centre, radius, transform=axes.transData))
    axes.add_patch(Circle(centre, radius * 1.06, fill=False, ec="0.45", lw=3))
    cursor = np.asarray(centre) + 1.06 * radius * unit_to_sonar(view.info.aspect_rad)
    axes.plot(*cursor, "o", color=_GREEN, ms=14, mec="black", mew=1.2, zorder=5)
    reach = 1.16 * radius
    axes.set_xlim(centre[0] - reach, centre[0] + reach)
    axes.set_ylim(centre[1] - reach, centre[1] + reach)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title)
    return shown


def figure_2b(subject: Subject) -> Figure:
    """Draw one sub-aperture inside the circular slider."""
    views = subject.keeper.of("sub_aperture")
    if not views:
        raise _MissingError("there are no sub-aperture views of this run")
    view = views[1 if len(views) > 1 else 0]
    centre, radius = _scene_circle(subject)
    figure = _new(6.6, 6.0)
    axes = figure.add_subplot()
    shown = _slider(axes, view, centre, radius, f"Sub-aperture at θ₀ = {_degrees(view):.0f}°")
    _scale_bar(axes, _round_length(2 * radius))
    figure.colorbar(shown, ax=axes, label="level over the median (dB)", shrink=0.8)
    return figure


def _six(subject: Subject, stage: str, heading: str) -> Figure:
    views = subject.keeper.of(stage)
    if not views:
        raise _MissingError(f"there are no {stage} views of this run")
    centre, radius = _scene_circle(subject)
    cols = min(3, len(views))
    rows = math.ceil(len(views) / cols)
    figure = _new(4.0 * cols + 0.9, 4.2 * rows + 0.5)
    grid = figure.subplots(rows, cols, squeeze=False)
    for axes in grid.ravel()[len(views) :]:
        axes.set_axis_off()
    shown: Any = None
    for axes, view in zip(grid.ravel(), views, strict=False):
        shown = _slider(axes, view, centre, radius, f"θ₀ = {_degrees(view):.0f}°")
    _scale_bar(grid[0, 0], _round_length(2 * radius))
    figure.colorbar(shown, ax=grid, label="level over the median (dB)", shrink=0.6)
    aperture = math.degrees(views[0].info.aperture_rad)
    figure.suptitle(f"{heading}, {aperture:g}° wide (north up; green: where the sonar was)")
    return figure


def figure_3(subject: Subject) -> Figure:
    """Draw six sub-apertures inside the circular slider."""
    return _six(subject, "sub_aperture", "Sub-apertures")


def figure_6(subject: Subject) -> Figure:
    """Draw six shadow enhanced sub-apertures inside the circular slider."""
    return _six(subject, "shadow", "Shadow enhanced sub-apertures")


def _example(subject: Subject) -> ProcessedView:
    """Return the kept view with the largest segmented shadow."""
    views = [v for v in subject.keeper.views() if v.shadow is not None and v.mask is not None]
    if not views or subject.result.target is None:
        raise _MissingError("there is no target, so no shadow to look at")

    def dark(view: ProcessedView) -> int:
        return 0 if view.mask is None else int((view.mask.pixels == MASK_SHADOW).sum())

    return max(views, key=dark)


def _most_enhanced(subject: Subject) -> ProcessedView:
    """Return the kept view whose segmented shadow enhancement has darkened most."""

    def gain(view: ProcessedView) -> float:
        full, shadow, mask = view.sub_aperture, view.shadow, view.mask
        if full is None or shadow is None or mask is None:
            return -math.inf
        inside = (mask.pixels == MASK_SHADOW) & np.isfinite(full.pixels) & np.isfinite(shadow.pixels)
        if not inside.any():
            return -math.inf
        powers = (np.square(np.abs(v.pixels[inside])).mean() for v in (full, shadow))
        return float(np.divide(*powers))

    return max((v for v in subject.keeper.views()), key=gain, default=_example(subject))


def _around_target(subject: Subject, view: View) -> tuple[float, float, float, float]:
    """Return the part of the view frame, about the target (m), in which its shadow lies."""
    target, dimensions = subject.result.target, subject.result.dimensions
    if target is None:
        raise _MissingError("there is no target, so no shadow to look at")
    across = 0.5 * math.hypot(target.size_m[0], target.size_m[1])
    height = dimensions.height_m if dimensions is not None else target.size_m[2]
    length = height / math.tan(view.info.camera.grazing_rad)
    return -across, across, -0.8 * across, length + across


def _show_view(axes: Any, subject: Subject, view: View, pixels: Any, title: str, **style: Any) -> Any:
    target = subject.result.target
    if target is None:
        raise _MissingError("there is no target, so no shadow to look at")
    shown = axes.imshow(pixels, extent=view_extent(view, target.position_m), **style)
    left, right, near, far = _around_target(subject, view)
    axes.set_xlim(left, right)
    axes.set_ylim(far, near)  # the sonar is above the picture
    axes.set_aspect("equal")
    axes.set_title(title)
    axes.set_xlabel("cross-range (m)")
    return shown


def figure_5(subject: Subject) -> Figure:
    """Draw a reduced sub-aperture, the full one and the shadow enhanced one, at one aspect."""
    example = _most_enhanced(subject)
    shadow, full = example.shadow, example.sub_aperture
    image, track, target = subject.image, subject.track, subject.result.target
    if image is None or track is None or shadow is None or full is None or target is None:
        raise _MissingError("there is no full-circle image to make a reduced sub-aperture of")
    width = min(_REDUCED_DEG, subject.parameters.sub_aperture.aperture_deg)
    narrow = replace(subject.parameters.sub_aperture, aperture_deg=width)
    reduced = SubApertures(image, track, narrow).view_of_aspect(full.info.aspect_rad)
    unfocused = enhance(reduced, target.position_m, replace(subject.parameters.shadow, enhancement="none"))
    aperture = math.degrees(full.info.aperture_rad)
    panels = (
        (unfocused, f"(a) reduced: {width:g}°"),
        (replace(full, pixels=np.abs(full.pixels)), f"(b) sub-aperture: {aperture:g}°"),
        (shadow, f"(c) shadow enhanced: {aperture:g}°"),
    )
    left, right, near, far = _around_target(subject, full)
    figure = _new(13.2, 1.6 + 3.9 * min(max((far - near) / (right - left), 0.6), 2.2))
    grid = figure.subplots(1, 3, sharey=True)
    shown: Any = None
    for axes, (view, title) in zip(grid, panels, strict=True):
        style = {"cmap": "gray", "vmin": _DB_LOW, "vmax": 15.0}
        shown = _show_view(axes, subject, view, decibels(view.pixels), title, **style)
    grid[0].set_ylabel("down-range from the target (m)")
    _scale_bar(grid[0], _round_length(right - left))
    figure.colorbar(shown, ax=grid, label="level over the median (dB)", shrink=0.85)
    figure.suptitle(f"Shadow enhancement at θ₀ = {_degrees(full):.0f}° (the sonar is above)")
    return figure


def figure_7(subject: Subject) -> Figure:
    """Draw a shadow enhanced view and the shadow that was segmented in it."""
    example = _example(subject)
    shadow, mask = example.shadow, example.mask
    if shadow is None or mask is None:
        raise _MissingError("there is no segmented shadow of this run")
    left, right, near, far = _around_target(subject, shadow)
    figure = _new(10.4, 1.8 + 4.2 * min(max((far - near) / (right - left), 0.6), 2.2))
    a, b = figure.subplots(1, 2, sharey=True)
    style: dict[str, Any] = {"cmap": "gray", "vmin": _DB_LOW, "vmax": 15.0}
    shown = _show_view(a, subject, shadow, decibels(shadow.pixels), "(a) shadow enhanced", **style)
    a.set_ylabel("down-range from the target (m)")
    _scale_bar(a, _round_length(right - left))
    figure.colorbar(shown, ax=a, label="level over the median (dB)", shrink=0.85)
    colours = {
        "outside": (0.85, 0.85, 0.85),
        "knows nothing": (0.55, 0.65, 0.85),
        "covered by the target": (0.9, 0.75, 0.45),
        "shadow": (0.0, 0.0, 0.0),
    }
    picture = np.empty((*mask.pixels.shape, 3))
    picture[:] = colours["outside"]
    picture[mask.pixels == MASK_UNKNOWN] = colours["knows nothing"]
    picture[mask.pixels == MASK_COVERED] = colours["covered by the target"]
    picture[mask.pixels == MASK_SHADOW] = colours["shadow"]
    _show_view(b, subject, mask, picture, "(b) segmented automatically")
    handles = [Patch(facecolor=c, edgecolor="0.3", label=n) for n, c in colours.items()]
    # Room for the legend is made by hand: "outside" takes matplotlib 3.7, and Ubuntu 24.04 has 3.6.
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0.0, 0.06, 1.0, 0.94))
    figure.legend(handles=handles, loc="lower right", ncols=4, frameon=False)
    figure.suptitle(f"Segmentation of the shadow at θ₀ = {_degrees(shadow):.0f}° (the sonar is above)")
    return figure


def _surface(grid: VoxelGrid) -> trimesh.Trimesh | None:
    """Return the object's surface with no more triangles than a figure needs."""
    if not grid.occupied.any():
        return None
    field_ = surface_field(grid)
    d = grid.volume.voxel_size_m
    for step in (1, 2, 3, 4):
        try:
            vertices, faces, _, _ = marching_cubes(field_, 0.0, spacing=(d, d, d), step_size=step)
        except (ValueError, RuntimeError):  # a coarser step may step over all of a thin object
            continue
        if len(faces) <= _MAX_FACES or step == 4:
            break
    xyz = vertices[:, ::-1] - d + np.asarray(grid.volume.origin_m)
    mesh = trimesh.Trimesh(xyz, faces[:, ::-1], process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _draw_solid(axes: Any, mesh: trimesh.Trimesh, colour: tuple[float, float, float]) -> None:
    # Triangles are painted back to front by their middles: large ones must be cut to be in order.
    vertices, faces = trimesh.remesh.subdivide_to_size(
        mesh.vertices, mesh.faces, max_edge=float(mesh.extents.max()) / 12.0
    )
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    normals = np.asarray(mesh.face_normals)
    light = np.array([-0.35, -0.55, 0.76])
    level = 0.35 + 0.65 * np.clip(normals @ light, 0.0, 1.0)
    tint = np.clip(np.asarray(colour)[None, :] * level[:, None], 0, 1)
    solid = Poly3DCollection(np.asarray(mesh.triangles), facecolors=tint, edgecolors=tint, linewidths=0.2)
    axes.add_collection3d(solid)


def _draw_outline(axes: Any, mesh: trimesh.Trimesh) -> None:
    """Draw the edges of the true target, where its faces meet at more than 25°."""
    sharp = mesh.face_adjacency_angles > math.radians(25.0)
    edges = np.asarray(mesh.vertices)[mesh.face_adjacency_edges[sharp]]
    if len(edges):
        axes.add_collection3d(Line3DCollection(edges, colors="#b3261e", linewidths=1.4))


def figure_8(subject: Subject) -> Figure:
    """Draw the surfaces that carving leaves, by both methods, and the true target where it is known."""
    grids = [g for g in (subject.result.other_grid, subject.result.grid) if g is not None]
    grids.sort(key=lambda g: not method_named(g.method).takes_masks)  # the paper's order: masks first
    solids: list[tuple[str, trimesh.Trimesh, bool]] = []
    for grid in grids:
        mesh = _surface(grid)
        if mesh is not None:
            solids.append((method_named(grid.method).title, mesh, False))
    if not solids:
        raise _MissingError("there is no object, so no surface")
    truth = subject.truth if subject.truth is not None and len(subject.truth.faces) else None
    if truth is not None:
        solids.append(("truth", truth, True))
    low = np.min([m.bounds[0] for _, m, _ in solids], axis=0)
    high = np.max([m.bounds[1] for _, m, _ in solids], axis=0)
    low[2] = 0.0
    size = np.maximum(high - low, 1e-6)
    margin = 0.06 * size[:2].max()
    low[:2] -= margin
    high[:2] += margin
    size = high - low
    figure = _new(5.4 * len(solids), 5.2)
    for i, (title, mesh, is_truth) in enumerate(solids):
        axes: Any = figure.add_subplot(1, len(solids), i + 1, projection="3d")
        _draw_solid(axes, mesh, (0.62, 0.75, 0.62) if is_truth else (0.93, 0.76, 0.42))
        if truth is not None:
            _draw_outline(axes, truth)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_zlim(0.0, high[2])
        axes.set_box_aspect(size, zoom=0.82)
        axes.view_init(elev=28, azim=-60)
        for axis, n in ((axes.xaxis, size[0]), (axes.yaxis, size[1]), (axes.zaxis, size[2])):
            axis.set_major_locator(mpl.ticker.MaxNLocator(max(2, round(5 * n / size.max()))))
        axes.tick_params(labelsize=9, pad=1)
        axes.set_xlabel("x (m)", labelpad=8)
        axes.set_ylabel("y (m)", labelpad=8)
        axes.set_zlabel("z (m)", labelpad=4)
        axes.set_title(f"({'abc'[i]}) {title}", y=1.0)
    red = "; red: edges of the true target" if truth is not None else ""
    figure.suptitle(f"Surface left by the shadows (scene frame{red})")
    return figure


#: Every figure by the name of its file.
FIGURES: dict[str, Callable[[Subject], Figure]] = {
    "figure_1b_multilook": figure_1b,
    "figure_1c_color_by_aspect": figure_1c,
    "figure_2a_spectrum": figure_2a,
    "figure_2b_slider": figure_2b,
    "figure_3_sub_apertures": figure_3,
    "figure_5_enhancement": figure_5,
    "figure_6_enhanced": figure_6,
    "figure_7_segmentation": figure_7,
    "figure_8_surfaces": figure_8,
}
