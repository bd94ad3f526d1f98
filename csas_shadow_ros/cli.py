"""The command line: ``csas-shadow simulate | check | info | run | replay | view | report | batch | …``."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from . import __version__
from .core.errors import CsasError, ParameterError
from .core.geometry.frame_name import SCENE_FRAME
from .core.parameters import STAGES, START_FROM, PipelineParameters, PlaceParameters

PROGRAM = "csas-shadow"
ALL_RUNS = "all"
OK, FAILED, USAGE, PARTIAL, UNEXPECTED = 0, 1, 2, 3, 4
#: Shadows may leave the image by so much of its half side before a simulation is said to be too small.
_MAX_REACH = 1.6

_DESCRIPTION = """\
Shadows of a circular synthetic aperture sonar (CSAS) run, as pictures and as a 3-D shape.

A run is a rosbag2 directory with the full-circle complex image (/csas/image and /csas/camera_info) and
the sonar's track (/csas/track). Lengths are metres, angles degrees, frequencies Hz. The scene frame has
x east, y north, z up, z = 0 on the seabed."""

_EXAMPLES = """\
a first try, from nothing to a 3-D shape (half a minute):
  csas-shadow simulate box_run --profile tiny --target box
  csas-shadow check box_run
  csas-shadow run box_run --out box_results --step-deg 5
  csas-shadow info box_results

exit codes: 0 done, 1 it failed (one line says why), 2 the command line is wrong, 3 the results are
there, but a part beside the grid failed (a line and report.json say which), 4 the results are there,
but not as --expect says."""


class _Help(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=100)


class _Command(argparse.ArgumentParser):
    """A command whose options are made when it is the one that is asked for.

    What the options of some need (profiles, stages) takes a second to import, which the others need not pay.
    """

    options: Callable[[argparse.ArgumentParser], None] | None = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # A coordinate of -4e-05 m is a number and no option: argparse's own pattern knows no exponents.
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$", re.IGNORECASE)

    def parse_known_args(self, *args: Any, **kwargs: Any) -> Any:
        """Make the options, once, and parse."""
        options, self.options = self.options, None
        if options is not None:
            options(self)
        return super().parse_known_args(*args, **kwargs)


class Console:
    """Where things are said: results on stdout, all else on stderr."""

    def __init__(self, *, quiet: bool = False, as_json: bool = False) -> None:
        self.quiet, self.as_json = quiet, as_json

    def notice(self, line: str) -> None:
        """Say something in passing."""
        if not self.quiet:
            print(f"{PROGRAM}: {line}", file=sys.stderr)

    def result(self, text: str, document: Any) -> None:
        """Give the result: the document if JSON was asked for, else the text."""
        if self.as_json:
            print(json.dumps(document, indent=2, allow_nan=False))
        else:
            print(text.rstrip("\n"))

    @contextlib.contextmanager
    def bar(self, what: str) -> Iterator[Callable[[int, int], None]]:
        """Give a function of (done, total) that moves a bar; none unless stderr is a terminal."""
        from .progress import progress_bar

        with progress_bar(False if self.quiet else None, what) as move:
            yield move


# -- options ----------------------------------------------------------------------------------------


def _common(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("output")
    group.add_argument("--json", action="store_true", help="JSON alone on stdout")
    group.add_argument("-q", "--quiet", action="store_true", help="no progress and no notices")
    group.add_argument("--debug", action="store_true", help="tracebacks of errors")


def _number_help(field: dataclasses.Field[Any]) -> str:
    """Return a parameter's help: what it is, its unit, its bounds and its default."""
    meta = field.metadata
    unit = f" {meta['unit']}" if meta["unit"] else ""
    default = field.default
    parts = []
    if meta["low"] is not None:
        parts.append(f"{meta['low']:g} to {meta['high']:g}{unit}")
    if isinstance(default, tuple):
        default = " ".join(f"{v:g}" for v in default)
    elif isinstance(default, bool):
        default = "on" if default else "off"
    elif isinstance(default, float):
        default = "none" if math.isnan(default) else f"{default:g}"
    with_unit = meta["low"] is not None and default != "none"
    parts.append(f"default {default}{unit if with_unit else ''}")
    return f"{meta['doc']} ({'; '.join(parts)})".replace("%", "%%")


def add_parameters(parser: argparse.ArgumentParser, stages: dict[str, type[Any]]) -> None:
    """Add an option for every field of parameter dataclasses, a group each."""
    for kind in stages.values():
        group = parser.add_argument_group((kind.__doc__ or "").splitlines()[0].rstrip("."))
        for field in dataclasses.fields(kind):
            flag = "--" + field.name.replace("_", "-")
            options: dict[str, Any] = {
                "default": None,
                "help": _number_help(field),
                "dest": f"p_{field.name}",
            }
            meta, default = field.metadata, field.default
            unit = str(meta["unit"] or "n").replace("/", "").upper()
            if isinstance(default, bool):
                options["action"] = argparse.BooleanOptionalAction
            elif isinstance(default, str):
                options["choices"] = meta["choices"] or None
            elif isinstance(default, tuple):
                options.update(type=float, nargs=meta["length"], metavar=unit)
            else:
                options.update(type=int if isinstance(default, int) else float, metavar=unit)
            group.add_argument(flag, **options)


def given_parameters(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters that the command line gives, by name."""
    return {
        name[2:]: tuple(value) if isinstance(value, list) else value
        for name, value in vars(arguments).items()
        if name.startswith("p_") and value is not None
    }


def parameters_of(arguments: argparse.Namespace) -> PipelineParameters:
    """Return the parameters of the file, with those of the command line over them.

    Raises
    ------
    ParameterError
        If one is unknown or out of range.
    """
    from .public import parameters

    return parameters(arguments.params, **given_parameters(arguments))


def _run_option(parser: argparse.ArgumentParser, *, each: bool = False) -> None:
    every = "; all: each, into folders DIR/run_1, DIR/run_2, …" if each else ""
    parser.add_argument(
        "--run",
        type=_run_or_all if each else int,
        metavar="N",
        help="which of the bag's runs: its number in time from 1, or its name, the stamp (ns) of its track's"
        f" first pose{every} (the first one that has an image or sectors)",
    )


def _run_or_all(text: str) -> int | str:
    return text if text == ALL_RUNS else int(text)


def _runs_and_folders(arguments: argparse.Namespace) -> list[tuple[int | None, Path]]:
    """Return which runs of the bag are asked for, and the results folder of each."""
    from .bags import read_run

    out = Path(arguments.out)
    if arguments.run != ALL_RUNS:
        return [(arguments.run, out)]
    names = read_run(arguments.bag, arguments.namespace).run_names
    if not names:
        raise ParameterError(
            f"--run is {ALL_RUNS!r}, but no track of {arguments.bag} names a run; expected none"
        )
    return [(number, out / f"run_{number}") for number in range(1, len(names) + 1)]


def _bounded_objects(parser: argparse.ArgumentParser) -> None:
    from .core.parameters import MAX_OBJECTS, MOST_OBJECTS

    parser.add_argument(
        "--max-objects",
        type=int,
        default=MAX_OBJECTS,
        metavar="N",
        help="bodies of a scene that are carved, the target among them; the target's result does not depend"
        f" on it (1 to {MOST_OBJECTS}; default {MAX_OBJECTS})",
    )


def _results_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("results")
    group.add_argument("--out", required=True, metavar="DIR", help="results folder to make")
    group.add_argument("--overwrite", action="store_true", help="replace a results folder that is there")
    group.add_argument("--no-bag", action="store_true", help="no result.mcap (it holds every view)")
    group.add_argument("--no-figures", action="store_true", help="no figures/")
    group.add_argument(
        "--no-sync",
        action="store_true",
        help="leave writing out to the disk to the system: a power cut may cost it",
    )


def _expect_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("continuous integration (docs/replay_in_ci.md)")
    group.add_argument(
        "--expect", metavar="YAML", help="values that the report must have; the exit code is 4 if it has not"
    )
    group.add_argument("--junit", metavar="FILE", help="write what became of them as JUnit XML")


def _parameter_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--params",
        metavar="YAML",
        help="parameter file in ROS 2's layout, as config/csas_shadow.yaml; options override it",
    )
    add_parameters(parser, dict(STAGES))


def build_parser() -> argparse.ArgumentParser:
    """Make the parser of the whole command line."""
    parser = argparse.ArgumentParser(
        PROGRAM, description=_DESCRIPTION, epilog=_EXAMPLES, formatter_class=_Help, allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Command)

    def add(
        name: str,
        summary: str,
        examples: str,
        function: Callable[..., int],
        options: Callable[[argparse.ArgumentParser], None] | None = None,
    ) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            epilog=f"examples:\n{examples}",
            formatter_class=_Help,
            allow_abbrev=False,
        )
        sub.set_defaults(function=function)
        sub.options = options
        return sub

    _add_simulate(add)
    check = add(
        "check",
        "say whether a bag can be processed or a results folder is whole, and what is wrong with it",
        "  csas-shadow check box_run\n  csas-shadow check box_run --json > report.json\n"
        "  csas-shadow check box_results\n\n"
        "exit code 1 if the bag does not honour the topic contract, or if files of the results folder are\n"
        "missing, changed or not listed.",
        _check,
    )
    check.add_argument("bag", metavar="BAG|DIR", help="rosbag2 directory, .mcap or .db3 file; or results")
    check.add_argument("--namespace", help="namespace of its topics (found by itself)")
    _run_option(check)
    _common(check)
    info = add(
        "info",
        "tell what a bag or a results folder holds",
        "  csas-shadow info box_run\n  csas-shadow info box_results",
        _info,
    )
    info.add_argument("path", metavar="BAG|DIR", help="a bag, or a results folder")
    info.add_argument("--namespace", help="namespace of the bag's topics (found by itself)")
    _common(info)
    _add_run(add)
    _add_replay(add)
    _add_archive(add)
    _add_import(add)
    _add_export(add)
    _add_view(add)
    _add_report(add)
    warm = add(
        "warm",
        "compile all kernels, which takes a minute, once for all users of this installation",
        "  csas-shadow warm\n\n"
        "Kernels are kept in the package's folder, else in the user's cache, else in the temporary folder:\n"
        "the first that can be written, or NUMBA_CACHE_DIR. Run it as whoever installs, on the machine\n"
        "that will run the nodes, or on one with the same processor.",
        _warm,
    )
    _common(warm)
    return parser


def _add_simulate(add: Callable[..., argparse.ArgumentParser]) -> None:
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
    from .simulation import PROFILES, TARGETS

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
    _common(p)


def _add_run(add: Callable[..., argparse.ArgumentParser]) -> None:
    add(
        "run",
        "reconstruct the target of a bag, in this process, and write a results folder",
        "  csas-shadow run box_run --out box_results\n"
        "  csas-shadow run box_run --out quick --step-deg 5 --voxel-size-m 0.04 --no-bag\n"
        "  csas-shadow run box_run --out by_hand --position-m 0.5 -0.3 --size-m 2 2 0.8\n"
        "  csas-shadow run other_run --out flipped --spectrum-sign -1\n"
        "  csas-shadow run views --out carved --start-from likelihood --method soft --target given \\\n"
        "      --size-m 2 2 0.8\n\n"
        "DIR holds grid.npz, mesh.stl .ply .obj .glb, report.json, summary.txt, result.mcap and figures/,\n"
        "and object_2.npz, object_2.stl and so on of what else stands on the seabed.\n"
        "A seabed without an object is a result like any other: it is said so, and the exit code is 0.",
        _run,
        _run_options,
    )


def _run_options(p: argparse.ArgumentParser) -> None:
    p.add_argument("bag", metavar="BAG", help="rosbag2 directory, .mcap or .db3 file")
    p.add_argument("--namespace", help="namespace of its topics (found by itself)")
    _run_option(p, each=True)
    p.add_argument(
        "--start-from",
        choices=START_FROM,
        default="auto",
        help="image (or sectors) and track, or views of a stage; auto: the first that the bag holds",
    )
    p.add_argument(
        "--spectrum-sign",
        type=int,
        choices=(1, -1),
        default=None,
        help="instead of the one that the bag states",
    )
    p.add_argument("--workers", type=int, default=2, metavar="N", help="threads (default 2)")
    _bounded_objects(p)
    _results_options(p)
    _expect_options(p)
    _parameter_options(p)
    _common(p)


def _add_replay(add: Callable[..., argparse.ArgumentParser]) -> None:
    add(
        "replay",
        "reconstruct the target of a bag through the ROS 2 nodes, and write the same results folder",
        "  csas-shadow replay box_run --out box_results\n\n"
        "starts every node as a process of its own, as `ros2 launch` does, and needs ROS 2 (rclpy).",
        _replay,
        _replay_options,
    )


def _replay_options(p: argparse.ArgumentParser) -> None:
    p.add_argument("bag", metavar="BAG", help="rosbag2 directory, .mcap or .db3 file")
    p.add_argument("--namespace", help="namespace of its topics (found by itself)")
    p.add_argument(
        "--start-from",
        choices=START_FROM,
        default="auto",
        help="image (or sectors) and track, or views of a stage; auto: the first that the bag holds",
    )
    p.add_argument(
        "--rate",
        type=float,
        default=0.0,
        metavar="R",
        help="views: times the recorded speed; 0: as fast as the nodes take them (default 0)",
    )
    p.add_argument(
        "--domain-id",
        type=int,
        metavar="N",
        help="ROS domain, to look on: ROS_DOMAIN_ID=N ros2 topic list (default: one that nobody uses)",
    )
    p.add_argument(
        "--view", action="store_true", help="open the operator's page beside it; it stays until Ctrl-C"
    )
    p.add_argument("--no-browser", action="store_true", help="with --view: only print the address")
    _run_option(p, each=True)
    _bounded_objects(p)
    _results_options(p)
    _expect_options(p)
    _parameter_options(p)
    _common(p)


def _add_archive(add: Callable[..., argparse.ArgumentParser]) -> None:
    add(
        "batch",
        "process many bags into an archive, with a catalogue of what is in them",
        "  csas-shadow batch runs/ --out season --workers 4\n"
        "  csas-shadow batch 'runs/*_leg3' @more.txt --out season --step-deg 2 --redo failed\n"
        "  csas-shadow batch runs/ --out season --scheduler tcp://cluster:8786\n\n"
        "SOURCE is a bag, a folder of which every bag below is taken, a pattern, or @FILE with a line each.\n"
        "What is done is not done again: the same command goes on after anything. A bag that fails is a row\n"
        "of the catalogue and a line of failed.txt; exit code 3 says that there are such. Ctrl-C ends with\n"
        "the bags that are being processed, a second one at once.",
        _batch,
        _batch_options,
    )
    catalogue = add(
        "catalogue",
        "make the catalogue of an archive anew, from the results that lie in it",
        "  csas-shadow catalogue season\n\n"
        "writes DIR/catalogue/runs.parquet and contacts.parquet; DIR may be any folder with results.",
        _catalogue,
    )
    catalogue.add_argument("archive", metavar="DIR", help="an archive, or a folder of results")
    _common(catalogue)
    find = add(
        "find",
        "ask the catalogue of an archive",
        "  csas-shadow find season --where \"length_m > 1 and verdict == 'object'\"\n"
        "  csas-shadow find season --near 48.36 -4.55 200 --where \"quality <> 'not trustworthy'\"\n"
        "  csas-shadow find season --same\n"
        "  csas-shadow find season --where \"status = 'failed'\" --json\n\n"
        "the expression is SQL (DuckDB's) over the columns that docs/archive.md lists.",
        _find,
    )
    find.add_argument("archive", metavar="DIR", help="an archive")
    find.add_argument("--where", metavar="EXPRESSION", help="keep the rows for which it is true")
    find.add_argument(
        "--near", type=float, nargs=3, metavar=("LAT", "LON", "RADIUS"), help="in a circle (degrees, m)"
    )
    find.add_argument("--same", action="store_true", help="objects that are in several runs, numbered")
    find.add_argument("--limit", type=int, metavar="N", help="at most so many rows (default: all)")
    _common(find)


def _batch_options(p: argparse.ArgumentParser) -> None:
    p.add_argument("sources", nargs="+", metavar="SOURCE", help="bag, folder, pattern, or @FILE of such")
    p.add_argument("--out", required=True, metavar="ARCHIVE", help="archive to make, or to go on with")
    p.add_argument(
        "--redo",
        action="append",
        default=[],
        choices=("failed", "changed", "all"),
        help="do again what failed; what is of other content, parameters or version; all. May be repeated",
    )
    p.add_argument("--namespace", help="namespace of the bags' topics (found by itself)")
    p.add_argument("--start-from", choices=START_FROM, default="auto", help="as of run (default auto)")
    p.add_argument("--spectrum-sign", type=int, choices=(1, -1), help="instead of what the bags state")
    p.add_argument("--bags", action="store_true", help="write result.mcap of each (it holds every view)")
    p.add_argument("--figures", action="store_true", help="draw the figures of each")
    p.add_argument("--no-sync", action="store_true", help="leave writing out to the disk to the system")
    _bounded_objects(p)
    group = p.add_argument_group("workers")
    group.add_argument(
        "--workers", type=int, metavar="N", help="processes on this machine (default: one a processor)"
    )
    group.add_argument(
        "--threads", type=int, metavar="N", help="of each (default: processors are shared; on a cluster 1)"
    )
    group.add_argument(
        "--memory-gb",
        type=float,
        metavar="GB",
        help="what each may take: a bag that needs more fails (default: 0.8 of the machine's memory, shared)",
    )
    group.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a dask.distributed cluster, tcp://HOST:PORT"
    )
    group.add_argument("--scheduler-file", metavar="FILE", help="the file that its scheduler wrote")
    _parameter_options(p)
    _common(p)


def _add_import(add: Callable[..., argparse.ArgumentParser]) -> None:
    p = add(
        "import",
        "make a run's bag of an image and navigation that other programs wrote",
        "  csas-shadow import image.npy --out my_run --geometry geometry.yaml\n"
        "  csas-shadow import image.tif --out my_run --geometry geometry.yaml --track mission.mcap\n\n"
        "SOURCE is a complex image (.npy .npz .mat .h5 .tif .ntf), the track a CSV file or a bag with\n"
        "Odometry, poses, fixes or transforms. docs/import.md tells of the page of geometry.",
        _import,
    )
    p.add_argument("source", metavar="SOURCE", help="the full-circle complex image")
    p.add_argument("--out", required=True, metavar="BAG", help="rosbag2 directory to make")
    p.add_argument("--geometry", required=True, metavar="YAML", help="what the image does not say of itself")
    p.add_argument("--track", metavar="FILE|BAG", help="navigation, instead of the one that the page names")
    p.add_argument(
        "--encoding",
        default="32FC2",
        choices=("32FC2", "64FC2", "16SC2", "8SC2"),
        help="of the image in the bag (default 32FC2)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace a bag that is there")
    _common(p)


def _add_export(add: Callable[..., argparse.ArgumentParser]) -> None:
    add(
        "export",
        "write a results folder for charts: GeoTIFF, GeoJSON, GeoPackage, KML, Zarr, NetCDF",
        "  csas-shadow export box_results --out box_maps\n"
        "  csas-shadow export box_results --out box_maps --format geotiff,gpkg --overwrite\n"
        "  csas-shadow export box_results --out box_maps --origin-lat-deg 48.38 --origin-lon-deg -4.49\n\n"
        "without --format all that the run can be written in; what it lacks is told. With it, what the run\n"
        "lacks makes exit code 3. docs/maps.md says what is in the files.",
        _export,
        _export_options,
    )


def _export_options(p: argparse.ArgumentParser) -> None:
    p.add_argument("result", metavar="RESULT", help="a results folder")
    p.add_argument("--out", required=True, metavar="FOLDER", help="folder to make")
    p.add_argument(
        "--format",
        default="",
        metavar="LIST",
        help="of geotiff, geojson, gpkg, kml, zarr, netcdf, with commas (default: all that can be)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace a folder of maps that is there")
    add_parameters(p, {"place": STAGES["place"]})
    _common(p)


def _add_view(add: Callable[..., argparse.ArgumentParser]) -> None:
    p = add(
        "view",
        "look at a results folder, a bag or an archive in a browser: circular sliders, layers, ruler, 3-D",
        "  csas-shadow view box_results\n"
        "  csas-shadow view box_results/result.mcap --no-browser --port 8765\n"
        "  csas-shadow view box_results --html box.html --every 5\n"
        "  csas-shadow view monday_results friday_results\n"
        "  csas-shadow view season\n\n"
        "ends with Ctrl-C. Listens on this machine alone unless --host says otherwise; the network is asked\n"
        "for the token that is then printed. For a live graph: ros2 run csas_shadow_ros viewer",
        _view,
    )
    p.add_argument("path", metavar="DIR|BAG", help="results, a bag that holds views, or an archive of batch")
    p.add_argument(
        "compare", nargs="?", metavar="OTHER", help="a second run of the same contact, to compare it with"
    )
    p.add_argument("--namespace", help="namespace of the bag's topics (found by itself)")
    p.add_argument("--host", default="127.0.0.1", help="address to listen at (default 127.0.0.1)")
    p.add_argument("--port", type=int, default=0, metavar="N", help="port (default: any that is free)")
    p.add_argument("--token", help="token to ask for (default: none here, a new one on a network)")
    p.add_argument("--no-browser", action="store_true", help="only print the address")
    p.add_argument("--html", metavar="FILE", help="write one HTML file that opens without a server, and end")
    p.add_argument(
        "--every", type=int, default=2, metavar="N", help="of that file: every N-th view (default 2)"
    )
    p.add_argument("--gif", metavar="FILE", help="write the circle as a moving picture, and end")
    _common(p)


def _add_report(add: Callable[..., argparse.ArgumentParser]) -> None:
    p = add(
        "report",
        "write one page on a contact: pictures, dimensions, position, judgement, damage",
        "  csas-shadow report box_results\n"
        "  csas-shadow report box_results --contact 2 --out second.html\n\n"
        "A PDF or an HTML file, as the name ends. The judgement is what was kept in the viewer.",
        _report,
    )
    p.add_argument("path", metavar="DIR|BAG", help="a results folder, or a bag that holds views")
    p.add_argument("--namespace", help="namespace of the bag's topics (found by itself)")
    p.add_argument("--out", metavar="FILE", help="file to write (default: NAME_report.pdf)")
    p.add_argument("--contact", type=int, metavar="N", help="number of the contact (default: the first)")
    _common(p)


# -- commands ---------------------------------------------------------------------------------------


def _simulate(arguments: argparse.Namespace, console: Console) -> int:
    from .simulation import Faults, get_profile, simulate_bag

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


def _check(arguments: argparse.Namespace, console: Console) -> int:
    from .bags import check_bag
    from .results import check_results, looks_like_results

    if looks_like_results(arguments.bag):
        checked = check_results(arguments.bag)
        console.result(str(checked), checked.as_dict())
        return OK if checked.ok else FAILED
    report = check_bag(arguments.bag, arguments.namespace, arguments.run)
    console.result(str(report), report.as_dict())
    return OK if report.ok else FAILED


def _save(
    arguments: argparse.Namespace,
    console: Console,
    out: str,
    make: Callable[[Any], bytes],
    second: str | None = None,
) -> int:
    """Write a file of a run, and say what of the run it lacks."""
    from .viewer import command

    size, damage = command.save(out, make, arguments.path, arguments.namespace, second)
    console.result(f"{out}: {_size(size)}", {"file": out, "bytes": size, "damage": damage})
    for line in damage:
        print(f"{PROGRAM}: error: {line}", file=sys.stderr)
    return PARTIAL if damage else OK


def _report(arguments: argparse.Namespace, console: Console) -> int:
    from .viewer.contact_report import as_html, as_pdf, sheet_of

    out = arguments.out or f"{Path(arguments.path).resolve().name}_report.pdf"
    writers = {".pdf": as_pdf, ".html": as_html}
    write = writers.get(Path(out).suffix.lower())
    if write is None:
        raise ParameterError(f"--out is {out!r}; expected a name that ends with .pdf or .html")
    contact = "" if arguments.contact is None else f"object-{arguments.contact}"
    return _save(arguments, console, out, lambda store: write(sheet_of(store, contact)))


def _view(arguments: argparse.Namespace, console: Console) -> int:
    from .archive.layout import is_archive
    from .viewer import command

    if arguments.html is not None:
        if not 1 <= arguments.every <= 360:
            raise ParameterError(f"--every is {arguments.every}; expected 1 to 360")
        from .viewer.export import export_html

        def page(store: Any) -> bytes:
            return export_html(store, arguments.every)

        return _save(arguments, console, arguments.html, page, arguments.compare)
    if arguments.gif is not None:
        from .viewer.crop import moving_picture

        return _save(arguments, console, arguments.gif, moving_picture)

    def say(url: str) -> None:
        console.result(url, {"url": url})
        sys.stdout.flush()

    if is_archive(arguments.path):
        from .archive_page import view_archive

        if arguments.compare is not None:
            raise ParameterError(f"{arguments.path} is an archive; expected one alone, or two runs of it")
        view_archive(
            arguments.path,
            host=arguments.host,
            port=arguments.port,
            token=arguments.token,
            browser=not arguments.no_browser,
            say=say,
        )
        return OK
    command.view(
        arguments.path,
        second=arguments.compare,
        namespace=arguments.namespace,
        host=arguments.host,
        port=arguments.port,
        token=arguments.token,
        browser=not arguments.no_browser,
        say=say,
    )
    return OK


def _warm(arguments: argparse.Namespace, console: Console) -> int:
    from .core import kernels
    from .core.warm import warm_all
    from .simulation.warm import warm_simulation

    start = time.perf_counter()
    warm_all()
    warm_simulation()
    seconds = time.perf_counter() - start
    loaded, compiled = kernels.counts()
    place = kernels.place()
    document = {
        "compiled": compiled,
        "loaded": loaded,
        "seconds": seconds,
        "place": place.kind,
        "folder": place.folder and str(place.folder),
    }
    text = f"{compiled} kernels compiled, {loaded} were there; {seconds:.1f} s; kept: {place}"
    console.result(text, document)
    return OK


def _info(arguments: argparse.Namespace, console: Console) -> int:
    from .results import is_results_folder, read_report, summary

    if is_results_folder(arguments.path):
        report = read_report(arguments.path)
        text = summary(report) + f"from {report['input'].get('path', '?')}, started from {report['stage']}\n"
        text += "files: " + ", ".join(f for f in report["files"] if "/" not in f)
        drawn = [f for f in report["files"] if f.startswith("figures/")]
        console.result(text + f", {len(drawn)} figures", report)
        return OK
    from .bags import read_run
    from .results import read_truth
    from .results.report import json_ready
    from .run_bag import describe_run, stages_of, topic_sizes

    run = read_run(arguments.path, arguments.namespace)
    about = describe_run(run)
    for topic, size in topic_sizes(run).items():
        about["topics"][topic]["bytes"] = size
    truth = read_truth(arguments.path)
    about["truth"] = None
    if truth is not None:
        about["truth"] = {"mesh": str(truth.path), "dimensions": truth.dimensions, "record": truth.record}
    about["start_from"] = stages_of(run)
    about["problems"] = [str(problem) for problem in run.problems]
    about = json_ready(about)
    console.result(_bag_text(about), about)
    return OK


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def _bag_text(about: dict[str, Any]) -> str:
    lines = [f"{about['path']}: {about['messages']} messages, {_size(about['bytes'])}", ""]
    width = max((len(name) for name in about["topics"]), default=0)
    for name, topic in about["topics"].items():
        size = _size(topic.get("bytes", 0))
        lines.append(f"  {name:<{width}}  {topic['messages']:>6}  {size:>9}  {topic['type']}")
    lines.append("")
    sectors = about["sectors"]
    if sectors:
        lines.append(f"sectors {sectors['count']} that cover {sectors['covered_deg']:.1f} of 360°")
        if sectors["missing"]:
            lines.append(f"        missing: {', '.join(sectors['missing'][:8])}")
    if image := about["image"] or (sectors and sectors["image"]):
        e = image["extent_m"]
        lines.append(
            f"image   {image['rows']} x {image['cols']} pixels of {image['spacing_m'] * 1e3:g} mm:"
            f" x {e['left']:.2f} to {e['right']:.2f} m, y {e['bottom']:.2f} to {e['top']:.2f} m"
        )
        lines.append(
            f"band    {image['centre_frequency_hz'] / 1e3:g} kHz ± {image['bandwidth_hz'] / 2e3:g} kHz,"
            f" sound speed {image['sound_speed_mps']:g} m/s, spectrum sign {image['spectrum_sign']:+d}"
        )
    if track := about["track"]:
        lines.append(
            f"track   {track['poses']} poses over {track['coverage_deg']:.1f}° {track['direction']}, radius"
            f" {track['radius_m']:.2f} m, height {track['height_m']:.2f} m,"
            f" grazing {track['grazing_deg']:.1f}°"
        )
        if track["gaps"]:
            lines.append(f"        missing: {', '.join(track['gaps'][:8])}")
    if truth := about["truth"]:
        d = truth["dimensions"]
        what = truth["record"].get("name", "target")
        lines.append(
            f"truth   {what}"
            + (f" {d['length_m']:.3f} x {d['width_m']:.3f} x {d['height_m']:.3f} m" if d else ": no object")
            + f" ({truth['mesh']})"
        )
    names = [
        "image (summed from the sectors)" if name == "image" and about["image"] is None else name
        for name in about["start_from"]
    ]
    starts = ", ".join(names) or "nothing: see `csas-shadow check`"
    lines.append(f"a run can start from: {starts}")
    lines += [f"problem: {problem}" for problem in about["problems"]]
    return "\n".join(lines)


def _run(arguments: argparse.Namespace, console: Console) -> int:
    from .run_bag import process_bag

    parameters = parameters_of(arguments)
    if arguments.workers < 1:
        raise ParameterError(f"workers is {arguments.workers}; expected 1 or more")

    def one(number: int | None, out: Path) -> tuple[int, dict[str, Any]]:
        with console.bar("views") as bar:
            report = process_bag(
                arguments.bag,
                out,
                parameters,
                start_from=arguments.start_from,
                spectrum_sign=arguments.spectrum_sign,
                namespace=arguments.namespace,
                run_of_bag=number,
                overwrite=arguments.overwrite,
                write_bag=not arguments.no_bag,
                figures=not arguments.no_figures,
                durable=not arguments.no_sync,
                workers=arguments.workers,
                max_objects=arguments.max_objects,
                command=arguments.command_line,
                progress=bar,
                notice=console.notice,
            )
        return _give_report(console, out, report), report

    return _each_run(arguments, one)


def _each_run(
    arguments: argparse.Namespace, one: Callable[[int | None, Path], tuple[int, dict[str, Any]]]
) -> int:
    """Make the results of each run that is asked for, and hold them against what is expected."""
    from .expectations import Checked, check_report, read_expectations, write_junit

    # Before anything is made: a slip in the file must not cost a run.
    expected = read_expectations(arguments.expect) if arguments.expect else ()
    code, checked, name = OK, list[Checked](), ""
    try:
        for number, out in _runs_and_folders(arguments):
            name = out.name
            own, report = one(number, out)
            checked.append(check_report(name, report, expected))
            for fault in checked[-1].unmet:
                print(f"{PROGRAM}: error: {name}: {fault}", file=sys.stderr)
            code = max(code, own, UNEXPECTED if checked[-1].unmet else OK)
    except (CsasError, OSError) as error:
        reason = f"{type(error).__name__}: {error}"
        checked.append(Checked(name or Path(arguments.out).name, {}, error=reason))
        raise
    finally:
        if arguments.junit:
            write_junit(arguments.junit, checked)
    return code


def _give_report(console: Console, out: Path, report: dict[str, Any]) -> int:
    """Tell the result, and give the exit status: a part beside the grid may have failed."""
    from .results import summary

    try:
        text = summary(report)
    except Exception:  # the report says why: it was tried there too
        text = ""
    console.result(f"{text}results: {out}", report)
    for part, why in report["failed"].items():
        print(f"{PROGRAM}: error: {part}: {why}", file=sys.stderr)
    return PARTIAL if report["failed"] else OK


def _batch(arguments: argparse.Namespace, console: Console) -> int:
    from .archive import command

    options = command.options_of(arguments, parameters_of(arguments))
    done = command.batch(arguments, options, quiet=console.quiet, notice=console.notice)
    console.result(f"{done}\ncatalogue of {done.runs} runs: {arguments.out}", dataclasses.asdict(done))
    if done.interrupted:
        raise KeyboardInterrupt
    return PARTIAL if done.failed else OK


def _catalogue(arguments: argparse.Namespace, console: Console) -> int:
    from .archive.catalogue import rebuild

    with console.bar("tasks") as bar:
        runs = rebuild(arguments.archive, lambda done: bar(done, done))
    console.result(f"catalogue of {runs} runs: {arguments.archive}", {"runs": runs})
    return OK


def _find(arguments: argparse.Namespace, console: Console) -> int:
    from .archive.command import find
    from .results.report import json_ready

    rows, text = find(arguments)
    console.result(text, json_ready(rows))
    return OK


def _import(arguments: argparse.Namespace, console: Console) -> int:
    from .bags import read_run
    from .importing import import_run

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
    from .maps import export_result

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


def _replay(arguments: argparse.Namespace, console: Console) -> int:
    from .run_bag import replay_bag

    parameters = parameters_of(arguments)
    port = _show_beside(console, browser=not arguments.no_browser) if arguments.view else None
    newest: list[Path] = []

    def one(number: int | None, out: Path) -> tuple[int, dict[str, Any]]:
        with console.bar("views") as bar:
            report = replay_bag(
                arguments.bag,
                out,
                parameters,
                start_from=arguments.start_from,
                rate=arguments.rate,
                domain_id=arguments.domain_id,
                namespace=arguments.namespace,
                run_of_bag=number,
                max_objects=arguments.max_objects,
                overwrite=arguments.overwrite,
                write_bag=not arguments.no_bag,
                figures=not arguments.no_figures,
                durable=not arguments.no_sync,
                command=arguments.command_line,
                progress=bar,
                notice=console.notice,
                viewer_port=port,
            )
        code = _give_report(console, out, report)
        if lacking := report.get("not_recorded"):
            told = "; ".join(lacking)
            print(f"{PROGRAM}: error: the recording is not whole: {told}", file=sys.stderr)
            code = max(code, FAILED)
        newest[:] = [out]
        return code, report

    code = _each_run(arguments, one)
    if port is not None and newest:
        from .viewer import command

        # At the same address: the page that followed the graph goes on with its results.
        console.notice("the results are in the page now; Ctrl-C ends it")
        command.view(newest[0], port=port, browser=False, say=lambda _: None)
    return code


def _show_beside(console: Console, *, browser: bool) -> int:
    """Choose a port for the page of a graph that is about to start, tell it, and open it once it answers."""
    import socket
    import threading
    import webbrowser

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    url = f"http://127.0.0.1:{port}/"
    console.notice(f"the graph is to be seen at {url}")

    def wait() -> None:
        for _ in range(600):  # a minute: a busy machine starts a graph in ten seconds
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
                webbrowser.open(url)
                return
            time.sleep(0.1)

    if browser:
        threading.Thread(target=wait, daemon=True).start()
    return port


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns
    -------
    int
        0 done, 1 failed; a wrong command line exits with 2.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    arguments = build_parser().parse_args(given)
    arguments.command_line = [PROGRAM, *given]
    console = Console(quiet=arguments.quiet, as_json=arguments.json)
    try:
        return int(arguments.function(arguments, console))
    except CsasError as error:
        if arguments.debug:
            raise
        print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return FAILED
    except BrokenPipeError:
        # The reader of our output has gone, as `head` does.
        sys.stderr.close()
        return FAILED
    except OSError as error:
        # A full disk, a folder that is read-only, a quota: nothing that a traceback would explain.
        if arguments.debug:
            raise
        where = f"{error.filename}: " if error.filename else ""
        print(f"{PROGRAM}: error: {where}{error.strerror or error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(f"{PROGRAM}: error: interrupted", file=sys.stderr)
        return FAILED


def run_and_exit() -> NoReturn:
    """Run the command line as a program: what SIGTERM and SIGHUP end is brought to an end in order."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number and signal.getsignal(number) == signal.SIG_DFL:
            # Not on the spot: processes that were started end too, and nothing half-written stays.
            signal.signal(number, lambda number, _: sys.exit(128 + number))
    sys.exit(main())


if __name__ == "__main__":
    run_and_exit()
