"""``csas-shadow warm``: kernels compiled once."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

from .console import OK, Console
from .options import output_options


def add_warm(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add ``warm``."""
    warm = add(
        "warm",
        "compile all kernels, which takes a minute, once for all users of this installation",
        "  csas-shadow warm\n\n"
        "Keeps kernels in the first writable of the package's folder, the user's cache and the temporary\n"
        "folder, or in NUMBA_CACHE_DIR. Run it as the user who installs, on the machine\n"
        "that will run the nodes, or on one with the same processor.",
        _warm,
    )
    output_options(warm)


def _warm(_: argparse.Namespace, console: Console) -> int:
    from ..core import kernels
    from ..core.warm import warm_all
    from ..simulation.warm import warm_simulation

    start = time.perf_counter()
    warm_all()
    warm_simulation()
    seconds = time.perf_counter() - start
    loaded, compiled = kernels.counts()
    place = kernels.place()
    document = {
        "compiled": compiled,
        "loaded": loaded,
        "seconds": seconds,
        "place": place.kind,
        "folder": place.folder and str(place.folder),
    }
    text = f"{compiled} kernels compiled, {loaded} loaded; {seconds:.1f} s; kept: {place}"
    console.result(text, document)
    return OK
