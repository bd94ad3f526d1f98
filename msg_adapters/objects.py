"""visualization_msgs/MarkerArray to and from the objects of a run, for any viewer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from csas_shadow_ros.core.errors import AdapterError
from csas_shadow_ros.core.shape.mesh import Dimensions
from csas_shadow_ros.core.shape.result import Result

from .measurements import half_width, numbered_objects
from .mesh import ADD, DELETE, DELETE_ALL, colour, marker
from .messages import MessageFactory, check_type, frame_of, point, xyz_of
from .target import CUBE
from .topics import MARKERS

TEXT_VIEW_FACING = 9
OBJECTS, LABELS = "objects", "labels"
_BOX_COLOUR = (0.3, 0.9, 0.4, 0.35)
_TEXT_COLOUR = (1.0, 1.0, 1.0, 1.0)
#: Height of a label's letters, and of its middle above the object, as a share of the object's length.
_LETTERS, _ABOVE = 0.08, 0.3


@dataclass(frozen=True)
class ObjectBox:
    """An object as a box on the seabed.

    Parameters
    ----------
    number : int
        1 is the target.
    position_m : (float, float)
        Middle (x, y).
    size_m : (float, float, float)
        Length, width, height.
    heading_rad : float
        Direction of the length, counter-clockwise from +x, in [0, π).
    """

    number: int
    position_m: tuple[float, float]
    size_m: tuple[float, float, float]
    heading_rad: float


def objects_to_msg(
    factory: MessageFactory, result: Result, before: int = 0, stamp_ns: int | None = None
) -> Any:
    """Make the MarkerArray of a result's objects: a CUBE and a label each, DELETE for removed ones.

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    result : Result
        What the run leaves.
    before : int
        Highest number of an object that was published before.
    stamp_ns : int, optional
        Stamp, ns; that of the newest view in it by default.

    Raises
    ------
    AdapterError
        If an object is nowhere or has no size.
    """
    stamp = result.stamp_ns if stamp_ns is None else stamp_ns
    factory = factory.in_frame(result.frame)
    found = numbered_objects(result)
    markers: list[Any] = []
    for number, one in found.items():
        markers += _markers(factory, stamp, number, one.dimensions)
    for number in (n for n in range(1, before + 1) if n not in found):
        markers.append(marker(factory, stamp, OBJECTS, CUBE, DELETE, id=number))
        markers.append(marker(factory, stamp, LABELS, TEXT_VIEW_FACING, DELETE, id=number))
    return factory.make(MARKERS, markers=markers)


def _markers(factory: MessageFactory, stamp_ns: int, number: int, d: Dimensions) -> list[Any]:
    size, (x, y) = (d.length_m, d.width_m, d.height_m), d.position_m
    if not (min(size) > 0 and all(math.isfinite(v) for v in (*size, x, y, d.heading_rad))):
        raise AdapterError(
            f"object {number} is {size} m at {(x, y)}, heading {d.heading_rad} rad;"
            " expected finite numbers, and sizes > 0 m"
        )
    half = d.heading_rad / 2
    turned = factory.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))

    def pose(z: float) -> Any:
        place = point(factory, (x, y, z))
        return factory.make("geometry_msgs/msg/Pose", position=place, orientation=turned)

    def vector(*values: float) -> Any:
        return point(factory, values, "geometry_msgs/msg/Vector3")

    return [
        marker(
            factory,
            stamp_ns,
            OBJECTS,
            CUBE,
            ADD,
            id=number,
            pose=pose(d.height_m / 2),
            scale=vector(*size),
            color=colour(factory, _BOX_COLOUR),
        ),
        marker(
            factory,
            stamp_ns,
            LABELS,
            TEXT_VIEW_FACING,
            ADD,
            id=number,
            pose=pose(d.height_m + _ABOVE * d.length_m),
            scale=vector(0.0, 0.0, _LETTERS * d.length_m),
            color=colour(factory, _TEXT_COLOUR),
            text=label_text(number, d),
        ),
    ]


def label_text(number: int, d: Dimensions) -> str:
    """Write an object's figures, each with half of its 95 % interval, if any."""

    def metres(name: str) -> str:
        return f"{getattr(d, name):.3f}{half_width(d, name)}"

    heading = half_width(d, "heading_rad", math.degrees(1.0), 1)
    return (
        f"object {number}\n"
        f"{metres('length_m')} x {metres('width_m')} x {metres('height_m')} m\n"
        f"heading {math.degrees(d.heading_rad):.1f}{heading} deg\n"
        f"volume {metres('volume_m3')} m³"
    )


def objects_from_msg(msg: Any) -> list[tuple[int, ObjectBox]]:
    """Read the objects as boxes, by rising number; skip labels and removed objects.

    Measures and their intervals stand in `measurements`, to the last digit; a heading is here to rounding.

    Raises
    ------
    AdapterError
        If a box is no CUBE in the scene frame, is tilted, has no number or no size, or two have one number.
    """
    check_type(msg, MARKERS, "objects")
    found: dict[int, ObjectBox] = {}
    for i, one in enumerate(msg.markers):
        where = f"objects.markers[{i}]"
        action = int(one.action)
        if one.ns != OBJECTS or action in (DELETE, DELETE_ALL):
            continue
        if action != ADD:
            raise AdapterError(f"{where}.action is {action}; expected 0 (ADD), 2 (DELETE) or 3 (DELETEALL)")
        frame_of(one, where)
        if int(one.type) != CUBE:
            raise AdapterError(f"{where}.type is {one.type}; expected {CUBE} (CUBE)")
        number = int(one.id)
        if number < 1 or number in found:
            raise AdapterError(f"{where}.id is {number}; expected a number of its own, from 1")
        q = one.pose.orientation
        norm = math.hypot(q.x, q.y, q.z, q.w)
        if not (abs(norm - 1.0) < 1e-6 and math.hypot(q.x, q.y) < 1e-9):
            raise AdapterError(
                f"{where}.pose.orientation is ({q.x:g}, {q.y:g}, {q.z:g}, {q.w:g}); expected a turn about z"
            )
        x, y, _ = xyz_of(one.pose.position, f"{where}.pose.position")
        size = xyz_of(one.scale, f"{where}.scale")
        if not min(size) > 0:
            raise AdapterError(f"{where}.scale is {size}; expected length, width, height > 0 m")
        found[number] = ObjectBox(number, (x, y), size, 2.0 * math.atan2(q.z, q.w) % math.pi)
    return sorted(found.items())
