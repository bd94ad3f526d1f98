"""A finished run cut into the sectors that it would have been made of while it went on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..core.errors import ParameterError, TrackError, check_range
from ..core.geometry import TWO_PI, CoherentImage, Track, unit_to_sonar
from ..core.sectors.sector import Sector


def sectors_of_run(image: CoherentImage, track: Track, width_deg: float) -> Iterator[tuple[Sector, int]]:
    """Cut a run's image into sectors of equal arcs, in the order in which the sonar passed them.

    Parameters
    ----------
    image, track : CoherentImage, Track
        The run.
    width_deg : float
        Arc of a sector; divides 360.

    Yields
    ------
    sector : Sector
        complex64 at baseband, stamped when the sonar was at the arc's middle. Together they sum to the image.
    when_ns : int
        When the sonar had passed the arc: no sooner could the sector have been made.

    Raises
    ------
    ParameterError
        If the width does not divide the circle.
    """
    check_range("sector width", width_deg, 0.0, 180.0, "deg", open_low=True)
    count = round(360.0 / width_deg)
    if abs(count * width_deg - 360.0) > 1e-6:
        raise ParameterError(f"sector width is {width_deg:g}°; expected a divisor of 360° (such as 5 or 10)")
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
        direction = sign * middle * unit_to_sonar(aspect)
        row, col = round(-direction[1] / step_row), round(direction[0] / step_col)
        part = np.where(arc == index, spectrum, np.complex64(0))
        baseband = np.roll(part, (-row, -col), (0, 1))
        pixels = scipy.fft.ifft2(baseband, norm="forward", overwrite_x=True, workers=-1)
        carrier = (col * step_col, -row * step_row)
        # The transform is referred to the image's corner, the contract's carrier to the scene's origin.
        corner = carrier[0] * image.grid.x_min_m + carrier[1] * image.grid.y_max_m
        pixels *= np.complex64(np.exp(-1j * corner))
        at = float(np.mod(aspect, TWO_PI))
        sector = Sector(
            pixels, image.grid, image.acoustics, stamp, at, width, carrier, frame=image.frame
        )
        yield sector, _passed(track, aspect + turns * width / 2.0, stamp, width)


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
