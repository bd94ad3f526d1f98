"""A simulated run as a bag, its truth beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .run import SimulatedRun, simulate


def simulate_bag(
    path: str | Path, *args: Any, encoding: str = "32FC2", overwrite: bool = False, **kwargs: Any
) -> SimulatedRun:
    """Simulate a run, write it as a complete bag, and write ``<path>.truth.stl`` and ``.json`` beside it.

    Parameters
    ----------
    path : str or Path
        Directory of the bag.
    *args, **kwargs
        Of `simulate`.
    encoding : str
        Pixel encoding of the image: ``32FC2``, ``64FC2``, ``16SC2`` or ``8SC2``.
    overwrite : bool
        Replace a bag that is there.

    Returns
    -------
    SimulatedRun
        What was written (before any rounding that the encoding does).

    Raises
    ------
    CsasError
        If an argument is out of range, or the bag cannot be written.
    """
    # Writing bags needs the message libraries; simulating does not.
    from ..bags import write_run

    run = simulate(*args, **kwargs)
    write_run(path, run.image, run.track, encoding=encoding, overwrite=overwrite)
    run.truth.save(path)
    return run
