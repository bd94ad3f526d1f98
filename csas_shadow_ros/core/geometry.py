"""Geometry: ground grids, the track, the shadow camera and the view frame.

Frames (SI, radians). The scene frame is x east, y north, z up, z = 0 on the seabed. The aspect θ is
the azimuth of the sonar seen from the scene's origin, counter-clockwise from +x, and û(θ) = (cos θ,
sin θ) points to the sonar. A view of aspect θ has cross-range e_c = (sin θ, -cos θ) along its
columns and down-range e_r = -û(θ) along its rows: the sonar is above the picture and shadows fall
downwards. See ``docs/conventions.md``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import GeometryError, ParameterError, TrackError, check_range

FloatArray = NDArray[np.float64]

TWO_PI = 2.0 * math.pi


def wrap_angle(angle_rad: Any) -> Any:
    """Wrap angles to (-π, π].

    Parameters
    ----------
    angle_rad : float or ndarray
        Angles in radians.
    """
    return math.pi - np.mod(math.pi - np.asarray(angle_rad, dtype=np.float64), TWO_PI)


def unit_to_sonar(aspect_rad: float) -> FloatArray:
    """Return û(θ) = (cos θ, sin θ), the ground direction from the scene to the sonar."""
    return np.array([math.cos(aspect_rad), math.sin(aspect_rad)])


def cross_range_axis(aspect_rad: float) -> FloatArray:
    """Return e_c = (sin θ, -cos θ), along which a view's columns grow."""
    return np.array([math.sin(aspect_rad), -math.cos(aspect_rad)])


def down_range_axis(aspect_rad: float) -> FloatArray:
    """Return e_r = -û(θ), along which a view's rows grow, away from the sonar."""
    return -unit_to_sonar(aspect_rad)


@dataclass(frozen=True)
class Acoustics:
    """Band and phase convention of a complex image.

    Parameters
    ----------
    centre_frequency_hz : float
        Centre frequency f_c.
    bandwidth_hz : float
        Bandwidth B; the band is f_c ± B/2.
    sound_speed_mps : float
        Sound speed c.
    spectrum_sign : int
        σ: energy seen from aspect θ lies at wavenumber σ K û(θ). +1 or -1.

    Raises
    ------
    ParameterError
        If a value is out of range.
    """

    centre_frequency_hz: float
    bandwidth_hz: float
    sound_speed_mps: float
    spectrum_sign: int

    def __post_init__(self) -> None:
        f_c = check_range("centre frequency", self.centre_frequency_hz, 0, 1e12, "Hz", open_low=True)
        check_range("bandwidth", self.bandwidth_hz, 0, 2 * f_c, "Hz", open_low=True)
        # The upper bound is the speed of light: the same formulas serve radar test data.
        check_range("sound speed", self.sound_speed_mps, 0, 3e8, "m/s", open_low=True)
        if self.spectrum_sign not in (1, -1):
            raise ParameterError(f"spectrum_sign is {self.spectrum_sign}; expected +1 or -1")
        object.__setattr__(self, "spectrum_sign", int(self.spectrum_sign))

    def ground_wavenumber(self, frequency_hz: float, grazing_rad: float) -> float:
        """Return K = 4π f cos ψ / c, the two-way wavenumber on the ground plane (rad/m)."""
        return 4.0 * math.pi * frequency_hz * math.cos(grazing_rad) / self.sound_speed_mps

    def ground_band(self, grazing_rad: float) -> tuple[float, float, float]:
        """Return (K(f_c - B/2), K(f_c), K(f_c + B/2)) in rad/m for grazing angle ψ."""
        half = self.bandwidth_hz / 2.0
        f_c = self.centre_frequency_hz
        low, mid, high = (self.ground_wavenumber(f, grazing_rad) for f in (f_c - half, f_c, f_c + half))
        return low, mid, high


@dataclass(frozen=True)
class GroundGrid:
    """A north-up pixel lattice on the seabed: u = (x - x_min)/d, v = (y_max - y)/d.

    Parameters
    ----------
    rows, cols : int
        Shape of the image, (row, col).
    spacing_m : float
        Pixel spacing d; pixels are square.
    x_min_m, y_max_m : float
        Scene coordinates of the centre of pixel (row 0, col 0).
    """

    rows: int
    cols: int
    spacing_m: float
    x_min_m: float
    y_max_m: float

    def __post_init__(self) -> None:
        for name, n in (("rows", self.rows), ("cols", self.cols)):
            check_range(f"number of {name}", n, 2, 1 << 16, "pixels")
        check_range("pixel spacing", self.spacing_m, 0, 1e6, "m", open_low=True)
        if not (math.isfinite(self.x_min_m) and math.isfinite(self.y_max_m)):
            raise GeometryError(f"grid corner is ({self.x_min_m}, {self.y_max_m}) m; expected finite numbers")

    @classmethod
    def centred(
        cls, rows: int, cols: int, spacing_m: float, centre_m: tuple[float, float] = (0.0, 0.0)
    ) -> GroundGrid:
        """Make a grid whose middle lies at `centre_m` (x, y)."""
        x_min = centre_m[0] - (cols - 1) / 2.0 * spacing_m
        y_max = centre_m[1] + (rows - 1) / 2.0 * spacing_m
        return cls(rows, cols, spacing_m, x_min, y_max)

    @classmethod
    def from_projection(cls, projection: ArrayLike, rows: int, cols: int) -> GroundGrid:
        """Read the grid back from the orthographic P (3×4) of a ground-plane image.

        Raises
        ------
        GeometryError
            If P is not u = (x - x_min)/d, v = (y_max - y)/d for one d > 0.
        """
        p = np.asarray(projection, dtype=np.float64).reshape(3, 4)
        if not np.all(np.isfinite(p)) or p[2, 3] == 0.0:
            raise GeometryError(f"P of the ground-plane image is {p.tolist()}; expected finite, P[2][3] = 1")
        p = p / p[2, 3]
        if p[0, 0] <= 0 or p[1, 1] >= 0:
            raise GeometryError(
                f"P has x scale {p[0, 0]:g} and y scale {p[1, 1]:g} px/m; expected +1/d and -1/d (north up,"
                " not mirrored)"
            )
        d = 1.0 / p[0, 0]
        if abs(-1.0 / p[1, 1] - d) > 1e-6 * d:
            raise GeometryError(
                f"pixels of the ground-plane image are {d:g} m by {-1.0 / p[1, 1]:g} m;"
                " expected square pixels"
            )
        off = np.abs(p[[0, 0, 1, 1, 2, 2, 2], [1, 2, 0, 2, 0, 1, 2]])
        if np.any(off > 1e-6 / d):
            raise GeometryError(
                "P of the ground-plane image has terms besides u = (x - x_min)/d, v = (y_max - y)/d:"
                f" {p.tolist()}"
            )
        return cls(rows, cols, float(d), float(-p[0, 3] * d), float(p[1, 3] * d))

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols

    @property
    def centre_m(self) -> tuple[float, float]:
        """Scene (x, y) of the middle of the image."""
        return (
            self.x_min_m + (self.cols - 1) / 2.0 * self.spacing_m,
            self.y_max_m - (self.rows - 1) / 2.0 * self.spacing_m,
        )

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Outer edges (left, right, bottom, top), as matplotlib's ``extent`` wants them."""
        half = self.spacing_m / 2.0
        return (
            self.x_min_m - half,
            self.x_min_m + (self.cols - 1) * self.spacing_m + half,
            self.y_max_m - (self.rows - 1) * self.spacing_m - half,
            self.y_max_m + half,
        )

    @property
    def ground_to_pixel(self) -> FloatArray:
        """3×3 matrix from ground metres (x, y, 1) to pixel (u, v, 1)."""
        inv = 1.0 / self.spacing_m
        return np.array([[inv, 0.0, -self.x_min_m * inv], [0.0, -inv, self.y_max_m * inv], [0.0, 0.0, 1.0]])

    @property
    def projection(self) -> FloatArray:
        """P (3×4) of the ground-plane image: orthographic, north up."""
        a = self.ground_to_pixel
        return np.column_stack([a[:, 0], a[:, 1], np.zeros(3), a[:, 2]])

    def x_of_columns(self) -> FloatArray:
        """Scene x of each column's centre, shape (cols,)."""
        return self.x_min_m + np.arange(self.cols, dtype=np.float64) * self.spacing_m

    def y_of_rows(self) -> FloatArray:
        """Scene y of each row's centre, shape (rows,), descending."""
        return self.y_max_m - np.arange(self.rows, dtype=np.float64) * self.spacing_m

    def contains(self, x_m: float, y_m: float) -> bool:
        """Say whether the ground point lies on the image."""
        left, right, bottom, top = self.extent_m
        return left <= x_m <= right and bottom <= y_m <= top


def _determinant(m: Sequence[Sequence[float]]) -> float:
    (a, b, c), (d, e, f), (g, h, i) = m
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def shadow_matrix(sonar_m: ArrayLike) -> FloatArray:
    """Return the 3×4 matrix that casts a point (x, y, z, 1) along the ray from the sonar to z = 0.

    p' = s_xy + (p_xy - s_xy) sz / (sz - z), in homogeneous form.

    Parameters
    ----------
    sonar_m : array_like, shape (3,)
        Sonar position (x, y, z).
    """
    sx, sy, sz = np.asarray(sonar_m, dtype=np.float64)
    return np.array([[sz, 0.0, -sx, 0.0], [0.0, sz, -sy, 0.0], [0.0, 0.0, -1.0, sz]])


@dataclass(frozen=True, eq=False)
class ShadowCamera:
    """A view's geometry: the finite projective camera whose pictures are shadows.

    ``projection @ (x, y, z, 1)`` is the (homogeneous) pixel where the shadow of the scene point
    falls; its null vector is the sonar. Everything else is derived from that one matrix, so that a
    camera that came through a ``CameraInfo`` message gives the same numbers as the one that went in.

    Parameters
    ----------
    projection : ndarray, shape (3, 4)
        P = A · shadow_matrix(sonar), A: ground metres → pixel. Scaled so that A[2, 2] = 1.
    rows, cols : int
        Shape of the view.

    Raises
    ------
    GeometryError
        If P is not finite, singular, mirrored, not an affine map of the ground, or its sonar is not
        above the seabed.
    """

    projection: FloatArray
    rows: int
    cols: int

    def __post_init__(self) -> None:
        p = np.array(self.projection, dtype=np.float64).reshape(3, 4)
        if not np.all(np.isfinite(p)):
            raise GeometryError(f"P is {p.tolist()}; expected finite numbers")
        for name, n in (("rows", self.rows), ("cols", self.cols)):
            check_range(f"number of {name}", n, 2, 1 << 16, "pixels")
        left = p[:, :3]
        scale = float(np.abs(left).max())
        if scale == 0.0 or abs(_determinant((left / scale).tolist())) < 1e-15:
            raise GeometryError(f"P is singular: {p.tolist()}; expected A · shadow matrix of the sonar")
        object.__setattr__(self, "projection", p)
        sonar, ground = self._sonar, self._ground_to_pixel
        if not sonar[2] > 0.0:
            raise GeometryError(f"the sonar of P is at z = {sonar[2]:g} m; expected above the seabed")
        row_scale = np.abs(ground[:2, :2]).max()
        span = max(float(np.hypot(*sonar[:2])), 1.0)
        if np.abs(ground[2, :2]).max() * span > 1e-6:
            raise GeometryError("P does not map the seabed affinely to pixels (its A has a perspective row)")
        (a, b), (c, d) = ground[:2, :2].tolist()
        det = a * d - b * c
        if det >= 0.0 or abs(det) < 1e-9 * row_scale**2:
            fault = "mirrors" if det > 0 else "flattens"
            raise GeometryError(
                f"P {fault} the ground (det A = {det:g}); expected a rotated map, rows down-range"
            )
        self.projection.flags.writeable = False

    @classmethod
    def from_ground(
        cls, ground_to_pixel: ArrayLike, sonar_m: ArrayLike, rows: int, cols: int
    ) -> ShadowCamera:
        """Make the camera of an image of the ground seen by a sonar at `sonar_m`.

        Parameters
        ----------
        ground_to_pixel : array_like, shape (3, 3)
            A, from (x, y, 1) in metres to (u, v, 1).
        sonar_m : array_like, shape (3,)
            Sonar position, metres, scene frame.
        """
        a = np.asarray(ground_to_pixel, dtype=np.float64)
        return cls(a @ shadow_matrix(sonar_m), rows, cols)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols

    @cached_property
    def _sonar(self) -> FloatArray:
        # Cramer's rule: general solvers take longer to call than all else that a view's geometry needs.
        a, b, c, d = self.projection.T.tolist()
        det = _determinant((a, b, c))
        return np.array([-_determinant(m) / det for m in ((d, b, c), (a, d, c), (a, b, d))])

    @cached_property
    def _ground_to_pixel(self) -> FloatArray:
        # P's left part times the inverse of the shadow matrix's.
        sx, sy, sz = self._sonar
        a = self.projection[:, :3].copy()
        a[:, :2] /= sz
        a[:, 2] = -(a[:, 0] * sx + a[:, 1] * sy + a[:, 2])
        return np.asarray(a / a[2, 2], dtype=np.float64)

    @property
    def sonar_m(self) -> FloatArray:
        """Sonar position (x, y, z): the null vector of P."""
        return self._sonar

    @property
    def ground_to_pixel(self) -> FloatArray:
        """A (3×3): ground metres (x, y, 1) → pixel (u, v, 1)."""
        return self._ground_to_pixel

    @cached_property
    def pixel_to_ground(self) -> FloatArray:
        """Inverse of `ground_to_pixel`."""
        return np.asarray(np.linalg.inv(self._ground_to_pixel), dtype=np.float64)

    @cached_property
    def aspect_rad(self) -> float:
        """Azimuth of the sonar seen from the scene's origin."""
        return math.atan2(self._sonar[1], self._sonar[0])

    @cached_property
    def grazing_rad(self) -> float:
        """ψ = atan2(height, ground range to the origin)."""
        return math.atan2(self._sonar[2], float(np.hypot(self._sonar[0], self._sonar[1])))

    @cached_property
    def spacing_m(self) -> tuple[float, float]:
        """Ground metres per (row, col) step."""
        inv = self.pixel_to_ground[:2, :2]
        return float(np.hypot(*inv[:, 1])), float(np.hypot(*inv[:, 0]))

    def decompose(self) -> tuple[FloatArray, FloatArray]:
        """Split P's left 3×3 into K (upper triangular, K[2, 2] = 1) and R (rotation), P = λ K [R|t].

        Returns
        -------
        K, R : ndarray, shape (3, 3)
            What ``CameraInfo.k`` and ``.r`` carry.
        """
        # Gram and Schmidt from the last row up; it is vertical, as A is affine.
        left = self.projection[:, :3]
        k, r = np.zeros((3, 3)), np.empty((3, 3))
        for row in (2, 1, 0):
            rest = left[row]
            for of in range(2, row, -1):
                k[row, of] = left[row] @ r[of]
                rest = rest - k[row, of] * r[of]
            k[row, row] = math.sqrt(rest @ rest)
            r[row] = rest / k[row, row]
        if _determinant(r.tolist()) < 0:
            r = -r
        return k / k[2, 2], r

    def project(self, points_m: ArrayLike) -> FloatArray:
        """Project scene points to the pixels where their shadows fall.

        Parameters
        ----------
        points_m : array_like, shape (..., 3)
            Points below the sonar.

        Returns
        -------
        ndarray, shape (..., 2)
            (u, v) = (col, row), fractional; NaN for points at or above the sonar's height.
        """
        points = np.asarray(points_m, dtype=np.float64)
        h = points @ self.projection[:, :3].T + self.projection[:, 3]
        below = points[..., 2] < self._sonar[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = h[..., :2] / h[..., 2:]
        return np.where(below[..., None], uv, np.nan)

    def height_slice_affine(self, z_m: float) -> FloatArray:
        """Return the 2×3 matrix from (x, y, 1) at height z to pixel (u, v): a similarity of A.

        Raises
        ------
        GeometryError
            If z is not below the sonar.
        """
        return np.asarray(self.height_slice_affines(np.array([z_m]))[0])

    def height_slice_affines(self, z_m: FloatArray) -> FloatArray:
        """Return `height_slice_affine` of several heights, shape (n, 2, 3).

        Raises
        ------
        GeometryError
            If a height is not below the sonar.
        """
        top = float(np.max(z_m))
        if not top < self._sonar[2]:
            raise GeometryError(f"height {top:g} m is not below the sonar at {self._sonar[2]:g} m")
        p = self.projection
        affines = np.empty((len(z_m), 2, 3))
        affines[:, :, :2] = p[:2, :2]
        affines[:, :, 2] = p[:2, 2] * z_m[:, None] + p[:2, 3]
        # Row 2 of P has no x, y terms: A is affine (checked at construction).
        affines /= (p[2, 2] * z_m + p[2, 3])[:, None, None]
        return affines


@dataclass(frozen=True)
class ViewInfo:
    """Everything about a view except its pixels: what its ``CameraInfo`` carries.

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
    """

    stamp_ns: int
    camera: ShadowCamera
    acoustics: Acoustics
    aspect_rad: float
    aperture_rad: float
    carrier_rad_m: tuple[float, float] = (0.0, 0.0)
    focus_range_m: float = math.nan

    @property
    def resolution_m(self) -> tuple[float, float]:
        """Size of a resolution cell on the ground, (down-range, cross-range).

        2π over the wedge's extent: K(f_c + B/2) - K(f_c - B/2) down-range, 2 K(f_c) sin(w/2) cross-range.
        """
        low, mid, high = self.acoustics.ground_band(self.camera.grazing_rad)
        cross = 2.0 * mid * math.sin(min(self.aperture_rad, math.pi) / 2.0)
        return TWO_PI / (high - low), TWO_PI / cross if cross > 0 else math.inf

    def down_range_of_rows(self) -> FloatArray:
        """Down-range e_r · p (m) of each row's centre, shape (rows,)."""
        e_r = down_range_axis(self.aspect_rad)
        to_ground = self.camera.pixel_to_ground
        start = to_ground[:2] @ np.array([(self.camera.cols - 1) / 2.0, 0.0, 1.0])
        rows = np.arange(self.camera.rows, dtype=np.float64)
        return float(e_r @ start) + rows * float(e_r @ to_ground[:2, 1])


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
        if self.pixels.shape != self.info.camera.shape:
            raise GeometryError(
                f"view has {self.pixels.shape} pixels; its camera says {self.info.camera.shape} (rows, cols)"
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
    """

    pixels: NDArray[Any]
    grid: GroundGrid
    acoustics: Acoustics
    stamp_ns: int = 0

    def __post_init__(self) -> None:
        if self.pixels.shape != self.grid.shape:
            raise GeometryError(
                f"image has {self.pixels.shape} pixels; its grid says {self.grid.shape} (rows, cols)"
            )


def view_ground_to_pixel(
    aspect_rad: float, spacing_m: float, rows: int, cols: int, centre_m: tuple[float, float]
) -> FloatArray:
    """Return A (3×3) of a view of aspect θ whose middle pixel looks at `centre_m` (x, y)."""
    e_c, e_r = cross_range_axis(aspect_rad), down_range_axis(aspect_rad)
    linear = np.vstack([e_c, e_r]) / spacing_m
    middle = np.array([(cols - 1) / 2.0, (rows - 1) / 2.0])
    a = np.eye(3)
    a[:2, :2] = linear
    a[:2, 2] = middle - linear @ np.asarray(centre_m, dtype=np.float64)
    return a


@dataclass(frozen=True)
class AspectGap:
    """An arc without sonar positions, from `start_rad` counter-clockwise over `width_rad`."""

    start_rad: float
    width_rad: float

    def __str__(self) -> str:
        start = math.degrees(self.start_rad) % 360.0
        return f"{start:.1f}° to {start + math.degrees(self.width_rad):.1f}°"


class Track:
    """Sonar poses along the circle.

    Parameters
    ----------
    stamps_ns : array_like of int, shape (n,)
        Strictly increasing time stamps, ns.
    positions_m : array_like, shape (n, 3)
        Positions in the scene frame, metres.
    max_gap_rad : float
        An arc between neighbouring poses wider than this is a gap: no view is made in it.

    Raises
    ------
    TrackError
        If there are fewer than three poses, stamps do not increase, a number is not finite, the
        sonar is not above the seabed, or passes over the scene's origin.
    """

    def __init__(
        self, stamps_ns: ArrayLike, positions_m: ArrayLike, *, max_gap_rad: float = math.radians(3.0)
    ) -> None:
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        positions = np.array(positions_m, dtype=np.float64)
        if positions.ndim != 2 or positions.shape[1] != 3 or stamps.shape != positions.shape[:1]:
            raise TrackError(
                f"track has stamps {stamps.shape} and positions {positions.shape}; expected (n,), (n, 3)"
            )
        if len(stamps) < 3:
            raise TrackError(f"track has {len(stamps)} poses; expected at least 3")
        bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
        if bad.size:
            raise TrackError(f"track pose {bad[0]} is {positions[bad[0]].tolist()}; expected finite metres")
        back = np.flatnonzero(np.diff(stamps) <= 0)
        if back.size:
            i = int(back[0])
            raise TrackError(
                f"track stamps are out of order: pose {i + 1} ({stamps[i + 1]} ns) is not after pose {i}"
                f" ({stamps[i]} ns)"
            )
        low = np.flatnonzero(positions[:, 2] <= 0)
        if low.size:
            raise TrackError(
                f"track pose {low[0]} is at z = {positions[low[0], 2]:g} m; expected above the seabed (z > 0)"
            )
        ground = np.hypot(positions[:, 0], positions[:, 1])
        if ground.min() < 1e-9:
            raise TrackError(f"track pose {int(ground.argmin())} is over the scene's origin: no aspect there")
        self.stamps_ns = stamps
        self.positions_m = positions
        self.max_gap_rad = check_range("max_gap_rad", max_gap_rad, 0, math.pi, "rad", open_low=True)
        #: Aspect of each pose, unwrapped along the track (rad).
        self.aspects_rad = np.unwrap(np.arctan2(positions[:, 1], positions[:, 0]))
        for array in (self.stamps_ns, self.positions_m, self.aspects_rad):
            array.flags.writeable = False

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @cached_property
    def circle(self) -> tuple[float, float, float, float]:
        """Least-squares circle (centre x, centre y, radius, mean height), metres.

        Algebraic (Kåsa) fit: x² + y² = 2ax + 2by + c.
        """
        x, y, z = self.positions_m.T
        design = np.column_stack([2 * x, 2 * y, np.ones_like(x)])
        (a, b, c), *_ = np.linalg.lstsq(design, x * x + y * y, rcond=None)
        return float(a), float(b), math.sqrt(max(c + a * a + b * b, 0.0)), float(z.mean())

    @cached_property
    def grazing_rad(self) -> float:
        """Mean grazing angle ψ = atan2(height, ground range), seen from the scene's origin."""
        x, y, z = self.positions_m.T
        return float(np.arctan2(z, np.hypot(x, y)).mean())

    def _steps(self) -> FloatArray:
        return np.diff(self.aspects_rad)

    @cached_property
    def gaps(self) -> tuple[AspectGap, ...]:
        """Arcs of the full circle that no pair of neighbouring poses spans."""
        steps = self._steps()
        lo = np.minimum(self.aspects_rad[:-1], self.aspects_rad[1:])
        covered = np.abs(steps) <= self.max_gap_rad
        arcs = [(float(s % TWO_PI), float(abs(w))) for s, w in zip(lo[covered], steps[covered], strict=True)]
        closing = float(wrap_angle(self.aspects_rad[0] - self.aspects_rad[-1]))
        if abs(self.aspects_rad[-1] - self.aspects_rad[0]) > math.pi and 0 < abs(closing) <= self.max_gap_rad:
            # A circle recorded as n poses of 360/n degrees ends one step before it closes.
            start = self.aspects_rad[-1] if closing > 0 else self.aspects_rad[0]
            arcs.append((float(start % TWO_PI), abs(closing)))
        if not arcs:
            return (AspectGap(0.0, TWO_PI),)
        # An arc across 0 covers the beginning of the circle as well.
        arcs += [(start - TWO_PI, width) for start, width in arcs if start + width > TWO_PI]
        arcs.sort()
        gaps = []
        first = reach = arcs[0][0]
        for start, width in arcs:
            if start > reach + 1e-9:
                gaps.append(AspectGap(reach, start - reach))
            reach = max(reach, start + width)
        if first + TWO_PI > reach + 1e-9:
            gaps.append(AspectGap(reach % TWO_PI, first + TWO_PI - reach))
        return tuple(gaps)

    @property
    def coverage_rad(self) -> float:
        """Arc of the circle that the track covers, up to 2π."""
        return TWO_PI - sum(gap.width_rad for gap in self.gaps)

    def covered_fraction(self, aspect_rad: float, width_rad: float) -> float:
        """Return the fraction of the aperture [θ - w/2, θ + w/2] that the track covers."""
        lost = 0.0
        for gap in self.gaps:
            start = float(np.mod(gap.start_rad - (aspect_rad - width_rad / 2.0), TWO_PI))
            for begin in (start, start - TWO_PI):
                lost += max(0.0, min(begin + gap.width_rad, width_rad) - max(begin, 0.0))
        return max(0.0, 1.0 - lost / width_rad) if width_rad > 0 else float(not lost)

    def at_aspect(self, aspect_rad: float) -> tuple[int, FloatArray]:
        """Return when and where the sonar was at an aspect (first passage).

        Parameters
        ----------
        aspect_rad : float
            Aspect θ, any number of turns.

        Returns
        -------
        stamp_ns : int
        sonar_m : ndarray, shape (3,)

        Raises
        ------
        TrackError
            If the track has a gap there.
        """
        a = self.aspects_rad
        # Number of whole turns between the wanted aspect and each pose: it changes where the track
        # crosses the aspect, whatever the direction and however the track wobbles.
        turns = np.floor((a - aspect_rad) / TWO_PI + 1e-12)
        crossing = np.flatnonzero((np.diff(turns) != 0) & (np.abs(self._steps()) <= self.max_gap_rad))
        # A pose may sit exactly on the aspect without a crossing: at the track's start, or beside a gap.
        exact = np.flatnonzero(np.abs(wrap_angle(a - aspect_rad)) < 1e-9)
        if exact.size and (not crossing.size or exact[0] <= crossing[0]):
            i = int(exact[0])
            return int(self.stamps_ns[i]), self.positions_m[i].copy()
        if crossing.size:
            i = int(crossing[0])
            target = aspect_rad + TWO_PI * max(turns[i], turns[i + 1])
            f = (target - a[i]) / (a[i + 1] - a[i])
            f = min(max(float(f), 0.0), 1.0)
            position = (1.0 - f) * self.positions_m[i] + f * self.positions_m[i + 1]
            stamp = int(self.stamps_ns[i]) + round(f * int(self.stamps_ns[i + 1] - self.stamps_ns[i]))
            return stamp, position
        # A circle of n poses closes on itself.
        closing = float(wrap_angle(a[0] - a[-1]))
        beyond = float(wrap_angle(aspect_rad - a[-1]))
        if (
            abs(a[-1] - a[0]) > math.pi
            and abs(closing) <= self.max_gap_rad
            and beyond * closing >= 0
            and abs(beyond) <= abs(closing)
        ):
            f = beyond / closing
            step = int(np.median(np.diff(self.stamps_ns)))
            return (
                int(self.stamps_ns[-1]) + round(f * step),
                (1.0 - f) * self.positions_m[-1] + f * self.positions_m[0],
            )
        raise TrackError(f"the track has no pose at aspect {math.degrees(aspect_rad) % 360.0:.2f}°")


def aspects_of_step(step_rad: float, start_rad: float = 0.0) -> FloatArray:
    """Return the aspects of a full circle at a fixed step, starting at `start_rad`.

    Raises
    ------
    ParameterError
        If the step does not divide the circle.
    """
    check_range("aspect step", step_rad, 0, TWO_PI, "rad", open_low=True)
    n = round(TWO_PI / step_rad)
    if abs(n * step_rad - TWO_PI) > 1e-6:
        raise ParameterError(
            f"aspect step is {math.degrees(step_rad):g}°; expected a divisor of 360° (such as 1, 2, 5)"
        )
    return start_rad + np.arange(n, dtype=np.float64) * (TWO_PI / n)


def looks_at(info: ViewInfo, target_m: tuple[float, float]) -> bool:
    """Say whether a view's focus range is that of a target, r₀ = e_r · target; without one it may be."""
    r0 = float(down_range_axis(info.aspect_rad) @ np.asarray(target_m, dtype=np.float64))
    return not math.isfinite(info.focus_range_m) or abs(info.focus_range_m - r0) < 1e-6


def fit_target_to_focus(infos: Sequence[ViewInfo]) -> tuple[float, float]:
    """Find the ground point whose down-range in every view is that view's focus range.

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
