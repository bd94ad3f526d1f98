"""Contacts as GeoJSON, GeoPackage and KML: a point an object, with its measures."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..archive.extras import need
from ..archive.rows import CONTACT_COLUMNS
from .crs import WGS_84, lone_wkt
from .source import MapSource

#: What of a contact is told, in this order; a place comes with a datum alone.
_LEFT_OUT = {"task", "position_sigma_m", "finished", "mesh", "results", "number", "time"}
_COLUMNS = {
    **{name: kind for name, kind in CONTACT_COLUMNS.items() if name not in _LEFT_OUT},
    "sigma_east_m": "number",
    "sigma_north_m": "number",
}


def write_geojson(source: MapSource, folder: Path) -> list[str]:
    """Write ``contacts.geojson`` (RFC 7946); return its name."""
    # Nine decimals are 0.1 mm; the standard's seven are 11 mm.
    options = {"RFC7946": "YES", "COORDINATE_PRECISION": "9"}
    return [_points(source, folder / "contacts.geojson", "GeoJSON", options)]


def write_kml(source: MapSource, folder: Path) -> list[str]:
    """Write ``contacts.kml``; return its name."""
    return [_points(source, folder / "contacts.kml", "KML", {"NameField": "name"})]


def write_geopackage(source: MapSource, folder: Path) -> list[str]:
    """Write ``contacts.gpkg``: layers ``contacts`` (points) and ``outlines`` (plans); return its name.

    Without a datum both are in the scene's own metres.
    """
    path = folder / "contacts.gpkg"
    _points(source, path, "GPKG", {})
    outlines = [
        _polygon([_place(source, *corner) for corner in source.corners_m(one)]) for one in source.contacts
    ]
    _write(source, path, "GPKG", "outlines", "Polygon", outlines, {}, append=True)
    return [path.name]


def _points(source: MapSource, path: Path, driver: str, options: Mapping[str, str]) -> str:
    points = [struct.pack("<BIdd", 1, 1, *_place(source, one["x_m"], one["y_m"])) for one in source.contacts]
    _write(source, path, driver, "contacts", "Point", points, options)
    return path.name


def _place(source: MapSource, x_m: float, y_m: float) -> tuple[float, float]:
    """Return longitude and latitude of a point of the scene; its x and y without a datum."""
    if source.datum is None:
        return x_m, y_m
    latitude, longitude = source.datum.to_latlon(x_m, y_m)
    return longitude, latitude


def _polygon(corners: Sequence[tuple[float, float]]) -> bytes:
    ring = [*corners, corners[0]]
    return struct.pack("<BIII", 1, 3, 1, len(ring)) + b"".join(struct.pack("<dd", *one) for one in ring)


def _write(
    source: MapSource,
    path: Path,
    driver: str,
    layer: str,
    kind: str,
    geometry: Sequence[bytes],
    options: Mapping[str, str],
    *,
    append: bool = False,
) -> None:
    need("pyogrio", "export of contacts", "maps")
    from pyogrio.raw import write

    columns = {name: _column(source.contacts, name, kind) for name, kind in _COLUMNS.items()}
    told = {name: values for name, values in columns.items() if values is not None}
    names = [f"object {one['object']} of {one['name'] or source.folder.name}" for one in source.contacts]
    told["label" if driver != "KML" else "name"] = np.array(names, dtype=object)
    write(
        path,
        np.array(geometry, dtype=object),
        list(told.values()),
        list(told),
        layer=layer,
        driver=driver,
        geometry_type=kind,
        crs=WGS_84 if source.datum is not None else lone_wkt(source.frame),
        append=append,
        layer_options=dict(options) if driver == "GeoJSON" else None,
        dataset_options=dict(options) if driver == "KML" else None,
    )


def _column(contacts: Sequence[Mapping[str, Any]], name: str, kind: str) -> Any:
    """Return a column's values; None where no contact has one."""
    values = [one.get(name) for one in contacts]
    if contacts and all(value is None for value in values):
        return None
    if kind == "text":
        return np.array([value or "" for value in values], dtype=object)
    if kind == "number":
        return np.array([math.nan if value is None else value for value in values], dtype=np.float64)
    if kind == "truth":
        return np.array([bool(value) for value in values], dtype=bool)
    return np.array([value or 0 for value in values], dtype=np.int64)
