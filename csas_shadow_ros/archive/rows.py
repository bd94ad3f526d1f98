"""A run as rows of the catalogue: one of the run, one an object. Everything in them is told by its report."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..core.errors import CsasError
from ..core.geometry import Datum
from ..results.layout import REPORT, read_report
from .layout import COPY, DONE, FAILED_STATUS, PartOfTask, Record, brief

#: Columns of the run's table, and what kind of value each holds.
RUN_COLUMNS: dict[str, str] = {
    "task": "text",
    "name": "text",
    "bag": "text",
    "number": "whole",
    "run_ns": "whole",
    "time": "time",
    "status": "text",
    "reason": "text",
    "verdict": "text",
    "why_no_object": "text",
    "quality": "text",
    "reasons": "text",
    "explained": "number",
    "objects": "whole",
    "objects_left_out": "whole",
    "origin_latitude_deg": "number",
    "origin_longitude_deg": "number",
    "origin_heading_deg": "number",
    "arc_deg": "number",
    "duration_s": "number",
    "views_in": "whole",
    "views_used": "whole",
    "views_rejected": "whole",
    "views_lost": "whole",
    "contrast_db": "number",
    "seabed_slope_deg": "number",
    "spectrum_sign": "text",
    "stage": "text",
    "method": "text",
    "voxel_size_m": "number",
    "iou_truth": "number",
    "problems": "text",
    "failed_parts": "text",
    "version": "text",
    "versions": "text",
    "results": "text",
    "finished": "time",
    "seconds": "number",
    "peak_memory_mb": "number",
    "host": "text",
    "bag_bytes": "whole",
    "content": "text",
    "signature": "text",
    "options": "text",
}
#: Measures of an object, with where the report has them: the name there, and its factor (radians to degrees).
_MEASURES = {
    "length_m": ("length_m", 1.0),
    "width_m": ("width_m", 1.0),
    "height_m": ("height_m", 1.0),
    "volume_m3": ("volume_m3", 1.0),
    "heading_deg": ("heading_rad", 180.0 / math.pi),
    "x_m": ("position_x_m", 1.0),
    "y_m": ("position_y_m", 1.0),
}


def _bounds(name: str) -> tuple[str, str]:
    """Return the columns of a measure's interval: ``length_low_m`` and ``length_high_m``."""
    what, _, unit = name.rpartition("_")
    return f"{what}_low_{unit}", f"{what}_high_{unit}"


#: Columns of the objects' table; the first ones are the run's.
CONTACT_COLUMNS: dict[str, str] = {
    **{
        name: RUN_COLUMNS[name]
        for name in ("task", "name", "bag", "number", "run_ns", "time", "verdict", "quality")
    },
    "object": "whole",
    "target": "truth",
    **{column: "number" for name in _MEASURES for column in (name, *_bounds(name))},
    "latitude_deg": "number",
    "longitude_deg": "number",
    "bearing_deg": "number",
    "position_sigma_m": "number",
    "east_half_m": "number",
    "north_half_m": "number",
    "views_used": "whole",
    "mesh": "text",
    "results": "text",
    "finished": "time",
}


@dataclass
class Rows:
    """Rows of one task.

    Parameters
    ----------
    runs, contacts : list of dict
        Values by column; what is not known is not there.
    """

    runs: list[dict[str, Any]] = field(default_factory=list)
    contacts: list[dict[str, Any]] = field(default_factory=list)

    @property
    def failures(self) -> list[str]:
        """Return why runs failed."""
        return [row["reason"] for row in self.runs if row["status"] == FAILED_STATUS]


def rows_of(folder: Path, record: Record | None, root: Path) -> Rows:
    """Make the rows of a task's folder, or of a results folder that no task made.

    Parameters
    ----------
    folder : Path
        Where ``task.json`` and the results lie.
    record : Record or None
        What the task left.
    root : Path
        The archive: paths of results are relative to it.
    """
    rows = Rows()
    parts = record.runs if record else [PartOfTask(folder=".")]
    for part in parts:
        place = folder / part.folder
        base = _base(record, part) if record else _base_of_results(place, root)
        if part.reason:
            rows.runs.append({**base, "status": FAILED_STATUS, "reason": part.reason})
            continue
        try:
            report = read_report(place)
            one, contacts = rows_of_report(report, base, place.relative_to(root).as_posix())
        except (CsasError, OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            why = f"results cannot be read: {brief(error)}"
            rows.runs.append({**base, "status": FAILED_STATUS, "reason": why})
            continue
        rows.runs.append(one)
        rows.contacts += contacts
    return rows


def copy_of(known: Record, copy: Record) -> Rows:
    """Make the row of a bag that holds what another one holds."""
    return Rows([{**_base(copy, PartOfTask()), "status": COPY, "reason": f"holds the same as {known.bag}"}])


def _base_of_results(folder: Path, root: Path) -> dict[str, Any]:
    finished = (folder / REPORT).stat().st_mtime_ns // 1000 if (folder / REPORT).exists() else 0
    return {
        "task": folder.relative_to(root).as_posix(),
        "bag": "",
        "name": "",
        "number": 1,
        "finished": finished,
    }


def _base(record: Record, part: PartOfTask) -> dict[str, Any]:
    return {
        "task": record.bag,
        "name": Path(record.bag).name,
        "bag": record.bag,
        "number": part.number,
        "version": record.version,
        "finished": record.finished_us,
        "seconds": record.seconds,
        "peak_memory_mb": record.peak_memory_mb,
        "host": record.host,
        "bag_bytes": record.bag_bytes,
        "content": record.content,
        "signature": record.signature,
        "options": record.options,
    }


def rows_of_report(
    report: Mapping[str, Any], base: Mapping[str, Any], results: str
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the row of a run, and those of its contacts, of its report."""
    quality, views, given = report["quality"], report["views"], report.get("input") or {}
    run_ns = report.get("run")
    track = given.get("track") or {}
    truth = report.get("truth") or {}
    datum = datum_of(report)
    row = {
        **base,
        "run_ns": run_ns,
        "time": None if run_ns is None else run_ns // 1000,
        "status": DONE,
        "verdict": report["verdict"],
        "why_no_object": report.get("why_no_object"),
        "quality": quality["verdict"],
        "reasons": _joined(quality["reasons"]),
        "explained": quality.get("explained"),
        "objects": len(report["objects"]),
        "objects_left_out": len(report.get("objects_left_out", ())),
        "origin_latitude_deg": None if datum is None else datum.latitude_deg,
        "origin_longitude_deg": None if datum is None else datum.longitude_deg,
        "origin_heading_deg": None if datum is None else datum.heading_deg,
        "arc_deg": report.get("arc_deg"),
        "duration_s": track.get("duration_s"),
        "views_in": views["in"],
        "views_used": views["used"],
        "views_rejected": views["rejected"],
        "views_lost": views["lost"],
        "contrast_db": report["levels"]["overall"].get("contrast_db", {}).get("median"),
        "seabed_slope_deg": (report.get("seabed_slope") or {}).get("slope_deg"),
        "spectrum_sign": report["spectrum_sign"]["verdict"],
        "stage": report.get("stage"),
        "method": report.get("method"),
        "voxel_size_m": (report.get("grid") or {}).get("voxel_size_m"),
        "iou_truth": (truth.get("scores") or {}).get("iou_truth"),
        "problems": _joined(report.get("problems", ())),
        "failed_parts": _joined(f"{part}: {why}" for part, why in report.get("failed", {}).items()),
        "versions": json.dumps(report["versions"], sort_keys=True),
        "results": results,
    }
    row.setdefault("version", None)
    row["version"] = row["version"] or report["versions"]["csas_shadow_ros"]
    row["bag"] = row["bag"] or str(given.get("path", ""))
    row["name"] = row["name"] or Path(row["bag"]).name
    shared = {name: row[name] for name in CONTACT_COLUMNS if name in row and name != "views_used"}
    return row, [_contact(entry, shared, datum) for entry in report["objects"]]


def _contact(entry: Mapping[str, Any], shared: Mapping[str, Any], datum: Datum | None) -> dict[str, Any]:
    dimensions = entry["dimensions"]
    x, y = entry["position_m"][:2]
    values = {**dimensions, "position_x_m": x, "position_y_m": y}
    contact = {**shared, "object": entry["number"], "target": bool(entry.get("target"))}
    for column, (name, factor) in _MEASURES.items():
        low, high = (dimensions.get("intervals") or {}).get(name, (None, None))
        lower, upper = _bounds(column)
        for key, value in ((column, values.get(name)), (lower, low), (upper, high)):
            contact[key] = None if value is None else value * factor
    contact |= place_of(entry, datum)
    contact["east_half_m"], contact["north_half_m"] = _half_widths(contact, datum)
    contact["views_used"] = entry.get("views_used")
    contact["mesh"] = f"{shared['results']}/{entry['files'][-1]}"
    return contact


def _half_widths(contact: Mapping[str, Any], datum: Datum | None) -> tuple[float | None, float | None]:
    """Return how far east and north of its position an object may lie (95 %), in the scene's place."""
    halves = []
    for name in ("x_m", "y_m"):
        low, high = (contact[bound] for bound in _bounds(name))
        if low is None or high is None:
            return None, None
        halves.append((high - low) / 2.0)
    turn = 0.0 if datum is None else math.radians(datum.heading_deg)
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    return c * halves[0] + s * halves[1], s * halves[0] + c * halves[1]


def datum_of(report: Mapping[str, Any]) -> Datum | None:
    """Return where on earth the scene of a report is; None where it does not say."""
    told = report.get("datum")
    if not told:
        return None
    covariance = told.get("covariance_m2")
    return Datum(**{**told, "covariance_m2": None if covariance is None else tuple(covariance)})


def place_of(entry: Mapping[str, Any], datum: Datum | None) -> dict[str, float | None]:
    """Return an object's latitude, longitude and true bearing, and how sure its scene's place is (1σ, m)."""
    told = entry.get("place") or {}
    covariance = None if datum is None else datum.covariance_m2
    return {
        "position_sigma_m": None if covariance is None else math.sqrt(max(covariance[:2])),
        **{name: told.get(name) for name in ("latitude_deg", "longitude_deg", "bearing_deg")},
    }


def _joined(lines: Iterable[str] | Sequence[str]) -> str:
    return "; ".join(lines)
