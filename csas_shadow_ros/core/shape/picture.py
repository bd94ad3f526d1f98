"""A result as a picture: its plan, its side, and the most complete shadow."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..geometry import View
from ..imaging.composites import level_image
from .verdict import no_object_reason

if TYPE_CHECKING:
    from .result import Result

#: Levels shown in pictures, down from the brightest.
_RANGE_DB = 40.0
#: Free room round the object in the plan, as a share of its size.
_ROOM = 0.4


class ResultFigure(Figure):
    """A figure that notebooks show even without pyplot."""

    def png(self, dpi: float = 100.0) -> bytes:
        """Return the figure as a PNG file."""
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=dpi)
        return file.getvalue()

    def _repr_png_(self) -> bytes:
        return self.png()


def plot(result: Result) -> ResultFigure:
    """Draw the plan, the side and the most complete shadow; see `Result.plot`."""
    figure = ResultFigure(figsize=(11.5, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    plan, side, shadow = figure.subplots(1, 3)
    _draw_plan(plan, result)
    _draw_side(side, result)
    _draw_shadow(shadow, result)
    verdict = f"{result.verdict}, quality {result.quality.verdict}"
    figure.suptitle(f"{verdict}: {result.dimensions}" if result.dimensions is not None else verdict)
    return figure


def _nothing(axes: Any, title: str, why: str) -> None:
    axes.set_axis_off()
    axes.set_title(title)
    axes.text(0.5, 0.5, why, ha="center", va="center", wrap=True, transform=axes.transAxes)


def _body(result: Result) -> Any:
    """Return the voxels that hold matter, of every object; None where there is no grid."""
    return result.matter if result.matter is not None else result.grid.occupied if result.grid else None


def _draw_plan(axes: Any, result: Result) -> None:
    title = "plan"
    if result.composites is None and result.grid is None:
        _nothing(axes, title, no_object_reason(result))
        return
    if result.composites is not None:
        levels = level_image(result.composites.multilook(), _RANGE_DB)
        axes.imshow(levels, cmap="gray", extent=result.composites.grid.extent_m)
    if (grid := result.grid) is not None:
        volume, body = grid.volume, _body(result)
        d = volume.voxel_size_m
        top = np.where(body, volume.z_m[:, None, None] + d / 2, -np.inf).max(axis=0)
        x, y = volume.x_m, volume.y_m
        extent = (x[0] - d / 2, x[-1] + d / 2, y[0] - d / 2, y[-1] + d / 2)
        style = {"origin": "lower", "cmap": "viridis", "vmin": 0.0, "interpolation": "nearest"}
        shown = axes.imshow(np.where(np.isfinite(top), top, np.nan), extent=extent, **style)
        left, right, bottom, upper = extent
        if body.any():
            rows, cols = np.flatnonzero(body.any(axis=(0, 2))), np.flatnonzero(body.any(axis=(0, 1)))
            room = _ROOM * d * max(np.ptp(rows) + 1, np.ptp(cols) + 1)
            left, right = x[cols[0]] - room, x[cols[-1]] + room
            bottom, upper = y[rows[0]] - room, y[rows[-1]] + room
        axes.set_xlim(left, right)
        axes.set_ylim(bottom, upper)
        if body.any():
            axes.figure.colorbar(shown, ax=axes, label="top (m)", shrink=0.7)
    for one in result.objects:
        dims = one.dimensions
        (cx, cy), (length, width) = dims.position_m, (dims.length_m, dims.width_m)
        box = Rectangle((cx - length / 2, cy - width / 2), length, width, rotation_point="center")
        box.set(angle=math.degrees(dims.heading_rad), fill=False, edgecolor="red")
        axes.add_patch(box)
    axes.set_aspect("equal")
    axes.set_title(title)
    axes.set_xlabel("x, east (m)")
    axes.set_ylabel("y, north (m)")


def _draw_side(axes: Any, result: Result) -> None:
    title = "side, from the south"
    if result.grid is None or not _body(result).any():
        why = "nothing is left in the target's volume" if result.objects else no_object_reason(result)
        _nothing(axes, title, why)
        return
    volume = result.grid.volume
    d = volume.voxel_size_m
    through = _body(result).sum(axis=1) * d
    x, z = volume.x_m, volume.z_m
    extent = (x[0] - d / 2, x[-1] + d / 2, z[0] - d / 2, z[-1] + d / 2)
    style = {"origin": "lower", "cmap": "cividis_r", "interpolation": "nearest"}
    shown = axes.imshow(np.where(through > 0.0, through, np.nan), extent=extent, **style)
    axes.figure.colorbar(shown, ax=axes, label="through (m)", shrink=0.7)
    axes.set_aspect("equal")
    axes.set_title(title)
    axes.set_xlabel("x, east (m)")
    axes.set_ylabel("z, up (m)")


def _draw_shadow(axes: Any, result: Result) -> None:
    view, target = result.best_shadow, result.target
    if view is None or target is None:
        _nothing(axes, "best shadow", "no view of a target was kept")
        return
    aspect = math.degrees(view.info.aspect_rad) % 360.0
    pixels = np.abs(view.pixels.astype(np.float32))
    extent = view_extent(view, target.position_m)
    known = np.isfinite(pixels)
    levels = level_image(pixels, _RANGE_DB) if (pixels[known] > 0).any() else pixels
    axes.imshow(np.where(known, levels, np.nan), cmap="gray", extent=extent)
    axes.set_facecolor("lightsteelblue")  # where the view knows nothing
    across = 0.5 * math.hypot(*target.size_m[:2])
    height = result.dimensions.height_m if result.dimensions is not None else target.size_m[2]
    axes.set_xlim(-across, across)
    # The sonar is above the picture: down-range grows downwards.
    axes.set_ylim(min(height / math.tan(view.info.camera.grazing_rad) + across, extent[2]), -0.8 * across)
    axes.set_aspect("equal")
    axes.set_title(f"best shadow, from {aspect:.0f}° (sonar above)")
    axes.set_xlabel("cross-range (m)")
    axes.set_ylabel("down-range (m)")


def view_extent(view: View, target_m: tuple[float, float]) -> tuple[float, float, float, float]:
    """Return matplotlib's extent of a view, cross-range and down-range from the target (m)."""
    camera = view.info.camera
    rows_m, cols_m = camera.spacing_m
    u, v, _ = camera.ground_to_pixel @ np.array([target_m[0], target_m[1], 1.0])
    return (
        (-0.5 - u) * cols_m,
        (camera.cols - 0.5 - u) * cols_m,
        (camera.rows - 0.5 - v) * rows_m,
        (-0.5 - v) * rows_m,
    )
