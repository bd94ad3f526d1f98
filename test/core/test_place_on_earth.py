"""Scene metres to latitude and longitude and back, and where on earth an object is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from csas_shadow_ros.core.errors import ParameterError
from csas_shadow_ros.core.geometry import Datum, Origin, origin_of
from csas_shadow_ros.core.parameters import PlaceParameters
from csas_shadow_ros.core.shape.mesh import Dimensions

PLACES = [(48.3829, -4.4953), (-33.86, 151.21), (0.0, 0.0), (69.65, 18.96), (-77.8, -179.9999), (89.9, 40.0)]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("heading_deg", [0.0, 37.0, -120.0])
def test_a_point_comes_back_to_where_it_was(place: tuple[float, float], heading_deg: float) -> None:
    datum = Datum(*place, heading_deg, altitude_m=-42.0)
    for x, y in ((0.0, 0.0), (100.0, 0.0), (-30.0, 70.0), (2000.0, -1500.0)):
        # 2.5 km away the plane is 0.5 m over the ellipsoid: 0.2 mm across.
        assert np.allclose(datum.to_scene(*datum.to_latlon(x, y)), (x, y), atol=1e-3)
    assert datum.to_latlon(0.0, 0.0) == pytest.approx(place, abs=1e-11)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("heading_deg", [0.0, 37.0, -120.0])
def test_it_agrees_with_proj_to_a_centimetre_at_100_m(place: tuple[float, float], heading_deg: float) -> None:
    pyproj = pytest.importorskip("pyproj")
    datum, (lat, lon) = Datum(*place, heading_deg), place
    to_plane = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=cart +ellps=WGS84"
        f" +step +proj=topocentric +ellps=WGS84 +lat_0={lat} +lon_0={lon} +h_0=0"
    )
    geod = pyproj.Geod(ellps="WGS84")
    for azimuth in range(0, 360, 30):
        angle = math.radians(90.0 - azimuth)  # of the scene
        x, y = 100.0 * math.cos(angle), 100.0 * math.sin(angle)
        latitude, longitude = datum.to_latlon(x, y)
        east, north, _ = to_plane.transform(longitude, latitude, 0.0, radians=False)
        # Scene y points to the heading: a scene azimuth is that much further round.
        bearing = math.radians(azimuth + heading_deg)
        assert math.hypot(east - 100 * math.sin(bearing), north - 100 * math.cos(bearing)) < 0.01
        along, _, metres = geod.inv(lon, lat, longitude, latitude)
        assert metres == pytest.approx(100.0, abs=0.01)
        assert math.remainder(along - datum.bearing_deg(angle), 360.0) == pytest.approx(0.0, abs=0.01)


def test_a_step_along_the_meridian_and_the_parallel_follows_the_radii_of_curvature() -> None:
    """M and N of the ellipsoid as every textbook of geodesy has them, from a and b alone."""
    a, b, lat = 6378137.0, 6356752.314245, math.radians(48.0)
    w = math.sqrt((a * math.cos(lat)) ** 2 + (b * math.sin(lat)) ** 2)
    meridian, normal = (a * b) ** 2 / w**3, a**2 / w
    datum = Datum(48.0, -4.5)
    north, east = datum.to_latlon(0.0, 100.0), datum.to_latlon(100.0, 0.0)
    assert math.radians(north[0] - 48.0) * meridian == pytest.approx(100.0, abs=0.001)
    assert math.radians(east[1] + 4.5) * normal * math.cos(lat) == pytest.approx(100.0, abs=0.001)
    assert north[1] == pytest.approx(-4.5, abs=1e-12)


def test_the_scene_turned_by_the_heading_is_the_scene_on_the_earth() -> None:
    """Rotation and translation to the earth's axes give the same points as latitude and longitude."""
    datum = Datum(10.0, 20.0, 30.0)
    rotation, translation = datum.scene_to_earth
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    radial = translation / np.linalg.norm(translation)
    assert rotation[:, 2] @ radial > 0.99999  # up points away from the earth, but for its flattening
    y_axis = Datum(10.0, 20.0).to_scene(*datum.to_latlon(0.0, 10.0))
    assert np.allclose(y_axis, (10 * math.sin(math.radians(30)), 10 * math.cos(math.radians(30))), atol=1e-5)


def box(heading_deg: float = 20.0) -> Dimensions:
    half = 0.02
    return Dimensions(
        1.0,
        0.5,
        0.4,
        0.2,
        math.radians(heading_deg),
        (3.0, 4.0),
        intervals={
            "position_x_m": (3.0 - half, 3.0 + half),
            "position_y_m": (4.0 - half / 2, 4.0 + half / 2),
        },
    )


def test_an_objects_bearing_is_true_and_its_place_as_sure_as_datum_and_measure_together() -> None:
    place = Datum(48.0, -4.5, 90.0, covariance_m2=(4.0, 1.0, 0.3)).place_of(box())
    # The scene's y axis points east, so +x points south; 20° counter-clockwise of it is 160° true.
    assert place.bearing_deg == pytest.approx(160.0)
    sigma_x, sigma_y = 0.02 / 1.959964, 0.01 / 1.959964
    assert place.sigma_east_m == pytest.approx(math.hypot(2.0, sigma_y))
    assert place.sigma_north_m == pytest.approx(math.hypot(1.0, sigma_x))
    assert (place.latitude_deg, place.longitude_deg) == Datum(48.0, -4.5, 90.0).to_latlon(3.0, 4.0)
    unsure = Datum(48.0, -4.5).place_of(box())
    assert math.isnan(unsure.sigma_east_m)
    assert "±" not in str(unsure)
    assert str(place).endswith("W (± 3.92 m)")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"latitude_deg": 91.0}, r"latitude of the origin is 91°; expected a number in \[-90, 90\]°"),
        ({"longitude_deg": math.nan}, "longitude of the origin is nan°"),
        ({"heading_deg": math.inf}, "heading of the origin is inf°"),
        ({"altitude_m": 1e6}, "altitude of the origin is 1e"),
        ({"covariance_m2": (-1.0, 1.0, 0.0)}, "covariance of the origin is"),
        ({"covariance_m2": (1.0, 1.0, 2.0)}, "covariance of the origin is"),
    ],
)
def test_what_is_no_place_is_refused(change: dict[str, object], match: str) -> None:
    with pytest.raises(ParameterError, match=match):
        Datum(**({"latitude_deg": 1.0, "longitude_deg": 2.0} | change))  # type: ignore[arg-type]


def test_the_newest_origin_of_the_frame_before_the_runs_end_counts() -> None:
    def at(stamp: int, frame: str, latitude: float) -> Origin:
        return Origin(stamp, frame, Datum(latitude, 0.0))

    said = [at(5, "a", 1.0), at(0, "a", 2.0), at(7, "b", 3.0), at(9, "a", 4.0)]
    assert origin_of(said, "a", 8) == said[0]
    assert origin_of(said, "a", 9) == said[3]
    assert origin_of(said, "a") == said[3]
    assert origin_of(said, "b", 1) == said[2]  # the only one, though it came late
    assert origin_of(said, "c", 8) is None


def test_a_latitude_without_a_longitude_is_refused() -> None:
    with pytest.raises(ParameterError, match="origin_lat_deg is given, origin_lon_deg is not; expected both"):
        PlaceParameters.from_mapping({"origin_lat_deg": 48.0})


def test_given_parameters_come_before_what_a_topic_says_and_a_given_heading_turns_it() -> None:
    said = Datum(1.0, 2.0, covariance_m2=(4.0, 9.0, 0.0))
    assert PlaceParameters().datum() is None
    assert PlaceParameters().datum(said) is said
    turned = PlaceParameters(origin_heading_deg=45.0).datum(said)
    assert turned == Datum(1.0, 2.0, 45.0, covariance_m2=(4.0, 9.0, 0.0))
    given = PlaceParameters(origin_lat_deg=3.0, origin_lon_deg=4.0, origin_sigma_m=2.0).datum(said)
    assert given == Datum(3.0, 4.0, covariance_m2=(4.0, 4.0, 0.0))
