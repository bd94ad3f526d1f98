"""``csas-shadow view`` and ``report``: the operator's page, and one page for paper."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.errors import ParameterError
from .console import OK, PARTIAL, PROGRAM, Console
from .info import size_text
from .options import output_options


def add_view(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``view``."""
    p = add(
        "view",
        "look at a results folder, a bag or an archive in a browser: circular sliders, layers, ruler, 3-D",
        "  csas-shadow view box_results\n"
        "  csas-shadow view box_results/result.mcap --no-browser --port 8765\n"
        "  csas-shadow view box_results --html box.html --every 5\n"
        "  csas-shadow view monday_results friday_results\n"
        "  csas-shadow view season\n\n"
        "Ends with Ctrl-C. Listens on this machine alone unless --host says otherwise; then it prints a\n"
        "token that visitors must give. For a live graph: ros2 run csas_shadow_ros viewer",
        _view,
    )
    p.add_argument("path", metavar="DIR|BAG", help="results, a bag with views, or an archive of batch")
    p.add_argument(
        "compare", nargs="?", metavar="OTHER", help="compare with this second run of the same contact"
    )
    p.add_argument("--namespace", help="namespace of the bag's topics (default: detect it)")
    p.add_argument("--host", default="127.0.0.1", help="listen at this address (default 127.0.0.1)")
    p.add_argument(
        "--port", type=int, default=0, metavar="N", help="listen on this port (default: any free one)"
    )
    p.add_argument("--token", help="ask for this token (default: none here, a new one on a network)")
    p.add_argument("--no-browser", action="store_true", help="only print the address")
    p.add_argument("--html", metavar="FILE", help="write one HTML file that opens without a server, and end")
    p.add_argument(
        "--every", type=int, default=2, metavar="N", help="put every N-th view into that file (default 2)"
    )
    p.add_argument("--gif", metavar="FILE", help="write the circle as a moving picture, and end")
    output_options(p)


def add_report(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``report``."""
    p = add(
        "report",
        "write one page on a contact: pictures, dimensions, position, judgement, damage",
        "  csas-shadow report box_results\n"
        "  csas-shadow report box_results --contact 2 --out second.html\n\n"
        "Writes a PDF or an HTML file by the name's ending. The judgement is the one kept in the viewer.",
        _report,
    )
    p.add_argument("path", metavar="DIR|BAG", help="a results folder, or a bag with views")
    p.add_argument("--namespace", help="namespace of the bag's topics (default: detect it)")
    p.add_argument("--out", metavar="FILE", help="write this file (default: NAME_report.pdf)")
    p.add_argument(
        "--contact", type=int, metavar="N", help="report this contact, by number (default: the first)"
    )
    output_options(p)


def _save(
    arguments: argparse.Namespace,
    console: Console,
    out: str,
    make: Callable[[Any], bytes],
    second: str | None = None,
) -> int:
    """Write a file of a run, and say what of the run it lacks."""
    from ..viewer import command

    size, damage = command.save(out, make, arguments.path, arguments.namespace, second)
    console.result(f"{out}: {size_text(size)}", {"file": out, "bytes": size, "damage": damage})
    for line in damage:
        print(f"{PROGRAM}: error: {line}", file=sys.stderr)
    return PARTIAL if damage else OK


def _report(arguments: argparse.Namespace, console: Console) -> int:
    from ..viewer.contact_report import as_html, as_pdf, sheet_of

    out = arguments.out or f"{Path(arguments.path).resolve().name}_report.pdf"
    writers = {".pdf": as_pdf, ".html": as_html}
    write = writers.get(Path(out).suffix.lower())
    if write is None:
        raise ParameterError(f"--out is {out!r}; expected a name that ends with .pdf or .html")
    contact = "" if arguments.contact is None else f"object-{arguments.contact}"
    return _save(arguments, console, out, lambda store: write(sheet_of(store, contact)))


def _view(arguments: argparse.Namespace, console: Console) -> int:
    from ..archive.layout import is_archive
    from ..viewer import command

    if arguments.html is not None:
        if not 1 <= arguments.every <= 360:
            raise ParameterError(f"--every is {arguments.every}; expected 1 to 360")
        from ..viewer.export import export_html

        def page(store: Any) -> bytes:
            return export_html(store, arguments.every)

        return _save(arguments, console, arguments.html, page, arguments.compare)
    if arguments.gif is not None:
        from ..viewer.crop import moving_picture

        return _save(arguments, console, arguments.gif, moving_picture)

    def say(url: str) -> None:
        console.result(url, {"url": url})
        sys.stdout.flush()

    if is_archive(arguments.path):
        from ..archive_page import view_archive

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
