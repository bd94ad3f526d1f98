"""The coordinate system of a scene, in the words of charts.

A scene lies on the plane that touches the ellipsoid at its datum. Programs that read charts know no such
plane, but all know a transverse Mercator projection; one whose middle is the datum differs from the plane by
d³/(3R²) at a distance d: 0.01 mm at 1 km, 1 mm at 5 km.
"""

from __future__ import annotations

import math

from ..core.geometry import Datum, GroundGrid

#: WGS-84: half major axis (m), inverse flattening.
SEMI_MAJOR_M, INVERSE_FLATTENING = 6378137.0, 298.257223563
#: Longitude and latitude of WGS 84.
WGS_84 = "EPSG:4326"
_GEOGRAPHIC = (
    f'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",{SEMI_MAJOR_M:.0f},{INVERSE_FLATTENING}]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'
)


def scale_of(datum: Datum) -> float:
    """Return metres of the ellipsoid a metre of the seabed, which may lie kilometres above or below it."""
    flattening = 1.0 / INVERSE_FLATTENING
    e2 = flattening * (2.0 - flattening)
    w = 1.0 - e2 * math.sin(math.radians(datum.latitude_deg)) ** 2
    mean_radius = SEMI_MAJOR_M * math.sqrt(1.0 - e2) / w  # Gauss: root of meridian times prime vertical
    return mean_radius / (mean_radius + datum.altitude_m)


def chart_wkt(datum: Datum) -> str:
    """Return the chart of a scene as WKT: east and north of its origin, in metres of the seabed."""
    lat, lon = datum.latitude_deg, math.remainder(datum.longitude_deg, 360.0)
    return (
        f'PROJCS["sonar scene at {lat:.7f}, {lon:.7f} (WGS 84)",{_GEOGRAPHIC},'
        'PROJECTION["Transverse_Mercator"],'
        f'PARAMETER["latitude_of_origin",{lat!r}],PARAMETER["central_meridian",{lon!r}],'
        # A metre of the chart is one of the seabed.
        f'PARAMETER["scale_factor",{1.0 / scale_of(datum)!r}],'
        'PARAMETER["false_easting",0],PARAMETER["false_northing",0],'
        'UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    )


def lone_wkt(frame: str) -> str:
    """Return the coordinate system of a scene without a datum as WKT: metres of a place that nobody said."""
    name = "".join(c for c in frame if c.isprintable() and c not in '"\\')
    return f'LOCAL_CS["sonar scene {name} without a datum",UNIT["metre",1]]'


def wkt_of(datum: Datum | None, frame: str) -> str:
    """Return the coordinate system of a scene, with or without a datum."""
    return lone_wkt(frame) if datum is None else chart_wkt(datum)


def affine_of(grid: GroundGrid, datum: Datum | None) -> tuple[float, float, float, float, float, float]:
    """Return what leads from (column, row) of a pixel's upper left corner to the chart.

    Returns
    -------
    tuple of float
        a, b, c, d, e, f: easting = a col + b row + c, northing = d col + e row + f. A scene that is turned
        keeps its pixels; its raster is turned on the chart.
    """
    left, _, _, top = grid.extent_m
    d = grid.spacing_m
    turn = [[1.0, 0.0], [0.0, 1.0]] if datum is None else datum.scene_to_east_north.tolist()
    (ee, en), (ne, nn) = turn
    return (ee * d, -en * d, ee * left + en * top, ne * d, -nn * d, ne * left + nn * top)
