"""Entry points of the nodes' executables, which stop cleanly from their first moment.

A node imports libraries for a second or more, and some of them swallow the KeyboardInterrupt that
Ctrl-C raises meanwhile: the node would start after all, and `ros2 launch` wait for it in vain.
"""

from __future__ import annotations

import importlib
import os
import signal
from collections.abc import Callable
from functools import partial

from csas_shadow_ros.node_table import NODES


def run(name: str) -> int:
    """Import a node and run it.

    Parameters
    ----------
    name : str
        Name of its module.

    Returns
    -------
    int
        The node's exit status; a signal before it began ends the process with 0.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        # Nothing has begun that would have to be brought to an end. `run_node` sets its own handlers.
        signal.signal(number, lambda *_: os._exit(0))
    nodes = __package__.rpartition(".")[0]
    status: int = importlib.import_module(f"{nodes}.{name}").main()
    return status


def __getattr__(name: str) -> Callable[[], int]:
    """Return the entry point of a node, which goes by the node's name."""
    if name not in NODES:
        raise AttributeError(f"there is no node {name!r}; expected one of: {', '.join(NODES)}")
    return partial(run, name)
