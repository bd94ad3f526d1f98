"""Pictures with their geometry: views and the full-circle image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..equality import equal_where_nan
from ..errors import (
    GeometryError,
    check_finite,
    check_number,
    check_numbers,
    check_range,
    check_stamp,
    check_type,
)
from ..frame_name import SCENE_FRAME, check_frame
from .camera import ShadowCamera
from .frames import TWO_PI, Acoustics, FloatArray, GroundGrid, down_range_axis
from .pixels import COHERENT, OF_A_VIEW, check_finite_pixels, check_pixels


@equal_where_nan
@dataclass(frozen=True)
class ViewInfo:
    """Everything about a view except its pixels: the content of its ``CameraInfo``.

    Parameters
    ----------
    stamp_ns : int
        When the sonar was at that aspect; identifies the view through the whole graph.
    camera : ShadowCamera
        Geometry.
    acoustics : Acoustics
        Band, sound speed, spectrum sign.
    aspect_rad : float
        θ₀, centre of the aperture.
    aperture_rad : float
        Full width of the aperture.
    carrier_rad_m : (float, float)
        Wavenumber (kx, ky), scene axes, that was divided out; (0, 0) where not demodulated.
    focus_range_m : float
        r₀ = e_r · target; NaN before enhancement.
    frame : str
        Name of the scene frame that it is in: one for all of a run.
    """

    stamp_ns: int
    camera: ShadowCamera
    acoustics: Acoustics
    aspect_rad: float
    aperture_rad: float
    carrier_rad_m: tuple[float, float] = (0.0, 0.0)
    focus_range_m: float = math.nan
    frame: str = field(default=SCENE_FRAME, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamp_ns", check_stamp("view", self.stamp_ns))
        check_type("camera of the view", self.camera, ShadowCamera, "a ShadowCamera")
        check_type("acoustics of the view", self.acoustics, Acoustics, "an Acoustics")
        check_finite("aspect of the view", self.aspect_rad, "rad")
        check_range("aperture of the view", self.aperture_rad, 0.0, TWO_PI * (1.0 + 1e-9), "rad")
        check_numbers("carrier of the view", self.carrier_rad_m, 2, "rad/m")
        check_number("focus range of the view", self.focus_range_m)
        check_frame("frame of the view", self.frame)

    @property
    def resolution_m(self) -> tuple[float, float]:
        """Size of a resolution cell on the ground, (down-range, cross-range).

        2π over the wedge's extent: K(f_c + B/2) - K(f_c - B/2) down-range, 2 K(f_c) sin(w/2) cross-range.
        """
        low, mid, high = self.acoustics.ground_band(self.camera.grazing_rad)
        cross = 2.0 * mid * math.sin(min(self.aperture_rad, math.pi) / 2.0)
        return TWO_PI / (high - low), TWO_PI / cross if cross > 0 else math.inf

    @property
    def cell_px(self) -> tuple[float, float]:
        """Pixels a resolution cell, (down-range, cross-range); the view's at most."""
        cell, pixel, shape = self.resolution_m, self.camera.spacing_m, self.camera.shape
        return min(cell[0] / pixel[0], shape[0]), min(cell[1] / pixel[1], shape[1])

    def down_range_of_rows(self) -> FloatArray:
        """Down-range e_r · p (m) of each row's centre, shape (rows,)."""
        e_r = down_range_axis(self.aspect_rad)
        to_ground = self.camera.pixel_to_ground
        start = to_ground[:2] @ np.array([(self.camera.cols - 1) / 2.0, 0.0, 1.0])
        rows = np.arange(self.camera.rows, dtype=np.float64)
        return float(e_r @ start) + rows * float(e_r @ to_ground[:2, 1])

    def moved_back(self, shift_m: float) -> ViewInfo:
        """Return the geometry that puts a view back that shows everything so far along e_c, m."""
        if not shift_m:
            return self
        to_pixel = self.camera.ground_to_pixel.copy()
        to_pixel[0, 2] += shift_m / self.camera.spacing_m[1]
        camera = ShadowCamera.from_ground(
            to_pixel, self.camera.sonar_m, self.camera.rows, self.camera.cols
        )
        return replace(self, camera=camera)


@dataclass(frozen=True, eq=False)
class View:
    """One picture of the scene in its view frame.

    Parameters
    ----------
    info : ViewInfo
        Geometry and band.
    pixels : ndarray, shape (rows, cols)
        complex64 (sub-aperture), float32 (shadow amplitude or likelihood) or uint8 (mask). NaN where
        the view knows nothing.
    """

    info: ViewInfo
    pixels: NDArray[Any]

    def __post_init__(self) -> None:
        check_type("info of the view", self.info, ViewInfo, "a ViewInfo")
        check_pixels("view", self.pixels, self.info.camera.shape, "camera", OF_A_VIEW)

    def __repr__(self) -> str:
        (rows, cols), (down_m, cross_m) = self.pixels.shape, self.info.camera.spacing_m
        return (
            f"View from {math.degrees(self.info.aspect_rad) % 360.0:.1f}°,"
            f" aperture {math.degrees(self.info.aperture_rad):.1f}°: {rows} × {cols} pixels"
            f" ({self.pixels.dtype}) of {down_m:.4g} × {cross_m:.4g} m, stamp {self.info.stamp_ns} ns"
        )


@dataclass(frozen=True, eq=False)
class CoherentImage:
    """A full-circle coherent complex image on the ground plane, north up.

    Parameters
    ----------
    pixels : ndarray of complex64 or complex128, shape (rows, cols)
        The image.
    grid : GroundGrid
        Its lattice.
    acoustics : Acoustics
        Its band.
    stamp_ns : int
        Stamp of the message that it came in.
    frame : str
        Name of the scene frame that it is in: one for all of a run.

    Raises
    ------
    CsasError
        If the pixels are not complex, not finite or not of the grid's shape, the stamp is no whole number,
        or something else is no what it should be; also a ValueError or a TypeError.
    """

    pixels: NDArray[Any]
    grid: GroundGrid
    acoustics: Acoustics
    stamp_ns: int = 0
    frame: str = field(default=SCENE_FRAME, kw_only=True)

    def __post_init__(self) -> None:
        check_type("grid of the image", self.grid, GroundGrid, "a GroundGrid")
        check_type("acoustics of the image", self.acoustics, Acoustics, "an Acoustics")
        object.__setattr__(self, "stamp_ns", check_stamp("image", self.stamp_ns))
        check_frame("frame of the image", self.frame)
        check_pixels("image", self.pixels, self.grid.shape, "grid", COHERENT)
        check_finite_pixels("image", self.pixels)

    def __repr__(self) -> str:
        (rows, cols), band = self.pixels.shape, self.acoustics
        left, right, bottom, top = self.grid.extent_m
        return (
            f"CoherentImage: {rows} × {cols} pixels ({self.pixels.dtype}) of {self.grid.spacing_m:.4g} m,"
            f" x {left:.2f} to {right:.2f} m, y {bottom:.2f} to {top:.2f} m\n"
            f"  {band.centre_frequency_hz / 1e3:g} kHz, bandwidth {band.bandwidth_hz / 1e3:g} kHz,"
            f" sound speed {band.sound_speed_mps:g} m/s, spectrum sign {band.spectrum_sign:+d}"
        )


def looks_at(info: ViewInfo, target_m: tuple[float, float]) -> bool:
    """Say whether a view may be focused on a target, r₀ = e_r · target; without a focus range it may."""
    r0 = float(down_range_axis(info.aspect_rad) @ np.asarray(target_m, dtype=np.float64))
    return not math.isfinite(info.focus_range_m) or abs(info.focus_range_m - r0) < 1e-6


def fit_target_to_focus(infos: Sequence[ViewInfo]) -> tuple[float, float]:
    """Find the ground point at the focus range of every view.

    r₀(θ) = e_r(θ) · target is one line a view; two aspects or more give the point (least squares).

    Raises
    ------
    GeometryError
        If fewer than two views are focused, or their aspects are all alike.
    """
    focused = [i for i in infos if math.isfinite(i.focus_range_m)]
    if len(focused) < 2:
        raise GeometryError(
            f"{len(focused)} views have a focus range; expected at least 2 to locate the target"
        )
    axes = np.array([down_range_axis(i.aspect_rad) for i in focused])
    ranges = np.array([i.focus_range_m for i in focused])
    if np.linalg.svd(axes, compute_uv=False)[-1] < 1e-3 * math.sqrt(len(focused)):
        raise GeometryError("the focused views all look the same way; expected different aspects")
    point, *_ = np.linalg.lstsq(axes, ranges, rcond=None)
    return float(point[0]), float(point[1])
