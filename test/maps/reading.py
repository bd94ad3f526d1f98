"""Reads a folder of maps as its users do: a script of its own, which knows nothing of this package."""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path

import geopandas
import numpy as np
import pyogrio
import pyproj
import rasterio
import xarray


def to_scene(latitude: float, longitude: float, origin: tuple[float, float]) -> list[float]:
    """Return metres east and north of the origin, on the plane that touches the ellipsoid there."""
    there = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84"
        f" +step +proj=topocentric +ellps=WGS84 +lat_0={origin[0]} +lon_0={origin[1]} +h_0=0"
    )
    return list(there.transform(longitude, latitude, 0.0, radians=False)[:2])


def raster(path: Path, origin: tuple[float, float] | None) -> dict:
    with rasterio.open(path) as file:
        band = file.read(1, masked=True)
        corner = file.xy(0, 0), file.xy(file.height - 1, file.width - 1)
        told = {
            "shape": list(file.shape),
            "bands": file.count,
            "projected": file.crs.is_projected,
            "geographic": file.crs.is_geographic,
            "wkt": file.crs.to_wkt(),
            "unit": file.units[0],
            "layout": file.tags(ns="IMAGE_STRUCTURE").get("LAYOUT"),
            "corners": [list(one) for one in corner],
            "max": float(band.max()),
        }
        if origin is not None:
            to_earth = pyproj.Transformer.from_crs(file.crs.to_wkt(), "EPSG:4326", always_xy=True)

            def metres(east: float, north: float) -> list[float]:
                longitude, latitude = to_earth.transform(east, north)
                return to_scene(latitude, longitude, origin)

            told["corners_m"] = [metres(*one) for one in corner]
            if path.stem.startswith("height"):
                rows, cols = np.nonzero(~np.ma.getmaskarray(band))
                told["plan_m"] = [metres(*file.xy(row, col)) for row, col in zip(rows, cols, strict=True)]
    return told


def contacts(path: Path, origin: tuple[float, float] | None) -> dict:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        layers = pyogrio.list_layers(path)[:, 0].tolist()
    table = geopandas.read_file(path, layer="contacts")
    told = {
        "layers": layers,
        "count": len(table),
        "columns": list(table.columns),
        "crs": None if table.crs is None else table.crs.to_wkt(),
        "points": [[p.x, p.y] for p in table.geometry],
        "lengths": table["length_m"].tolist() if len(table) else [],
    }
    if origin is not None:
        told["metres"] = [to_scene(p.y, p.x, origin) for p in table.geometry]
    if "outlines" in layers:
        outline = geopandas.read_file(path, layer="outlines")
        if origin is not None and len(outline):
            outline = outline.to_crs(f"+proj=tmerc +lat_0={origin[0]} +lon_0={origin[1]} +datum=WGS84")
        told["areas"] = outline.geometry.area.tolist()
    return told


def cube(path: Path, origin: tuple[float, float] | None) -> dict:
    opened = xarray.open_zarr(path) if path.suffix == ".zarr" else xarray.open_dataset(path)
    with opened as data:
        mapping = dict(data["crs"].attrs)
        told = {
            "mapping": mapping.get("grid_mapping_name"),
            "conventions": data.attrs["Conventions"],
            "verdict": data.attrs["verdict"],
            "occupied": int(data["occupied"].sum()),
            "sum": float(data["likelihood"].sum()),
            "variables": sorted(map(str, data.variables)),
            "names": {axis: data[axis].attrs.get("standard_name") for axis in "xyz"},
        }
        if origin is not None:
            columns = data["occupied"].sum("z")
            weights = columns / columns.sum()
            latitude = float((weights * data["latitude"]).sum())
            longitude = float((weights * data["longitude"]).sum())
            told["middle_m"] = to_scene(latitude, longitude, origin)
        if "grid_mapping_name" in mapping:
            crs = pyproj.CRS.from_cf(mapping)
            to_earth = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
            x, y = float(data["x"][0]), float(data["y"][0])
            longitude, latitude = to_earth.transform(x, y)
            told["apart_deg"] = [
                longitude - float(data["longitude"][0, 0]),
                latitude - float(data["latitude"][0, 0]),
            ]
    return told


def main() -> None:
    folder = Path(sys.argv[1])
    origin = tuple(map(float, sys.argv[2:4])) or None
    told: dict[str, dict] = {}
    for path in sorted(folder.iterdir()):
        kind = {".tif": raster, ".geojson": contacts, ".gpkg": contacts, ".kml": contacts}.get(path.suffix)
        if kind is None and path.suffix in (".nc", ".zarr"):
            kind = cube
        if kind is not None:
            told[path.name] = kind(path, origin)
    assert "csas_shadow_ros" not in sys.modules
    print(json.dumps(told))


if __name__ == "__main__":
    main()
