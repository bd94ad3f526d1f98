"""sensor_msgs/NavSatFix and geometry_msgs/TransformStamped to and from a scene's place on earth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csas_shadow_ros.core.errors import AdapterError, CsasError
from csas_shadow_ros.core.geometry import Datum, Origin

from .messages import MessageFactory, check_type, frame_of, make_header, point, stamp_to_ns
from .topics import NAV_SAT_FIX, TRANSFORM

#: REP 105's name of the earth-centred, earth-fixed frame.
EARTH = "earth"
#: Of NavSatStatus. Who does not fill it in leaves -2, unknown, which is taken.
_FIX, _NO_FIX = 0, -1
#: Of NavSatFix: what is known of the covariance.
_UNKNOWN, _KNOWN = 0, 3


def origin_to_msg(factory: MessageFactory, origin: Origin) -> Any:
    """Make the NavSatFix of a scene's origin; it has no place for a heading."""
    datum = origin.datum
    covariance = np.zeros(9)
    if datum.covariance_m2 is not None:
        east, north, both = datum.covariance_m2
        covariance[[0, 4, 1, 3]] = east, north, both, both
    return factory.make(
        NAV_SAT_FIX,
        header=make_header(factory.in_frame(origin.frame), origin.stamp_ns),
        status=factory.make("sensor_msgs/msg/NavSatStatus", status=_FIX),
        latitude=float(datum.latitude_deg),
        longitude=float(datum.longitude_deg),
        altitude=float(datum.altitude_m),
        position_covariance=covariance,
        position_covariance_type=_UNKNOWN if datum.covariance_m2 is None else _KNOWN,
    )


def origin_from_msg(msg: Any) -> Origin:
    """Read a scene's origin: x east and y north, since a NavSatFix has no heading.

    Parameters
    ----------
    msg : sensor_msgs/NavSatFix
        Of either message world. An altitude of NaN is not known: 0 is taken.

    Raises
    ------
    AdapterError
        If it is no fix, or a value is out of range.
    """
    where = "origin"
    check_type(msg, NAV_SAT_FIX, where)
    frame = frame_of(msg, where)
    if int(msg.status.status) == _NO_FIX:
        raise AdapterError(f"{where}.status.status is {_NO_FIX} (no fix); expected a fix, 0 or more")
    c = np.array(msg.position_covariance, dtype=np.float64)
    covariance = None
    if int(msg.position_covariance_type) != _UNKNOWN:
        covariance = float(c[0]), float(c[4]), float(c[1])
    altitude = float(msg.altitude)
    try:
        datum = Datum(
            float(msg.latitude),
            float(msg.longitude),
            altitude_m=0.0 if math.isnan(altitude) else altitude,
            covariance_m2=covariance,
        )
    except CsasError as error:
        raise AdapterError(f"{where}: {error}") from error
    return Origin(stamp_to_ns(msg.header.stamp, f"{where}.header.stamp"), frame, datum)


def scene_transform_to_msg(
    factory: MessageFactory,
    origin: Origin,
    parent_frame: str = EARTH,
    parent_deg: tuple[float, float] | None = None,
) -> Any:
    """Make the transform from the scene to a frame of the earth.

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    origin : Origin
        Where the scene is.
    parent_frame : str
        ``earth``: REP 105's earth-centred frame. Any other is taken for an east-north-up one.
    parent_deg : (float, float), optional
        Latitude and longitude of that frame's origin, at altitude 0. The scene's own origin, at the seabed,
        if not given.

    Raises
    ------
    AdapterError
        If the parent is the scene itself.
    """
    if parent_frame == origin.frame:
        raise AdapterError(f"parent_frame is {parent_frame!r}, as the scene's frame; expected another")
    rotation, translation = origin.datum.scene_to_earth
    if parent_frame != EARTH:
        parent = Datum(*parent_deg) if parent_deg is not None else None
        place = translation if parent is None else parent.scene_to_earth[1]
        down = (parent or origin.datum).east_north_up_to_earth.T
        rotation, translation = down @ rotation, down @ (translation - place)
    header = make_header(factory.in_frame(parent_frame), origin.stamp_ns)
    x, y, z, w = _quaternion(rotation)
    return factory.make(
        TRANSFORM,
        header=header,
        child_frame_id=origin.frame,
        transform=factory.make(
            "geometry_msgs/msg/Transform",
            translation=point(factory, translation, "geometry_msgs/msg/Vector3"),
            rotation=factory.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
    )


def _quaternion(rotation: Any) -> tuple[float, float, float, float]:
    """Return (x, y, z, w) of a rotation matrix."""
    from scipy.spatial.transform import Rotation  # late: whoever only reads messages needs none of it

    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return x, y, z, w
