"""Lattices of pixels on the seabed that need not be north-up or square, as sectors may have them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import GeometryError, check_numbers, check_whole
from .frames import FloatArray, GroundGrid

#: A lattice whose two steps are nearer to one line than this (sine of the angle) is no map: its pixel
#: coordinates would lose three of a double's sixteen digits to it.
_LEAST_SINE = 1e-3


@dataclass(frozen=True)
class GroundLattice:
    """A lattice of pixels on the seabed: decimated, turned or with oblong pixels, but never mirrored.

    Parameters
    ----------
    rows, cols : int
        Shape of the image, (row, col).
    origin_m : (float, float)
        Scene (x, y) of the centre of pixel (row 0, col 0).
    column_step_m, row_step_m : (float, float)
        Scene (x, y) from one column to the next, and from one row to the next.

    Raises
    ------
    GeometryError
        If the steps span no area, or the image is mirrored.
    """

    rows: int
    cols: int
    origin_m: tuple[float, float]
    column_step_m: tuple[float, float]
    row_step_m: tuple[float, float]

    def __post_init__(self) -> None:
        for name in ("rows", "cols"):
            n = check_whole(f"number of {name}", getattr(self, name), 2, 1 << 16, "pixels")
            object.__setattr__(self, name, n)
        for name in ("origin", "column step", "row step"):
            check_numbers(f"{name} of the lattice", getattr(self, f"{name.replace(' ', '_')}_m"), 2, "m")
        (ax, ay), (bx, by) = self.column_step_m, self.row_step_m
        area = ax * by - ay * bx
        if abs(area) <= _LEAST_SINE * math.hypot(ax, ay) * math.hypot(bx, by):
            raise GeometryError(
                f"steps of the lattice are ({ax:g}, {ay:g}) and ({bx:g}, {by:g}) m; expected two directions"
            )
        if area > 0:
            raise GeometryError(
                f"steps of the lattice are ({ax:g}, {ay:g}) m a column and ({bx:g}, {by:g}) m a row:"
                " mirrored; expected rows to the right of columns, as in a north-up map"
            )

    @classmethod
    def of(cls, grid: GroundGrid | GroundLattice) -> GroundLattice:
        """Return a grid as a lattice."""
        if isinstance(grid, GroundLattice):
            return grid
        d = grid.spacing_m
        return cls(grid.rows, grid.cols, (grid.x_min_m, grid.y_max_m), (d, 0.0), (0.0, -d))

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows, self.cols

    @property
    def pixel_to_ground(self) -> FloatArray:
        """3×3 matrix from pixel (u, v, 1) to ground metres (x, y, 1)."""
        (ax, ay), (bx, by), (x, y) = self.column_step_m, self.row_step_m, self.origin_m
        return np.array([[ax, bx, x], [ay, by, y], [0.0, 0.0, 1.0]])

    @property
    def ground_to_pixel(self) -> FloatArray:
        """3×3 matrix from ground metres (x, y, 1) to pixel (u, v, 1)."""
        return np.asarray(np.linalg.inv(self.pixel_to_ground), np.float64)

    @property
    def projection(self) -> FloatArray:
        """P (3×4) of the ground-plane image: orthographic."""
        a = self.ground_to_pixel
        return np.column_stack([a[:, 0], a[:, 1], np.zeros(3), a[:, 2]])

    def pixels_of(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (u, v), column and row, of ground points."""
        a = self.ground_to_pixel
        x, y = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
        return a[0, 0] * x + a[0, 1] * y + a[0, 2], a[1, 0] * x + a[1, 1] * y + a[1, 2]

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) of the wholly covered ground.

        The outer edges where it is north-up; else the largest upright square about its middle.
        """
        to_ground = self.pixel_to_ground
        middle = to_ground @ ((self.cols - 1) / 2.0, (self.rows - 1) / 2.0, 1.0)
        (ax, ay), (bx, by) = self.column_step_m, self.row_step_m
        if abs(ay) <= 1e-9 * abs(ax) and abs(bx) <= 1e-9 * abs(by) and ax > 0:
            across, along = self.cols * ax / 2.0, -self.rows * by / 2.0
        else:
            inverse = np.abs(np.linalg.inv(to_ground[:2, :2])).sum(axis=1)
            across = along = float(min(self.cols / inverse[0], self.rows / inverse[1])) / 2.0
        x, y = float(middle[0]), float(middle[1])
        return x - across, x + across, y - along, y + along


def ground_from_projection(projection: ArrayLike, rows: int, cols: int) -> GroundGrid | GroundLattice:
    """Read a ground-plane image's lattice from its orthographic P: a grid if it is north-up and square.

    Raises
    ------
    GeometryError
        If P is not orthographic, mirrors, or maps the ground to a line.
    """
    try:
        return GroundGrid.from_projection(projection, rows, cols)
    except GeometryError:
        p = np.asarray(projection, dtype=np.float64).reshape(3, 4)
        if not np.all(np.isfinite(p)) or p[2, 3] == 0.0:
            raise
    p = p / p[2, 3]
    a = p[:, [0, 1, 3]]
    # What a third axis or a perspective would add over the image must stay far below a pixel.
    if np.any(np.abs(p[:, 2]) > 1e-6) or np.any(np.abs(p[2, :2]) > 1e-9) or np.linalg.det(a) == 0.0:
        raise GeometryError(f"P of the ground-plane image is {p.tolist()}; expected an orthographic map")
    inverse = np.linalg.inv(a)
    (ax, bx, x), (ay, by, y) = inverse[0].tolist(), inverse[1].tolist()
    return GroundLattice(rows, cols, (x, y), (ax, ay), (bx, by))
