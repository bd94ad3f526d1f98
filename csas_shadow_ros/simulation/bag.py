"""A simulated run as a bag, its truth beside it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..core.errors import check_type
from ..core.geometry import Datum
from ..core.sectors.sector import Sector
from .run import SimulatedRun, simulate
from .sectors import sectors_of_run


def simulate_bag(
    path: str | Path,
    *args: Any,
    encoding: str = "32FC2",
    overwrite: bool = False,
    sectors_deg: float = 0.0,
    sector_lattice: str = "image",
    datum: Datum | None = None,
    **kwargs: Any,
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
    sectors_deg : float
        Write the image as sectors of so much arc, as they would come during the run; 0: as it is.
    sector_lattice : {'image', 'own'}
        Lattice of those sectors: the image's, or each on the coarsest one that holds its band.
    datum : Datum, optional
        Where on earth the scene's origin is, for topic ``origin``.

    Returns
    -------
    SimulatedRun
        What was written (before any rounding that the encoding does).

    Raises
    ------
    CsasError
        If an argument is out of range, or the bag cannot be written.

    Examples
    --------
    >>> import csas_shadow_ros as csas
    >>> made = csas.simulate_bag("sector_run", "tiny", "cone", sectors_deg=30)
    >>> csas.read_run("sector_run")
    Run of sector_run: 12 sector, track
      Track: 720 poses over 360.0° of the circle, radius 30.00 m, height 12.00 m, 0 gaps
    """
    check_type("path", path, (str, os.PathLike), "the path of a bag")
    # Writing bags needs the message libraries; simulating does not.
    from ..bags import write_run

    run = simulate(*args, **kwargs)
    how: dict[str, Any] = {"encoding": encoding, "overwrite": overwrite, "datum": datum}
    if sectors_deg:
        times: dict[int, int] = {}

        def timed() -> Iterator[Sector]:
            for sector, when in sectors_of_run(run.image, run.track, sectors_deg, sector_lattice):
                times[sector.stamp_ns] = when
                yield sector

        write_run(path, None, run.track, sectors=timed(), sector_times_ns=times, **how)
    else:
        write_run(path, run.image, run.track, **how)
    run.truth.save(path)
    return run
