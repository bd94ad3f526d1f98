"""What ``csas-shadow batch`` and ``find`` do with their options."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from ..core.errors import ParameterError, check_range
from ..core.parameters import MOST_OBJECTS, PipelineParameters
from .batch import Summary, run_batch
from .find import Found, table_of
from .task import Options
from .workers import ClusterWorkers, LocalWorkers, Workers, processors


def options_of(arguments: argparse.Namespace, parameters: PipelineParameters) -> Options:
    """Return what is done with each bag."""
    check_range("max_objects", arguments.max_objects, 1, MOST_OBJECTS)
    return Options(
        parameters,
        start_from=arguments.start_from,
        spectrum_sign=arguments.spectrum_sign,
        namespace=arguments.namespace,
        max_objects=arguments.max_objects,
        bag=arguments.bags,
        figures=arguments.figures,
    )


def _workers(arguments: argparse.Namespace) -> Callable[[], Workers]:
    """Return what makes the workers; what cannot be asked for is refused before anything is read."""
    where = [arguments.scheduler, arguments.scheduler_file]
    if not any(where):
        count = processors() if arguments.workers is None else arguments.workers
        local = LocalWorkers(count, arguments.threads, arguments.memory_gb)
        return lambda: local
    if all(where):
        raise ParameterError("--scheduler and --scheduler-file are both given; expected one")
    for name in ("workers", "memory_gb"):
        if (value := getattr(arguments, name)) is not None:
            flag = "--" + name.replace("_", "-")
            raise ParameterError(f"{flag} is {value}; expected none with a scheduler: its cluster says that")
    threads = 1 if arguments.threads is None else arguments.threads
    check_range("threads", threads, 1, 1024)
    return lambda: ClusterWorkers(arguments.scheduler, arguments.scheduler_file, threads)


def batch(
    arguments: argparse.Namespace, options: Options, *, quiet: bool, notice: Callable[[str], None]
) -> Summary:
    """Run a batch; see `run_batch`."""
    return run_batch(
        arguments.sources,
        arguments.out,
        _workers(arguments),
        options,
        redo=arguments.redo,
        durable=not arguments.no_sync,
        quiet=quiet,
        notice=notice,
    )


def find(arguments: argparse.Namespace) -> tuple[list[dict[str, Any]], str]:
    """Ask the catalogue; return rows, and the table of them."""
    if arguments.limit is not None and arguments.limit < 1:
        raise ParameterError(f"limit is {arguments.limit}; expected 1 or more")
    found = Found(arguments.archive)
    if arguments.near is not None:
        found.near(*arguments.near)
    if arguments.where is not None:
        found.where(arguments.where)
    if arguments.same:
        found.same()
    rows = found.rows(arguments.limit)
    return rows, table_of(rows)
