"""A results folder as files for charts: GeoTIFF, GeoJSON, GeoPackage, KML, Zarr and NetCDF."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..core.errors import ParameterError
from ..core.parameters import PlaceParameters
from ..durable import Place
from . import vectors
from .cube import write_netcdf, write_zarr
from .geotiff import write_geotiff
from .source import MapError, MapSource

#: Formats, and what writes them into a folder; each returns the names of what it wrote.
FORMATS: dict[str, Callable[[MapSource, Path], list[str]]] = {
    "geotiff": write_geotiff,
    "geojson": vectors.write_geojson,
    "gpkg": vectors.write_geopackage,
    "kml": vectors.write_kml,
    "zarr": write_zarr,
    "netcdf": write_netcdf,
}
#: Those whose standard knows nothing but longitude and latitude.
_ON_EARTH = ("geojson", "kml")
MANIFEST, FORMAT = "maps.json", "csas_shadow_ros maps 1"


@dataclass
class Exported:
    """What was written.

    Parameters
    ----------
    folder : str
        Where.
    files : list of str
        Names of files, and of Zarr's folder.
    left_out : dict
        Why what is not there is not, by its name.
    """

    folder: str
    files: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.folder}: {', '.join(self.files) or 'nothing'}"


def export_result(
    result: str | Path,
    out: str | Path,
    formats: Sequence[str] = (),
    *,
    place: PlaceParameters | None = None,
    overwrite: bool = False,
) -> Exported:
    """Write a results folder as files for charts.

    Parameters
    ----------
    result : path-like
        A results folder.
    out : path-like
        Folder to make.
    formats : sequence of str
        Of `FORMATS`; by default all that the run can be written in. GeoJSON and KML need a datum.
    place : PlaceParameters, optional
        Where the scene is, instead of what the run was told.
    overwrite : bool
        Replace such a folder that is there; no other is ever replaced.

    Returns
    -------
    Exported
        What was written, and what the run does not hold.

    Raises
    ------
    CsasError
        If a format is unknown or cannot hold this run, a library is missing, or the folder is taken.
    """
    for name in formats:
        if name not in FORMATS:
            raise ParameterError(f"format is {name!r}; expected one of: {', '.join(FORMATS)}")
    source = MapSource(result, place)
    folder = Path(os.path.abspath(out))  # noqa: PTH100  (a link stays one)
    done = Exported(str(folder))
    for name in _ON_EARTH if source.datum is None else ():
        why = (
            f"{result} has no datum, and {name} holds longitude and latitude alone; expected one, as"
            " --origin-lat-deg and --origin-lon-deg give it"
        )
        if name in formats:
            raise MapError(why)
        done.left_out[name] = why
    chosen = [name for name in FORMATS if (name in formats or not formats) and name not in done.left_out]
    _check_place(folder, overwrite)
    place_of_folder = Place(folder)
    place_of_folder.clear(lambda _: None)
    work = place_of_folder.make()
    try:
        for name in chosen:
            done.files += FORMATS[name](source, work)
        done.left_out |= source.lacking
        manifest = {
            "format": FORMAT,
            "result": str(source.folder.resolve()),
            "datum": None if source.datum is None else vars(source.datum),
            "files": done.files,
            "left_out": done.left_out,
        }
        (work / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
        place_of_folder.put(replace=overwrite, durable=False)
    except BaseException:
        place_of_folder.abandon()
        raise
    return done


def _check_place(folder: Path, overwrite: bool) -> None:
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not overwrite:
        raise MapError(f"{folder} exists already; expected a new folder, or --overwrite")
    try:
        told: Any = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        ours = told["format"] == FORMAT
    except (OSError, ValueError, LookupError, TypeError):
        ours = False
    if not ours:
        raise MapError(f"{folder} exists and is not a folder of maps: not replaced")
