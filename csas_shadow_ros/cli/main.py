"""The command line: ``csas-shadow simulate | check | info | run | replay | view | report | batch | …``."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from .. import __version__
from ..core.errors import CsasError
from .archive import add_archive
from .check import add_check
from .console import FAILED, PROGRAM, Command, Console, Help
from .exchange import add_export, add_import
from .info import add_info
from .keys import add_keys
from .replay import add_replay
from .run import add_run
from .simulate import add_simulate
from .view import add_report, add_view
from .warm import add_warm

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


def build_parser() -> argparse.ArgumentParser:
    """Make the parser of the whole command line."""
    parser = argparse.ArgumentParser(
        PROGRAM, description=_DESCRIPTION, epilog=_EXAMPLES, formatter_class=Help, allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Command)

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
            formatter_class=Help,
            allow_abbrev=False,
        )
        sub.set_defaults(function=function)
        sub.options = options
        return sub

    add_simulate(add)
    add_check(add)
    add_info(add)
    add_run(add)
    add_replay(add)
    add_archive(add)
    add_import(add)
    add_export(add)
    add_view(add)
    add_report(add)
    add_keys(add)
    add_warm(add)
    return parser


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
