"""nav_msgs/Path to and from the sonar's track."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from csas_shadow_ros.core.errors import AdapterError, CsasError
from csas_shadow_ros.core.geometry import Track

from .messages import SCENE_FRAME, MessageFactory, check_frame, check_type, make_header, point, stamp_to_ns
from .topics import PATH

DEFAULT_MAX_GAP_RAD = math.radians(3.0)


def track_to_msg(factory: MessageFactory, track: Track) -> Any:
    """Make the Path of a track: one stamped pose a position, orientation identity.

    Raises
    ------
    AdapterError
        If a stamp is no ROS time.
    """
    identity = factory.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    poses = [
        factory.make(
            "geometry_msgs/msg/PoseStamped",
            header=make_header(factory, int(stamp)),
            pose=factory.make("geometry_msgs/msg/Pose", position=point(factory, xyz), orientation=identity),
        )
        for stamp, xyz in zip(track.stamps_ns, track.positions_m, strict=True)
    ]
    return factory.make(PATH, header=make_header(factory, int(track.stamps_ns[-1])), poses=poses)


def track_from_msg(msg: Any, max_gap_rad: float = DEFAULT_MAX_GAP_RAD) -> Track:
    """Read a Path as the sonar's track; orientations are not used.

    Parameters
    ----------
    msg : nav_msgs/Path
        Of either message world; every pose stamped, in `csas_scene`.
    max_gap_rad : float
        See `Track`.

    Raises
    ------
    AdapterError
        If a frame, a stamp or the positions are not usable as a track; the error names the pose.
    """
    check_type(msg, PATH, "track")
    check_frame(msg, "track")
    n = len(msg.poses)
    stamps = np.empty(n, np.int64)
    positions = np.empty((n, 3))
    for i, pose in enumerate(msg.poses):
        frame = pose.header.frame_id
        if frame not in ("", SCENE_FRAME):
            raise AdapterError(f"track.poses[{i}].header.frame_id is {frame!r}; expected {SCENE_FRAME!r}")
        stamps[i] = stamp_to_ns(pose.header.stamp, f"track.poses[{i}].header.stamp")
        p = pose.pose.position
        positions[i] = p.x, p.y, p.z
    if n > 1 and not stamps.any():
        raise AdapterError("track.poses: no pose is stamped (all are 0); expected when the sonar was there")
    try:
        return Track(stamps, positions, max_gap_rad=max_gap_rad)
    except CsasError as error:
        raise AdapterError(f"track.poses: {error}") from error


def track_piece_from_msg(msg):
    from csas_shadow_ros.core.geometry.runs import TrackPiece
    t = track_from_msg(msg)
    return TrackPiece(t.stamps_ns, t.positions_m, stamp_to_ns(msg.header.stamp))
