"""Sectors: the full-circle image as it is made during a run, one coherent image an arc."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import GeometryError, check_finite, check_numbers, check_stamp, check_type
from ..frame_name import SCENE_FRAME, check_frame
from ..geometry import Acoustics, CoherentImage, GroundGrid, GroundLattice, unit_to_sonar
from ..geometry.pixels import COHERENT, check_pixels

#: A wavenumber under this fraction of the band's lower edge would need a grazing angle over 66°.
LEAST_COSINE = 0.4
#: So far may the scene's edge lie outside a sector's outer edge (its own pixels): programs align corners or
#: centres of pixels, and a turned lattice has whole numbers of them.
_EDGE_PIXELS = 0.5 + 1e-6
#: A lattice holds the scene's band if its Nyquist wavenumber reaches this fraction of the band's edge, which
#: the carrier tells, rounded to a bin of the spectrum.
_WHOLE_BAND = 0.98
#: A scene that a few small sectors tell of has at most so many pixels (2 GiB): 16384², the largest profile. A
#: wrong P or band must not ask for all memory.
MAX_SCENE_PIXELS = 1 << 28
#: So far may a band reach beyond a lattice's Nyquist wavenumber (fraction of it), told by the track's mean
#: grazing angle: the angle at the sector's own aspect is another by some degrees where the track wobbles.
_FOLD_SLACK = 0.05


class HasBand(Protocol):
    """A sector, or its description before its pixels are read."""

    @property
    def grid(self) -> GroundGrid | GroundLattice:
        """Lattice."""

    @property
    def acoustics(self) -> Acoustics:
        """Band."""

    @property
    def frame(self) -> str:
        """Frame id."""

    @property
    def aspect_rad(self) -> float:
        """Middle of its arc."""

    @property
    def aperture_rad(self) -> float:
        """Width of its arc."""

    @property
    def carrier_rad_m(self) -> tuple[float, float]:
        """Wavenumber that its pixels are at."""


@dataclass(frozen=True, eq=False)
class Sector:
    """A coherent baseband ground-plane image of one arc.

    Parameters
    ----------
    pixels : ndarray of complex, shape (rows, cols)
        The image, divided by exp(j carrier · (x, y)).
    grid : GroundGrid or GroundLattice
        Its lattice: the scene's, or one of its own that holds its arc's band and covers the scene.
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
    grid: GroundGrid | GroundLattice
    acoustics: Acoustics
    stamp_ns: int
    aspect_rad: float
    aperture_rad: float
    carrier_rad_m: tuple[float, float] = (0.0, 0.0)
    frame: str = field(default=SCENE_FRAME, kw_only=True)

    def __post_init__(self) -> None:
        expected = "a GroundGrid or a GroundLattice"
        check_type("grid of the sector", self.grid, (GroundGrid, GroundLattice), expected)
        check_type("acoustics of the sector", self.acoustics, Acoustics, "an Acoustics")
        object.__setattr__(self, "stamp_ns", check_stamp("sector", self.stamp_ns))
        check_finite("aspect of the sector", self.aspect_rad, "rad")
        check_finite("arc of the sector", self.aperture_rad, "rad")
        check_numbers("carrier of the sector", self.carrier_rad_m, 2, "rad/m")
        check_frame("frame of the sector", self.frame)
        # That they are finite is seen where they are read, and where they are summed: a sector comes often.
        check_pixels("sector", self.pixels, self.grid.shape, "grid", COHERENT)

    def carrier(self) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Return exp(j carrier · (x, y)) as a factor of the columns and one of the rows."""
        return wave_on(self.grid, self.carrier_rad_m)

    def on_carrier(self) -> NDArray[Any]:
        """Return the true image, pixels · exp(j carrier · (x, y)), shape (rows, cols)."""
        along_cols, along_rows = self.carrier()
        product: NDArray[Any] = self.pixels * along_cols[None, :] * along_rows[:, None]
        return product


def wave_on(
    grid: GroundGrid | GroundLattice, k_rad_m: tuple[float, float]
) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
    """Return exp(j k · (x, y)) over a lattice as a factor of its columns and one of its rows."""
    kx, ky = k_rad_m
    if isinstance(grid, GroundGrid):
        along_x = kx * grid.x_of_columns()
        along_y = ky * grid.y_of_rows()
    else:
        (ax, ay), (bx, by), (x, y) = grid.column_step_m, grid.row_step_m, grid.origin_m
        along_x = (kx * ax + ky * ay) * np.arange(grid.cols, dtype=np.float64)
        along_y = kx * x + ky * y + (kx * bx + ky * by) * np.arange(grid.rows, dtype=np.float64)
    return np.exp(1j * along_x).astype(np.complex64), np.exp(1j * along_y).astype(np.complex64)


def same_grid(a: GroundGrid, b: GroundGrid) -> bool:
    """Say whether two grids are the same lattice, to a millionth of a pixel."""
    tolerance = 1e-6 * a.spacing_m
    return a.shape == b.shape and all(
        abs(x - y) <= tolerance
        for x, y in ((a.spacing_m, b.spacing_m), (a.x_min_m, b.x_min_m), (a.y_max_m, b.y_max_m))
    )


def same_band(a: Acoustics, b: Acoustics) -> bool:
    """Say whether two bands are the same, to a millionth, as programs recompute them for each sector."""
    return a.spectrum_sign == b.spectrum_sign and all(
        math.isclose(x, y, rel_tol=1e-6)
        for x, y in (
            (a.centre_frequency_hz, b.centre_frequency_hz),
            (a.bandwidth_hz, b.bandwidth_hz),
            (a.sound_speed_mps, b.sound_speed_mps),
        )
    )


def unlike(own: HasBand, expected: HasBand) -> tuple[str, str] | None:
    """Return how a sector's ``frame`` or ``band`` differs, with both values; None if both agree."""
    if own.frame != expected.frame:
        return "frame", f"{own.frame!r}; expected {expected.frame!r}"
    if not same_band(own.acoustics, expected.acoustics):
        return "band", f"{own.acoustics}; expected {expected.acoustics}"
    return None


def unfit(own: HasBand, scene: GroundGrid, grazing_rad: float | None = None) -> str:
    """Say why a sector's lattice cannot give its part of the scene's image; empty if it can.

    Parameters
    ----------
    own : HasBand
        The sector, or what is known of it.
    scene : GroundGrid
        The scene's lattice. A sector on it is always fit.
    grazing_rad : float, optional
        The track's mean grazing angle, where it is known.
    """
    if isinstance(own.grid, GroundGrid) and same_grid(own.grid, scene):
        return ""
    lattice = GroundLattice.of(own.grid)
    left, right, bottom, top = scene.extent_m
    u, v = lattice.pixels_of([left, right, left, right], [bottom, bottom, top, top])
    slack = 0.5 + _EDGE_PIXELS
    if (
        min(u.min(), v.min()) < -slack
        or u.max() > own.grid.cols - 1 + slack
        or v.max() > own.grid.rows - 1 + slack
    ):
        return f"it covers {_ground(lattice.extent_m)}; expected all of the scene, {_ground(scene.extent_m)}"
    return folded(own, grazing_rad)


def folded(own: HasBand, grazing_rad: float | None = None) -> str:
    """Say how a lattice fails to hold its arc's band at its carrier; empty if it holds it.

    Parameters
    ----------
    own : HasBand
        The sector, or what is known of it.
    grazing_rad : float, optional
        The track's mean grazing angle, where it is known. Otherwise any that is not steeper than 66° will do.
    """
    slack = 1e-6 if grazing_rad is None else _FOLD_SLACK
    low, _, high = own.acoustics.ground_band(0.0)
    half = own.aperture_rad / 2.0
    angles = own.aspect_rad + np.linspace(-half, half, 65)
    ways = own.acoustics.spectrum_sign * np.concatenate(
        [k * unit_to_sonar(a)[None] for k in (low, high) for a in angles]
    )
    lattice = GroundLattice.of(own.grid)
    carrier = np.asarray(own.carrier_rad_m)
    cosines = (LEAST_COSINE, 1.0) if grazing_rad is None else (math.cos(grazing_rad),) * 2
    least, most = cosines
    steps = [np.asarray(step) for step in (lattice.column_step_m, lattice.row_step_m)]
    for step in steps:
        # Folding starts where (cos ψ · way - carrier) · step leaves ±π: bounds on cos ψ, point by point.
        slope, offset, turn = ways @ step, float(carrier @ step), math.pi * (1.0 + slack)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.sort(np.stack([(offset - turn) / slope, (offset + turn) / slope]), axis=0)
        level = np.abs(slope) < 1e-12
        if np.any(level & (abs(offset) > turn)):
            least = math.inf
        if not level.all():
            least, most = max(least, float(ends[0][~level].max())), min(most, float(ends[1][~level].min()))
    if least <= most * (1.0 + 1e-9):
        return ""
    middle = (low + high) / 2.0 * own.acoustics.spectrum_sign * unit_to_sonar(own.aspect_rad)
    along = float(carrier @ middle) / float(middle @ middle)
    cosine = min(max(along, cosines[0]), cosines[1])
    beyond = cosine * ways - carrier
    sizes = [float(np.hypot(*step)) for step in steps]
    need = [
        math.pi / float(np.abs(beyond @ (step / size)).max()) for step, size in zip(steps, sizes, strict=True)
    ]
    return (
        f"pixels of {sizes[0]:.4g} by {sizes[1]:.4g} m fold the band of its arc at its carrier"
        f" ({carrier[0]:.4g}, {carrier[1]:.4g}) rad/m; expected at most {need[0]:.4g} by {need[1]:.4g} m"
    )


def _ground(extent_m: tuple[float, float, float, float]) -> str:
    left, right, bottom, top = extent_m
    return f"x = {left:.4g} to {right:.4g} m, y = {bottom:.4g} to {top:.4g} m"


def scene_of(first: HasBand) -> GroundGrid:
    """Return the lattice of the image that a run's sectors sum to, from the first sector.

    Its own lattice where that holds the whole circle's band. Otherwise one over the same ground that holds
    the band at any grazing angle (a pixel of c / 4 (f_c + B/2)), of a size that transforms fast: so it is the
    same whichever sector of equal extent comes first.

    Raises
    ------
    GeometryError
        If its lattice folds its band, or the image would be too large.
    """
    grid, acoustics = first.grid, first.acoustics
    _, middle, high = acoustics.ground_band(0.0)
    carrier = np.asarray(first.carrier_rad_m)
    if isinstance(grid, GroundGrid):
        # The carrier sits in the middle of the band on the ground: it tells the cosine of the grazing angle.
        along = acoustics.spectrum_sign * float(carrier @ unit_to_sonar(first.aspect_rad)) / middle
        cosine = min(max(along, LEAST_COSINE), 1.0) if carrier.any() else LEAST_COSINE
        if math.pi / grid.spacing_m >= _WHOLE_BAND * cosine * high:
            return grid
    if fault := folded(first):
        raise GeometryError(fault)
    left, right, bottom, top = GroundLattice.of(grid).extent_m
    width, height = right - left, top - bottom
    across, down = width * high / math.pi, height * high / math.pi
    if not (across * down <= MAX_SCENE_PIXELS and max(across, down) < 1 << 16):
        raise GeometryError(
            f"it covers {width:.4g} by {height:.4g} m: at this band the image would have {across:.3g} by"
            f" {down:.3g} pixels; expected at most {MAX_SCENE_PIXELS:.3g} in all"
        )
    least = math.ceil(width * high / math.pi)
    # Late: it needs the FFT, which readers of messages need not load.
    from scipy.fft import next_fast_len

    cols = next_fast_len(least)
    # Pixels are square, so rows come out whole only for some numbers of columns: a few more may do.
    for more in range(least, least + least // 20 + 1):
        rows = more * height / width
        if (
            next_fast_len(more) == more
            and abs(rows - round(rows)) < 1e-6
            and next_fast_len(round(rows)) == round(rows)
        ):
            cols = more
            break
    spacing = width / cols
    rows = next_fast_len(math.ceil(height / spacing - 1e-6))
    return GroundGrid(rows, cols, spacing, left + spacing / 2.0, top - spacing / 2.0)


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
        If there are none, their bands differ, or a lattice does not hold its part of the image.
    """
    # Late: the sum needs the FFT and the compiler, which readers of messages need not load.
    from .streaming import SectorSum

    total = SectorSum()
    for sector in sectors:
        total.add(sector)
    return total.image()
