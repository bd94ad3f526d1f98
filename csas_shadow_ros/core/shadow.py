"""Fixed focus shadow enhancement, FFSE (section 3.2 of the paper).

Seen from different aspects of an aperture, the shadow of a target turns about the target. Refocusing
every row of the view to the target's own range r₀ lays these shadows over one another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import ducc0
import numba
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from .errors import ViewError
from .geometry import View, ViewInfo, cross_range_axis, down_range_axis
from .parameters import ShadowParameters

#: Rows after which a running product of phases starts anew: its rounding stays under 1e-5.
_RUN = 32


def focus_range(info: ViewInfo, target_m: tuple[float, float]) -> float:
    """Return r₀ = e_r · target, the down-range (m) at which a view is focused."""
    return float(down_range_axis(info.aspect_rad) @ np.asarray(target_m, dtype=np.float64))


def focus_phase_rate(
    cross_wavenumber_rad_m: NDArray[np.float64], info: ViewInfo, form: str
) -> NDArray[np.float64]:
    """Return the filter's phase per metre behind the focus range, ∂ arg h / ∂Δ.

    Exact form: h(k_c, Δ) = exp(jσΔ sqrt(K₀² - k_c²)), the paper's h for σ = -1 with its 2k₀ = K₀ = K(f_c)
    on the ground plane. Simplified form: exp(-jσΔ k_c²/(2K₀)). The constant σΔK₀, a phase common to a whole
    row, is left out of both: it does not change the amplitude.

    Parameters
    ----------
    cross_wavenumber_rad_m : ndarray
        k_c.
    info : ViewInfo
        Band and grazing angle.
    form : {'exact', 'small_angle'}
        Which filter.
    """
    _, k0, _ = info.acoustics.ground_band(info.camera.grazing_rad)
    k_c = np.clip(cross_wavenumber_rad_m, -k0, k0)  # beyond K₀ nothing propagates
    rate = -(k_c**2) / (2.0 * k0) if form == "small_angle" else np.sqrt(k0**2 - k_c**2) - k0
    return info.acoustics.spectrum_sign * rate


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _apply_phase(
    rows: NDArray[np.complex64], first_m: float, step_m: float, rate: NDArray[np.float64]
) -> None:  # pragma: no cover
    """Multiply row i by exp(j (first + i step) rate), as a running product that starts anew now and then."""
    n, length = rows.shape
    turn, by = np.empty(length, np.complex64), np.empty(length, np.complex64)
    for k in range(length):
        by[k] = complex(math.cos(step_m * rate[k]), math.sin(step_m * rate[k]))
    for i in range(n):
        if i % _RUN == 0:
            delta = first_m + i * step_m
            for k in range(length):
                turn[k] = complex(math.cos(delta * rate[k]), math.sin(delta * rate[k]))
        for k in range(length):
            rows[i, k] *= turn[k]
            turn[k] *= by[k]


@numba.njit(cache=True, nogil=True)
def _known_pixels(
    pixels: NDArray[np.complex64], first: int, known: NDArray[np.bool_], rows: NDArray[np.complex64]
) -> None:  # pragma: no cover
    """Mark the finite pixels; copy the rows from `first` on, zero where unknown and beyond their end."""
    n, cols = pixels.shape
    for i in range(n):
        for j in range(cols):
            pixel = pixels[i, j]
            finite = (abs(pixel.real) < np.inf) & (abs(pixel.imag) < np.inf)
            known[i, j] = finite
            if i >= first:
                rows[i - first, j] = pixel if finite else np.complex64(0)
        if i >= first:
            rows[i - first, cols:] = np.complex64(0)


@numba.njit(cache=True, nogil=True)
def _shrink_rows(known: NDArray[np.bool_], margins: NDArray[np.int64]) -> None:  # pragma: no cover
    """Drop `margins[i]` pixels from both ends of each row's known interval (and all beyond)."""
    cols = known.shape[1]
    for i in range(known.shape[0]):
        first, last = cols, -1
        for j in range(cols):
            if known[i, j]:
                first = min(first, j)
                last = j
        for j in range(cols):
            if j < first + margins[i] or j > last - margins[i]:
                known[i, j] = False


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _known_amplitudes(
    parts: NDArray[np.float32], known: NDArray[np.bool_], out: NDArray[np.float32]
) -> None:  # pragma: no cover
    """Take the amplitudes of known pixels; NaN where unknown. `parts` may have longer rows than `out`."""
    rows, cols = out.shape
    for i in range(rows):
        line, here, to = parts[i], known[i], out[i]
        for j in range(cols):
            # In double precision: a square of float32 overflows at 2e19.
            re, im = np.float64(line[2 * j]), np.float64(line[2 * j + 1])
            to[j] = np.float32(math.sqrt(re * re + im * im)) if here[j] else np.float32(np.nan)


@dataclass(frozen=True, eq=False)
class _Focused:
    """A focused view in parts: up to row `first` its pixels are the view's own, from there on `rows`."""

    info: ViewInfo
    pixels: NDArray[np.complex64]
    first: int
    rows: NDArray[np.complex64]
    known: NDArray[np.bool_]


def _focus(view: View, target_m: tuple[float, float], parameters: ShadowParameters | None) -> _Focused:
    p = parameters or ShadowParameters()
    info = view.info
    if not np.iscomplexobj(view.pixels):
        raise ViewError(f"sub-aperture view has {view.pixels.dtype} pixels; expected complex")
    r0 = focus_range(info, target_m)
    pixels = np.ascontiguousarray(view.pixels, dtype=np.complex64)
    n_rows, cols = pixels.shape
    offsets = info.down_range_of_rows() - r0
    # Rows grow down-range: all from the first one behind the focus are.
    first = n_rows if p.enhancement == "none" else int(np.searchsorted(offsets, 0.0, side="right"))
    behind = offsets[first:]
    spacing = info.camera.spacing_m[1]
    reach = np.ceil(behind * math.tan(info.aperture_rad / 2.0) / spacing).astype(np.int64)
    # What leaves the view on one side must not come back on the other.
    length = scipy.fft.next_fast_len(cols + int(min(reach.max(initial=0), cols)))
    known = np.empty(pixels.shape, np.bool_)
    rows = np.empty((len(behind), length), np.complex64)
    _known_pixels(pixels, first, known, rows)
    if not known.any():
        raise ViewError("sub-aperture view holds no finite pixel")
    if len(behind):
        carrier = float(cross_range_axis(info.aspect_rad) @ np.asarray(info.carrier_rad_m))
        k_c = 2.0 * math.pi * scipy.fft.fftfreq(length, spacing) + carrier
        rate = focus_phase_rate(k_c, info, p.enhancement)
        ducc0.fft.c2c(rows, axes=(1,), out=rows, nthreads=1)
        _apply_phase(rows, float(behind[0]), float(offsets[-1] - offsets[0]) / (n_rows - 1), rate)
        ducc0.fft.c2c(rows, axes=(1,), forward=False, inorm=2, out=rows, nthreads=1)
        margins = np.zeros(n_rows, np.int64)
        margins[first:] = reach
        _shrink_rows(known, margins)
    return _Focused(replace(info, focus_range_m=r0), pixels, first, rows, known)


def focus(view: View, target_m: tuple[float, float], parameters: ShadowParameters | None = None) -> View:
    """Focus a sub-aperture view's shadows at the target's range.

    Parameters
    ----------
    view : View
        Complex view; NaN off the image.
    target_m : (float, float)
        Ground position (x, y) of the target, whose range is the focus.
    parameters : ShadowParameters
        Exact filter, the paper's simplified one, or none.

    Returns
    -------
    View
        complex64, but for the phase σΔK₀ common to a row (see `focus_phase_rate`). NaN off the image, and
        where part of the aperture looked past the image's edge: pixel Δ behind the focus needs Δ tan(w/2)
        of image to either side.

    Raises
    ------
    ViewError
        If the view is not complex or holds nothing.

    Notes
    -----
    Section 3.2: F = FFT along cross-range, F̃ = F · h(k_c, Δ) for Δ = r - r₀ > 0, inverse FFT. The view is at
    baseband, so k_c is the transform's wavenumber plus the carrier's cross-range part.
    """
    f = _focus(view, target_m, parameters)
    pixels = f.pixels.copy()
    pixels[f.first :] = f.rows[:, : pixels.shape[1]]
    pixels[~f.known] = np.complex64(complex(math.nan, math.nan))
    return View(f.info, pixels)


def enhance(view: View, target_m: tuple[float, float], parameters: ShadowParameters | None = None) -> View:
    """Focus a sub-aperture view's shadows and take the amplitude; see `focus`.

    Returns
    -------
    View
        float32 amplitude, NaN where the view knows nothing.

    Raises
    ------
    ViewError
        If the view is not complex or holds nothing.
    """
    f = _focus(view, target_m, parameters)
    amplitude = np.empty(f.pixels.shape, np.float32)
    _known_amplitudes(_parts(f.pixels[: f.first]), f.known[: f.first], amplitude[: f.first])
    _known_amplitudes(_parts(f.rows), f.known[f.first :], amplitude[f.first :])
    return View(f.info, amplitude)


def _parts(pixels: NDArray[np.complex64]) -> NDArray[np.float32]:
    """View complex rows as rows of real and imaginary parts in turns."""
    return pixels.view(np.float32)
