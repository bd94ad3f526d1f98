"""``csas-shadow run``: a bag in, a results folder out, in this process."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.errors import ParameterError
from .console import Console
from .each_run import each_run, give_report
from .options import (
    bag_argument,
    expect_options,
    objects_option,
    output_options,
    parameter_options,
    parameters_of,
    results_options,
    run_option,
    start_option,
)


def add_run(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``run``."""
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
        "and object_2.npz, object_2.stl and so on for further objects on the seabed.\n"
        "A seabed without an object is a valid result: the summary says so, and the exit code is 0.",
        _run,
        _run_options,
    )


def _run_options(p: argparse.ArgumentParser) -> None:
    bag_argument(p)
    run_option(p, each=True)
    start_option(p)
    p.add_argument(
        "--spectrum-sign",
        type=int,
        choices=(1, -1),
        default=None,
        help="use this sign instead of the bag's",
    )
    p.add_argument("--workers", type=int, default=2, metavar="N", help="use this many threads (default 2)")
    objects_option(p)
    results_options(p)
    expect_options(p)
    parameter_options(p)
    output_options(p)


def _run(arguments: argparse.Namespace, console: Console) -> int:
    from ..run_bag import process_bag

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
        return give_report(console, out, report), report

    return each_run(console, arguments, one)
