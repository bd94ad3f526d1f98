"""visualization_msgs/MarkerArray of the objects: what RViz and Foxglove draw, and where each is."""

from __future__ import annotations

import math
from typing import Any

from csas_shadow_ros.core.errors import AdapterError
from csas_shadow_ros.core.mesh import Dimensions
from csas_shadow_ros.core.shape.result import Result

from .measurements import figures
from .mesh import ADD, DELETE, DELETE_ALL, colour, marker, pose
from .messages import MessageFactory, check_frame, check_type, point, xyz_of
from .target import CUBE
from .topics import MARKERS

TEXT = 9
OBJECTS, LABELS = "objects", "labels"
_COLOURS = {
    "good": (0.2, 0.9, 0.3, 0.35),
    "limited": (1.0, 0.8, 0.1, 0.35),
    "not trustworthy": (1.0, 0.25, 0.2, 0.35),
}
_WHITE = (1.0, 1.0, 1.0, 1.0)


def objects_to_msg(factory: MessageFactory, result: Result, stamp_ns: int, before: int = 0) -> Any:
    """Make the message of topic `objects`.

    Parameters
    ----------
    factory : MessageFactory
        Makes the message.
    result : Result
        What was found.
    stamp_ns : int
        Stamp.
    before : int
        How many objects were told last: those that are gone are taken away.
    """
    markers = []
    objects = result.objects
    for number, one in enumerate(objects, start=1):
        d = one.dimensions
        size = (d.length_m, d.width_m, d.height_m)
        middle = pose(factory, (*d.position_m, d.height_m / 2.0))
        middle.orientation.z = math.sin(d.heading_rad / 2.0)
        middle.orientation.w = math.cos(d.heading_rad / 2.0)
        text_size = max(0.05, 0.15 * d.length_m)
        label = pose(factory, (*d.position_m, d.height_m + text_size))
        markers += [
            _numbered(
                marker(
                    factory,
                    stamp_ns,
                    OBJECTS,
                    CUBE,
                    ADD,
                    pose=middle,
                    scale=point(factory, [max(s, 1e-6) for s in size], "geometry_msgs/msg/Vector3"),
                    color=colour(factory, _COLOURS[result.quality.verdict]),
                ),
                number,
            ),
            _numbered(
                marker(
                    factory,
                    stamp_ns,
                    LABELS,
                    TEXT,
                    ADD,
                    pose=label,
                    scale=point(factory, (0.0, 0.0, text_size), "geometry_msgs/msg/Vector3"),
                    color=colour(factory, _WHITE),
                    text=_label(number, d),
                ),
                number,
            ),
        ]
    for number in range(len(objects) + 1, before + 1):
        markers += [
            _numbered(marker(factory, stamp_ns, ns, kind, DELETE), number)
            for ns, kind in ((OBJECTS, CUBE), (LABELS, TEXT))
        ]
    return factory.make(MARKERS, markers=markers)


def _numbered(made: Any, number: int) -> Any:
    made.id = number
    return made


def _label(number: int, d: Dimensions) -> str:
    lines = [f"object {number}", figures(d)]
    halves = [
        (high - low) / 2.0
        for low, high in (d.intervals[n] for n in ("length_m", "width_m", "height_m") if n in d.intervals)
    ]
    if len(halves) == 3:
        lines.append("95 %: " + " x ".join(f"± {half:.3f}" for half in halves) + " m")
    return "\n".join(lines)


def objects_from_msg(msg: Any) -> dict[int, Dimensions | None]:
    """Read the boxes of topic `objects`, by number; None for what is gone.

    Raises
    ------
    AdapterError
        If a box is no cube that stands upright in the scene frame, or has no size.
    """
    check_type(msg, MARKERS, "objects")
    found: dict[int, Dimensions | None] = {}
    for index, one in enumerate(msg.markers):
        where = f"objects.markers[{index}]"
        if one.ns != OBJECTS:
            continue
        if int(one.action) in (DELETE, DELETE_ALL):
            found[int(one.id)] = None
            continue
        check_frame(one, where)
        if int(one.type) != CUBE:
            raise AdapterError(f"{where}.type is {one.type}; expected {CUBE} (CUBE)")
        q = one.pose.orientation
        if abs(q.x) > 1e-9 or abs(q.y) > 1e-9:
            raise AdapterError(f"{where}.pose.orientation leans; expected a turn about z alone")
        x, y, _ = xyz_of(one.pose.position, f"{where}.pose.position")
        length, width, height = xyz_of(one.scale, f"{where}.scale")
        if min(length, width, height) <= 0:
            raise AdapterError(f"{where}.scale is {(length, width, height)}; expected x, y, z > 0 m")
        heading = 2.0 * math.atan2(q.z, q.w) % math.pi
        found[int(one.id)] = Dimensions(length, width, height, length * width * height, heading, (x, y))
    return found
