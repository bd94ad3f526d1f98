"""Small synthetic data for the tests of the core: tracks, band-limited images, cameras and exact shadows."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy.signal.windows import tukey

from csas_shadow_ros.core import reference
from csas_shadow_ros.core.geometry import (
    Acoustics,
    CoherentImage,
    GroundGrid,
    ShadowCamera,
    Track,
    View,
    ViewInfo,
    view_ground_to_pixel,
)
from csas_shadow_ros.core.imaging.subaperture import SubApertures
from csas_shadow_ros.core.parameters import SubApertureParameters
from csas_shadow_ros.core.shape.measurement import SilhouetteSides
from csas_shadow_ros.simulation import Profile

RADIUS_M, HEIGHT_M = 30.0, 12.0
#: Band 374 … 560 rad/m on the ground; a pixel of 5 mm holds 628 rad/m.
SPACING_M = 0.005

#: Cells of 6 cm across and more: a low body is two or three of them high.
COARSE_SONAR = Profile(
    name="coarse",
    rows=512,
    cols=512,
    spacing_m=0.016,
    radius_m=34.0,
    height_m=21.4,
    centre_frequency_hz=21.3e3,
    bandwidth_hz=7.5e3,
    block_deg=1.0,
    edge_m=0.064,
)


def acoustics(sign=1):
    return Acoustics(60e3, 24e3, 1500.0, sign)


def circle_track(n=720, *, clockwise=False, start_deg=0.0, keep=None, radius_m=RADIUS_M, height_m=HEIGHT_M):
    """Return a circular track of n poses, 1 s apart; `keep(degrees)` says which poses exist."""
    direction = -1.0 if clockwise else 1.0
    degrees = start_deg + direction * np.arange(n) * 360.0 / n
    stamps = np.arange(n) * 10**9
    if keep is not None:
        kept = np.array([keep(d % 360.0) for d in degrees])
        degrees, stamps = degrees[kept], stamps[kept]
    a = np.radians(degrees)
    return Track(stamps, np.c_[radius_m * np.cos(a), radius_m * np.sin(a), np.full(len(a), height_m)])


def wavenumber_lattice(grid):
    kx = 2 * np.pi * np.fft.fftfreq(grid.cols, grid.spacing_m)
    ky = -2 * np.pi * np.fft.fftfreq(grid.rows, grid.spacing_m)
    return np.meshgrid(kx, ky)


def nominal_grazing():
    return math.atan2(HEIGHT_M, RADIUS_M)


def image_of_spectrum(values, grid, sign=1):
    """Return I(x, y) = Σ S exp(j (Kx x + Ky y)), S on the grid's own lattice, phases at the origin."""
    kx, ky = wavenumber_lattice(grid)
    shifted = values * np.exp(1j * (kx * grid.x_min_m + ky * grid.y_max_m))
    pixels = np.fft.ifft2(shifted) * shifted.size
    return CoherentImage(pixels.astype(np.complex64), grid, acoustics(sign), 7)


@lru_cache(maxsize=4)
def band_limited_image(sign=1, rows=320, cols=384, centre=(0.1, -0.05), seed=0):
    """Return white complex noise over the annulus: a periodic seabed without a target."""
    rng = np.random.default_rng(seed)
    grid = GroundGrid.centred(rows, cols, SPACING_M, centre)
    low, _, high = acoustics(sign).ground_band(nominal_grazing())
    k = np.hypot(*wavenumber_lattice(grid))
    noise = rng.normal(size=k.shape) + 1j * rng.normal(size=k.shape)
    return image_of_spectrum(noise * ((k > low) & (k < high)) / 100.0, grid, sign)


def point_image(position_m, sign=1, rows=320, cols=384, centre=(0.1, -0.05)):
    """Return the image of one isotropic point scatterer."""
    grid = GroundGrid.centred(rows, cols, SPACING_M, centre)
    low, _, high = acoustics(sign).ground_band(nominal_grazing())
    kx, ky = wavenumber_lattice(grid)
    k = np.hypot(kx, ky)
    phase = np.exp(-1j * (kx * position_m[0] + ky * position_m[1]))
    return image_of_spectrum(phase * ((k > low) & (k < high)) / 1e3, grid, sign)


def factor_of(aperture_deg):
    """How many times coarser than the image the views are that are compared with the literal ones."""
    return 4 if aperture_deg <= 12.0 else 3


@lru_cache(maxsize=4)
def faded_image(sign=1):
    """Return the band-limited noise, faded out towards the image's borders: no edge that would diffract."""
    image = band_limited_image(sign)
    grid = image.grid
    low, _, high = acoustics(sign).ground_band(nominal_grazing())
    k = np.hypot(*wavenumber_lattice(grid))
    # Narrower than the band by what the fading spreads.
    core = np.fft.ifft2(np.fft.fft2(image.pixels) * ((k > low + 25) & (k < high - 25)))
    window = np.outer(tukey(grid.rows, 0.5), tukey(grid.cols, 0.5))
    return CoherentImage((core * window).astype(np.complex64), grid, acoustics(sign), 7)


@lru_cache(maxsize=8)
def sub_apertures(sign=1, aperture_deg=12.0, faded=False):
    parameters = SubApertureParameters(
        aperture_deg=aperture_deg, spacing_m=factor_of(aperture_deg) * SPACING_M
    )
    image = faded_image(sign) if faded else band_limited_image(sign)
    return SubApertures(image, circle_track(), parameters)


def fine_camera(camera, factor):
    """Return the same camera with `factor` times finer pixels."""
    a = camera.ground_to_pixel.copy()
    a[:2] *= factor
    return ShadowCamera.from_ground(a, camera.sonar_m, *(factor * n for n in camera.shape))


@lru_cache(maxsize=32)
def view_and_reference(sign, aspect_deg, aperture_deg=12.0, faded=False):
    """Return a fast view and the literal full-size one (view frame, on its carrier, finely sampled)."""
    image, aspect = faded_image(sign) if faded else band_limited_image(sign), math.radians(aspect_deg)
    view = sub_apertures(sign, aperture_deg, faded).view_of_aspect(aspect)
    camera = fine_camera(view.info.camera, factor_of(aperture_deg))
    full = reference.sub_aperture(image, aspect, math.radians(aperture_deg))
    return view, reference.rotate_to_view(full, image, camera, aspect), camera


def ground_of_pixels(camera):
    """Return ground (x, y) of every pixel, each of the camera's shape."""
    u, v = np.meshgrid(np.arange(camera.cols), np.arange(camera.rows))
    g = np.tensordot(camera.pixel_to_ground[:2], np.stack([u, v, np.ones_like(u)]), axes=1)
    return g[0], g[1]


def on_carrier(view):
    x, y = ground_of_pixels(view.info.camera)
    kx, ky = view.info.carrier_rad_m
    return view.pixels * np.exp(1j * (kx * x + ky * y))


def make_info(
    aspect_rad,
    *,
    size=128,
    spacing_m=0.02,
    centre=(0.0, 0.0),
    stamp_ns=None,
    sonar_m=None,
    sign=1,
    aperture_deg=12.0,
):
    """Return the geometry of a square view on the nominal circle."""
    if sonar_m is None:
        sonar_m = (RADIUS_M * math.cos(aspect_rad), RADIUS_M * math.sin(aspect_rad), HEIGHT_M)
    a = view_ground_to_pixel(aspect_rad, spacing_m, size, size, centre)
    camera = ShadowCamera.from_ground(a, sonar_m, size, size)
    stamp = round(math.degrees(aspect_rad) % 360.0 * 1e9) if stamp_ns is None else stamp_ns
    return ViewInfo(stamp, camera, acoustics(sign), aspect_rad, math.radians(aperture_deg))


def make_view(pixels, aspect_rad=0.3, **kwargs):
    return View(make_info(aspect_rad, size=pixels.shape[0], **kwargs), pixels)


def hidden_by_box(x, y, sonar_m, low, high):
    """Say where the ground lies in the shadow of a box [low, high] (x, y, z) that stands on the seabed."""
    start, lower, upper = _segment_starts(x, y, sonar_m, high[2]), np.zeros(x.shape), np.ones(x.shape)
    for a, b, lo, hi in ((start[0], x, low[0], high[0]), (start[1], y, low[1], high[1])):
        step = np.where(np.abs(b - a) < 1e-12, 1e-12, b - a)
        t0, t1 = (lo - a) / step, (hi - a) / step
        lower, upper = np.maximum(lower, np.minimum(t0, t1)), np.minimum(upper, np.maximum(t0, t1))
    return lower <= upper


def hidden_by_cylinder(x, y, sonar_m, centre, radius_m, height_m):
    """Say where the ground lies in the shadow of an upright cylinder."""
    ax, ay = _segment_starts(x, y, sonar_m, height_m)
    dx, dy = x - ax, y - ay
    t = ((centre[0] - ax) * dx + (centre[1] - ay) * dy) / np.maximum(dx * dx + dy * dy, 1e-18)
    t = np.clip(t, 0.0, 1.0)
    return np.hypot(ax + t * dx - centre[0], ay + t * dy - centre[1]) <= radius_m


def _segment_starts(x, y, sonar_m, top_m):
    """Where the ray from the sonar to the ground point passes the height `top_m`, in plan."""
    t = 1.0 - top_m / sonar_m[2]
    return sonar_m[0] + t * (x - sonar_m[0]), sonar_m[1] + t * (y - sonar_m[1])


@lru_cache(maxsize=8)
def hull_of(hidden, infos, volume):
    """Return the voxels whose shadow points are hidden in every view: exact, without any image."""
    z, y, x = np.meshgrid(volume.z_m, volume.y_m, volume.x_m, indexing="ij")
    alive = np.ones(volume.shape, bool)
    for info in infos:
        s = info.camera.sonar_m
        stretch = s[2] / (s[2] - z)
        alive &= hidden(s[0] + (x - s[0]) * stretch, s[1] + (y - s[1]) * stretch, s)
    return alive


@lru_cache(maxsize=8)
def perfect_views(hidden, infos, kind):
    """Return shadow views without noise: 'mask' (uint8 255/0) or 'likelihood' (float32 0/1)."""
    views = []
    for info in infos:
        dark = hidden(*ground_of_pixels(info.camera), info.camera.sonar_m)
        pixels = np.where(dark, 255, 0).astype(np.uint8) if kind == "mask" else (~dark).astype(np.float32)
        views.append(View(info, pixels))
    return tuple(views)


def normalised_rms(a, b, where):
    return float(np.sqrt(np.mean(np.abs(a - b)[where] ** 2) / np.mean(np.abs(b[where]) ** 2)))


def iou(a, b):
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


def drawn_sides_of(infos, support, aperture_deg=12.0, keep=lambda degrees: True):
    """Sides whose support is the mean of a known support function over the aperture."""
    looks = np.radians(np.linspace(-aperture_deg / 2, aperture_deg / 2, 241))
    out = []
    for info in infos:
        degrees = math.degrees(info.aspect_rad)
        if not keep(degrees):
            continue
        phi = [info.aspect_rad - math.pi / 2, info.aspect_rad + math.pi / 2]
        values = tuple(float(np.mean(support(p + looks))) for p in phi)
        out.append(SilhouetteSides(info, tuple(phi), values, 1.0))
    return out


def box_support(length, width, heading=0.0):
    def support(phi):
        a = np.asarray(phi) - heading
        return length / 2 * np.abs(np.cos(a)) + width / 2 * np.abs(np.sin(a))

    return support
