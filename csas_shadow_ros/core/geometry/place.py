"""Where on earth the scene is: a datum, and scene metres to latitude and longitude and back.

The scene lies on the plane that touches the WGS-84 ellipsoid at the datum. A point of it is turned to east
and north, put into earth-centred coordinates (EPSG:4978) and read as latitude and longitude (EPSG:4979):
exact, without a map projection's scale. That is a page of formulas; PROJ, which a payload computer would have
to install for it, is what the tests compare with.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..equality import equal_where_nan
from ..errors import ParameterError, check_number, check_numbers
from .frames import FloatArray

if TYPE_CHECKING:
    from ..shape.mesh import Dimensions

#: WGS-84 (NIMA TR8350.2): half major axis (m), flattening, and the square of the eccentricity.
_A, _F = 6378137.0, 1.0 / 298.257223563
_E2 = _F * (2.0 - _F)
#: Half of a 95 % interval of a normal distribution, in standard deviations.
_SIGMAS_95 = 1.959964


@equal_where_nan
@dataclass(frozen=True)
class Place:
    """The place of an object on earth.

    Parameters
    ----------
    latitude_deg, longitude_deg : float
        WGS-84.
    bearing_deg : float
        Of its length, clockwise from true north, in [0, 180): an object has no front.
    sigma_east_m, sigma_north_m : float
        Standard deviations of the position: the datum's, and the measured one's where that is known. NaN
        where the datum's is not.
    """

    latitude_deg: float
    longitude_deg: float
    bearing_deg: float
    sigma_east_m: float = math.nan
    sigma_north_m: float = math.nan

    def __str__(self) -> str:
        return f"{_degrees(self.latitude_deg, 'NS')} {_degrees(self.longitude_deg, 'EW')}{self._sure()}"

    def _sure(self) -> str:
        if not math.isfinite(self.sigma_east_m + self.sigma_north_m):
            return ""
        return f" (± {_SIGMAS_95 * max(self.sigma_east_m, self.sigma_north_m):.2f} m)"


def _degrees(value: float, sides: str) -> str:
    # 1e-7 degrees are 11 mm.
    return f"{abs(value):.7f}° {sides[value < 0]}"


@dataclass(frozen=True)
class Datum:
    """Where on earth the scene's origin is, and how the scene is turned.

    Parameters
    ----------
    latitude_deg, longitude_deg : float
        Of the origin, WGS-84.
    heading_deg : float
        True bearing of the scene's y axis, clockwise from north; 0: x is east and y north.
    altitude_m : float
        Of the seabed at the origin, over the ellipsoid.
    covariance_m2 : (float, float, float), optional
        Uncertainty of the origin: variances along east and north, and their covariance (m²). None: not known.

    Raises
    ------
    ParameterError
        If a value is out of range.

    Examples
    --------
    >>> from csas_shadow_ros.core.geometry import Datum
    >>> datum = Datum(48.3829, -4.4953)
    >>> latitude, longitude = datum.to_latlon(100.0, 50.0)
    >>> f"{latitude:.6f} {longitude:.6f}"
    '48.383350 -4.493950'
    >>> "{:.3f} {:.3f}".format(*datum.to_scene(latitude, longitude))
    '100.000 50.000'
    """

    latitude_deg: float
    longitude_deg: float
    heading_deg: float = 0.0
    altitude_m: float = 0.0
    covariance_m2: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        for name, limit in (("latitude", 90.0), ("longitude", 360.0), ("heading", 360.0)):
            value = check_number(f"{name} of the origin", getattr(self, f"{name}_deg"))
            if not abs(value) <= limit:  # also NaN
                raise ParameterError(
                    f"{name} of the origin is {value:g}°; expected a number in [{-limit:g}, {limit:g}]°"
                )
        if not abs(check_number("altitude of the origin", self.altitude_m)) <= 1e5:
            raise ParameterError(f"altitude of the origin is {self.altitude_m:g} m; expected at most 100 km")
        if self.covariance_m2 is None:
            return
        c = check_numbers("covariance of the origin", self.covariance_m2, 3, "m²")
        if not (min(c[:2]) >= 0.0 and c[2] ** 2 <= c[0] * c[1] * (1 + 1e-9)):
            raise ParameterError(
                f"covariance of the origin is {list(c)} m²; expected finite variances >= 0 and a covariance"
                " that fits them"
            )

    def __str__(self) -> str:
        place = Place(self.latitude_deg, self.longitude_deg, 0.0)
        turned = f", y towards {self.heading_deg % 360.0:.2f}°" if self.heading_deg else ""
        return f"origin at {place}{turned}"

    @property
    def scene_to_east_north(self) -> FloatArray:
        """2×2 matrix from scene (x, y) to (east, north)."""
        c, s = math.cos(math.radians(self.heading_deg)), math.sin(math.radians(self.heading_deg))
        return np.array([[c, s], [-s, c]])

    @property
    def east_north_up_to_earth(self) -> FloatArray:
        """3×3 matrix whose columns are east, north and up at the origin, in earth-centred axes."""
        lat, lon = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        sp, cp, sl, cl = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
        return np.array([[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0.0, cp, sp]])

    @property
    def scene_to_earth(self) -> tuple[FloatArray, FloatArray]:
        """Rotation (3×3) and translation (3) from the scene to the earth-centred frame (EPSG:4978)."""
        turn = np.eye(3)
        turn[:2, :2] = self.scene_to_east_north
        return self.east_north_up_to_earth @ turn, self._earth(self.latitude_deg, self.longitude_deg)

    def _earth(self, latitude_deg: float, longitude_deg: float) -> FloatArray:
        lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
        n = _A / math.sqrt(1.0 - _E2 * math.sin(lat) ** 2)
        across = (n + self.altitude_m) * math.cos(lat)
        up = (n * (1.0 - _E2) + self.altitude_m) * math.sin(lat)
        return np.array([across * math.cos(lon), across * math.sin(lon), up])

    def to_latlon(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return (latitude, longitude) in degrees of a point of the scene.

        Parameters
        ----------
        x_m, y_m : float
            Scene coordinates.
        """
        rotation, origin = self.scene_to_earth
        x, y, z = (origin + rotation @ np.array([x_m, y_m, 0.0])).tolist()
        across = math.hypot(x, y)
        # Fixed point of tan φ = (z + e² N sin φ) / p: each round gains a factor of e², five reach rounding.
        tangent = z / (across * (1.0 - _E2)) if across else math.inf
        lat = math.atan(tangent)
        for _ in range(5 if across else 0):
            n = _A / math.sqrt(1.0 - _E2 * math.sin(lat) ** 2)
            lat = math.atan2(z + _E2 * n * math.sin(lat), across)
        return math.degrees(lat), math.degrees(math.atan2(y, x))

    def to_scene(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Return the scene's (x, y) below a latitude and longitude (degrees), at the origin's altitude."""
        rotation, origin = self.scene_to_earth
        x, y, _ = rotation.T @ (self._earth(latitude_deg, longitude_deg) - origin)
        return float(x), float(y)

    def bearing_deg(self, heading_rad: float) -> float:
        """Return the true bearing, clockwise from north in [0, 360), of a direction of the scene.

        Parameters
        ----------
        heading_rad : float
            Counter-clockwise from +x.
        """
        return (90.0 - math.degrees(heading_rad) + self.heading_deg) % 360.0

    def place_of(self, dimensions: Dimensions) -> Place:
        """Return an object's place on earth."""
        d = dimensions
        latitude, longitude = self.to_latlon(*d.position_m)
        bearing = self.bearing_deg(d.heading_rad) % 180.0
        if self.covariance_m2 is None:
            return Place(latitude, longitude, bearing)
        east, north, both = self.covariance_m2
        own = [
            ((high - low) / 2.0 / _SIGMAS_95) ** 2
            for low, high in (d.intervals.get(f"position_{axis}_m", (0.0, 0.0)) for axis in "xy")
        ]
        turn = self.scene_to_east_north
        covariance = np.array([[east, both], [both, north]]) + turn @ np.diag(own) @ turn.T
        return Place(latitude, longitude, bearing, *np.sqrt(np.diag(covariance)).tolist())


@dataclass(frozen=True)
class Origin:
    """A datum as somebody stated it.

    Parameters
    ----------
    stamp_ns : int
        When.
    frame : str
        Name of the scene frame whose origin it is.
    datum : Datum
        Where that is.
    """

    stamp_ns: int
    frame: str
    datum: Datum


def origin_of(origins: Iterable[Origin], frame: str, last_ns: int | None = None) -> Origin | None:
    """Choose the origin that counts for a run: the newest in its frame before its end.

    Parameters
    ----------
    origins : iterable of Origin
        All that are known; of one stamp the later one counts.
    frame : str
        Frame of the run.
    last_ns : int, optional
        Stamp of its last pose. An origin that came later counts if there is no other: the earliest of them.

    Returns
    -------
    Origin or None
        None if nobody said anything of that frame.
    """
    own = sorted((one for one in origins if one.frame == frame), key=lambda one: one.stamp_ns)
    before = [one for one in own if last_ns is None or one.stamp_ns <= last_ns]
    return before[-1] if before else own[0] if own else None
