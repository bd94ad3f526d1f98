"""``csas-shadow batch``, ``catalogue`` and ``find``: many bags, and questions to them."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable

from ..core.parameters import START_FROM
from .console import OK, PARTIAL, Console
from .options import objects_option, output_options, parameter_options, parameters_of


def add_archive(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``batch``, ``catalogue`` and ``find``."""
    add(
        "batch",
        "process many bags into an archive, with a catalogue of the results",
        "  csas-shadow batch runs/ --out season --workers 4\n"
        "  csas-shadow batch 'runs/*_leg3' @more.txt --out season --step-deg 2 --redo failed\n"
        "  csas-shadow batch runs/ --out season --scheduler tcp://cluster:8786\n\n"
        "SOURCE is a bag, a folder (every bag below it), a pattern, or @FILE with one of these per line.\n"
        "The same command resumes after any interruption and repeats nothing. A bag that fails is a row\n"
        "of the catalogue and a line of failed.txt, and makes exit code 3. Ctrl-C finishes the bags in\n"
        "progress; a second Ctrl-C ends at once.",
        _batch,
        _batch_options,
    )
    catalogue = add(
        "catalogue",
        "rebuild the catalogue of an archive from its results",
        "  csas-shadow catalogue season\n\n"
        "writes DIR/catalogue/runs.parquet and contacts.parquet; DIR may be any folder with results.",
        _catalogue,
    )
    catalogue.add_argument("archive", metavar="DIR", help="an archive, or a folder of results")
    output_options(catalogue)
    find = add(
        "find",
        "query the catalogue of an archive",
        "  csas-shadow find season --where \"length_m > 1 and verdict == 'object'\"\n"
        "  csas-shadow find season --near 48.36 -4.55 200 --where \"quality <> 'not trustworthy'\"\n"
        "  csas-shadow find season --same\n"
        "  csas-shadow find season --where \"status = 'failed'\" --json\n\n"
        "the expression is SQL (DuckDB's) over the columns that docs/archive.md lists.",
        _find,
    )
    find.add_argument("archive", metavar="DIR", help="an archive")
    find.add_argument("--where", metavar="EXPRESSION", help="keep rows for which this is true")
    find.add_argument(
        "--near",
        type=float,
        nargs=3,
        metavar=("LAT", "LON", "RADIUS"),
        help="keep rows in this circle (degrees, m)",
    )
    find.add_argument("--same", action="store_true", help="number objects that several runs show")
    find.add_argument("--limit", type=int, metavar="N", help="print at most this many rows (default: all)")
    output_options(find)


def _batch_options(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "sources", nargs="+", metavar="SOURCE", help="bag, folder, pattern, or @FILE that lists them"
    )
    p.add_argument("--out", required=True, metavar="ARCHIVE", help="make or continue this archive")
    p.add_argument(
        "--redo",
        action="append",
        default=[],
        choices=("failed", "changed", "all"),
        help="repeat failed runs, runs of other content, parameters or version, or all; may be given twice",
    )
    p.add_argument("--namespace", help="namespace of the bags' topics (default: detect it)")
    p.add_argument("--start-from", choices=START_FROM, default="auto", help="as for run (default auto)")
    p.add_argument("--spectrum-sign", type=int, choices=(1, -1), help="use this sign instead of the bags'")
    p.add_argument("--bags", action="store_true", help="write each run's result.mcap (it holds every view)")
    p.add_argument("--figures", action="store_true", help="draw each run's figures")
    p.add_argument("--no-sync", action="store_true", help="do not sync results to the disk")
    objects_option(p)
    group = p.add_argument_group("workers")
    group.add_argument(
        "--workers", type=int, metavar="N", help="run this many processes here (default: one per processor)"
    )
    group.add_argument(
        "--threads",
        type=int,
        metavar="N",
        help="give each worker this many threads (default: share the processors; on a cluster 1)",
    )
    group.add_argument(
        "--memory-gb",
        type=float,
        metavar="GB",
        help="limit each worker's memory: a bag that needs more fails (default: share 0.8 of the machine's)",
    )
    group.add_argument(
        "--scheduler", metavar="ADDRESS", help="use this dask.distributed scheduler, tcp://HOST:PORT"
    )
    group.add_argument(
        "--scheduler-file", metavar="FILE", help="find the scheduler by the file that it wrote"
    )
    parameter_options(p)
    output_options(p)


def _batch(arguments: argparse.Namespace, console: Console) -> int:
    from ..archive import command

    options = command.options_of(arguments, parameters_of(arguments))
    done = command.batch(arguments, options, quiet=console.quiet, notice=console.notice)
    console.result(f"{done}\ncatalogue of {done.runs} runs: {arguments.out}", dataclasses.asdict(done))
    if done.interrupted:
        raise KeyboardInterrupt
    return PARTIAL if done.failed else OK


def _catalogue(arguments: argparse.Namespace, console: Console) -> int:
    from ..archive.catalogue import rebuild

    with console.bar("tasks") as bar:
        runs = rebuild(arguments.archive, lambda done: bar(done, done))
    console.result(f"catalogue of {runs} runs: {arguments.archive}", {"runs": runs})
    return OK


def _find(arguments: argparse.Namespace, console: Console) -> int:
    from ..archive.command import find
    from ..results.layout import json_ready

    rows, text = find(arguments)
    console.result(text, json_ready(rows))
    return OK
