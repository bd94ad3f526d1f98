"""The shadow camera: a view's geometry as one projection matrix."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..errors import GeometryError, check_whole, quoted
from .frames import FloatArray, cross_range_axis, down_range_axis


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
        given = np.asarray(self.projection)
        if given.size != 12 or given.dtype.kind not in "fiu":
            raise GeometryError(
                f"P is {quoted(self.projection)} of shape {given.shape}; expected numbers of shape (3, 4)"
            )
        p = np.array(given, dtype=np.float64).reshape(3, 4)
        if not np.all(np.isfinite(p)):
            raise GeometryError(f"P is {p.tolist()}; expected finite numbers")
        for name in ("rows", "cols"):
            n = check_whole(f"number of {name}", getattr(self, name), 2, 1 << 16, "pixels")
            object.__setattr__(self, name, n)
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


def view_ground_to_pixel(
    aspect_rad: float, spacing_m: float, rows: int, cols: int, centre_m: tuple[float, float]
) -> FloatArray:
    """Return A (3×3) of a view of aspect θ with its middle pixel at `centre_m` (x, y)."""
    e_c, e_r = cross_range_axis(aspect_rad), down_range_axis(aspect_rad)
    linear = np.vstack([e_c, e_r]) / spacing_m
    middle = np.array([(cols - 1) / 2.0, (rows - 1) / 2.0])
    a = np.eye(3)
    a[:2, :2] = linear
    a[:2, 2] = middle - linear @ np.asarray(centre_m, dtype=np.float64)
    return a
