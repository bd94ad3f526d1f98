"""The contacts of a run, as its report tells them: objects, what was left out, how sure, and where."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def geographic(entry: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return latitude and longitude (deg, WGS-84) of an object, if its entry of the report tells them.

    Examples
    --------
    >>> geographic({"place": {"latitude_deg": 60.0, "longitude_deg": 5.0}})
    (60.0, 5.0)
    >>> geographic({"position_m": [0.0, 0.0]}) is None
    True
    """
    place = _mapping(entry.get("place"))
    if not place:
        return None
    return float(place["latitude_deg"]), float(place["longitude_deg"])


def north_deg(report: Mapping[str, Any]) -> float:
    """Return where true north is, degrees counter-clockwise from the scene's +y: 0 unless the run says so."""
    heading = _mapping(report.get("datum")).get("heading_deg")
    return float(heading) if isinstance(heading, int | float) and math.isfinite(heading) else 0.0


def north_shown_deg(scene: Mapping[str, Any]) -> float:
    """Return where true north is in what the page shows: `north_deg` of its report, 0 before there is one."""
    return float(_mapping(scene.get("report")).get("north_deg") or 0.0)


def axis_bearing_deg(heading_rad: float, north_deg: float = 0.0) -> float:
    """Return the true bearing, 0° up to 180°, of an axis that heads somewhere in the scene.

    An object has no front: its other end bears 180° more.

    Parameters
    ----------
    heading_rad : float
        Counter-clockwise from the scene's +x, as in ``report.json``.
    north_deg : float
        Of :func:`north_deg`.

    Examples
    --------
    >>> axis_bearing_deg(0.0)
    90.0
    >>> axis_bearing_deg(3.0 * math.pi / 4.0, north_deg=10.0)
    145.0
    """
    return (90.0 + north_deg - math.degrees(heading_rad)) % 180.0


def contacts_of(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what an operator decides on: every object, the target first, then what was left out.

    Parameters
    ----------
    report : mapping
        Of a results folder; entries that it lacks are left out.
    """
    found: list[dict[str, Any]] = []
    for entry in report.get("objects") or []:
        number, d = int(entry["number"]), entry["dimensions"]
        files = entry.get("files") or ["grid.npz"]
        found.append(
            {
                "id": f"object-{number}",
                "name": f"Contact {number}",
                "kind": "object",
                "position_m": list(entry["position_m"][:2]),
                "geographic": geographic(entry),
                "size_m": max(d["length_m"], d["width_m"], 2.0 * d["height_m"]),
                "height_m": d["height_m"],
                "dimensions": d,
                "truth": entry.get("truth"),
                "views_used": entry.get("views_used"),
                "volume": "main" if files[0] == "grid.npz" else f"object_{number}",
            }
        )
    for number, entry in enumerate(report.get("objects_left_out") or [], start=1):
        found.append(
            {
                "id": f"left-out-{number}",
                "name": f"Left out {number}",
                "kind": "left out",
                "position_m": list(entry["position_m"][:2]),
                "geographic": geographic(entry),
                "size_m": 1.0,
                "reason": str(entry["reason"]),
                "strong": bool(entry.get("strong")),
            }
        )
    return found


def about(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return what else of a report belongs beside the contacts."""
    views, heights = _mapping(report.get("views")), _mapping(report.get("shadow_heights"))
    rejected = _mapping(views.get("rejected_by_aspect_deg"))
    return {
        "verdict": str(report.get("verdict", "")),
        "why_no_object": report.get("why_no_object"),
        "quality": report.get("quality"),
        "hollows": report.get("hollows"),
        "views": {key: views.get(key) for key in ("in", "used", "rejected", "lost", "reasons")},
        "rejected": [[float(aspect), str(reason)] for aspect, reason in rejected.items()],
        "height_median_m": heights.get("median_m"),
        "heights": [
            [one["aspect_deg"], one["height_m"], one["unexplained"], one["lit"]]
            for one in heights.get("by_view") or []
        ],
        "problems": [str(p) for p in report.get("problems") or []]
        + [f"{part}: {why}" for part, why in _mapping(report.get("failed")).items()],
        "run": None if report.get("run") is None else str(report["run"]),
        "north_deg": north_deg(report),
        "version": _mapping(report.get("versions")).get("csas_shadow_ros"),
    }


__all__ = ["about", "axis_bearing_deg", "contacts_of", "geographic", "north_deg", "north_shown_deg"]
