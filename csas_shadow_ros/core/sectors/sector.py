"""Sectors: the full-circle image as it is made during a run, one coherent image an arc."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import GeometryError
from ..geometry import SCENE_FRAME, Acoustics, CoherentImage, GroundGrid


class HasBand(Protocol):
    """A sector, or what is known of one before its pixels are read."""

    @property
    def grid(self) -> GroundGrid:
        """Lattice."""
    @property
    def acoustics(self) -> Acoustics:
        """Band."""
    @property
    def frame(self) -> str:
        """Frame id."""


@dataclass(frozen=True, eq=False)
class Sector:
    """A coherent baseband ground-plane image of one arc.

    Parameters
    ----------
    pixels : ndarray of complex, shape (rows, cols)
        The image, divided by exp(j carrier · (x, y)).
    grid : GroundGrid
        Its lattice.
    acoustics : Acoustics
        Its band.
    stamp_ns : int
        When the sonar was at `aspect_rad`; identifies the sector.
    aspect_rad, aperture_rad : float
        Centre and full width of the arc.
    carrier_rad_m : (float, float)
        Wavenumber (kx, ky), scene axes, that was divided out.
    frame : str
        Name of the scene frame that it is in: one for all of a run.
    """

    pixels: NDArray[Any]
    grid: GroundGrid
    acoustics: Acoustics
    stamp_ns: int
    aspect_rad: float
    aperture_rad: float
    carrier_rad_m: tuple[float, float] = (0.0, 0.0)
    frame: str = field(default=SCENE_FRAME, kw_only=True)

    def __post_init__(self) -> None:
        if self.pixels.shape != self.grid.shape:
            raise GeometryError(
                f"sector has {self.pixels.shape} pixels; its grid says {self.grid.shape} (rows, cols)"
            )

    def carrier(self) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Return exp(j kx x) of the columns and exp(j ky y) of the rows: the carrier is their product."""
        kx, ky = self.carrier_rad_m
        along_x = np.exp(1j * kx * self.grid.x_of_columns()).astype(np.complex64)
        along_y = np.exp(1j * ky * self.grid.y_of_rows()).astype(np.complex64)
        return along_x, along_y

    def on_carrier(self) -> NDArray[Any]:
        """Return the true image, pixels · exp(j carrier · (x, y)), shape (rows, cols)."""
        along_x, along_y = self.carrier()
        product: NDArray[Any] = self.pixels * along_x[None, :] * along_y[:, None]
        return product


def same_grid(a: GroundGrid, b: GroundGrid) -> bool:
    """Say whether two grids are the same lattice, to a millionth of a pixel."""
    tolerance = 1e-6 * a.spacing_m
    return a.shape == b.shape and all(
        abs(x - y) <= tolerance
        for x, y in ((a.spacing_m, b.spacing_m), (a.x_min_m, b.x_min_m), (a.y_max_m, b.y_max_m))
    )


def same_band(a: Acoustics, b: Acoustics) -> bool:
    """Say whether two bands are the same, to a millionth: programs work them out anew for each sector."""
    return a.spectrum_sign == b.spectrum_sign and all(
        math.isclose(x, y, rel_tol=1e-6)
        for x, y in (
            (a.centre_frequency_hz, b.centre_frequency_hz),
            (a.bandwidth_hz, b.bandwidth_hz),
            (a.sound_speed_mps, b.sound_speed_mps),
        )
    )


def unlike(own: HasBand, expected: HasBand) -> tuple[str, str] | None:
    """Say in what a sector differs, ``frame``, ``grid`` or ``band``, with both values; None if in none."""
    if own.frame != expected.frame:
        return "frame", f"{own.frame!r}; expected {expected.frame!r}"
    if not same_grid(own.grid, expected.grid):
        return "grid", f"{own.grid}; expected {expected.grid}"
    if not same_band(own.acoustics, expected.acoustics):
        return "band", f"{own.acoustics}; expected {expected.acoustics}"
    return None


def image_from_sectors(sectors: Iterable[Sector]) -> CoherentImage:
    """Sum sectors, each put back on its carrier, to the full-circle image.

    Parameters
    ----------
    sectors : iterable of Sector
        Held one at a time. A stamp that comes twice counts once.

    Returns
    -------
    CoherentImage
        Stamped with the last sector's stamp.

    Raises
    ------
    GeometryError
        If there are none, or their grids or bands differ.
    """
    # Late: the sum needs the FFT and the compiler, which readers of messages need not load.
    from .streaming import SectorSum

    total = SectorSum()
    for sector in sectors:
        total.add(sector)
    return total.image()
