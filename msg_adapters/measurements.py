"""diagnostic_msgs/DiagnosticArray to and from a run's objects with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from csas_shadow_ros.core.errors import AdapterError, CsasError, quoted
from csas_shadow_ros.core.geometry import SCENE_FRAME, Datum, Place
from csas_shadow_ros.core.methods import METHODS
from csas_shadow_ros.core.shape.mesh import Dimensions
from csas_shadow_ros.core.shape.result import (
    QUALITIES,
    VERDICTS,
    Detectable,
    LeftOut,
    ObjectResult,
    Quality,
    Result,
)
from csas_shadow_ros.core.shape.seabed import SeabedSlope
from csas_shadow_ros.core.shape.volume import Target, VoxelGrid

from .messages import MessageFactory, frame_of
from .progress import Level
from .statuses import (
    RUN,
    Status,
    Value,
    detectable_of,
    detectable_values,
    left_out_of,
    left_out_statuses,
    numbered,
    run_of,
    sign_of,
    sign_values,
    statuses_from_msg,
    statuses_to_msg,
    target_of,
    target_values,
)
from .topics import LAST_FURTHER

if TYPE_CHECKING:
    from csas_shadow_ros.core.search.bodies import SignEvidence

_WHERE = "measurements"
_OBJECT = "object"
_OTHER = "other method"
_TARGET = "target_"
_SEPARATOR = "; "
#: Fields of `Datum`, and what its covariance is made of.
_DATUM = ("latitude_deg", "longitude_deg", "heading_deg", "altitude_m")
_COVARIANCE = ("datum_variance_east_m2", "datum_variance_north_m2", "datum_covariance_m2")
_LEVELS = dict(zip(QUALITIES, (Level.OK, Level.WARN, Level.ERROR), strict=True))
#: Names of the values, by those of `Dimensions.intervals`.
_KEYS = {
    "length_m": "length_m",
    "width_m": "width_m",
    "height_m": "height_m",
    "volume_m3": "volume_m3",
    "heading_rad": "heading_rad",
    "position_x_m": "x_m",
    "position_y_m": "y_m",
    "hull_top_m": "hull_top_m",
}


@dataclass(frozen=True)
class GridFacts:
    """Facts of a grid that its images lack, or hold only rounded.

    Parameters
    ----------
    method, threshold, seabed
        See `VoxelGrid`.
    origin_m : (float, float, float)
        Scene (x, y, z) of the centre of voxel [0, 0, 0].
    voxel_size_m : float
        Edge of a voxel.
    """

    method: str
    threshold: float
    origin_m: tuple[float, float, float]
    voxel_size_m: float
    seabed: SeabedSlope | None = None

    @classmethod
    def of(cls, grid: VoxelGrid) -> GridFacts:
        """Return a grid's facts."""
        volume = grid.volume
        return cls(grid.method, grid.threshold, volume.origin_m, volume.voxel_size_m, grid.seabed)


@dataclass(frozen=True)
class MeasuredObject:
    """One object.

    Parameters
    ----------
    number : int
        1 is the target; further ones have the number of their topics' prefix.
    target : Target
        The volume that was carved.
    dimensions : Dimensions
        Its measures.
    grid : GridFacts
        Of its grid.
    views_used : int
        Views in the grid.
    """

    number: int
    target: Target
    dimensions: Dimensions
    grid: GridFacts
    views_used: int


@dataclass(frozen=True)
class Measurements:
    """A run's objects, verdict and quality.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the message, ns.
    newest_ns : int
        Stamp of the newest view in it.
    run_ns, final, verdict, quality, arc_rad, views_used, target, sign, detectable
        See `Result`.
    objects : tuple of MeasuredObject
        By rising number.
    grid, other_grid : GridFacts or None
        Of the target's grid by the chosen method and by the other one; None where there is no grid.
    matter_volume_m3, hollow_volume_m3 : float or None
        Of the voxels that hold matter, and of the object's others; None where no echo was looked at.
    left_out : tuple of LeftOut
        Bodies of the search that are no objects, and why.
    frame, datum
        See `Result`.
    """

    stamp_ns: int
    newest_ns: int
    run_ns: int | None
    final: bool
    verdict: str
    quality: Quality
    arc_rad: float
    views_used: int
    target: Target | None = None
    sign: SignEvidence | None = None
    detectable: Detectable | None = None
    objects: tuple[MeasuredObject, ...] = ()
    grid: GridFacts | None = None
    other_grid: GridFacts | None = None
    matter_volume_m3: float | None = None
    hollow_volume_m3: float | None = None
    left_out: tuple[LeftOut, ...] = ()
    frame: str = SCENE_FRAME
    datum: Datum | None = None


def numbered_objects(result: Result) -> dict[int, ObjectResult]:
    """Return a result's objects by their numbers.

    The target is number 1, and no other object takes that number where its carving left none: a further
    object's number is that of its topics' prefix.

    Raises
    ------
    AdapterError
        If there are more objects than prefixes.
    """
    further = dict(enumerate(result.further, start=2))
    if further and max(further) > LAST_FURTHER:
        raise AdapterError(
            f"the result has {len(further)} further objects; expected at most {LAST_FURTHER - 1}"
        )
    return {1: result.objects[0]} | further if len(result.objects) > len(further) else further


def half_width(dimensions: Dimensions, name: str, scale: float = 1.0, digits: int = 3) -> str:
    """Return half of a measure's 95 % interval as `` ± 0.012``; empty without an interval."""
    if name not in dimensions.intervals:
        return ""
    low, high = dimensions.intervals[name]
    return f" ± {scale * (high - low) / 2:.{digits}f}"


def measurements_to_msg(factory: MessageFactory, result: Result, stamp_ns: int | None = None) -> Any:
    """Make the DiagnosticArray of a result: one status for the run, each object and each body left out.

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    result : Result
        What the run leaves. A semicolon in a reason goes out as a comma: semicolons separate reasons.
    stamp_ns : int, optional
        Stamp, ns; that of the newest view in it by default.

    Raises
    ------
    AdapterError
        If the verdict or the quality is none of those that there are, or an interval is of no measure.
    """
    for name, value, allowed in (
        ("verdict", result.verdict, VERDICTS),
        ("quality", result.quality.verdict, QUALITIES),
    ):
        if value not in allowed:
            raise AdapterError(f"the result's {name} is {value!r}; expected one of: {', '.join(allowed)}")
    level = _LEVELS[result.quality.verdict]
    statuses = [Status.of(RUN, _run_values(result), _run_line(result), level)]
    for number, one in numbered_objects(result).items():
        place = result.place_of(one.dimensions)
        values = _object_values(one) | _place_values(place)
        statuses.append(Status.of(f"{_OBJECT} {number}", values, _line(one.dimensions, place), level))
    if result.other_grid is not None:
        statuses.append(Status.of(_OTHER, _grid_values(result.other_grid)))
    statuses += left_out_statuses(result.left_out)
    stamp = result.stamp_ns if stamp_ns is None else stamp_ns
    return statuses_to_msg(factory.in_frame(result.frame), stamp, statuses)


def _reasons(quality: Quality) -> str:
    return _SEPARATOR.join(reason.replace(";", ",") for reason in quality.reasons)


def _run_line(result: Result) -> str:
    reasons = _reasons(result.quality)
    return f"{result.verdict}, {result.quality.verdict}" + (f": {reasons}" if reasons else "")


def _line(d: Dimensions, place: Place | None) -> str:
    size = f"{d.length_m:.3f} x {d.width_m:.3f} x {d.height_m:.3f} m"
    if place is None:
        return f"{size}, heading {math.degrees(d.heading_rad):.1f} deg"
    return f"{size}, bearing {place.bearing_deg:.1f} deg, at {place}"


def _datum_values(datum: Datum | None) -> dict[str, Value]:
    """Return what the places of the objects go by, to the last digit."""
    if datum is None:
        return {}
    values: dict[str, Value] = {f"datum_{name}": getattr(datum, name) for name in _DATUM}
    if datum.covariance_m2 is not None:
        values |= dict(zip(_COVARIANCE, datum.covariance_m2, strict=True))
    return values


def _datum_of(run: Status) -> Datum | None:
    if "datum_latitude_deg" not in run:
        return None
    latitude, longitude, heading, altitude = run.reals(*(f"datum_{name}" for name in _DATUM))
    east, north, both = run.reals(*_COVARIANCE) if _COVARIANCE[0] in run else (math.nan,) * 3
    covariance = None if math.isnan(east) else (east, north, both)
    try:
        return Datum(latitude, longitude, heading, altitude, covariance)
    except CsasError as error:
        raise AdapterError(f"{_WHERE}, status {RUN!r}: {error}") from error


def _place_values(place: Place | None) -> dict[str, Value]:
    """Return an object's place for readers at large; it is worked out from the datum, not read back."""
    return {} if place is None else dict(vars(place))


def _run_values(result: Result) -> dict[str, Value]:
    values: dict[str, Value] = {
        "verdict": result.verdict,
        "quality": result.quality.verdict,
        "reasons": _reasons(result.quality),
    }
    if result.run_ns is not None:
        values["run"] = int(result.run_ns)
    values |= {
        "newest": int(result.stamp_ns),
        "final": bool(result.final),
        "arc_deg": math.degrees(result.arc_rad),
        "arc_rad": result.arc_rad,
        "views": int(result.views_used),
    }
    values |= sign_values(result.sign) | detectable_values(result.detectable) | _datum_values(result.datum)
    if result.target is not None:
        values |= target_values(result.target, _TARGET)
    if result.grid is not None:
        values |= _grid_values(result.grid)
        if result.matter is not None:
            voxel = result.grid.volume.voxel_size_m**3
            hollow = result.grid.occupied & ~result.matter
            values["matter_volume_m3"] = int(np.count_nonzero(result.matter)) * voxel
            values["hollow_volume_m3"] = int(np.count_nonzero(hollow)) * voxel
    return values


def _grid_values(grid: VoxelGrid) -> dict[str, Value]:
    x, y, z = grid.volume.origin_m
    values: dict[str, Value] = {
        "method": grid.method,
        "threshold": grid.threshold,
        "origin_x_m": x,
        "origin_y_m": y,
        "origin_z_m": z,
        "voxel_size_m": grid.volume.voxel_size_m,
    }
    if grid.seabed is not None:
        values |= {
            "seabed_gradient_x": grid.seabed.gradient[0],
            "seabed_gradient_y": grid.seabed.gradient[1],
            "seabed_sigma": grid.seabed.sigma,
            "seabed_about_x_m": grid.seabed.about_m[0],
            "seabed_about_y_m": grid.seabed.about_m[1],
            "seabed_believed": bool(grid.seabed.believed),
        }
    return values


def _object_values(one: ObjectResult) -> dict[str, Value]:
    d = one.dimensions
    x, y = d.position_m
    measured = {"position_x_m": x, "position_y_m": y}
    values: dict[str, Value] = {}
    for name, key in _KEYS.items():
        values[key] = measured[name] if name in measured else getattr(d, name)
        if name in d.intervals:
            values[f"{key}.low"], values[f"{key}.high"] = d.intervals[name]
    if unknown := sorted(set(d.intervals) - set(_KEYS)):
        raise AdapterError(f"there is an interval of {quoted(unknown[0])}; expected of: {', '.join(_KEYS)}")
    values["views"] = int(one.views_used)
    if math.isfinite(d.scatter_cells):
        values["scatter_cells"] = d.scatter_cells
    return values | _grid_values(one.grid) | target_values(one.target, _TARGET)


def measurements_from_msg(msg: Any) -> Measurements:
    """Read a run's objects, to the last digit; ignore unknown values.

    Parameters
    ----------
    msg : diagnostic_msgs/DiagnosticArray
        Of either message world.

    Raises
    ------
    AdapterError
        Naming the status and the value that are missing or not what they must be.
    """
    stamp_ns, statuses = statuses_from_msg(msg, _WHERE)
    run = run_of(statuses, _WHERE)
    reasons = tuple(reason for reason in run.text("reasons").split(_SEPARATOR) if reason)
    matter = "matter_volume_m3" in run
    return Measurements(
        stamp_ns=stamp_ns,
        newest_ns=run.whole("newest"),
        run_ns=run.whole("run") if "run" in run else None,
        final=run.truth("final"),
        verdict=run.text("verdict", VERDICTS),
        quality=Quality(run.text("quality", QUALITIES), reasons),
        arc_rad=run.real("arc_rad"),
        views_used=run.whole("views"),
        target=target_of(run, _TARGET) if f"{_TARGET}x_m" in run else None,
        sign=sign_of(run),
        detectable=detectable_of(run),
        objects=tuple(_object_of(number, one) for number, one in numbered(statuses, _OBJECT).items()),
        grid=_grid_of(run) if "voxel_size_m" in run else None,
        other_grid=_grid_of(statuses[_OTHER]) if _OTHER in statuses else None,
        matter_volume_m3=run.real("matter_volume_m3") if matter else None,
        hollow_volume_m3=run.real("hollow_volume_m3") if matter else None,
        left_out=left_out_of(statuses),
        frame=frame_of(msg, _WHERE),
        datum=_datum_of(run),
    )


def _grid_of(status: Status) -> GridFacts:
    x, y, z = status.reals("origin_x_m", "origin_y_m", "origin_z_m", finite=True)
    size = status.real("voxel_size_m", finite=True)
    if not size > 0:
        raise status.refuse("voxel_size_m", "more than 0 m")
    seabed = None
    if "seabed_sigma" in status:
        gx, gy = status.reals("seabed_gradient_x", "seabed_gradient_y", finite=True)
        about_x, about_y = status.reals("seabed_about_x_m", "seabed_about_y_m", finite=True)
        seabed = SeabedSlope((gx, gy), status.real("seabed_sigma"), (about_x, about_y))
    return GridFacts(status.text("method", tuple(METHODS)), status.real("threshold"), (x, y, z), size, seabed)


def _object_of(number: int, status: Status) -> MeasuredObject:
    if number > LAST_FURTHER:
        raise AdapterError(f"{_WHERE} has an object {number}; expected at most {LAST_FURTHER}")
    return MeasuredObject(
        number, target_of(status, _TARGET), _dimensions_of(status), _grid_of(status), status.whole("views")
    )


def _dimensions_of(status: Status) -> Dimensions:
    intervals: dict[str, tuple[float, float]] = {}
    for name, key in _KEYS.items():
        if f"{key}.low" in status or f"{key}.high" in status:
            low, high = status.reals(f"{key}.low", f"{key}.high")
            intervals[name] = low, high
    x, y = status.reals("x_m", "y_m")
    plain: Mapping[str, float] = {
        name: status.real(key) for name, key in _KEYS.items() if not name.startswith("position")
    }
    scatter = status.real("scatter_cells") if "scatter_cells" in status else math.nan
    return Dimensions(position_m=(x, y), intervals=intervals, scatter_cells=scatter, **plain)
