"""``csas-shadow replay``: the same through the node graph."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..node_table import REPLACEABLE
from .console import FAILED, PROGRAM, Console
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


def add_replay(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``replay``."""
    add(
        "replay",
        "reconstruct the target of a bag through the ROS 2 nodes, and write the same results folder",
        "  csas-shadow replay box_run --out box_results\n\n"
        "starts every node as a process of its own, as `ros2 launch` does, and needs ROS 2 (rclpy).",
        _replay,
        _replay_options,
    )


def _replay_options(p: argparse.ArgumentParser) -> None:
    bag_argument(p)
    start_option(p)
    p.add_argument(
        "--rate",
        type=float,
        default=0.0,
        metavar="R",
        help="play views at this multiple of the recorded speed; 0: as fast as nodes take them (default 0)",
    )
    p.add_argument(
        "--domain-id",
        type=int,
        metavar="N",
        help="use this ROS domain; watch with ROS_DOMAIN_ID=N ros2 topic list (default: a free one)",
    )
    p.add_argument(
        "--view", action="store_true", help="open the operator's page beside the run; it stays until Ctrl-C"
    )
    p.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="NODE",
        help=f"leave this node ({', '.join(REPLACEABLE)}) to one of your own; repeatable",
    )
    p.add_argument("--no-browser", action="store_true", help="with --view: only print the page's address")
    run_option(p, each=True)
    objects_option(p)
    results_options(p)
    expect_options(p)
    parameter_options(p)
    output_options(p)


def _replay(arguments: argparse.Namespace, console: Console) -> int:
    from ..run_bag import replay_bag

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
                without=arguments.without,
            )
        code = give_report(console, out, report)
        if lacking := report.get("not_recorded"):
            told = "; ".join(lacking)
            print(f"{PROGRAM}: error: the recording is not whole: {told}", file=sys.stderr)
            code = max(code, FAILED)
        newest[:] = [out]
        return code, report

    code = each_run(console, arguments, one)
    if port is not None and newest:
        from ..viewer import command

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
