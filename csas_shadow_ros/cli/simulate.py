"""``csas-shadow simulate``: a bag of a simulated run."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path

from ..core.frame_name import SCENE_FRAME
from ..core.parameters import PlaceParameters
from .console import OK, Console
from .options import output_options

#: Shadows may leave the image by so much of its half side before a simulation is said to be too small.
_MAX_REACH = 1.6


def add_simulate(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``simulate``."""
    add(
        "simulate",
        "make a bag of a simulated run, with its truth beside it",
        "  csas-shadow simulate box_run --profile tiny\n"
        "  csas-shadow simulate frame_run --target frame_grid --heading-deg 30 --encoding 16SC2\n"
        "  csas-shadow simulate hard_run --contrast-db 6 --track-wobble-m 0.5 --missing-arc 40 75\n"
        "  csas-shadow simulate mine_run --target mine.stl --position 0.5 -0.3\n\n"
        "writes OUT_BAG, OUT_BAG.truth.stl and OUT_BAG.truth.json. Profile samdis takes minutes and 2 GB.",
        _simulate,
        _simulate_options,
    )


def _simulate_options(p: argparse.ArgumentParser) -> None:
    from ..simulation import PROFILES, TARGETS

    p.add_argument("out_bag", metavar="OUT_BAG", help="bag to make (a rosbag2 directory)")
    p.add_argument("--overwrite", action="store_true", help="replace a bag that is there")
    p.add_argument(
        "--profile",
        choices=list(PROFILES),
        default="standard",
        help="image, circle and band (default standard)",
    )
    p.add_argument(
        "--target",
        default="box",
        metavar="NAME|MESH",
        help=f"{', '.join(TARGETS)}; or a closed mesh file in metres (default box)",
    )
    p.add_argument("--seed", type=int, default=0, help="of everything random (default 0)")
    p.add_argument(
        "--position", type=float, nargs=2, default=(0.0, 0.0), metavar=("X", "Y"), help="of the target (m)"
    )
    p.add_argument(
        "--heading-deg", type=float, default=0.0, metavar="DEG", help="turn of the target, counter-clockwise"
    )
    p.add_argument(
        "--encoding",
        choices=("32FC2", "64FC2", "16SC2", "8SC2"),
        default="32FC2",
        help="pixels of the image: float32, float64, int16 or int8 pairs (default 32FC2)",
    )
    p.add_argument(
        "--sectors",
        type=float,
        default=0.0,
        metavar="DEG",
        help="write sectors of so much arc, as they come during a run, instead of the image",
    )
    p.add_argument(
        "--sector-lattice",
        choices=("image", "own"),
        default="image",
        help="lattice of those sectors: the image's (default), or each the coarsest that holds its arc",
    )
    p.add_argument(
        "--spectrum-sign",
        type=int,
        choices=(1, -1),
        default=1,
        help="phase convention of the image (default 1)",
    )
    p.add_argument(
        "--echo-db", type=float, default=12.0, metavar="DB", help="target's echo over the seabed (default 12)"
    )
    p.add_argument("--clockwise", action="store_true", help="the sonar goes round clockwise")
    p.add_argument(
        "--start-aspect-deg",
        type=float,
        default=0.0,
        metavar="DEG",
        help="aspect of the first pose (default 0)",
    )
    place = p.add_argument_group("place on earth, for topic origin")
    for flag, text in (
        ("--origin-lat-deg", "latitude of the scene's origin, WGS-84 (default: no origin is written)"),
        ("--origin-lon-deg", "its longitude"),
        ("--origin-sigma-m", "its standard deviation, along east and north (default: not known)"),
    ):
        place.add_argument(
            flag, type=float, metavar=flag.rpartition("-")[2].upper(), default=math.nan, help=text
        )
    place.add_argument(
        "--scene-frame",
        default=SCENE_FRAME,
        metavar="NAME",
        help=f"the scene's frame (default {SCENE_FRAME})",
    )
    faults = p.add_argument_group("faults")
    faults.add_argument(
        "--contrast-db", type=float, default=15.0, metavar="DB", help="seabed over shadow level (default 15)"
    )
    faults.add_argument(
        "--track-wobble-m",
        type=float,
        default=0.0,
        metavar="M",
        help="rms departure from the circle, reported",
    )
    faults.add_argument(
        "--height-error",
        type=float,
        default=0.0,
        metavar="F",
        help="the track reports heights (1 + F) times true",
    )
    faults.add_argument(
        "--missing-arc",
        type=float,
        nargs=2,
        action="append",
        default=[],
        metavar=("START", "STOP"),
        help="arc without imagery and poses, degrees counter-clockwise; may be repeated",
    )
    faults.add_argument(
        "--phase-error-rad", type=float, default=0.0, metavar="RAD", help="rms residual phase error"
    )
    faults.add_argument(
        "--quadratic-phase-rad",
        type=float,
        default=0.0,
        metavar="RAD",
        help="parabolic phase error of each arc",
    )
    faults.add_argument(
        "--quadratic-arc-deg",
        type=float,
        default=12.0,
        metavar="DEG",
        help="length of those arcs (default 12)",
    )
    faults.add_argument("--wrong-sign", action="store_true", help="the bag states the opposite spectrum sign")
    faults.add_argument(
        "--sound-speed-error",
        type=float,
        default=0.0,
        metavar="F",
        help="the bag states (1 + F) times the true c",
    )
    faults.add_argument(
        "--seabed-slope-db",
        type=float,
        default=0.0,
        metavar="DB",
        help="seabed level rises so much west to east",
    )
    shape = p.add_argument_group("image and circle, instead of the profile's")
    for flag, kind, unit, text in (
        ("--rows", int, "N", "rows of the image"),
        ("--cols", int, "N", "columns of the image"),
        ("--spacing-m", float, "M", "pixel"),
        ("--radius-m", float, "M", "radius of the circle"),
        ("--height-m", float, "M", "height of the sonar over the seabed"),
        ("--centre-frequency-hz", float, "HZ", "centre frequency"),
        ("--bandwidth-hz", float, "HZ", "bandwidth"),
        ("--sound-speed-mps", float, "MS", "sound speed"),
    ):
        dest = "profile_" + flag[2:].replace("-", "_")
        shape.add_argument(flag, type=kind, metavar=unit, default=None, dest=dest, help=text)
    output_options(p)


def _simulate(arguments: argparse.Namespace, console: Console) -> int:
    from ..simulation import Faults, get_profile, simulate_bag

    overrides = {
        name.removeprefix("profile_"): value
        for name, value in vars(arguments).items()
        if name.startswith("profile_") and value is not None
    }
    faults = Faults(
        contrast_db=arguments.contrast_db,
        track_wobble_m=arguments.track_wobble_m,
        height_error=arguments.height_error,
        missing_arcs_deg=tuple(tuple(arc) for arc in arguments.missing_arc),
        phase_error_rad=arguments.phase_error_rad,
        quadratic_phase_rad=arguments.quadratic_phase_rad,
        quadratic_arc_deg=arguments.quadratic_arc_deg,
        wrong_sign=arguments.wrong_sign,
        sound_speed_error=arguments.sound_speed_error,
        seabed_slope_db=arguments.seabed_slope_db,
    )
    datum = PlaceParameters(
        origin_lat_deg=arguments.origin_lat_deg,
        origin_lon_deg=arguments.origin_lon_deg,
        origin_sigma_m=arguments.origin_sigma_m,
    ).datum()
    start = time.perf_counter()
    with console.bar("simulating") as bar:
        run = simulate_bag(
            arguments.out_bag,
            get_profile(arguments.profile, **overrides),
            arguments.target,
            seed=arguments.seed,
            position_m=tuple(arguments.position),
            heading_deg=arguments.heading_deg,
            faults=faults,
            spectrum_sign=arguments.spectrum_sign,
            echo_db=arguments.echo_db,
            clockwise=arguments.clockwise,
            start_aspect_deg=arguments.start_aspect_deg,
            progress=bar,
            encoding=arguments.encoding,
            overwrite=arguments.overwrite,
            sectors_deg=arguments.sectors,
            sector_lattice=arguments.sector_lattice,
            datum=datum,
            frame=arguments.scene_frame,
        )
    out = Path(arguments.out_bag)
    length, width, height = run.truth.dims_m
    grid = run.image.grid
    _, _, radius, sonar_height = run.track.circle
    # The target's far corner and the shadow behind its top, against where the image ends.
    reach = math.hypot(*run.truth.position_m) + math.hypot(length, width) / 2 + height * radius / sonar_height
    side = min(grid.rows, grid.cols) * grid.spacing_m / 2
    if height and reach > _MAX_REACH * side:
        console.notice(
            f"the target's shadows reach {reach:.1f} m from the middle, but the image ends at {side:.1f} m:"
            " its shape will not come out; take a larger profile or a smaller target"
        )
    document = {
        "bag": str(out.resolve()),
        "truth": [str(out.with_name(f"{out.name}.truth.{kind}").resolve()) for kind in ("stl", "json")],
        "target": run.truth.name,
        "dims_m": [length, width, height],
        "position_m": list(run.truth.position_m),
        "profile": arguments.profile,
        "encoding": arguments.encoding,
        "rows": grid.rows,
        "cols": grid.cols,
        "poses": len(run.track),
        "seconds": time.perf_counter() - start,
    }
    text = (
        f"{out}: {run.truth.name}"
        + (f" {length:.2f} x {width:.2f} x {height:.2f} m" if height else "")
        + f", image {grid.rows} x {grid.cols} of {grid.spacing_m * 1e3:g} mm as {arguments.encoding},"
        f" {len(run.track)} poses; {document['seconds']:.1f} s"
    )
    console.result(text, document)
    return OK
