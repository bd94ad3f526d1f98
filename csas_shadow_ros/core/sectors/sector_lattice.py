"""A sector on a lattice of its own, taken to the scene's bins.

Where the lattice spans the scene's period, north-up, its transform's coefficients are the scene's, but for a
shift: nothing is interpolated. Any other lattice is interpolated, band-limited, to a coarse one that does.
"""

from __future__ import annotations

import cmath
import math

import ducc0
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import i0

from ..geometry import TWO_PI, GroundGrid, GroundLattice
from .sector import Sector, wave_on

#: A lattice spans the scene's period if it is so near it (its own pixels).
_SAME_PERIOD = 1e-6
#: Accuracy of the interpolation; float32 pixels have 6e-8.
_EPSILON = 1e-7
#: Pixels beyond the scene, on one side, from which on a sector is faded out there, and the fading's shape: a
#: Kaiser window's integral. Sixteen pixels of it at twice the band leave 1e-5 of what an abrupt end would.
_LEAST_GUARD, _SHAPE, _SHAPE_A_PIXEL = 2.0, 12.0, 0.75


def coefficients(
    sector: Sector, scene: GroundGrid, workers: int = 2
) -> tuple[NDArray[np.complex64], tuple[int, int]]:
    """Return the bins of the scene's spectrum that a sector fills.

    Parameters
    ----------
    sector : Sector
        On any lattice that is fit for the scene (`core.sectors.sector.unfit`).
    scene : GroundGrid
        The scene's lattice; the bins are those of its own period.
    workers : int
        Threads.

    Returns
    -------
    box : ndarray of complex64
        Its part of the spectrum, referred to the scene's pixel (0, 0).
    first : (int, int)
        Signed bin (row, col) of its first entry.
    """
    d = scene.spacing_m
    period = scene.rows * d, scene.cols * d
    steps = TWO_PI / period[0], TWO_PI / period[1]
    kx, ky = sector.carrier_rad_m
    centre = round(-ky / steps[0]), round(kx / steps[1])
    bin_rad_m = centre[1] * steps[1], -centre[0] * steps[0]
    lattice = GroundLattice.of(sector.grid)
    if not _spans(lattice, period):
        lattice, pixels = _resampled(lattice, np.asarray(sector.pixels), scene, period, workers)
    else:
        pixels = np.asarray(sector.pixels)
    along_cols, along_rows = wave_on(lattice, (kx - bin_rad_m[0], ky - bin_rad_m[1]))
    small = np.asarray(pixels * along_cols[None, :] * along_rows[:, None], np.complex64)
    small = scipy.fft.fftshift(scipy.fft.fft2(small, norm="forward", overwrite_x=True, workers=workers))
    # From the lattice's own first pixel to the scene's, and to the carrier's, which is the scene's origin.
    x, y = lattice.origin_m
    to_x, to_y = scene.x_min_m - x, scene.y_max_m - y
    rows, cols = (np.arange(n) - n // 2 for n in small.shape)
    small *= np.exp(-1j * steps[0] * to_y * rows).astype(np.complex64)[:, None]
    corner = cmath.exp(1j * (bin_rad_m[0] * scene.x_min_m + bin_rad_m[1] * scene.y_max_m))
    small *= (corner * np.exp(1j * steps[1] * to_x * cols)).astype(np.complex64)[None, :]
    # Bins that the scene's lattice cannot tell apart hold nothing of the band.
    keep, first = [], []
    for start, count, size in zip(
        (centre[0] - small.shape[0] // 2, centre[1] - small.shape[1] // 2),
        small.shape,
        scene.shape,
        strict=True,
    ):
        low, high = max(start, -(size // 2)), min(start + count, (size + 1) // 2)
        keep.append(slice(low - start, high - start))
        first.append(low)
    return np.ascontiguousarray(small[keep[0], keep[1]]), (first[0], first[1])


def _spans(lattice: GroundLattice, period_m: tuple[float, float]) -> bool:
    """Say whether a lattice is north-up and its period is the scene's."""
    (ax, ay), (bx, by) = lattice.column_step_m, lattice.row_step_m
    return (
        abs(lattice.cols * ay) <= _SAME_PERIOD * ax
        and abs(lattice.rows * bx) <= _SAME_PERIOD * -by
        and abs(lattice.cols * ax - period_m[1]) <= _SAME_PERIOD * ax
        and abs(-lattice.rows * by - period_m[0]) <= _SAME_PERIOD * -by
    )


def _resampled(
    lattice: GroundLattice,
    pixels: NDArray[np.complexfloating],
    scene: GroundGrid,
    period_m: tuple[float, float],
    workers: int,
) -> tuple[GroundLattice, NDArray[np.complex128]]:
    """Interpolate a baseband image to a north-up lattice that spans the scene's period and holds its band."""
    inverse = np.abs(lattice.ground_to_pixel[:2, :2])
    # As far as its own lattice can tell wavenumbers apart, along x and y.
    reach_x, reach_y = math.pi * inverse.sum(axis=0)
    shape = [
        min(full, scipy.fft.next_fast_len(math.ceil(reach * period / math.pi) + 2))
        for full, reach, period in zip(scene.shape, (reach_y, reach_x), period_m, strict=True)
    ]
    step_y, step_x = period_m[0] / shape[0], period_m[1] / shape[1]
    own = GroundLattice(shape[0], shape[1], (scene.x_min_m, scene.y_max_m), (step_x, 0.0), (0.0, -step_y))
    x, y = scene.x_min_m + step_x * np.arange(shape[1]), scene.y_max_m - step_y * np.arange(shape[0])
    u, v = lattice.pixels_of(x[None, :], y[:, None])
    left, right, bottom, top = scene.extent_m
    at_u, at_v = lattice.pixels_of([left, right, left, right], [bottom, bottom, top, top])
    faded = pixels * _fading(lattice.cols, at_u)[None, :] * _fading(lattice.rows, at_v)[:, None]
    bins = scipy.fft.fft2(np.asarray(faded, np.complex128), norm="forward", workers=workers)
    found = ducc0.nufft.u2nu(
        grid=bins,
        coord=np.stack([v.ravel(), u.ravel()], axis=1),
        forward=False,
        epsilon=_EPSILON,
        nthreads=workers,
        periodicity=[float(n) for n in lattice.shape],
        fft_order=True,
    )
    return own, found.reshape(shape)


def _fading(size: int, corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 1 over the scene, along one axis, falling to 0 at the ends where there are pixels to spare."""
    weight = np.ones(size)
    at = np.arange(size) + 0.5
    for flip, guard in ((False, float(corners.min()) + 0.5), (True, size - 0.5 - float(corners.max()))):
        if guard < _LEAST_GUARD:
            continue
        fine = np.linspace(-1.0, 1.0, 513)
        window = i0(min(_SHAPE, _SHAPE_A_PIXEL * guard) * np.sqrt(1.0 - fine * fine))
        risen = np.concatenate([[0.0], np.cumsum(window[1:] + window[:-1])])
        rise = np.interp(at / guard, (fine + 1.0) / 2.0, risen / risen[-1])
        weight *= rise[::-1] if flip else rise
    return weight
