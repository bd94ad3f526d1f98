"""visualization_msgs/Marker TRIANGLE_LIST to and from a triangle mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from csas_shadow_ros.core.errors import AdapterError

from .messages import MessageFactory, check_type, frame_of, make_header, point
from .topics import MARKER

if TYPE_CHECKING:
    import trimesh

TRIANGLE_LIST = 11
ADD, DELETE, DELETE_ALL = 0, 2, 3
MARKER_NAMESPACE = "csas_mesh"
COLOUR = (0.85, 0.65, 0.25, 1.0)


def marker(
    factory: MessageFactory, stamp_ns: int, namespace: str, kind: int, action: int, **fields: Any
) -> Any:
    """Make a Marker with an identity pose unless one is given."""
    defaults: dict[str, Any] = {
        "id": 0,
        "pose": pose(factory, (0.0, 0.0, 0.0)),
        "scale": point(factory, (1.0, 1.0, 1.0), "geometry_msgs/msg/Vector3"),
    }
    return factory.make(
        MARKER,
        header=make_header(factory, stamp_ns),
        ns=namespace,
        type=kind,
        action=action,
        **(defaults | fields),
    )


def pose(factory: MessageFactory, xyz: tuple[float, float, float]) -> Any:
    """Make an upright Pose at a scene position."""
    identity = factory.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    return factory.make("geometry_msgs/msg/Pose", position=point(factory, xyz), orientation=identity)


def colour(factory: MessageFactory, rgba: tuple[float, float, float, float]) -> Any:
    """Make a ColorRGBA."""
    r, g, b, a = rgba
    return factory.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=a)


def check_marker(msg: Any, kind: int, name: str, where: str) -> bool:
    """Check a marker's type, frame and pose; return False if it means no object.

    Raises
    ------
    AdapterError
        If it is another kind of marker, in another frame, turned, or its action is unknown.
    """
    check_type(msg, MARKER, where)
    action = int(msg.action)
    if action in (DELETE, DELETE_ALL):
        return False
    if action != ADD:
        raise AdapterError(f"{where}.action is {action}; expected 0 (ADD), 2 (DELETE) or 3 (DELETEALL)")
    frame_of(msg, where)
    if int(msg.type) != kind:
        raise AdapterError(f"{where}.type is {msg.type}; expected {kind} ({name})")
    q = msg.pose.orientation
    if not (abs(q.x) < 1e-9 and abs(q.y) < 1e-9 and abs(q.z) < 1e-9):
        raise AdapterError(
            f"{where}.pose.orientation is ({q.x:g}, {q.y:g}, {q.z:g}, {q.w:g}); expected none (0, 0, 0, 1)"
        )
    return True


def mesh_to_msg(factory: MessageFactory, mesh: trimesh.Trimesh | None, stamp_ns: int) -> Any:
    """Make the Marker of a mesh in metres, scene frame; no mesh (or an empty one) deletes it.

    Raises
    ------
    AdapterError
        If a vertex is not finite.
    """
    if mesh is None or len(mesh.faces) == 0:
        return marker(factory, stamp_ns, MARKER_NAMESPACE, TRIANGLE_LIST, DELETE)
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)].reshape(-1, 3)
    if not np.isfinite(corners).all():
        raise AdapterError("mesh has a vertex that is not finite; expected metres")
    make_point = factory.cls("geometry_msgs/msg/Point")
    points = [make_point(x=x, y=y, z=z) for x, y, z in corners.tolist()]
    return marker(
        factory,
        stamp_ns,
        MARKER_NAMESPACE,
        TRIANGLE_LIST,
        ADD,
        points=points,
        color=colour(factory, COLOUR),
    )


def mesh_from_msg(msg: Any, where: str = "mesh") -> trimesh.Trimesh | None:
    """Read a mesh (equal corners merged to one vertex); None if the marker deletes it.

    Parameters
    ----------
    msg : visualization_msgs/Marker
        Of either message world.
    where : str
        Its topic, for errors.

    Raises
    ------
    AdapterError
        If the marker is no triangle list in the scene frame, or its points are no triangles.
    """
    if not check_marker(msg, TRIANGLE_LIST, "TRIANGLE_LIST", where):
        return None
    n = len(msg.points)
    if n == 0 or n % 3:
        raise AdapterError(f"{where}.points has {n} points; expected three a triangle")
    s, p = msg.scale, msg.pose.position
    scale, offset = np.array([s.x, s.y, s.z]), np.array([p.x, p.y, p.z])
    corners = np.array([(q.x, q.y, q.z) for q in msg.points], np.float64) * scale + offset
    if not np.isfinite(corners).all():
        bad = int(np.flatnonzero(~np.isfinite(corners).all(axis=1))[0])
        raise AdapterError(f"{where}.points[{bad}] is {corners[bad].tolist()}; expected finite metres")
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    import trimesh  # late: it takes longer to import than all else here

    return trimesh.Trimesh(vertices, index.reshape(-1, 3), process=False)
