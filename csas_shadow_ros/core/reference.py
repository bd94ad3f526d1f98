"""Sections 3.1 to 4.2 of the paper, literally: full-size transforms, then loops over pixels and voxels.

Slow and obvious on purpose. Tests hold the fast path against it and benchmarks measure the gain;
nothing else uses it.

From images to views (`sub_aperture`, `rotate_to_view`, `enhance`), from views to what is carved with
(`silhouette` for 4.1, `l_out` for 4.2), and from these to voxels (`hard_carving`, `soft_carving`). The paper
draws silhouettes by hand; here the package's rule stands in its place. Levels are given: σ_r and σ_s, one of
each for a view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from .geometry import CoherentImage, ShadowCamera, View, ViewInfo, down_range_axis, unit_to_sonar
from .shape.volume import Volume

#: Values of a silhouette: lit seabed; between the target's echo and its shadow; not known; target's shadow.
OUTSIDE, COVERED, UNKNOWN, SHADOW = 0, 64, 128, 255


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


def silhouette(
    view: View,
    sigma_r: float,
    sigma_s: float,
    target_m: tuple[float, float],
    reach_m: float,
    echo_db: float = 8.0,
) -> NDArray[np.uint8]:
    """Segment the target's shadow (section 4.1, figure 7), by the package's rule instead of by hand.

    The shadow is every dark patch that begins at the target. Echoes are not known, as they lie over what
    they hide, nor is what is too dark for seabed beside thin shadow. What lies between the target's echo and
    its shadow is covered.

    Parameters
    ----------
    view : View
        Amplitude after enhancement, shape (rows, cols), rows down-range; NaN where unknown.
    sigma_r, sigma_s : float
        Rayleigh modes of seabed and shadow, in the amplitude's unit.
    target_m : (float, float)
        Ground position (x, y) of the target, metres.
    reach_m : float
        The shadow begins within this distance of the target, metres.
    echo_db : float
        How far an echo's mean power is over the seabed's, dB.

    Returns
    -------
    ndarray of uint8, shape (rows, cols)
        255 shadow, 0 outside, 64 covered, 128 unknown.
    """
    shadow = shadow_patches(dark_pixels(view, sigma_r, sigma_s), view.info, target_m, reach_m)
    echo = echo_pixels(view, sigma_r, echo_db)
    covered = covered_pixels(shadow, echo, view.info, target_m, reach_m)
    unsure = unsure_pixels(view, sigma_r, sigma_s, shadow)
    rows, cols = view.info.camera.shape
    mask = np.empty((rows, cols), np.uint8)
    for v in range(rows):
        for u in range(cols):
            if shadow[v, u]:
                mask[v, u] = SHADOW
            elif echo[v, u] or not math.isfinite(view.pixels[v, u]):
                mask[v, u] = UNKNOWN
            elif covered[v, u]:
                mask[v, u] = COVERED
            else:
                mask[v, u] = UNKNOWN if unsure[v, u] else OUTSIDE
    return mask


def thin_shadow(shadow: NDArray[np.bool_], info: ViewInfo) -> NDArray[np.bool_]:
    """Mark the shadow that no box of shadow comes near, three times that of `dark_pixels` in size.

    Near is within 1.5 resolution cells, down-range and across.
    """
    rows, cols = shadow.shape
    per_cell = tuple(c / p for c, p in zip(info.resolution_m, info.camera.spacing_m, strict=True))
    down, across = round(3.0 * 1.8 * per_cell[0]), round(3.0 * 0.75 * per_cell[1])
    near_down, near_across = down + round(1.5 * per_cell[0]), across + round(1.5 * per_cell[1])
    thin = shadow.copy()
    for v in range(rows):
        for u in range(cols):
            if shadow[max(0, v - down) : v + down + 1, max(0, u - across) : u + across + 1].all():
                # From its middle, the box reaches so far, and what is near it farther.
                thin[
                    max(0, v - near_down) : v + near_down + 1, max(0, u - near_across) : u + near_across + 1
                ] = False
    return thin


def unsure_pixels(
    view: View, sigma_r: float, sigma_s: float, shadow: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Mark the pixels beside thin shadow that are too dark for seabed.

    Dark is here where the mean power is less than half of the way from the shadow's to the seabed's, over 0.9
    resolution cells down-range and 0.4 across, to either side; beside is within a cell either way.

    Parameters
    ----------
    view : View
        Amplitude, shape (rows, cols); NaN where unknown.
    sigma_r, sigma_s : float
        Rayleigh modes of seabed and shadow, in the amplitude's unit.
    shadow : ndarray of bool, shape (rows, cols)
        The target's shadow.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
    """
    amplitude = view.pixels.astype(np.float64)
    thin = thin_shadow(shadow, view.info)
    half = box_px((0.9, 0.4), view.info)
    cell_m, pixel_m = view.info.resolution_m, view.info.camera.spacing_m
    down, across = (math.ceil(cell / pixel) for cell, pixel in zip(cell_m, pixel_m, strict=True))
    threshold = 2 * sigma_s**2 + 0.5 * (2 * sigma_r**2 - 2 * sigma_s**2)
    rows, cols = amplitude.shape
    unsure = np.zeros((rows, cols), bool)
    for v in range(rows):
        for u in range(cols):
            near = thin[max(0, v - down) : v + down + 1, max(0, u - across) : u + across + 1]
            if near.any() and math.isfinite(amplitude[v, u]):
                unsure[v, u] = mean_power(amplitude, v, u, half) < threshold
    return unsure


def mean_power(amplitude: NDArray[np.float64], v: int, u: int, half: tuple[int, int]) -> float:
    """Return the mean of i² over the known pixels of a box, half (rows, cols) to either side of (v, u)."""
    box = amplitude[max(0, v - half[0]) : v + half[0] + 1, max(0, u - half[1]) : u + half[1] + 1]
    return float(np.mean(box[np.isfinite(box)] ** 2))


def box_px(half_cells: tuple[float, float], info: ViewInfo) -> tuple[int, int]:
    """Return the half-size (rows, cols) of a box in pixels, from resolution cells (down-range, across).

    At least one pixel, at most the view.
    """
    cell_m, pixel_m, shape = info.resolution_m, info.camera.spacing_m, info.camera.shape
    rows = round(min(half_cells[0] * cell_m[0] / pixel_m[0], shape[0]))
    cols = round(min(half_cells[1] * cell_m[1] / pixel_m[1], shape[1]))
    return max(rows, 1), max(cols, 1)


def dark_pixels(view: View, sigma_r: float, sigma_s: float) -> NDArray[np.bool_]:
    """Mark the pixels that are shadow rather than seabed (section 4.1).

    Dark is where the mean power is less than 0.37 of the way from the shadow's, 2σ_s², to the seabed's,
    2σ_r². The mean is over 1.8 resolution cells down-range and 0.75 across, to either side.

    Parameters
    ----------
    view : View
        Amplitude, shape (rows, cols); NaN where unknown.
    sigma_r, sigma_s : float
        Rayleigh modes of seabed and shadow, in the amplitude's unit.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
    """
    amplitude = view.pixels.astype(np.float64)
    down, across = box_px((1.8, 0.75), view.info)
    threshold = 2 * sigma_s**2 + 0.37 * (2 * sigma_r**2 - 2 * sigma_s**2)
    rows, cols = amplitude.shape
    low = np.zeros((rows, cols), bool)
    for v in range(rows):
        for u in range(cols):
            if math.isfinite(amplitude[v, u]):
                low[v, u] = mean_power(amplitude, v, u, (down, across)) < threshold
    # At a straight edge the mean is 0.5 of the way: 0.37 draws the edge in by 0.13 of the box. The far end
    # tells the height and is put back.
    drawn_in = round(0.13 * (2 * down + 1))
    dark = np.zeros((rows, cols), bool)
    for v in range(rows):
        for u in range(cols):
            dark[v, u] = math.isfinite(amplitude[v, u]) and low[max(0, v - drawn_in) : v + 1, u].any()
    return dark


def shadow_patches(
    dark: NDArray[np.bool_], info: ViewInfo, target_m: tuple[float, float], reach_m: float
) -> NDArray[np.bool_]:
    """Keep the dark patches that begin at the target (section 4.1).

    Pixels that touch, corners too, are one patch. It begins at the target if any of it lies within reach of
    it, or a little farther down-range, by the shadow of a quarter of the reach. Less than 5.6 resolution
    cells are speckle.

    Parameters
    ----------
    dark : ndarray of bool, shape (rows, cols)
        Dark pixels.
    info : ViewInfo
        The view.
    target_m : (float, float)
        Ground position (x, y) of the target, metres.
    reach_m : float
        Reach, metres.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
    """
    camera = info.camera
    least = 5.6 * info.resolution_m[0] * info.resolution_m[1] / camera.spacing_m[0] / camera.spacing_m[1]
    target_u, target_v = ground_pixel(target_m, camera)
    row_m, col_m = camera.spacing_m
    top, bottom = target_v - reach_m / row_m, target_v + reach_m / row_m
    bottom += reach_m / 4 / math.tan(camera.grazing_rad) / row_m
    left, right = target_u - reach_m / col_m, target_u + reach_m / col_m
    rows, cols = dark.shape
    kept = np.zeros((rows, cols), bool)
    seen = np.zeros((rows, cols), bool)
    for v in range(rows):
        for u in range(cols):
            if not dark[v, u] or seen[v, u]:
                continue
            # A new patch: from its first pixel on, every dark neighbour of a pixel of it is of it too.
            patch = [(v, u)]
            seen[v, u] = True
            for a, b in patch:
                for c in range(max(0, a - 1), min(rows, a + 2)):
                    for d in range(max(0, b - 1), min(cols, b + 2)):
                        if dark[c, d] and not seen[c, d]:
                            seen[c, d] = True
                            patch.append((c, d))
            # Pixels on the box's own edge are in it.
            begins_here = any(
                math.floor(top) <= a <= bottom and math.floor(left) <= b <= right for a, b in patch
            )
            if begins_here and len(patch) >= least:
                for pixel in patch:
                    kept[pixel] = True
    return kept


def echo_pixels(view: View, sigma_r: float, echo_db: float) -> NDArray[np.bool_]:
    """Mark echoes: where the mean power of a box is `echo_db` over the seabed's, and all of that box.

    It reaches 0.6 resolution cells to either side down-range, 0.375 across.

    Parameters
    ----------
    view : View
        Amplitude, shape (rows, cols); NaN where unknown.
    sigma_r : float
        Rayleigh mode of the seabed, in the amplitude's unit.
    echo_db : float
        Threshold over 2σ_r², dB.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
    """
    amplitude = view.pixels.astype(np.float64)
    threshold = 2 * sigma_r**2 * 10 ** (echo_db / 10)
    down, across = box_px((0.6, 0.375), view.info)
    rows, cols = amplitude.shape
    echo = np.zeros((rows, cols), bool)
    for v in range(rows):
        for u in range(cols):
            if math.isfinite(amplitude[v, u]) and mean_power(amplitude, v, u, (down, across)) > threshold:
                # The flank of an echo is neither seabed nor shadow.
                echo[max(0, v - down) : v + down + 1, max(0, u - across) : u + across + 1] = True
    return echo


def covered_pixels(
    shadow: NDArray[np.bool_],
    echo: NDArray[np.bool_],
    info: ViewInfo,
    target_m: tuple[float, float],
    reach_m: float,
) -> NDArray[np.bool_]:
    """Mark the pixels between the target's echo and its shadow, column by column.

    It reaches from the farthest echo within reach of the target to the shadow. A side along range, g long, is
    smeared by g/2 tan(w/2) to either side by the aperture w: a stretch of shadow that lies no farther inside
    than that is led up to by no more than g, or by its own length where that is more. An edge that glitters
    has gaps: echoes up to 0.75 resolution cells beside count. The 1.2 cells before the shadow, its flank, are
    covered without any echo.

    Parameters
    ----------
    shadow, echo : ndarray of bool, shape (rows, cols)
        Target's shadow; echoes.
    info : ViewInfo
        The view.
    target_m : (float, float)
        Ground position (x, y) of the target, metres.
    reach_m : float
        Reach, metres.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
    """
    row_m, col_m = info.camera.spacing_m
    near_end = int(ground_pixel(target_m, info.camera)[1] - reach_m / row_m)
    rows_a_column = 2 * col_m / (row_m * math.tan(info.aperture_rad / 2))
    flank = max(1, round(1.2 * info.resolution_m[0] / row_m))
    beside = max(1, round(0.75 * info.resolution_m[1] / col_m))
    rows, cols = shadow.shape
    covered = np.zeros((rows, cols), bool)
    for u in range(cols):
        for start in range(rows):
            if not shadow[start, u] or (start > 0 and shadow[start - 1, u]):
                continue
            end = start
            while end < rows and shadow[end, u]:
                end += 1
            inside = 0
            for v in range(start, end):
                left = right = u
                while left >= 0 and shadow[v, left]:
                    left -= 1
                while right < cols and shadow[v, right]:
                    right += 1
                inside = max(inside, min(u - left, right - u))
            smeared = start - int(inside * rows_a_column)
            farthest = max(0, min(start - (end - start), max(near_end, smeared)))
            begin = max(farthest, start - flank)
            for v in range(farthest, start):
                if echo[v, max(0, u - beside) : u + beside + 1].any():
                    begin = min(begin, v)
            covered[begin:start, u] = True
    return covered


def l_out(amplitude: NDArray[np.floating[Any]], sigma_r: float, sigma_s: float) -> NDArray[np.float64]:
    """Rate every pixel's likelihood of being outside the shadow, as printed (section 4.2).

    p = i/σ² exp(-i²/2σ²) for σ_r and σ_s; l_out = (p_r / (p_r + p_s))².

    Parameters
    ----------
    amplitude : ndarray, shape (rows, cols)
        i(x, y); NaN where unknown.
    sigma_r, sigma_s : float
        Rayleigh modes of seabed and shadow, in the amplitude's unit.

    Returns
    -------
    ndarray, shape (rows, cols)
        In [0, 1]. NaN where unknown, and where the printed fraction is 0/0: at i = 0, and from i = 39 σ_r on,
        where both densities underflow.
    """
    out = np.full(amplitude.shape, np.nan)
    for v in range(amplitude.shape[0]):
        for u in range(amplitude.shape[1]):
            i = float(amplitude[v, u])
            p_r = i / sigma_r**2 * math.exp(-(i**2) / (2 * sigma_r**2))
            p_s = i / sigma_s**2 * math.exp(-(i**2) / (2 * sigma_s**2))
            if p_r + p_s > 0:
                out[v, u] = (p_r / (p_r + p_s)) ** 2
    return out


def ground_pixel(ground_m: tuple[float, float], camera: ShadowCamera) -> tuple[float, float]:
    """Return the pixel (u, v) = (col, row), fractional, of a ground point (x, y) in metres."""
    u, v, _ = camera.ground_to_pixel @ np.array([ground_m[0], ground_m[1], 1.0])
    return float(u), float(v)


def shadow_point(
    point_m: tuple[float, float, float], sonar_m: tuple[float, float, float]
) -> tuple[float, float]:
    """Cast a point's shadow on the seabed: p' = s + (p - s) s_z / (s_z - z), where the ray is at z = 0.

    Parameters
    ----------
    point_m, sonar_m : (float, float, float)
        Point p and sonar s (x, y, z), metres; p is below s.

    Returns
    -------
    (float, float)
        Ground position (x, y), metres.
    """
    (x, y, z), (s_x, s_y, s_z) = point_m, sonar_m
    stretch = s_z / (s_z - z)
    return s_x + (x - s_x) * stretch, s_y + (y - s_y) * stretch


def bilinear(pixels: NDArray[np.floating[Any]], u: float, v: float) -> float:
    """Interpolate between the four pixels round (u, v); NaN off the view, or if any of them is unknown."""
    rows, cols = pixels.shape
    if not (0 <= u <= cols - 1 and 0 <= v <= rows - 1):
        return math.nan
    # On the last row or column the cell before it is used.
    left: int = min(int(u), cols - 2)
    top: int = min(int(v), rows - 2)
    a, b = u - left, v - top
    upper = (1 - a) * float(pixels[top, left]) + a * float(pixels[top, left + 1])
    lower = (1 - a) * float(pixels[top + 1, left]) + a * float(pixels[top + 1, left + 1])
    return (1 - b) * upper + b * lower


def values_at_shadows(images: Sequence[View], volume: Volume) -> NDArray[np.float64]:
    """Look up every view where every voxel's shadow falls (sections 4.1 and 4.2).

    Parameters
    ----------
    images : sequence of View
        What is carved with, shape (rows, cols); NaN where unknown.
    volume : Volume
        Voxels, whose centres are below every sonar.

    Returns
    -------
    ndarray, shape (nz, ny, nx, views)
        NaN where the view does not see the voxel's shadow.
    """
    values = np.full((*volume.shape, len(images)), np.nan)
    for k, z in enumerate(volume.z_m):
        for j, y in enumerate(volume.y_m):
            for i, x in enumerate(volume.x_m):
                for n, image in enumerate(images):
                    camera = image.info.camera
                    s_x, s_y, s_z = camera.sonar_m
                    u, v = ground_pixel(shadow_point((x, y, z), (s_x, s_y, s_z)), camera)
                    values[k, j, i, n] = bilinear(image.pixels, u, v)
    return values


def outside_silhouette(mask: View) -> View:
    """Map a silhouette to 1 outside, 0 inside, NaN where it is unknown or covered."""
    pixels = np.full(mask.pixels.shape, np.nan)
    pixels[mask.pixels == OUTSIDE] = 1.0
    pixels[mask.pixels == SHADOW] = 0.0
    return View(mask.info, pixels)


def hard_carving(masks: Sequence[View], volume: Volume) -> NDArray[np.bool_]:
    """Carve with silhouettes (section 4.1): remove every voxel outside one view's silhouette.

    Parameters
    ----------
    masks : sequence of View
        Silhouettes, uint8, shape (rows, cols).
    volume : Volume
        Voxels, whose centres are below every sonar.

    Returns
    -------
    ndarray of bool, shape (nz, ny, nx)
        The voxels that are left. One that no view sees is left too.
    """
    values = values_at_shadows([outside_silhouette(mask) for mask in masks], volume)
    left = np.ones(volume.shape, bool)
    for voxel in np.ndindex(volume.shape):
        for outside in values[voxel]:
            if outside > 0:
                left[voxel] = False
    return left


def soft_carving(likelihoods: Sequence[View], volume: Volume) -> NDArray[np.float64]:
    """Carve softly (section 4.2): the mean of l_out over the views that see the voxel's shadow.

    Parameters
    ----------
    likelihoods : sequence of View
        l_out, shape (rows, cols); NaN where unknown.
    volume : Volume
        Voxels, whose centres are below every sonar.

    Returns
    -------
    ndarray, shape (nz, ny, nx)
        Small inside the object; NaN where no view sees. The threshold is still to be applied.
    """
    values = values_at_shadows(likelihoods, volume)
    mean = np.full(volume.shape, np.nan)
    for voxel in np.ndindex(volume.shape):
        seen = [value for value in values[voxel] if not math.isnan(value)]
        if seen:
            mean[voxel] = sum(seen) / len(seen)
    return mean
