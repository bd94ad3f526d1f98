"""The seabed's slope, from the shadows that fall on it.

A track says how high the sonar is above a level. If the seabed slopes against that level, shadows are
longer on one side of the circle and shorter on the other than the track makes them, and the carved shape
leans.

The far end of a shadow is where the sonar's ray over the top of the target meets the seabed. Carried back
along that ray to the height of the target's top, it is the point where the top's outline touches a line
across the view: its distance S(θ) down-range is the support function of that outline, whatever its shape,
and its place across the view is S'(θ). A slope moves the end along the ray alone, by the more the farther
the sonar lies up the slope, and so contradicts the place across: that is what is fitted here.

What cannot be told is an error of the sonar's height that is the same all round: shadows are then those of
a target that is higher in the same proportion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry import ShadowCamera, View, ViewInfo, cross_range_axis, down_range_axis

#: Values of a shadow mask that are needed here (`carving.MASK_UNKNOWN`, `carving.MASK_SHADOW`).
_UNKNOWN, _SHADOW = 128, 255
#: The far end's place across is the mean over so much of the shadow (resolution cells down-range).
_END_CELLS = 2.4
#: Harmonics of the support function: a square top has corners.
_HARMONICS = 6
#: Fewer far ends, or less of a circle, tell no slope.
_MIN_ENDS, _MIN_ARC_RAD = 24, math.pi
#: A slope is believed if it is so many standard deviations from none, and steeper than this.
_SIGMAS, _LEAST_RAD = 3.0, math.radians(0.5)
#: No seabed that a circle is swum over is steeper.
_MOST_RAD = math.radians(10.0)
#: A slope moves ends in proportion only while it is small: it is fitted so often, each time on the last one.
_ROUNDS = 3
#: A residual of more than this many of their spreads is an outlier (Huber).
_HUBER = 1.5


@dataclass(frozen=True)
class ShadowEnd:
    """The far end of the target's shadow in one view.

    Parameters
    ----------
    info : ViewInfo
        The view.
    point_m : (float, float)
        Where it lies on the seabed (x, y), m.
    """

    info: ViewInfo
    point_m: tuple[float, float]


@dataclass(frozen=True)
class SeabedSlope:
    """How the seabed slopes against the level that the track's heights refer to.

    Parameters
    ----------
    gradient : (float, float)
        Rise of the seabed per metre along x and y.
    sigma : float
        Standard deviation of either.
    about_m : (float, float)
        Where the track's heights hold (x, y): the target.
    """

    gradient: tuple[float, float]
    sigma: float
    about_m: tuple[float, float]

    @property
    def slope_rad(self) -> float:
        """Steepness of the slope."""
        return math.atan(math.hypot(*self.gradient))

    @property
    def believed(self) -> bool:
        """Whether the slope is too steep to be chance."""
        return max(_LEAST_RAD, _SIGMAS * self.sigma) < self.slope_rad < _MOST_RAD

    def corrected(self, info: ViewInfo) -> ViewInfo:
        """Return a view's geometry over this seabed if the slope is believed, unchanged otherwise."""
        return self.applied(info) if self.believed else info

    def applied(self, info: ViewInfo) -> ViewInfo:
        """Return a view's geometry with the sonar's height above this seabed.

        Raises
        ------
        GeometryError
            If the sonar would be under it.
        """
        x, y, z = info.camera.sonar_m
        gx, gy = self.gradient
        height = z - gx * (x - self.about_m[0]) - gy * (y - self.about_m[1])
        camera = info.camera
        raised = ShadowCamera.from_ground(camera.ground_to_pixel, (x, y, height), camera.rows, camera.cols)
        return replace(info, camera=raised)


def largest_piece(shadow: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """Return the largest connected piece of a silhouette, None if there is none."""
    x, y, width, height = cv2.boundingRect(shadow.view(np.uint8))
    if not width:
        return None
    box = np.s_[y : y + height, x : x + width]  # most of a view is no shadow
    _, labels, stats, _ = cv2.connectedComponentsWithStats(shadow[box].view(np.uint8), connectivity=8)
    piece = np.zeros_like(shadow)
    piece[box] = labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    return piece


def leaves_image(known: NDArray[np.bool_], shadow: NDArray[np.bool_], last: int) -> bool:
    """Say whether a shadow may go on off the image.

    Parameters
    ----------
    known : ndarray of bool, shape (rows, cols)
        What the view knows. Off the image that is nothing any more; an echo, or what is too dark for seabed,
        ends again.
    shadow : ndarray of bool, shape (rows, cols)
        The shadow.
    last : int
        Its last row.
    """
    return bool(last + 1 >= len(shadow) or not known[last + 1 :, shadow[last]].any(axis=0).all())


def shadow_end(mask: View) -> ShadowEnd | None:
    """Find the far end of the target's shadow.

    Parameters
    ----------
    mask : View
        Segmented shadow (uint8).

    Returns
    -------
    ShadowEnd or None
        None if there is no shadow, or it may go on where the view knows nothing.
    """
    shadow = largest_piece(mask.pixels == _SHADOW)
    if shadow is None:
        return None
    rows = np.flatnonzero(shadow.any(axis=1))
    last = int(rows[-1])
    if leaves_image(mask.pixels != _UNKNOWN, shadow, last):
        return None
    end_rows = max(1, round(_END_CELLS * mask.info.cell_px[0]))
    columns = np.nonzero(shadow[max(int(rows[0]), last + 1 - end_rows) : last + 1])[1]
    x, y, _ = mask.info.camera.pixel_to_ground @ np.array([columns.mean(), last + 0.5, 1.0])
    return ShadowEnd(mask.info, (float(x), float(y)))


def seabed_slope(
    ends: Sequence[ShadowEnd], about_m: tuple[float, float], height_m: float
) -> SeabedSlope | None:
    """Fit the seabed's slope to the far ends of shadows.

    Parameters
    ----------
    ends : sequence of ShadowEnd
        Of the views of a circle, in any order.
    about_m : (float, float)
        The target's place.
    height_m : float
        The target's height above the seabed.

    Returns
    -------
    SeabedSlope or None
        None if there are too few ends, or too little of a circle, to tell.

    Notes
    -----
    With p the end, s and h the sonar's ground position and height, and z the target's height, the ray is
    q = p + (s - p) z/h at the top. Unknown are the Fourier coefficients of S(θ), and the gradient g; the
    data are e_r · q = S(θ) + |s - p| z/h² g · (s - about) and e_c · q = S'(θ), about the target's place.
    """
    ends = sorted(ends, key=lambda end: end.info.stamp_ns)
    if len(ends) < _MIN_ENDS or height_m <= 0.0:
        return None
    aspect = np.array([end.info.aspect_rad for end in ends])
    aperture = float(np.median([end.info.aperture_rad for end in ends]))
    gaps = np.diff(np.sort(np.mod(aspect, 2.0 * math.pi)), append=np.sort(np.mod(aspect, 2.0 * math.pi))[0])
    gaps[-1] += 2.0 * math.pi
    if 2.0 * math.pi - float(gaps[gaps > aperture].sum()) < _MIN_ARC_RAD:
        return None
    p = np.array([end.point_m for end in ends]) - about_m
    sonar = np.array([end.info.camera.sonar_m for end in ends])
    s = sonar[:, :2] - about_m
    down = np.array([down_range_axis(float(a)) for a in aspect])
    across = np.array([cross_range_axis(float(a)) for a in aspect])
    order = np.arange(1, _HARMONICS + 1)
    cosine, sine = np.cos(aspect[:, None] * order), np.sin(aspect[:, None] * order)
    none = np.zeros((len(ends), 1))
    gradient: NDArray[np.float64] = np.zeros(2)
    sigma = math.nan
    for _ in range(_ROUNDS):
        h = sonar[:, 2] - s @ gradient
        if h.min() <= height_m:
            return None
        q = p + (s - p) * (height_m / h)[:, None]
        data = np.concatenate([(down * q).sum(axis=1), (across * q).sum(axis=1)])
        moved = (np.linalg.norm(s - p, axis=1) * height_m / h**2)[:, None] * s
        design = np.vstack(
            [
                np.hstack([none + 1.0, cosine, sine, moved]),
                np.hstack([none, -order * sine, order * cosine, np.zeros_like(moved)]),
            ]
        )
        step, sigma = _last_two(design, data)
        gradient = gradient + step
    # Views whose apertures overlap share their looks.
    sigma *= math.sqrt(max(1.0, len(ends) * aperture / (2.0 * math.pi)))
    if not (math.isfinite(sigma) and np.isfinite(gradient).all()):
        return None
    return SeabedSlope((float(gradient[0]), float(gradient[1])), sigma, about_m)


def _last_two(design: NDArray[np.float64], data: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Solve for the last two unknowns, and their standard deviation; outliers count less."""
    n = len(data) // 2
    weight = np.ones(2 * n)
    for _ in range(6):
        weighted = design * weight[:, None]
        normal = weighted.T @ weighted
        solution = np.linalg.lstsq(weighted, data * weight, rcond=None)[0]
        residual = data - design @ solution
        spread = np.repeat([max(float(np.std(part)), 1e-4) for part in np.split(residual, 2)], n)
        weight = np.sqrt(np.minimum(1.0, _HUBER * spread / np.maximum(np.abs(residual), 1e-12))) / spread
    covariance = np.linalg.pinv(normal)[-2:, -2:]
    variance = max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0)
    return np.asarray(solution[-2:], dtype=np.float64), math.sqrt(variance)
