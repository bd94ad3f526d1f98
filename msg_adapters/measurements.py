"""diagnostic_msgs/DiagnosticArray to and from what was measured: topics `measurements` and `evidence`.

Numbers are written as Python writes them: they come back to the last digit. Units are in the names (``_m``,
``_m3``, ``_rad``, ``_deg``, ``_ns``). Readers pass over values that they do not know.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from csas_shadow_ros.core.errors import AdapterError
from csas_shadow_ros.core.mesh import Dimensions
from csas_shadow_ros.core.seabed import SeabedSlope
from csas_shadow_ros.core.shape.result import QUALITIES, VERDICTS, LeftOut, Quality, Result, ViewEvidence
from csas_shadow_ros.core.target import SignEvidence
from csas_shadow_ros.core.volume import Target, Volume, VoxelGrid

from .messages import MessageFactory, stamp_to_ns
from .progress import Level
from .search import (
    left_out_of,
    left_out_statuses,
    sign_of_values,
    sign_values,
    target_of_values,
    target_values,
)
from .values import Status, finite, numbered, statuses_from_msg, statuses_to_msg, value_texts

#: Measures by their names in messages, and where `Dimensions` has them.
_MEASURES = {
    "length_m": "length_m",
    "width_m": "width_m",
    "height_m": "height_m",
    "volume_m3": "volume_m3",
    "heading_rad": "heading_rad",
    "x_m": "position_x_m",
    "y_m": "position_y_m",
}
_LEVELS = dict(zip(QUALITIES, (Level.OK, Level.WARN, Level.ERROR), strict=True))
_REASONS = "; "


@dataclass(frozen=True)
class GridFacts:
    """What of a grid does not come with its voxels: the lattice to the last digit, method and threshold."""

    volume: Volume
    method: str
    threshold: float
    views: int


@dataclass(frozen=True)
class MeasuredObject:
    """One object as topic `measurements` tells it."""

    dimensions: Dimensions
    target: Target
    grid: GridFacts


@dataclass(frozen=True)
class Measurements:
    """What topic `measurements` says.

    Parameters
    ----------
    stamp_ns : int
        Newest view in it.
    objects : tuple of MeasuredObject
        In their order; of the target its own grid's facts are `main`, whether or not it is an object.
    main, other : GridFacts or None
        Of the target's grid, and of the one by the other method.
    target : Target or None
        The volume that was carved.
    run_ns, final, verdict, quality, arc_rad, views_used, slope, sign, left_out
        See `Result`.
    hollow : bool or None
        Whether the object has hollows; None where no echo was looked at.
    """

    stamp_ns: int
    objects: tuple[MeasuredObject, ...]
    main: GridFacts | None
    other: GridFacts | None
    target: Target | None
    run_ns: int | None
    final: bool
    verdict: str
    quality: Quality
    arc_rad: float
    views_used: int
    slope: SeabedSlope | None
    sign: SignEvidence | None
    left_out: tuple[LeftOut, ...]
    hollow: bool | None


def dimension_values(d: Dimensions) -> dict[str, Any]:
    """Return the values that tell an object's measures, with ``.low`` and ``.high`` of 95 % intervals."""
    numbers = {
        **{name: getattr(d, name) for name in list(_MEASURES)[:5]},
        "x_m": d.position_m[0],
        "y_m": d.position_m[1],
        "hull_top_m": finite(d.hull_top_m),
    }
    values: dict[str, Any] = {}
    for name, value in numbers.items():
        values[name] = None if value is None else float(value)
        if (interval := d.intervals.get(_MEASURES.get(name, ""))) is not None:
            values[f"{name}.low"], values[f"{name}.high"] = map(float, interval)
    return values


def dimensions_of_values(status: Status) -> Dimensions:
    """Read what `dimension_values` wrote.

    Raises
    ------
    AdapterError
        If a measure is missing or no number.
    """
    intervals = {
        name: (status.number(f"{key}.low"), status.number(f"{key}.high"))
        for key, name in _MEASURES.items()
        if f"{key}.low" in status.values
    }
    length, width, height, volume, heading, x, y = (status.number(key) for key in _MEASURES)
    top = status.number("hull_top_m", math.nan)
    return Dimensions(length, width, height, volume, heading, (x, y), top, intervals)


def figures(d: Dimensions) -> str:
    """Write an object's size in a line."""
    size = " x ".join(f"{side:.3f}" for side in (d.length_m, d.width_m, d.height_m))
    return f"{size} m, heading {math.degrees(d.heading_rad):.1f} deg"


def _grid_values(grid: VoxelGrid, views: int) -> dict[str, Any]:
    v = grid.volume
    return {
        "method": grid.method,
        "threshold": float(grid.threshold),
        "views": views,
        "voxel_size_m": float(v.voxel_size_m),
        **{f"origin_{axis}_m": float(at) for axis, at in zip("xyz", v.origin_m, strict=True)},
        **{f"voxels_{axis}": int(n) for axis, n in zip("zyx", v.shape, strict=True)},
    }


def _grid_facts(status: Status) -> GridFacts:
    x, y, z = (status.number(f"origin_{axis}_m") for axis in "xyz")
    nz, ny, nx = (status.whole(f"voxels_{axis}") for axis in "zyx")
    volume = Volume((x, y, z), status.number("voxel_size_m"), (nz, ny, nx))
    method = status.text("method", ("consensus", "hard", "soft"))
    return GridFacts(volume, method, status.number("threshold"), status.whole("views"))


def measurements_to_msg(factory: MessageFactory, result: Result, stamp_ns: int | None = None) -> Any:
    """Make the message of topic `measurements`.

    Parameters
    ----------
    factory : MessageFactory
        Makes the message.
    result : Result
        What was found.
    stamp_ns : int, optional
        Stamp; that of the newest view in it by default.
    """
    level = _LEVELS[result.quality.verdict]
    statuses = [
        Status(
            f"object {number}",
            figures(one.dimensions),
            value_texts(
                dimension_values(one.dimensions)
                | _grid_values(one.grid, one.views_used)
                | target_values(one.target, "target_")
            ),
            level,
        )
        for number, one in enumerate(result.objects, start=1)
    ]
    # A list in one value: no reason may hold what separates them.
    reasons = [reason.replace(";", ",") for reason in result.quality.reasons]
    slope = result.grid.seabed if result.grid is not None else None
    hollow = result.matter is not None and result.matter_mesh is not result.mesh
    run: dict[str, Any] = {
        "verdict": result.verdict,
        "quality": result.quality.verdict,
        "reasons": _REASONS.join(reasons),
        "run": result.run_ns,
        "arc_deg": math.degrees(result.arc_rad),
        "arc_rad": float(result.arc_rad),
        "views": result.views_used,
        "final": result.final,
        "hollow": None if result.matter is None else hollow,
        **sign_values(result.sign),
    }
    if slope is not None:
        run |= {
            "seabed_slope_rad": float(slope.slope_rad),
            "seabed_slope.believed": slope.believed,
            "seabed_slope.x": float(slope.gradient[0]),
            "seabed_slope.y": float(slope.gradient[1]),
            "seabed_slope.sigma": float(slope.sigma),
            "seabed_slope.about_x_m": float(slope.about_m[0]),
            "seabed_slope.about_y_m": float(slope.about_m[1]),
        }
    said = f"{result.verdict} ({result.quality.verdict})"
    statuses.append(Status("run", _REASONS.join([said, *reasons]), value_texts(run), level))
    if result.target is not None:
        statuses.append(Status("target", "the carved volume", value_texts(target_values(result.target))))
    for name, grid in (("grid", result.grid), ("other method", result.other_grid)):
        if grid is not None:
            statuses.append(Status(name, grid.method, value_texts(_grid_values(grid, result.views_used))))
    statuses += left_out_statuses(result.left_out)
    return statuses_to_msg(factory, result.stamp_ns if stamp_ns is None else stamp_ns, statuses)


def measurements_from_msg(msg: Any) -> Measurements:
    """Read the message of topic `measurements`.

    Raises
    ------
    AdapterError
        If a status or a value is missing or wrong.
    """
    where = "measurements"
    statuses = statuses_from_msg(msg, where)
    run = statuses.get("run")
    if run is None:
        raise AdapterError(f"{where} has statuses {sorted(statuses)}; expected one named 'run'")
    objects = tuple(
        MeasuredObject(dimensions_of_values(one), target_of_values(one, "target_"), _grid_facts(one))
        for one in numbered(statuses, "object")
    )
    slope = None
    if "seabed_slope.x" in run.values:
        gx, gy, sigma, x, y = (
            run.number(f"seabed_slope.{name}") for name in ("x", "y", "sigma", "about_x_m", "about_y_m")
        )
        slope = SeabedSlope((gx, gy), sigma, (x, y))
    reasons = tuple(reason for reason in run.values.get("reasons", "").split(_REASONS) if reason)
    facts = {name: _grid_facts(statuses[name]) for name in ("grid", "other method") if name in statuses}
    hollow = run.values.get("hollow")
    return Measurements(
        stamp_to_ns(msg.header.stamp, f"{where}.header.stamp"),
        objects,
        facts.get("grid"),
        facts.get("other method"),
        target_of_values(statuses["target"]) if "target" in statuses else None,
        run.whole("run") if "run" in run.values else None,
        run.values.get("final") != "false",
        run.text("verdict", VERDICTS),
        Quality(run.text("quality", QUALITIES), reasons),
        run.number("arc_rad", math.radians(run.number("arc_deg", 0.0))),
        run.whole("views", 0),
        slope,
        sign_of_values(run),
        tuple(left_out_of(statuses)),
        None if hollow is None else hollow == "true",
    )


def evidence_to_msg(factory: MessageFactory, evidence: Mapping[int, ViewEvidence], stamp_ns: int) -> Any:
    """Make the message of topic `evidence`: a status a view, named by its stamp (ns)."""
    statuses = []
    for stamp, one in sorted(evidence.items()):
        values = {
            "aspect_deg": math.degrees(one.aspect_rad) % 360.0,
            "aspect_rad": float(one.aspect_rad),
            **{f"sonar_{axis}_m": float(at) for axis, at in zip("xyz", one.sonar_m, strict=True)},
            "seabed_level": finite(float(one.seabed_level)),
            "contrast": finite(float(one.contrast)),
            "levels_estimated": bool(one.levels_estimated),
            "height_m": finite(float(one.height_m)),
        }
        told = "no height" if math.isnan(one.height_m) else f"{one.height_m:.3f} m high"
        statuses.append(Status(str(stamp), f"{values['aspect_deg']:.2f} deg: {told}", value_texts(values)))
    return statuses_to_msg(factory, stamp_ns, statuses)


def evidence_from_msg(msg: Any) -> dict[int, ViewEvidence]:
    """Read the message of topic `evidence`.

    Raises
    ------
    AdapterError
        If a status is not named by a stamp, or a value is missing or wrong.
    """
    found = {}
    for name, one in statuses_from_msg(msg, "evidence").items():
        try:
            stamp = int(name)
        except ValueError:
            raise AdapterError(f"evidence status is named {name!r}; expected a view's stamp in ns") from None
        x, y, z = (one.number(f"sonar_{axis}_m") for axis in "xyz")
        found[stamp] = ViewEvidence(
            stamp,
            one.number("aspect_rad"),
            (x, y, z),
            one.number("seabed_level", math.nan),
            one.number("contrast", math.nan),
            one.values.get("levels_estimated") == "true",
            one.number("height_m", math.nan),
        )
    return found
