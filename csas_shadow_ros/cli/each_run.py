"""Results of each run that is asked for, held against what is expected."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.errors import CsasError, ParameterError
from .console import OK, PARTIAL, PROGRAM, UNEXPECTED, Console
from .options import ALL_RUNS


def runs_and_folders(arguments: argparse.Namespace) -> list[tuple[int | None, Path]]:
    """Return which runs of the bag are asked for, and the results folder of each."""
    from ..bags import read_run

    out = Path(arguments.out)
    if arguments.run != ALL_RUNS:
        return [(arguments.run, out)]
    names = read_run(arguments.bag, arguments.namespace).run_names
    if not names:
        raise ParameterError(
            f"--run is {ALL_RUNS!r}, but no track of {arguments.bag} names a run; expected none"
        )
    return [(number, out / f"run_{number}") for number in range(1, len(names) + 1)]


def each_run(
    console: Console,
    arguments: argparse.Namespace,
    one: Callable[[int | None, Path], tuple[int, dict[str, Any]]],
) -> int:
    """Make the results of each run that is asked for, and hold them against what is expected."""
    from ..expectations import Checked, check_report, read_expectations, write_junit

    # Before anything is made: a slip in the file must not cost a run.
    expected = read_expectations(arguments.expect) if arguments.expect else ()
    code, checked, name = OK, list[Checked](), ""
    try:
        for number, out in runs_and_folders(arguments):
            name = out.name
            own, report = one(number, out)
            checked.append(check_report(name, report, expected))
            for fault in checked[-1].unmet:
                print(f"{PROGRAM}: error: {name}: {fault}", file=sys.stderr)
            if expected and not checked[-1].unmet:
                console.notice(f"{name}: as {arguments.expect} expects ({len(expected)} values)")
            code = max(code, own, UNEXPECTED if checked[-1].unmet else OK)
    except (CsasError, OSError) as error:
        reason = f"{type(error).__name__}: {error}"
        checked.append(Checked(name or Path(arguments.out).name, {}, error=reason))
        raise
    finally:
        if arguments.junit:
            write_junit(arguments.junit, checked)
    return code


def give_report(console: Console, out: Path, report: dict[str, Any]) -> int:
    """Tell the result, and give the exit status: a part beside the grid may have failed."""
    from ..results import summary

    try:
        text = summary(report)
    except Exception:  # the report says why: it was tried there too
        text = ""
    console.result(f"{text}results: {out}", report)
    for part, why in report["failed"].items():
        print(f"{PROGRAM}: error: {part}: {why}", file=sys.stderr)
    return PARTIAL if report["failed"] else OK
