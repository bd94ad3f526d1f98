"""A finished run cut into the sectors that it would have been made of while it went on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..core.errors import ParameterError, TrackError, check_divides_circle, check_range
from ..core.geometry import TWO_PI, CoherentImage, GroundGrid, GroundLattice, Track, unit_to_sonar
from ..core.sectors.sector import Sector

#: What lattices sectors are written on.
LATTICES = ("image", "own")
#: Energy of a sector (share) that its own lattice may leave out: what float32 pixels lose anyway.
_LEFT_OUT = 1e-12
#: Bins to spare at either end of a lattice that a sector has for itself.
_SPARE_BINS = 2


def sectors_of_run(
    image: CoherentImage, track: Track, width_deg: float, lattice: str = "image"
) -> Iterator[tuple[Sector, int]]:
    """Cut a run's image into sectors of equal arcs, in the order in which the sonar passed them.

    Parameters
    ----------
    image, track : CoherentImage, Track
        The run.
    width_deg : float
        Arc of a sector; divides 360.
    lattice : {'image', 'own'}
        What sectors lie on: the image's lattice, or each on the coarsest one that holds its band.

    Yields
    ------
    sector : Sector
        complex64 at baseband, stamped when the sonar was at the arc's middle. Together they sum to the image.
    when_ns : int
        When the sonar had passed the arc: no sooner could the sector have been made.

    Raises
    ------
    ParameterError
        If the width does not divide the circle, or there is no such lattice.
    """
    if lattice not in LATTICES:
        raise ParameterError(f"sector lattice is {lattice!r}; expected one of: {', '.join(LATTICES)}")
    check_range("sector width", width_deg, 0.0, 180.0, "deg", open_low=True)
    check_divides_circle("sector width", width_deg, "°", off_deg=1e-6)
    count = round(360.0 / width_deg)
    rows, cols = image.grid.shape
    spectrum = scipy.fft.fft2(np.asarray(image.pixels, np.complex64), norm="forward", workers=-1)
    step_row, step_col = TWO_PI / (rows * image.grid.spacing_m), TWO_PI / (cols * image.grid.spacing_m)
    sign = image.acoustics.spectrum_sign
    kx, ky = sign * step_col * _bins(cols), -sign * step_row * _bins(rows)
    turns = -1 if track.aspects_rad[-1] < track.aspects_rad[0] else 1
    first = float(track.aspects_rad[0])
    # Which arc every wavenumber belongs to, counted from the track's start in the sonar's direction.
    arc = np.empty((rows, cols), np.int16)
    for row in range(rows):
        ahead = np.mod(turns * (np.arctan2(ky[row], kx) - first), TWO_PI)
        arc[row] = np.minimum(ahead * (count / TWO_PI), count - 1).astype(np.int16)
    _, middle, _ = image.acoustics.ground_band(track.grazing_rad)
    width = TWO_PI / count
    for index in range(count):
        aspect = first + turns * (index + 0.5) * width
        try:
            stamp, _ = track.at_aspect(aspect)
        except TrackError:
            continue  # the sonar never was there
        part = np.where(arc == index, spectrum, np.complex64(0))
        if lattice == "own":
            pixels, grid, carrier = _on_own_lattice(part, image.grid)
        else:
            direction = sign * middle * unit_to_sonar(aspect)
            row, col = round(-direction[1] / step_row), round(direction[0] / step_col)
            baseband = np.roll(part, (-row, -col), (0, 1))
            pixels = scipy.fft.ifft2(baseband, norm="forward", overwrite_x=True, workers=-1)
            grid, carrier = image.grid, (col * step_col, -row * step_row)
            # The transform is referred to the image's corner, the contract's carrier to the scene's origin.
            corner = carrier[0] * image.grid.x_min_m + carrier[1] * image.grid.y_max_m
            pixels *= np.complex64(np.exp(-1j * corner))
        at = float(np.mod(aspect, TWO_PI))
        sector = Sector(pixels, grid, image.acoustics, stamp, at, width, carrier, frame=image.frame)
        yield sector, _passed(track, aspect + turns * width / 2.0, stamp, width)


def _on_own_lattice(
    part: NDArray[np.complex64], image: GroundGrid
) -> tuple[NDArray[np.complex64], GroundGrid | GroundLattice, tuple[float, float]]:
    """Return an arc of the spectrum as pixels on the coarsest lattice over the image that holds it."""
    power = part.real**2 + part.imag**2
    sizes, carrier, shifts, places = [], [], [], []
    for axis, count in enumerate(part.shape):
        along = np.asarray(power.sum(axis=1 - axis), np.float64)
        # Bins in the order of wavenumbers, from the middle of the gap between them.
        gap = _widest_gap(along > _LEFT_OUT * along.sum() / count)
        order = (np.arange(count) + gap) % count
        kept = np.flatnonzero(np.roll(along, -gap) > _LEFT_OUT * along.sum() / count)
        first, last = (kept[0], kept[-1]) if kept.size else (0, 1)
        size = min(count, scipy.fft.next_fast_len(int(last - first) + 1 + 2 * _SPARE_BINS))
        middle = int(first + last) // 2
        signed = int(order[middle])
        centre = signed - count if signed >= (count + 1) // 2 else signed
        bins = np.arange(size) - size // 2
        sizes.append(size)
        carrier.append(centre)
        shifts.append(bins)
        places.append((centre + bins) % count)
    small = part[np.ix_(*places)]
    extent = [n * image.spacing_m for n in image.shape]
    step_row, step_col = (TWO_PI / length for length in extent)
    pitch_row, pitch_col = (length / n for length, n in zip(extent, sizes, strict=True))
    left, _, _, top = image.extent_m
    x, y = left + pitch_col / 2.0, top - pitch_row / 2.0
    # The transform is referred to the image's first pixel, pixels to the lattice's, carriers to the origin.
    along_rows = np.exp(-1j * step_row * shifts[0] * (y - image.y_max_m))
    along_cols = np.exp(1j * step_col * shifts[1] * (x - image.x_min_m))
    k = carrier[1] * step_col, -carrier[0] * step_row
    corner = np.exp(-1j * (k[0] * image.x_min_m + k[1] * image.y_max_m))
    shifted = scipy.fft.ifftshift(small * along_rows[:, None] * (corner * along_cols)[None, :])
    pixels = scipy.fft.ifft2(shifted, norm="forward", workers=-1).astype(np.complex64)
    if pitch_row == pitch_col:
        return pixels, GroundGrid(sizes[0], sizes[1], pitch_col, x, y), k
    return pixels, GroundLattice(sizes[0], sizes[1], (x, y), (pitch_col, 0.0), (0.0, -pitch_row)), k


def _widest_gap(held: NDArray[np.bool_]) -> int:
    """Return the place after the longest run of entries that hold nothing, going round."""
    at = np.flatnonzero(held)
    if not at.size:
        return 0
    ahead = np.diff(np.append(at, at[0] + held.size))
    return int(at[(int(np.argmax(ahead)) + 1) % at.size])


def _bins(count: int) -> NDArray[np.float64]:
    return np.asarray(np.fft.fftfreq(count, 1.0 / count), np.float64)


def _passed(track: Track, aspect_rad: float, stamp_ns: int, width_rad: float) -> int:
    """Return when the sonar was at the end of an arc; the last one ends after the last pose."""
    first, last = int(track.stamps_ns[0]), int(track.stamps_ns[-1])
    turn = abs(float(track.aspects_rad[-1] - track.aspects_rad[0]))
    half = round((last - first) * (width_rad / 2.0) / turn) if turn > 0 else 0
    try:
        when, _ = track.at_aspect(aspect_rad)
    except TrackError:
        when = 0
    return when if when > stamp_ns else stamp_ns + half
