"""``csas-shadow check``: whether a bag or a results folder is as it should be."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from .console import FAILED, OK, Console
from .options import output_options, run_option


def add_check(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``check``."""
    check = add(
        "check",
        "check that a bag can be processed or that a results folder is whole, and list the faults",
        "  csas-shadow check box_run\n  csas-shadow check box_run --json > report.json\n"
        "  csas-shadow check box_results\n\n"
        "Exit code 1 if the bag breaks the topic contract, or if files of the results folder are\n"
        "missing, changed or not listed.",
        _check,
    )
    check.add_argument("bag", metavar="BAG|DIR", help="rosbag2 directory, .mcap or .db3 file; or results")
    check.add_argument("--namespace", help="namespace of its topics (default: detect it)")
    run_option(check)
    output_options(check)


def _check(arguments: argparse.Namespace, console: Console) -> int:
    from ..bags import check_bag
    from ..results import check_results, looks_like_results

    if looks_like_results(arguments.bag):
        checked = check_results(arguments.bag)
        console.result(str(checked), checked.as_dict())
        return OK if checked.ok else FAILED
    report = check_bag(arguments.bag, arguments.namespace, arguments.run)
    console.result(str(report), report.as_dict())
    return OK if report.ok else FAILED
