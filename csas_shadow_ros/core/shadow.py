"""Fixed focus shadow enhancement, FFSE (section 3.2 of the paper).

Seen from different aspects of an aperture, the shadow of a target turns about the target. Refocusing
every row of the view to the target's own range r₀ lays these shadows over one another.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numba
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from .errors import ViewError
from .geometry import View, ViewInfo, cross_range_axis, down_range_axis
from .parameters import ShadowParameters


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


@numba.njit(cache=True, nogil=True, fastmath=True)
def _apply_phase(
    rows: NDArray[np.complex64], offsets: NDArray[np.float32], rate: NDArray[np.float32]
) -> None:  # pragma: no cover
    for i in range(rows.shape[0]):
        delta = offsets[i]
        for k in range(rows.shape[1]):
            phase = delta * rate[k]
            rows[i, k] *= np.complex64(complex(math.cos(phase), math.sin(phase)))


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
    p = parameters or ShadowParameters()
    info = view.info
    if not np.iscomplexobj(view.pixels):
        raise ViewError(f"sub-aperture view has {view.pixels.dtype} pixels; expected complex")
    known = np.isfinite(view.pixels)
    if not known.any():
        raise ViewError("sub-aperture view holds no finite pixel")
    r0 = focus_range(info, target_m)
    pixels = view.pixels.astype(np.complex64)
    offsets = info.down_range_of_rows() - r0
    behind = np.flatnonzero(offsets > 0.0)
    if p.enhancement != "none" and behind.size:
        cols = info.camera.cols
        spacing = info.camera.spacing_m[1]
        reach = np.ceil(offsets[behind] * math.tan(info.aperture_rad / 2.0) / spacing).astype(np.int64)
        # What leaves the view on one side must not come back on the other.
        length = scipy.fft.next_fast_len(cols + int(min(reach.max(), cols)))
        rows = np.where(known[behind], pixels[behind], np.complex64(0))
        spectrum = scipy.fft.fft(rows, n=length, axis=1, overwrite_x=True)
        carrier = float(cross_range_axis(info.aspect_rad) @ np.asarray(info.carrier_rad_m))
        k_c = 2.0 * math.pi * scipy.fft.fftfreq(length, spacing) + carrier
        rate = focus_phase_rate(k_c, info, p.enhancement)
        _apply_phase(spectrum, offsets[behind].astype(np.float32), rate.astype(np.float32))
        pixels[behind] = scipy.fft.ifft(spectrum, axis=1, overwrite_x=True)[:, :cols]
        margins = np.zeros(info.camera.rows, np.int64)
        margins[behind] = reach
        _shrink_rows(known, margins)
    pixels[~known] = np.complex64(complex(math.nan, math.nan))
    return View(replace(info, focus_range_m=r0), pixels)


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
    focused = focus(view, target_m, parameters)
    return replace(focused, pixels=np.abs(focused.pixels))
