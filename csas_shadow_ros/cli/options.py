"""Options that several commands share, and the parameters that they give."""

from __future__ import annotations

import argparse
import dataclasses
import math
from typing import Any

from ..core.parameters import STAGES, START_FROM, PipelineParameters

ALL_RUNS = "all"


def output_options(parser: argparse.ArgumentParser) -> None:
    """Add what every command has: JSON, quiet, tracebacks."""
    group = parser.add_argument_group("output")
    group.add_argument("--json", action="store_true", help="print only JSON on stdout")
    group.add_argument("-q", "--quiet", action="store_true", help="print no progress and no notices")
    group.add_argument("--debug", action="store_true", help="print tracebacks of errors")


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
    from ..public import parameters

    return parameters(arguments.params, **given_parameters(arguments))


def bag_argument(p: argparse.ArgumentParser) -> None:
    """Add the bag, and the namespace of its topics."""
    p.add_argument("bag", metavar="BAG", help="rosbag2 directory, .mcap or .db3 file")
    p.add_argument("--namespace", help="namespace of its topics (default: detect it)")


def start_option(p: argparse.ArgumentParser) -> None:
    """Add ``--start-from``."""
    p.add_argument(
        "--start-from",
        choices=START_FROM,
        default="auto",
        help="start from image (or sectors) and track, or from views of a stage; auto: the first in the bag",
    )


def run_option(parser: argparse.ArgumentParser, *, each: bool = False) -> None:
    """Add ``--run``."""
    every = "; all: each, into folders DIR/run_1, DIR/run_2, …" if each else ""
    parser.add_argument(
        "--run",
        type=_run_or_all if each else int,
        metavar="N",
        help="take this run of the bag: its number in time from 1, or its name, the stamp (ns) of its track's"
        f" first pose{every} (default: the first with an image or sectors)",
    )


def _run_or_all(text: str) -> int | str:
    return text if text == ALL_RUNS else int(text)


def objects_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--max-objects``."""
    from ..core.parameters import MAX_OBJECTS, MOST_OBJECTS

    parser.add_argument(
        "--max-objects",
        type=int,
        default=MAX_OBJECTS,
        metavar="N",
        help="carve at most this many bodies, including the target; the target's result does not depend"
        f" on it (1 to {MOST_OBJECTS}; default {MAX_OBJECTS})",
    )


def results_options(parser: argparse.ArgumentParser) -> None:
    """Add what a results folder is made by."""
    group = parser.add_argument_group("results")
    group.add_argument("--out", required=True, metavar="DIR", help="make this results folder")
    group.add_argument("--overwrite", action="store_true", help="replace an existing results folder")
    group.add_argument("--no-bag", action="store_true", help="write no result.mcap (it holds every view)")
    group.add_argument("--no-figures", action="store_true", help="draw no figures/")
    group.add_argument(
        "--no-sync",
        action="store_true",
        help="do not sync the results to the disk: a power cut may lose them",
    )


def expect_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--expect`` and ``--junit``."""
    group = parser.add_argument_group("continuous integration (docs/replay_in_ci.md)")
    group.add_argument(
        "--expect", metavar="YAML", help="compare the report with these values; exit with 4 if they differ"
    )
    group.add_argument("--junit", metavar="FILE", help="write the comparison as JUnit XML")


def parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add a parameter file, and an option a parameter."""
    parser.add_argument(
        "--params",
        metavar="YAML",
        help="read this parameter file in ROS 2's layout, as config/csas_shadow.yaml; options override it",
    )
    add_parameters(parser, dict(STAGES))
