"""Fixed focus shadow enhancement, FFSE (section 3.2 of the paper).

Seen from different aspects of an aperture, the shadow of a target turns about the target. Refocusing
every row of the view to the target's own range r₀ lays these shadows over one another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import ducc0
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..errors import ViewError
from ..geometry import View, ViewInfo, cross_range_axis, down_range_axis
from ..kernels import kernel
from ..parameters import ShadowParameters

#: Rows after which a running product of phases starts anew: its rounding stays under 1e-5.
_RUN = 32
#: Between these a power of single precision has kept its digits, and an amplitude has no need of more.
_LEAST, _MOST = np.float32(1e-30), np.float32(1e37)


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


@kernel(fastmath=True, error_model="numpy")
def _apply_phase(
    rows: NDArray[np.complex64], first_m: float, step_m: float, rate: NDArray[np.float64]
) -> None:  # pragma: no cover
    """Multiply row i by exp(j (first + i step) rate), as running products.

    That of every row is of single precision and starts anew from one of double precision now and then.
    """
    n, length = rows.shape
    turn, by = np.empty(length, np.complex64), np.empty(length, np.complex64)
    start, run = np.empty(length, np.complex128), np.empty(length, np.complex128)
    for k in range(length):
        start[k] = complex(math.cos(first_m * rate[k]), math.sin(first_m * rate[k]))
        by[k] = complex(math.cos(step_m * rate[k]), math.sin(step_m * rate[k]))
        run[k] = complex(math.cos(_RUN * step_m * rate[k]), math.sin(_RUN * step_m * rate[k]))
    for i in range(n):
        if i % _RUN == 0:
            for k in range(length):
                turn[k] = start[k]
                start[k] *= run[k]
        for k in range(length):
            rows[i, k] *= turn[k]
            turn[k] *= by[k]


@kernel()
def _finite(line: NDArray[np.float32], j: int) -> bool:  # pragma: no cover
    """Say whether pixel j of a row, real and imaginary parts in turns, is finite."""
    return bool(abs(line[2 * j]) < np.inf and abs(line[2 * j + 1]) < np.inf)


@kernel()
def _known_pixels(
    pixels: NDArray[np.float32], first: int, ends: NDArray[np.int64], rows: NDArray[np.float32]
) -> int:  # pragma: no cover
    """Find where each row's finite pixels begin and end; copy the rows from `first` on.

    A copy is zero where nothing is known, and beyond the row's end. Returns the row behind the last that has
    a finite pixel.
    """
    behind = 0
    for i in range(len(pixels)):
        line = pixels[i]
        begin, end = 0, len(line) // 2
        while begin < end and not _finite(line, begin):
            begin += 1
        while begin < end and not _finite(line, end - 1):
            end -= 1
        ends[i, 0], ends[i, 1] = begin, end
        if begin < end:
            behind = i + 1
        if i < first:
            continue
        copy = rows[i - first]
        copy[: 2 * begin], copy[2 * end :] = 0.0, 0.0
        here, there = line[2 * begin : 2 * end], copy[2 * begin : 2 * end]
        holes = 0
        for k in range(len(there)):
            there[k] = here[k]
            holes += not abs(here[k]) < np.inf
        if holes:
            for j in range(end - begin):
                if not _finite(here, j):
                    there[2 * j] = there[2 * j + 1] = 0.0
    return behind


@kernel(error_model="numpy")
def _known_amplitudes(
    pixels: NDArray[np.float32],
    first: int,
    ends: NDArray[np.int64],
    rows: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:  # pragma: no cover
    """Take the amplitudes, from row `first` on those of `rows`; NaN where a pixel is not known."""
    for i in range(len(out)):
        begin, end = ends[i, 0], max(ends[i, 0], ends[i, 1])
        out[i, :begin], out[i, end:] = np.float32(np.nan), np.float32(np.nan)
        here, to = pixels[i, 2 * begin : 2 * end], out[i, begin:end]
        line = rows[i - first, 2 * begin : 2 * end] if i >= first and begin < end else here
        doubtful = np.int32(0)
        for j in range(len(to)):
            re, im = line[2 * j], line[2 * j + 1]
            # A difference of what is not finite is NaN.
            unknown = (here[2 * j] - here[2 * j]) + (here[2 * j + 1] - here[2 * j + 1])
            power = re * re + im * im + unknown
            to[j] = math.sqrt(power)
            doubtful = np.int32(doubtful + (not (power > _LEAST) & (power < _MOST)))
        if doubtful:
            # In double precision: a square of float32 overflows at 2e19, and vanishes below 1e-19.
            for j in range(len(to)):
                re, im = np.float64(line[2 * j]), np.float64(line[2 * j + 1])
                amplitude = np.float32(math.sqrt(re * re + im * im))
                to[j] = amplitude if _finite(here, j) else np.float32(np.nan)


@dataclass(frozen=True, eq=False)
class _Focused:
    """A focused view in parts: up to row `first` its pixels are the view's own, from there on `rows`.

    Row i is known from column `ends[i, 0]` to `ends[i, 1]`, where the view's own pixels are finite.
    """

    info: ViewInfo
    pixels: NDArray[np.complex64]
    first: int
    rows: NDArray[np.complex64]
    ends: NDArray[np.int64]


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
    ends = np.empty((n_rows, 2), np.int64)
    rows = np.empty((len(behind), length), np.complex64)
    last = _known_pixels(_parts(pixels), first, ends, _parts(rows))
    if not last:
        raise ViewError("sub-aperture view holds no finite pixel")
    rows = rows[: max(last - first, 0)]
    if len(rows):
        carrier = float(cross_range_axis(info.aspect_rad) @ np.asarray(info.carrier_rad_m))
        k_c = 2.0 * math.pi * scipy.fft.fftfreq(length, spacing) + carrier
        rate = focus_phase_rate(k_c, info, p.enhancement)
        ducc0.fft.c2c(rows, axes=(1,), out=rows, nthreads=1)
        _apply_phase(rows, float(behind[0]), float(offsets[-1] - offsets[0]) / (n_rows - 1), rate)
        ducc0.fft.c2c(rows, axes=(1,), forward=False, inorm=2, out=rows, nthreads=1)
        ends[first:, 0] += reach
        ends[first:, 1] -= reach
    return _Focused(replace(info, focus_range_m=r0), pixels, first, rows, ends)


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
    pixels[f.first : f.first + len(f.rows)] = f.rows[:, : pixels.shape[1]]
    column = np.arange(pixels.shape[1])
    known = np.isfinite(f.pixels) & (column >= f.ends[:, :1]) & (column < f.ends[:, 1:])
    pixels[~known] = np.complex64(complex(math.nan, math.nan))
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
    _known_amplitudes(_parts(f.pixels), f.first, f.ends, _parts(f.rows), amplitude)
    return View(f.info, amplitude)


def _parts(pixels: NDArray[np.complex64]) -> NDArray[np.float32]:
    """View complex rows as rows of real and imaginary parts in turns."""
    return pixels.view(np.float32)
