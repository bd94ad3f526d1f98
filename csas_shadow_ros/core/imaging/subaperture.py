"""Sub-aperture generation: wedges of the one 2-D spectrum (section 3.1 of the paper).

The paper masks the spectrum of the full image to the wavenumbers within an aperture round θ₀ and
transforms back at full size, once a view. Only a small box of the spectrum is not zero then, so here
that box alone is transformed. The result is the view at baseband, sampled as finely as the wedge's
bandwidth needs, and it is resampled straight into the view frame.

The resampling is that of a non-uniform FFT: the box is divided by the Fourier transform of a short
Kaiser-Bessel kernel before the transform, and the kernel interpolates afterwards. With an
oversampled transform this is band-limited interpolation to about 1e-3, at 16 taps a pixel.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from functools import lru_cache

import ducc0
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..errors import ParameterError, TrackError, ViewError, check_type
from ..geometry import (
    CoherentImage,
    GroundGrid,
    ShadowCamera,
    Track,
    View,
    ViewInfo,
    aspects_of_step,
    one_frame,
    view_ground_to_pixel,
)
from ..geometry.pixels import check_finite_pixels
from ..kernels import kernel
from ..parameters import SubApertureParameters
from .interpolation import interpolate_four, interpolate_one

#: Taps of the interpolation kernel along each axis.
_TAPS = 4
#: Oversampling of the small transform that the kernel is designed for.
_OVERSAMPLING = 1.5
#: Entries of the kernel table per sample.
_TABLE = 2048
#: Samples of its period by which the small image is extended, so that the kernel never wraps.
_BORDER = _TAPS
#: Widening of the band on either side, as a fraction of the bandwidth: a processor's window and a
#: wobbling track put a little energy outside the nominal annulus.
_BAND_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The 2-D spectrum S of a coherent image: I(x, y) = Σ S exp(j (Kx x + Ky y)).

    Parameters
    ----------
    values : ndarray of complex64, shape (n_rows, n_cols)
        FFT order; row index counts -Ky, column index Kx, referred to the image's pixel (0, 0).
    grid : GroundGrid
        The image's lattice.
    """

    values: NDArray[np.complex64]
    grid: GroundGrid

    @classmethod
    def of_image(cls, image: CoherentImage, workers: int = 2) -> Spectrum:
        """Transform an image, zero-padded to a fast size.

        Parameters
        ----------
        image : CoherentImage
            The image.
        workers : int
            Threads.

        Raises
        ------
        ParameterError
            If a pixel is not finite.
        """
        shape = tuple(scipy.fft.next_fast_len(n) for n in image.grid.shape)
        pixels = np.asarray(image.pixels, dtype=np.complex64)
        values = scipy.fft.fft2(pixels, s=shape, norm="forward", workers=workers)
        # One pixel that is not finite spoils every bin: the zeroth one tells.
        if not np.isfinite(values[0, 0]):
            check_finite_pixels("image", pixels)
            raise ParameterError(f"the image's pixels sum to {values[0, 0]}; expected smaller numbers")
        return cls(values, image.grid)

    @property
    def step_rad_m(self) -> tuple[float, float]:
        """Wavenumber step along (rows, cols), rad/m."""
        rows, cols = self.values.shape
        return 2 * math.pi / (rows * self.grid.spacing_m), 2 * math.pi / (cols * self.grid.spacing_m)


def band_of_image(image: CoherentImage, grazing_rad: float) -> tuple[float, float]:
    """Return the annulus (K_low, K_high) in rad/m that holds the image's energy, margin included.

    Raises
    ------
    ParameterError
        If the band's upper edge does not fit the pixel spacing: the spectrum would be folded.
    """
    low, _, high = image.acoustics.ground_band(grazing_rad)
    if too_coarse := image.acoustics.folds(image.grid.spacing_m, grazing_rad):
        raise ParameterError(too_coarse)
    margin = _BAND_MARGIN * (high - low)
    return max(low - margin, 1e-6), min(high + margin, math.pi / image.grid.spacing_m)


def taper_table(name: str, entries: int = 1025) -> NDArray[np.float32]:
    """Sample a window over the aperture, from one edge to the other.

    Parameters
    ----------
    name : {'none', 'tukey', 'taylor'}
        No taper (the paper's), a Tukey window with half of it tapered, or a Taylor window (n̄ = 4,
        sidelobes at -30 dB).
    entries : int
        Samples.
    """
    if name == "none":
        return np.ones(entries, np.float32)
    # Late: it takes a second and a half to import, which every process of the node graph would pay.
    from scipy.signal import windows

    if name == "tukey":
        return np.asarray(windows.tukey(entries, 0.5), np.float32)
    if name == "taylor":
        return np.asarray(windows.taylor(entries, nbar=4, sll=30), np.float32)
    raise ParameterError(f"taper is {name!r}; expected one of: none, tukey, taylor")


def _kaiser_beta() -> float:
    # Beatty, Nishimura, Pauly 2005, eq. 5: the kernel that least aliases at this oversampling.
    ratio = _TAPS / _OVERSAMPLING * (_OVERSAMPLING - 0.5)
    return math.pi * math.sqrt(ratio * ratio - 0.8)


@lru_cache(maxsize=1)
def _kernel_table() -> NDArray[np.float32]:
    """Kernel weights (entries, taps): row i for a sample i/_TABLE beyond a lattice point."""
    offset = np.arange(_TABLE + 1)[:, None] / _TABLE
    distance = np.arange(_TAPS)[None, :] - (_TAPS // 2 - 1) - offset
    inside = np.clip(1.0 - (2.0 * distance / _TAPS) ** 2, 0.0, None)
    return np.asarray(np.i0(_kaiser_beta() * np.sqrt(inside)), dtype=np.float32)


@lru_cache(maxsize=64)
def _kernel_inverse(half: int, size: int) -> NDArray[np.float32]:
    """Reciprocal of the kernel's Fourier transform at bins -half … +half of a transform of `size`."""
    u = (math.pi * _TAPS * np.arange(-half, half + 1) / size) ** 2
    root = np.sqrt(_kaiser_beta() ** 2 - u + 0j)
    transform = (_TAPS * np.sinh(root) / root).real
    return np.asarray(1.0 / transform, dtype=np.float32)


@kernel()
def _half_size(
    edge_low: float,
    width: float,
    band: tuple[float, float],
    centre: tuple[int, int],
    steps: tuple[float, float],
) -> tuple[int, int]:  # pragma: no cover
    """Return how many bins (rows, cols) a wedge reaches from its centre, by points along its two arcs."""
    rows = cols = 0.0
    for i in range(65):
        angle = edge_low + i * (width / 64)
        for k in band:
            rows = max(rows, abs(-k * math.sin(angle) / steps[0] - centre[0]))
            cols = max(cols, abs(k * math.cos(angle) / steps[1] - centre[1]))
    return math.ceil(rows) + 1, math.ceil(cols) + 1


@kernel(error_model="numpy")
def _cut_wedge(  # noqa: C901, PLR0912  (a kernel)
    spectrum: NDArray[np.complex64],
    centre: tuple[int, int],
    half: tuple[int, int],
    steps: tuple[float, float],
    edge_low: float,
    edge_high: float,
    band: tuple[float, float],
    taper: NDArray[np.float32],
    width: float,
    weights_v: NDArray[np.float32],
    weights_u: NDArray[np.float32],
    factor: np.complex64,
    out_shape: tuple[int, int],
    extended: NDArray[np.complex64],
) -> tuple[int, int]:  # pragma: no cover
    """Copy a wedge of the spectrum, weighted, so that the carrier lands on bin 0.

    It goes to the first `out_shape` bins inside `extended`'s border, which are zero elsewhere. Returns how
    many rows from row 0 on, and how many at the end, hold it (1 at least).
    """
    rows, cols = spectrum.shape
    out_rows, out_cols = out_shape
    # The wedge is half-open, [θ - w/2, θ + w/2), so that neighbours share no bin and leave none out.
    cos_l, sin_l, cos_h, sin_h = (
        math.cos(edge_low),
        math.sin(edge_low),
        math.cos(edge_high),
        math.sin(edge_high),
    )
    low2, high2 = band[0] * band[0], band[1] * band[1]
    ahead = behind = 1
    for ov in range(out_rows):
        line = extended[_BORDER + ov, _BORDER : _BORDER + out_cols]
        line[:] = 0
        dv = ov if ov <= half[0] else ov - out_rows
        ky = -(centre[0] + dv) * steps[0]
        if dv < -half[0] or ky * ky > high2:
            continue
        # A row's bins within both edges and the outer circle lie side by side: from `first` to `last`.
        right = math.sqrt(high2 - ky * ky)
        left = -right
        for a, b in ((-sin_l, cos_l * ky), (sin_h, -cos_h * ky), (cos_l, sin_l * ky)):
            if a > 0.0:
                left = max(left, -b / a)
            elif a < 0.0:
                right = min(right, -b / a)
        first = max(int(left / steps[1]) - 2 - centre[1], -half[1])
        last = min(int(right / steps[1]) + 3 - centre[1], half[1] + 1)
        # Rounding decides at the ends only: there the inequalities themselves are asked.
        for end in range(2):
            while first < last:
                kx = (centre[1] + (last - 1 if end else first)) * steps[1]
                if (
                    cos_l * ky - sin_l * kx >= 0.0
                    and cos_h * ky - sin_h * kx < 0.0
                    and cos_l * kx + sin_l * ky >= 0.0
                    and kx * kx + ky * ky <= high2
                ):
                    break
                first, last = (first, last - 1) if end else (first + 1, last)
        if first < last:
            ahead, behind = max(ahead, dv + 1), max(behind, -dv)
        # Both arrays may wrap within the row. Slices: without negative indices these are vector instructions.
        source = spectrum[(centre[0] + dv) % rows]
        by = factor * weights_v[dv + half[0]]
        near, far = min(0, -centre[1]), max(0, -centre[1])
        near, far = min(max(near, first), last), min(max(far, first), last)
        for begin, end in ((first, near), (near, far), (far, last)):
            n, at, to = end - begin, (centre[1] + begin) % cols, begin % out_cols
            bins, places, w = source[at : at + n], line[to : to + n], weights_u[half[1] + begin :]
            for i in range(n):
                value = bins[i] * by
                places[i] = complex(value.real * w[i], value.imag * w[i])
            if taper.shape[0] > 1:
                for i in range(n):
                    kx = (centre[1] + begin + i) * steps[1]
                    k2 = kx * kx + ky * ky
                    if k2 >= low2:
                        sine = (cos_l * ky - sin_l * kx) / math.sqrt(k2)
                        position = math.asin(min(1.0, sine)) / width * (taper.shape[0] - 1)
                        j = min(int(position), taper.shape[0] - 2)
                        f = position - j
                        places[i] *= np.float32((1.0 - f) * taper[j] + f * taper[j + 1])
        # Inside the inner circle nothing is kept.
        if ky * ky < low2:
            reach = int(math.sqrt(low2 - ky * ky) / steps[1]) + 1
            while reach >= 0 and (reach * steps[1]) ** 2 + ky * ky >= low2:
                reach -= 1
            for du in range(max(first, -reach - centre[1]), min(last, reach + 1 - centre[1])):
                line[du % out_cols] = 0
    return ahead, behind


@kernel()
def _span(slope: float, start: float, low: float, high: float, n: int) -> tuple[int, int]:  # pragma: no cover
    """Return from where to where, of 0 … n - 1, low <= slope i + start <= high."""
    first, last = 0, n
    if slope != 0.0:
        a, b = (low - start) / slope, (high - start) / slope
        first = int(min(max(math.floor(min(a, b)) - 1.0, 0.0), float(n)))
        last = int(min(max(math.ceil(max(a, b)) + 2.0, 0.0), float(n)))
    # Rounding decides at the ends only: there the inequality itself is asked.
    while first < last and not low <= slope * first + start <= high:
        first += 1
    while last > first and not low <= slope * (last - 1) + start <= high:
        last -= 1
    return first, last


@kernel(error_model="numpy")
def _resample(
    box: NDArray[np.float32],
    table: NDArray[np.float32],
    affine: NDArray[np.float64],
    limits: tuple[float, float, float, float],
    out: NDArray[np.float32],
) -> None:  # pragma: no cover
    """Interpolate an image at an affine lattice; NaN outside `limits`.

    `box` is extended by `_BORDER` samples of its period on every side; it and `out` hold real and imaginary
    parts in turns. `affine` maps (u, v) to samples.
    """
    n_v, n_u = out.shape[0], out.shape[1] // 2
    samples, weights, pixels = box.ravel(), table.ravel(), out.ravel()
    # Of 32 bits, as vector instructions convert to: enough for boxes of 2^30 samples.
    stride, two, four, entries = np.int32(box.shape[1]), np.int32(2), np.int32(4), np.int32(_TABLE)
    starts, across, down = np.empty(n_u, np.int32), np.empty(n_u, np.int32), np.empty(n_u, np.int32)
    for v in range(n_v):
        x0 = affine[0, 1] * v + affine[0, 2]
        y0 = affine[1, 1] * v + affine[1, 2]
        a, b = _span(affine[0, 0], x0, limits[0], limits[1], n_u)
        c, d = _span(affine[1, 0], y0, limits[2], limits[3], n_u)
        first, last = max(a, c), max(min(b, d), max(a, c))
        line = 2 * v * n_u
        pixels[line : line + 2 * first] = np.float32(np.nan)
        pixels[line + 2 * last : line + 2 * n_u] = np.float32(np.nan)
        # All positions first: without the interpolation they become vector instructions.
        for i in range(last - first):
            x = affine[0, 0] * (first + i) + x0
            y = affine[1, 0] * (first + i) + y0
            ix, iy = np.int32(x), np.int32(y)  # not negative: the border is in front
            starts[i] = (iy - np.int32(1)) * stride + two * (ix - np.int32(1))
            across[i] = four * (np.int32(x * _TABLE + 0.5) - entries * ix)
            down[i] = four * (np.int32(y * _TABLE + 0.5) - entries * iy)
        place, fours = line + 2 * first, (last - first) // 4 * 4
        for i in range(0, fours, 4):
            interpolate_four(samples, stride, weights, starts, across, down, i, pixels, place + 2 * i)
        for i in range(fours, last - first):
            interpolate_one(samples, stride, weights, starts, across, down, i, pixels, place + 2 * i)


def _extend(extended: NDArray[np.complex64], cols: int) -> None:
    """Fill the border round an image of so many columns with `_BORDER` samples of its period."""
    n = _BORDER
    rows = extended[n:-n]
    rows[:, :n], rows[:, n + cols : 2 * n + cols] = rows[:, cols : n + cols], rows[:, n : 2 * n]
    extended[:n], extended[-n:] = rows[-n:], rows[:n]


class SubApertures:
    """The views of a circular run, made one by one from its coherent image.

    Parameters
    ----------
    image : CoherentImage
        Full-circle coherent image.
    track : Track
        Where the sonar was.
    parameters : SubApertureParameters
        Aperture, step, taper, sampling.
    workers : int
        Threads of the one full-size transform.

    Raises
    ------
    ParameterError
        If the image's band does not fit its pixels.

    Notes
    -----
    The view of aspect θ₀ keeps the wavenumbers whose angle is within [θ₀ - w/2, θ₀ + w/2)
    (section 3.1; w is the full width, 12° in the paper), on the side of the spectrum that
    `spectrum_sign` says.
    """

    def __init__(
        self,
        image: CoherentImage,
        track: Track,
        parameters: SubApertureParameters | None = None,
        *,
        workers: int = 2,
        spectrum: Spectrum | None = None,
    ) -> None:
        check_type("image", image, CoherentImage, "a CoherentImage")
        check_type("track", track, Track, "a Track")
        p = SubApertureParameters() if parameters is None else parameters
        check_type("parameters", p, SubApertureParameters, "a SubApertureParameters")
        one_frame("the track", track.frame, image.frame, "the image")
        self.parameters = p
        self.track = track
        self.frame = image.frame
        self.grid = image.grid
        self.acoustics = image.acoustics
        self.aperture_rad = math.radians(p.aperture_deg)
        self.aspects_rad = aspects_of_step(math.radians(p.step_deg))
        self.band = band_of_image(image, track.grazing_rad)
        self.spectrum = spectrum or Spectrum.of_image(image, workers)
        self._taper = np.ones(1, np.float32) if p.taper == "none" else taper_table(p.taper)
        low, high = self.band
        half = self.aperture_rad / 2.0
        down_range = (low * math.cos(half), high)
        bandwidth = max(down_range[1] - down_range[0], 2.0 * high * math.sin(half))
        if p.spacing_m > 2.0 * math.pi / bandwidth:
            raise ParameterError(
                f"spacing_m is {p.spacing_m:g} m; expected at most {2.0 * math.pi / bandwidth:.3g} m, which"
                f" the bandwidth of a {p.aperture_deg:g}° aperture needs, or 0 for automatic"
            )
        #: Pixel of the views (m).
        self.spacing_m = p.spacing_m or 2.0 * math.pi / (p.oversampling * bandwidth)
        self._carrier = sum(down_range) / 2.0
        side = p.extent_m or self.grid.spacing_m * math.hypot(*self.grid.shape)
        #: Side of the square views (pixels).
        self.size = max(2, math.ceil(side / self.spacing_m))

    def __repr__(self) -> str:
        return (
            f"SubApertures: {len(self.aspects_rad)} views, aperture {math.degrees(self.aperture_rad):g}°,"
            f" each {self.size} × {self.size} pixels of {self.spacing_m:.4g} m"
        )

    def __len__(self) -> int:
        return len(self.aspects_rad)

    def info(self, aspect_rad: float) -> ViewInfo:
        """Return the geometry and band of the view of an aspect before it is made.

        Raises
        ------
        ViewError
            If the track does not cover the aspect, or too little of its aperture.
        """
        p = self.parameters
        covered = self.track.covered_fraction(aspect_rad, self.aperture_rad)
        degrees = math.degrees(aspect_rad) % 360.0
        if covered < p.min_coverage:
            raise ViewError(
                f"track gap: the track covers {covered:.0%} of the {p.aperture_deg:g}° aperture at aspect"
                f" {degrees:.1f}°; expected at least {p.min_coverage:.0%}"
            )
        try:
            stamp, sonar = self.track.at_aspect(aspect_rad)
        except TrackError as error:
            raise ViewError(f"track gap: {error}") from error
        to_pixel = view_ground_to_pixel(aspect_rad, self.spacing_m, self.size, self.size, self.grid.centre_m)
        camera = ShadowCamera.from_ground(to_pixel, sonar, self.size, self.size)
        centre, steps = self._carrier_bin(aspect_rad), self.spectrum.step_rad_m
        carrier = (centre[1] * steps[1], -centre[0] * steps[0])
        return ViewInfo(
            stamp, camera, self.acoustics, aspect_rad, self.aperture_rad, carrier, frame=self.frame
        )

    def _carrier_bin(self, aspect_rad: float) -> tuple[int, int]:
        """(row, col) bin of the spectrum, signed, nearest to the wedge's middle."""
        k, steps = self.acoustics.spectrum_sign * self._carrier, self.spectrum.step_rad_m
        return round(-k * math.sin(aspect_rad) / steps[0]), round(k * math.cos(aspect_rad) / steps[1])

    def wedge_edges(self, aspect_rad: float) -> tuple[float, float]:
        """Return the angles in the spectrum that bound the view's energy.

        They are rounded to 1e-9 rad so that neighbours of a partition name the same edge alike.
        """
        turn = 0.0 if self.acoustics.spectrum_sign > 0 else math.pi
        half = self.aperture_rad / 2.0
        low, high = (round(math.remainder(aspect_rad + s + turn, 2 * math.pi), 9) for s in (-half, half))
        return low, high

    def baseband(self, aspect_rad: float) -> tuple[NDArray[np.complex64], tuple[int, int]]:
        """Transform the wedge's box to a small periodic image of the whole scene.

        Returns
        -------
        box : ndarray of complex64, shape (m, n)
            Image at baseband, before the interpolation kernel has been applied.
        centre : (int, int)
            The carrier's bin (row, col).
        """
        extended, (rows, cols), centre = self._extended_baseband(aspect_rad)
        return extended[_BORDER : _BORDER + rows, _BORDER : _BORDER + cols], centre

    def _extended_baseband(
        self, aspect_rad: float
    ) -> tuple[NDArray[np.complex64], tuple[int, int], tuple[int, int]]:
        """Return the baseband image inside a border of its period, its shape, and the carrier's bin."""
        centre = self._carrier_bin(aspect_rad)
        steps = self.spectrum.step_rad_m
        low, high = self.wedge_edges(aspect_rad)
        half = _half_size(low, self.aperture_rad, self.band, centre, steps)
        rows, cols = (scipy.fft.next_fast_len(math.ceil(_OVERSAMPLING * (2 * h + 1))) for h in half)
        k = (centre[1] * steps[1], -centre[0] * steps[0])
        # The spectrum is referred to the image's corner; the contract's carrier to the scene's origin.
        corner = k[0] * self.grid.x_min_m + k[1] * self.grid.y_max_m
        stride = cols + 2 * _BORDER
        # Rows a power of two apart would share a few lines of the cache.
        extended = np.empty((rows + 2 * _BORDER, stride + 8 * (stride % 128 == 0)), np.complex64)
        ahead, behind = _cut_wedge(
            self.spectrum.values,
            centre,
            half,
            steps,
            low,
            high,
            self.band,
            self._taper,
            self.aperture_rad,
            _kernel_inverse(half[0], rows),
            _kernel_inverse(half[1], cols),
            np.complex64(cmath.exp(-1j * corner)),
            (rows, cols),
            extended,
        )
        box = extended[_BORDER:-_BORDER, _BORDER : _BORDER + cols]
        # Rows first: only the wedge's are not zero.
        for part in (box[:ahead], box[rows - behind :]):
            ducc0.fft.c2c(part, axes=(1,), forward=False, out=part, nthreads=1)
        ducc0.fft.c2c(box, axes=(0,), forward=False, out=box, nthreads=1)
        _extend(extended, cols)
        return extended, (rows, cols), centre

    def view_of_aspect(self, aspect_rad: float) -> View:
        """Make the view of any aspect.

        Parameters
        ----------
        aspect_rad : float
            θ₀.

        Returns
        -------
        View
            complex64 baseband pixels; NaN off the image.

        Raises
        ------
        ViewError
            If the track has a gap there.
        """
        info = self.info(aspect_rad)
        extended, shape, _ = self._extended_baseband(aspect_rad)
        # View pixel → ground → image pixel → sample of the small image.
        rows, cols = self.spectrum.values.shape
        scale_x, scale_y = shape[1] / cols, shape[0] / rows
        affine = (self.grid.ground_to_pixel @ info.camera.pixel_to_ground)[:2]
        affine *= ((scale_x,), (scale_y,))
        affine[:, 2] += _BORDER
        # The image reaches half a pixel beyond the centres of its outer pixels.
        limits = (
            _BORDER - 0.5 * scale_x,
            _BORDER + (self.grid.cols - 0.5) * scale_x,
            _BORDER - 0.5 * scale_y,
            _BORDER + (self.grid.rows - 0.5) * scale_y,
        )
        pixels = np.empty(info.camera.shape, np.complex64)
        _resample(extended.view(np.float32), _kernel_table(), affine, limits, pixels.view(np.float32))
        return View(info, pixels)

    def view(self, index: int) -> View:
        """Make the view of ``aspects_rad[index]``; see `view_of_aspect`."""
        return self.view_of_aspect(float(self.aspects_rad[index]))
