"""Angles, axes, the band of an image, and ground grids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import (
    GeometryError,
    ParameterError,
    check_divides_circle,
    check_finite,
    check_range,
    check_whole,
    quoted,
)

FloatArray = NDArray[np.float64]


TWO_PI = 2.0 * math.pi


def one_frame(what: str, frame: str, expected: str, of: str) -> None:
    """Refuse an item of a run in another frame than the rest.

    Parameters
    ----------
    what, frame : str
        What it is, and its frame.
    expected, of : str
        The run's frame, and what is in it.

    Raises
    ------
    GeometryError
        Naming both frames.
    """
    if frame != expected:
        raise GeometryError(f"{what} is in frame {frame!r}; expected that of {of}, {expected!r}")


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


def place_text(position_m: Sequence[float]) -> str:
    """Write a place of the scene as "(1.20, -0.35) m"; never as -0.00."""
    x, y = (round(value, 2) + 0.0 for value in position_m)
    return f"({x:.2f}, {y:.2f}) m"


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
        if isinstance(self.spectrum_sign, str) or self.spectrum_sign not in (1, -1):
            raise ParameterError(f"spectrum_sign is {quoted(self.spectrum_sign)}; expected +1 or -1")
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

    def folds(self, spacing_m: float, grazing_rad: float) -> str:
        """Say that pixels are too coarse for the band, whose edge would fold over; empty if they hold it.

        Pixels hold wavenumbers up to π/d. Those below it by rounding alone are held.
        """
        high, nyquist = self.ground_band(grazing_rad)[2], math.pi / spacing_m
        if high <= nyquist * (1.0 + 1e-9):
            return ""
        return (
            f"the band reaches K = {high:.0f} rad/m on the ground, but a pixel of {spacing_m * 1e3:.3g} mm"
            f" holds only {nyquist:.0f} rad/m: expected a pixel of at most {math.pi / high * 1e3:.3g} mm"
        )


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
        for name in ("rows", "cols"):
            n = check_whole(f"number of {name}", getattr(self, name), 2, 1 << 16, "pixels")
            object.__setattr__(self, name, n)
        check_range("pixel spacing", self.spacing_m, 0, 1e6, "m", open_low=True)
        for axis, corner in (("x", self.x_min_m), ("y", self.y_max_m)):
            check_finite(f"{axis} of the grid's corner", corner, "m")

    @classmethod
    def centred(
        cls, rows: int, cols: int, spacing_m: float, centre_m: tuple[float, float] = (0.0, 0.0)
    ) -> GroundGrid:
        """Make a grid with its middle at `centre_m` (x, y)."""
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


def aspects_of_step(step_rad: float, start_rad: float = 0.0) -> FloatArray:
    """Return the aspects of a full circle at a fixed step, starting at `start_rad`.

    Raises
    ------
    ParameterError
        If the step does not divide the circle.
    """
    check_range("aspect step", step_rad, 0, TWO_PI, "rad", open_low=True)
    check_divides_circle("aspect step", math.degrees(step_rad), "°")
    n = round(TWO_PI / step_rad)
    return start_rad + np.arange(n, dtype=np.float64) * (TWO_PI / n)
