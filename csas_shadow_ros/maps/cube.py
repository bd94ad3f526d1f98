"""The carved grid as NetCDF and Zarr, by the climate and forecast conventions (CF 1.11)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..archive.extras import need
from ..core.geometry import Datum
from .crs import INVERSE_FLATTENING, SEMI_MAJOR_M, chart_wkt, scale_of
from .source import MapSource

if TYPE_CHECKING:
    import xarray

_BOOLEANS = ("occupied", "matter")


def dataset_of(source: MapSource) -> xarray.Dataset:
    """Return grid and pictures of a results folder as CF has them.

    With a datum every column has ``latitude`` and ``longitude``, and x and y are those of the chart, unless
    the scene is turned: the axes of such a scene are its own, and no map projection of CF.

    Raises
    ------
    MissingExtraError
        If xarray is not installed.
    """
    need("xarray", "export to Zarr and NetCDF", "maps")
    result = source.result()
    data = result.to_xarray()
    datum = source.datum
    for name in _BOOLEANS:
        if name in data:
            flags = {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "no yes"}
            data[name] = data[name].astype(np.int8).assign_attrs(data[name].attrs | flags)
    data["z"].attrs |= {"axis": "Z", "positive": "up", "standard_name": "height"}
    for axis in "xy":
        data[axis].attrs |= {"axis": axis.upper()}
    for raster in source.rasters:
        if raster.pixels.ndim == 2 and not raster.name.startswith("height"):
            lattice = {
                f"ground_{axis}": (f"ground_{axis}", values, dict(data[axis].attrs))
                for axis, values in (("y", raster.grid.y_of_rows()), ("x", raster.grid.x_of_columns()))
            }
            attributes = {"long_name": raster.about}
            picture = (("ground_y", "ground_x"), raster.pixels, attributes)
            data = data.assign_coords(lattice).assign({raster.name: picture})
    variables = list(data.data_vars)
    data["crs"] = ((), np.int32(0), _mapping(datum, source.frame))
    for variable in variables:
        data[variable].attrs["grid_mapping"] = "crs"
    if datum is not None:
        if not datum.heading_deg:
            for axis in ("x", "y", "ground_x", "ground_y"):
                if axis in data.coords:
                    data[axis].attrs["standard_name"] = f"projection_{axis[-1]}_coordinate"
        data = data.assign_coords(_latlon(datum, data["x"].values, data["y"].values))
    run = source.report.get("run")
    data.attrs |= {
        "Conventions": "CF-1.11",
        "title": f"circular SAS contact, {result.verdict}",
        "source": f"csas_shadow_ros {source.report['versions'].get('csas_shadow_ros', '')}",
    }
    return data.assign_attrs({} if run is None else {"run_ns": str(run)})


def _mapping(datum: Datum | None, frame: str) -> dict[str, Any]:
    """Return the attributes of CF's grid mapping; of a scene that is turned or nowhere, its text alone."""
    if datum is None or datum.heading_deg:
        text = {"long_name": f"axes of the sonar's scene {frame}", "comment": "x and y are no map projection"}
        return text if datum is None else {**text, "heading_deg": datum.heading_deg, **_about(datum)}
    return {
        "grid_mapping_name": "transverse_mercator",
        "latitude_of_projection_origin": datum.latitude_deg,
        "longitude_of_central_meridian": datum.longitude_deg,
        "scale_factor_at_central_meridian": 1.0 / scale_of(datum),
        "false_easting": 0.0,
        "false_northing": 0.0,
        "semi_major_axis": SEMI_MAJOR_M,
        "inverse_flattening": INVERSE_FLATTENING,
        "longitude_of_prime_meridian": 0.0,
        "crs_wkt": chart_wkt(datum),
        **_about(datum),
    }


def _about(datum: Datum) -> dict[str, float]:
    told = {
        "datum_latitude_deg": datum.latitude_deg,
        "datum_longitude_deg": datum.longitude_deg,
        "datum_altitude_m": datum.altitude_m,
    }
    if datum.covariance_m2 is not None:
        told["datum_sigma_east_m"], told["datum_sigma_north_m"] = np.sqrt(datum.covariance_m2[:2]).tolist()
    return told


def _latlon(datum: Datum, x: Any, y: Any) -> dict[str, Any]:
    places = np.array([[datum.to_latlon(one, other) for one in x.tolist()] for other in y.tolist()])
    return {
        name: (("y", "x"), places[..., index], {"standard_name": name, "units": f"degrees_{side}"})
        for index, (name, side) in enumerate((("latitude", "north"), ("longitude", "east")))
    }


def write_netcdf(source: MapSource, folder: Path) -> list[str]:
    """Write ``grid.nc`` (NetCDF-4); return its name."""
    data = dataset_of(source)
    need("h5netcdf", "export to NetCDF", "maps")
    packed = {name: {"zlib": True, "complevel": 4} for name, one in data.data_vars.items() if one.ndim}
    data.to_netcdf(folder / "grid.nc", engine="h5netcdf", encoding=packed)
    return ["grid.nc"]


def write_zarr(source: MapSource, folder: Path) -> list[str]:
    """Write ``grid.zarr``; return its name."""
    data = dataset_of(source)
    need("zarr", "export to Zarr", "maps")
    # Version 2 is what all readers know.
    data.to_zarr(folder / "grid.zarr", mode="w", consolidated=True, zarr_format=2)
    return ["grid.zarr"]
