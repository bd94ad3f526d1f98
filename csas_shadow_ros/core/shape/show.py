"""A result to look at: in a few lines, as a table, and as labelled arrays."""

from __future__ import annotations

import base64
import html
import math
from typing import TYPE_CHECKING, Any

from ..errors import MissingExtraError
from ..methods import method_named
from .verdict import no_object_reason

if TYPE_CHECKING:
    import xarray

    from .mesh import Dimensions
    from .result import Result

#: Dots per inch of the picture in a notebook's table: about 700 pixels wide.
_SMALL_DPI = 60


def table(result: Result) -> list[tuple[str, str]]:
    """Return a result as rows of name and value."""
    quality = result.quality
    rows = [("verdict", result.verdict), ("quality", "; ".join((quality.verdict, *quality.reasons)))]
    if not result.objects:
        rows.append(("why", no_object_reason(result)))
    for number, one in enumerate(result.objects, start=1):
        prefix = "" if len(result.objects) == 1 else f"object {number}: "
        rows += [(prefix + name, value) for name, value in _measures(one.dimensions)]
        if (place := result.place_of(one.dimensions)) is not None:
            rows.append((f"{prefix}place", f"{place}, bearing {place.bearing_deg:.1f}°"))
    if (grid := result.grid) is not None:
        nz, ny, nx = grid.volume.shape
        rows.append(("grid", f"{nx} × {ny} × {nz} voxels of {grid.volume.voxel_size_m:g} m, {grid.method}"))
    views = f"{result.views_used} used, {len(result.rejected)} refused"
    rows.append(("views", f"{views}, {math.degrees(result.arc_rad):.0f}° of the circle"))
    return rows


def _measures(d: Dimensions) -> list[tuple[str, str]]:
    def row(name: str, unit: str, value: float, scale: float = 1.0, digits: int = 3) -> tuple[str, str]:
        between = ""
        if name in d.intervals:
            low, high = (end * scale for end in d.intervals[name])
            between = f" ({low:.{digits}f} to {high:.{digits}f})"
        return name.rpartition("_")[0], f"{value * scale:.{digits}f} {unit}{between}"

    x, y = d.position_m
    return [
        row("length_m", "m", d.length_m),
        row("width_m", "m", d.width_m),
        row("height_m", "m", d.height_m),
        row("volume_m3", "m³", d.volume_m3, digits=4),
        row("heading_rad", "°", d.heading_rad, math.degrees(1.0), 1),
        ("position", f"x {x:.3f}, y {y:.3f} m"),
    ]


def text(result: Result) -> str:
    """Return a result in a few lines."""
    lines = [f"Result: {result.verdict}, quality {result.quality.verdict}"]
    lines += [f"  {reason}" for reason in result.quality.reasons]
    for one in result.objects:
        lines.append(f"  {one.dimensions}")
        if (place := result.place_of(one.dimensions)) is not None:
            lines.append(f"  {place}, bearing {place.bearing_deg:.1f}°")
    if not result.objects:
        lines.append(f"  {no_object_reason(result)}")
    lines.append(f"  {table(result)[-1][1]}".replace(" used", " views used"))
    return "\n".join(lines)


def as_html(result: Result) -> str:
    """Return a result as a table over a small picture."""
    from .picture import plot  # late: who reads a line needs no matplotlib

    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
        f"<td style='text-align:left'>{html.escape(value)}</td></tr>"
        for name, value in table(result)
    )
    picture = base64.b64encode(plot(result).png(_SMALL_DPI)).decode()
    return (
        f"<table>{rows}</table><img alt='plan, side and best shadow' src='data:image/png;base64,{picture}'>"
    )


def to_xarray(result: Result) -> xarray.Dataset:
    """Return the target's grid as labelled arrays; see `Result.to_xarray`."""
    try:
        import xarray
    except ImportError as error:
        raise MissingExtraError(
            "to_xarray needs xarray, which is not installed; expected: pip install 'csas_shadow_ros[xarray]'"
        ) from error
    attributes: dict[str, Any] = {
        "verdict": result.verdict,
        "quality": result.quality.verdict,
        "reasons": "; ".join(result.quality.reasons),
        "views_used": result.views_used,
    }
    if (d := result.dimensions) is not None:
        names = ("length_m", "width_m", "height_m", "volume_m3", "heading_rad")
        attributes |= {name: getattr(d, name) for name in names}
        attributes |= {"x_m": d.position_m[0], "y_m": d.position_m[1]}
        if (place := result.place_of(d)) is not None:
            attributes |= vars(place)
    if (grid := result.grid) is None:
        return xarray.Dataset(attrs=attributes)
    volume, dims = grid.volume, ("z", "y", "x")
    matter = grid.occupied if result.matter is None else result.matter
    attributes |= {
        "method": grid.method,
        "threshold": grid.threshold,
        "voxel_size_m": volume.voxel_size_m,
        "frame": result.frame,
    }
    return xarray.Dataset(
        {
            "likelihood": (dims, grid.likelihood, {"long_name": method_named(grid.method).says}),
            "views": (dims, grid.views, {"long_name": "views that know something"}),
            "occupied": (dims, grid.occupied, {"long_name": "object's voxels"}),
            "matter": (dims, matter, {"long_name": "object's voxels without its hollows"}),
        },
        coords={
            "z": ("z", volume.z_m, {"units": "m", "long_name": "up"}),
            "y": ("y", volume.y_m, {"units": "m", "long_name": "north"}),
            "x": ("x", volume.x_m, {"units": "m", "long_name": "east"}),
        },
        attrs=attributes,
    )
