"""visualization_msgs/Marker CUBE to and from the carved box."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from csas_shadow_ros.core.errors import AdapterError
from csas_shadow_ros.core.shape.volume import Volume

from .mesh import ADD, DELETE, check_marker, colour, marker, pose
from .messages import MessageFactory, point, xyz_of

CUBE = 1
MARKER_NAMESPACE = "csas_target"
COLOUR = (0.2, 0.6, 1.0, 0.15)
#: Text of the marker of a run that is still going on: another one may follow, and replaces it.
MAY_MOVE = "may move"


@dataclass(frozen=True)
class TargetBox:
    """The carved volume.

    Parameters
    ----------
    centre_m : (float, float, float)
        Middle (x, y, z), scene frame.
    size_m : (float, float, float)
        Extent along (x, y, z).
    """

    centre_m: tuple[float, float, float]
    size_m: tuple[float, float, float]

    @classmethod
    def of(cls, volume: Volume) -> TargetBox:
        """Return the box of a voxel lattice."""
        return cls(volume.centre_m, volume.size_m)


def target_to_msg(
    factory: MessageFactory, box: TargetBox | None, stamp_ns: int, *, may_move: bool = False
) -> Any:
    """Make the Marker of the carved box; None means no object.

    Parameters
    ----------
    factory : MessageFactory
        Makes the message.
    box : TargetBox or None
        The box.
    stamp_ns : int
        Stamp; of a target that moves a later one each time.
    may_move : bool
        The run is still going on: another target may follow, and replaces this one.

    Raises
    ------
    AdapterError
        If the box has no size.
    """
    text = MAY_MOVE if may_move else ""
    if box is None:
        return marker(factory, stamp_ns, MARKER_NAMESPACE, CUBE, DELETE, text=text)
    if not min(box.size_m) > 0:
        raise AdapterError(f"target size is {box.size_m}; expected x, y, z > 0 m")
    return marker(
        factory,
        stamp_ns,
        MARKER_NAMESPACE,
        CUBE,
        ADD,
        pose=pose(factory, box.centre_m),
        scale=point(factory, box.size_m, "geometry_msgs/msg/Vector3"),
        color=colour(factory, COLOUR),
        text=text,
    )


def target_may_move(msg: Any) -> bool:
    """Say whether a target's marker belongs to a run that is still going on."""
    return str(getattr(msg, "text", "")) == MAY_MOVE


def target_from_msg(msg: Any) -> TargetBox | None:
    """Read the carved box; None if there is no object.

    Raises
    ------
    AdapterError
        If the marker is no upright cube in the scene frame, or has no size.
    """
    where = "target"
    if not check_marker(msg, CUBE, "CUBE", where):
        return None
    box = TargetBox(xyz_of(msg.pose.position, f"{where}.pose.position"), xyz_of(msg.scale, f"{where}.scale"))
    if not min(box.size_m) > 0:
        raise AdapterError(f"{where}.scale is {box.size_m}; expected x, y, z > 0 m")
    return box
