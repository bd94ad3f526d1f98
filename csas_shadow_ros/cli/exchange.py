"""``csas-shadow import`` and ``export``: other programs' runs, and files for them."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable

from ..core.parameters import STAGES, PlaceParameters
from .console import OK, PARTIAL, PROGRAM, Console
from .options import add_parameters, given_parameters, output_options


def add_import(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``import``."""
    p = add(
        "import",
        "make a run's bag from an image and navigation of other programs",
        "  csas-shadow import image.npy --out my_run --geometry geometry.yaml\n"
        "  csas-shadow import image.tif --out my_run --geometry geometry.yaml --track mission.mcap\n\n"
        "SOURCE is a complex image (.npy .npz .mat .h5 .tif .ntf), the track a CSV file or a bag with\n"
        "Odometry, poses, fixes or transforms. docs/import.md describes the page of geometry.",
        _import,
    )
    p.add_argument("source", metavar="SOURCE", help="the full-circle complex image")
    p.add_argument("--out", required=True, metavar="BAG", help="make this rosbag2 directory")
    p.add_argument(
        "--geometry", required=True, metavar="YAML", help="read what the image does not say from this page"
    )
    p.add_argument("--track", metavar="FILE|BAG", help="read navigation from here instead of the page's file")
    p.add_argument(
        "--encoding",
        default="32FC2",
        choices=("32FC2", "64FC2", "16SC2", "8SC2"),
        help="encode the bag's image in this way (default 32FC2)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace an existing bag")
    output_options(p)


def add_export(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``export``."""
    add(
        "export",
        "write a results folder for charts: GeoTIFF, GeoJSON, GeoPackage, KML, Zarr, NetCDF",
        "  csas-shadow export box_results --out box_maps\n"
        "  csas-shadow export box_results --out box_maps --format geotiff,gpkg --overwrite\n"
        "  csas-shadow export box_results --out box_maps --origin-lat-deg 48.38 --origin-lon-deg -4.49\n\n"
        "Without --format writes all formats that the run allows, and names what it lacks. With --format,\n"
        "anything missing makes exit code 3. docs/maps.md describes the files.",
        _export,
        _export_options,
    )


def _export_options(p: argparse.ArgumentParser) -> None:
    p.add_argument("result", metavar="RESULT", help="a results folder")
    p.add_argument("--out", required=True, metavar="FOLDER", help="make this folder")
    p.add_argument(
        "--format",
        default="",
        metavar="LIST",
        help="comma-separated: geotiff, geojson, gpkg, kml, zarr, netcdf (default: all possible ones)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace an existing folder of maps")
    add_parameters(p, {"place": STAGES["place"]})
    output_options(p)


def _import(arguments: argparse.Namespace, console: Console) -> int:
    from ..bags import read_run
    from ..importing import import_run

    bag = import_run(
        arguments.source,
        arguments.out,
        arguments.geometry,
        track=arguments.track,
        encoding=arguments.encoding,
        overwrite=arguments.overwrite,
    )
    run = read_run(bag)
    problems = [str(problem) for problem in run.problems]
    console.result(str(run), {"bag": str(bag.resolve()), "problems": problems})
    return OK


def _export(arguments: argparse.Namespace, console: Console) -> int:
    from ..maps import export_result

    formats = [name.strip() for name in arguments.format.split(",") if name.strip()]
    place = PlaceParameters.from_mapping(given_parameters(arguments))
    done = export_result(arguments.result, arguments.out, formats, place=place, overwrite=arguments.overwrite)
    console.result(str(done), dataclasses.asdict(done))
    for name, why in done.left_out.items():
        if formats:
            print(f"{PROGRAM}: error: {name}: {why}", file=sys.stderr)
        else:
            console.notice(f"left out: {name}: {why}")
    return PARTIAL if formats and done.left_out else OK
