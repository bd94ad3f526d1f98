"""``csas-shadow simulate``: a bag of a simulated run."""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.frame_name import SCENE_FRAME
from ..core.parameters import PlaceParameters
from .console import OK, Console
from .options import output_options

if TYPE_CHECKING:
    from ..simulation import SimulatedRun

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
    p.add_argument("out_bag", metavar="OUT_BAG", help="bag to make (a rosbag2 directory)")
    p.add_argument("--overwrite", action="store_true", help="replace a bag that is there")
    _scene_options(p)
    _image_options(p)
    _sonar_options(p)
    _place_options(p.add_argument_group("place on earth, for topic origin"))
    _fault_options(p.add_argument_group("faults"))
    _profile_options(p.add_argument_group("image and circle, instead of the profile's"))
    output_options(p)


def _scene_options(p: argparse.ArgumentParser) -> None:
    """Add what is looked at, and by what kind of run."""
    from ..simulation import PROFILES, TARGETS

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


def _image_options(p: argparse.ArgumentParser) -> None:
    """Add how the image is written."""
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


def _sonar_options(p: argparse.ArgumentParser) -> None:
    """Add how the sonar goes round, and how loud it hears the target."""
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


def _place_options(group: argparse._ArgumentGroup) -> None:
    """Add where on earth the scene is."""
    for flag, text in (
        ("--origin-lat-deg", "latitude of the scene's origin, WGS-84 (default: no origin is written)"),
        ("--origin-lon-deg", "its longitude"),
        ("--origin-sigma-m", "its standard deviation, along east and north (default: not known)"),
    ):
        group.add_argument(
            flag, type=float, metavar=flag.rpartition("-")[2].upper(), default=math.nan, help=text
        )
    group.add_argument(
        "--scene-frame",
        default=SCENE_FRAME,
        metavar="NAME",
        help=f"the scene's frame (default {SCENE_FRAME})",
    )


def _fault_options(group: argparse._ArgumentGroup) -> None:
    """Add what is wrong with the run."""
    from ..simulation import Faults

    _field_options(group, Faults, "contrast_db", "track_wobble_m", "height_error")
    group.add_argument(
        "--missing-arc",
        type=float,
        nargs=2,
        action="append",
        metavar=("START", "STOP"),
        dest="faults.missing_arcs_deg",
        help="arc without imagery and poses, degrees counter-clockwise; may be repeated",
    )
    _field_options(
        group,
        Faults,
        "phase_error_rad",
        "quadratic_phase_rad",
        "quadratic_arc_deg",
        "wrong_sign",
        "sound_speed_error",
        "seabed_slope_db",
    )


def _profile_options(group: argparse._ArgumentGroup) -> None:
    """Add fields of the profile; what they are by default is the profile's to say."""
    from ..simulation import Profile

    _field_options(
        group,
        Profile,
        "rows",
        "cols",
        "spacing_m",
        "radius_m",
        "height_m",
        "centre_frequency_hz",
        "bandwidth_hz",
        "sound_speed_mps",
        defaults=False,
    )


def _field_options(
    group: argparse._ArgumentGroup, kind: type[Any], *names: str, defaults: bool = True
) -> None:
    """Add an option for each of some fields of a dataclass; `_given_fields` collects what is given."""
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name in names:
        default, meta = fields[name].default, fields[name].metadata
        # A fault that is off by default need not say so.
        told = f" (default {default:g})" if defaults and default else ""
        options: dict[str, Any] = {"default": None, "dest": f"{kind.__name__.lower()}.{name}"}
        options["help"] = f"{meta['doc']}{told}"
        if isinstance(default, bool):
            options["action"] = "store_true"
        else:
            number = type(default)
            unit = meta["unit"] or ("n" if number is int else "f")
            options |= {"type": number, "metavar": unit.replace("/", "").upper()}
        group.add_argument("--" + name.replace("_", "-"), **options)


def _given_fields(arguments: argparse.Namespace, kind: type[Any]) -> dict[str, Any]:
    """Return the fields of a dataclass that the command line gives."""
    prefix = f"{kind.__name__.lower()}."
    return {
        name.removeprefix(prefix): value
        for name, value in vars(arguments).items()
        if name.startswith(prefix) and value is not None
    }


def _simulate(arguments: argparse.Namespace, console: Console) -> int:
    start = time.perf_counter()
    run = _simulated(arguments, console)
    _tell_of_lost_shadows(run, console)
    _tell_what_was_made(run, arguments, time.perf_counter() - start, console)
    return OK


def _simulated(arguments: argparse.Namespace, console: Console) -> SimulatedRun:
    """Simulate what is asked for, and write its bag."""
    from ..simulation import Faults, Profile, get_profile, simulate_bag

    faults = Faults(**_given_fields(arguments, Faults))
    datum = PlaceParameters(
        origin_lat_deg=arguments.origin_lat_deg,
        origin_lon_deg=arguments.origin_lon_deg,
        origin_sigma_m=arguments.origin_sigma_m,
    ).datum()
    with console.bar("simulating") as bar:
        return simulate_bag(
            arguments.out_bag,
            get_profile(arguments.profile, **_given_fields(arguments, Profile)),
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


def _tell_of_lost_shadows(run: SimulatedRun, console: Console) -> None:
    """Say so if shadows end beyond the image: the target's shape cannot come out then."""
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


def _tell_what_was_made(
    run: SimulatedRun, arguments: argparse.Namespace, seconds: float, console: Console
) -> None:
    """Say what the bag holds."""
    out = Path(arguments.out_bag)
    length, width, height = run.truth.dims_m
    grid = run.image.grid
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
        "seconds": seconds,
    }
    text = (
        f"{out}: {run.truth.name}"
        + (f" {length:.2f} x {width:.2f} x {height:.2f} m" if height else "")
        + f", image {grid.rows} x {grid.cols} of {grid.spacing_m * 1e3:g} mm as {arguments.encoding},"
        f" {len(run.track)} poses; {seconds:.1f} s"
    )
    console.result(text, document)
