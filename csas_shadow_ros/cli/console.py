"""Where the command line says things, and how it ends."""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any

PROGRAM = "csas-shadow"


OK, FAILED, USAGE, PARTIAL, UNEXPECTED = 0, 1, 2, 3, 4


class Help(argparse.RawDescriptionHelpFormatter):
    """Help of a width that terminals have."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=100)


class Command(argparse.ArgumentParser):
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
        from ..progress import progress_bar

        with progress_bar(False if self.quiet else None, what) as move:
            yield move
