"""Sections 3.1 and 3.2 of the paper, literally: full-size transforms, one step after another.

Slow and obvious on purpose. Tests hold the fast path against it and benchmarks measure the gain;
nothing else uses it.
"""

from __future__ import annotations

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from .geometry import CoherentImage, ShadowCamera, down_range_axis, unit_to_sonar


def wavenumbers(image: CoherentImage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (Kx, Ky) of every bin of the image's 2-D FFT, each of the image's shape."""
    kx = 2 * np.pi * np.fft.fftfreq(image.grid.cols, image.grid.spacing_m)
    ky = -2 * np.pi * np.fft.fftfreq(image.grid.rows, image.grid.spacing_m)  # rows grow along -y
    kx_grid, ky_grid = np.meshgrid(kx, ky)
    return kx_grid, ky_grid


def sub_aperture(image: CoherentImage, aspect_rad: float, aperture_rad: float) -> NDArray[np.complex128]:
    """Mask the spectrum to an aperture and transform back at full size (section 3.1).

    Parameters
    ----------
    image : CoherentImage
        Full-circle image.
    aspect_rad, aperture_rad : float
        θ₀ and full width.

    Returns
    -------
    ndarray, shape of the image
        The sub-aperture image, north up, not demodulated.
    """
    kx, ky = wavenumbers(image)
    angle = np.arctan2(image.acoustics.spectrum_sign * ky, image.acoustics.spectrum_sign * kx)
    # Rounded, so that a wavenumber on the edge of two neighbouring apertures lies in one of them.
    look = np.round(np.angle(np.exp(1j * (angle - aspect_rad))), 9)
    half = round(aperture_rad / 2, 9)
    mask = (look >= -half) & (look < half)
    return np.fft.ifft2(np.fft.fft2(image.pixels) * mask)


def rotate_to_view(
    pixels: NDArray[np.complex128], image: CoherentImage, camera: ShadowCamera, aspect_rad: float
) -> NDArray[np.complex128]:
    """Rotate a sub-aperture image into the view frame.

    The carrier is taken off for the interpolation and put back, since near the pixel's Nyquist
    wavenumber no spline interpolates.

    Returns
    -------
    ndarray, shape of the camera
        Zero off the image.
    """
    _, k0, _ = image.acoustics.ground_band(camera.grazing_rad)
    carrier = image.acoustics.spectrum_sign * k0 * unit_to_sonar(aspect_rad)
    x, y = np.meshgrid(image.grid.x_of_columns(), image.grid.y_of_rows())
    baseband = pixels * np.exp(-1j * (carrier[0] * x + carrier[1] * y))
    affine = image.grid.ground_to_pixel @ camera.pixel_to_ground
    # scipy wants (row, col) order: output index → input index.
    matrix, offset = affine[:2, :2][::-1, ::-1], affine[:2, 2][::-1]
    rotated = scipy.ndimage.affine_transform(
        baseband, matrix, offset, output_shape=camera.shape, order=5, mode="constant"
    )
    u, v = np.meshgrid(np.arange(camera.cols), np.arange(camera.rows))
    ground = np.tensordot(camera.pixel_to_ground[:2], np.stack([u, v, np.ones_like(u)]), axes=1)
    modulated: NDArray[np.complex128] = rotated * np.exp(
        1j * (carrier[0] * ground[0] + carrier[1] * ground[1])
    )
    return modulated


def enhance(
    view: NDArray[np.complex128],
    image: CoherentImage,
    camera: ShadowCamera,
    aspect_rad: float,
    focus_range_m: float,
    *,
    small_angle: bool = False,
) -> NDArray[np.complex128]:
    """Apply FFSE to a rotated, not demodulated view (section 3.2).

    F(k_x, y) = FFT[I], F̃ = F h with h = exp(jσΔy sqrt(K₀² - k_x²)) for Δy > 0, inverse FFT.

    Returns
    -------
    ndarray, shape of the view
        Complex, focused at `focus_range_m`.
    """
    _, k0, _ = image.acoustics.ground_band(camera.grazing_rad)
    rows_m, cols_m = camera.spacing_m
    k_c = 2 * np.pi * np.fft.fftfreq(camera.cols, cols_m)
    e_r = down_range_axis(aspect_rad)
    first = e_r @ (camera.pixel_to_ground[:2] @ np.array([0.0, 0.0, 1.0]))
    out = view.copy()
    for row in range(camera.rows):
        delta = first + row * rows_m - focus_range_m
        if delta > 0:
            phase = k0 - k_c**2 / (2 * k0) if small_angle else np.sqrt(np.maximum(k0**2 - k_c**2, 0.0))
            h = np.exp(1j * image.acoustics.spectrum_sign * delta * phase)
            out[row] = np.fft.ifft(np.fft.fft(view[row]) * h)
    return out


def focus_range(aspect_rad: float, target_m: tuple[float, float]) -> float:
    """Return r₀ = e_r · target."""
    return float(down_range_axis(aspect_rad) @ np.asarray(target_m))
