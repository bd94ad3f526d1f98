"""nav_msgs/Path to and from the sonar's track."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csas_shadow_ros.core.errors import AdapterError, CsasError, quoted
from csas_shadow_ros.core.geometry import Track, TrackPiece

from .messages import (
    MAX_COORDINATE_M,
    MAX_POSES,
    NANOSECONDS,
    MessageFactory,
    PackedPath,
    check_type,
    frame_of,
    make_header,
    point,
    stamp_to_ns,
)
from .topics import PATH

DEFAULT_MAX_GAP_RAD = math.radians(3.0)
#: A receiver that loses its fix for a moment is no reason to refuse a run: 7 of 720 poses, 3.5° of the
#: circle, hardly more than the gap that is bridged (3°). At half of it 3 poses; at double an arc is lost.
MAX_BAD_POSES = 0.01
#: So many of them are named one by one.
MAX_NOTES = 3
#: A few poses so long before or after all others (ns) were stamped by no clock that ran, or by another one:
#: a day. A circle takes minutes; at half of it and at double the same poses are found, of 1970 or of 2106.
MAX_PAUSE_NS = 86_400 * NANOSECONDS


def track_to_msg(factory: MessageFactory, track: Track) -> Any:
    """Make the Path of a track: one stamped pose per position, orientation identity.

    Raises
    ------
    AdapterError
        If a stamp is no ROS time.
    """
    factory = factory.in_frame(track.frame)
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
        Of either message world; every pose stamped, in the frame of its header or without one.
    max_gap_rad : float
        See `Track`.

    Raises
    ------
    AdapterError
        If a frame, a stamp or the positions are not usable as a track; the error names the pose.
    """
    stamps, positions, frame = _poses(msg)
    try:
        return Track(stamps, positions, max_gap_rad=max_gap_rad, frame=frame)
    except CsasError as error:
        raise AdapterError(f"track.poses: {error}") from error


def _bad_places(positions: NDArray[np.float64]) -> dict[int, str]:
    """Return the poses that are at no place a sonar can be, and why, by number."""
    bad: dict[int, str] = {}
    for i in np.flatnonzero(~np.isfinite(positions).all(axis=1)).tolist():
        bad[i] = f"track pose {i} is {_brief(positions[i])}; expected finite metres"
    for i in np.flatnonzero((np.abs(positions) > MAX_COORDINATE_M).any(axis=1)).tolist():
        bad.setdefault(
            i,
            f"track pose {i} is at {_brief(positions[i])} m; expected coordinates of at most"
            f" {MAX_COORDINATE_M:.6g} m",
        )
    for i in np.flatnonzero(positions[:, 2] <= 0.0).tolist():
        bad.setdefault(
            i, f"track pose {i} is at z = {positions[i, 2]:g} m; expected above the seabed (z > 0)"
        )
    for i in np.flatnonzero(np.hypot(positions[:, 0], positions[:, 1]) < 1e-9).tolist():
        bad.setdefault(i, f"track pose {i} is over the scene's origin: no aspect there")
    return bad


def track_piece_from_msg(msg: Any) -> TrackPiece:
    """Read a Path as poses of a run, whole or in part; orientations are not used.

    Parameters
    ----------
    msg : nav_msgs/Path
        Of either message world; every pose stamped, in the frame of its header or without one.

    Returns
    -------
    TrackPiece
        Without the poses that cannot be used (not finite, on no map of the Earth, not above the seabed, over
        the scene's origin, stamped out of order or more than a day off the others), if they are at most 1 %
        of all, or one. Its notes name them.

    Raises
    ------
    AdapterError
        If a frame or a stamp is not usable, there is no pose, or more poses cannot be used.
    """
    stamps, positions, frame = _poses(msg)
    n = len(stamps)
    if not n:
        raise AdapterError("track.poses: track has 0 poses; expected at least 1")
    header_ns = stamp_to_ns(msg.header.stamp, "track.header.stamp")
    bad = _bad_places(positions)
    low = np.flatnonzero(positions[:, 2] <= 0.0)
    good = [i for i in range(n) if i not in bad]
    times = stamps.tolist()
    last = -1
    for k, i in enumerate(good):
        after = times[good[k + 1]] if k + 1 < len(good) else None
        if last >= 0 and times[i] <= times[last]:
            bad[i] = f"pose {i} ({times[i]} ns) is not after pose {last} ({times[last]} ns)"
        elif after is not None and after < times[i] and (last < 0 or after > times[last]):
            # It is the one before that is out of order: all later ones would be, too.
            bad[i] = f"pose {i} ({times[i]} ns) is after pose {good[k + 1]} ({after} ns)"
        else:
            last = i
            continue
        bad[i] = f"track stamps are out of order: {bad[i]}"
    allowed = max(1, int(MAX_BAD_POSES * n))
    far = _far_in_time(stamps, [i for i in good if i not in bad])
    if len(bad) + len(far) <= allowed:
        bad |= far
    if len(bad) > allowed or len(bad) == n:
        first = min(bad)
        hint = ""
        if len(low) == n:
            hint = (
                "; all poses are: is z positive downwards, as in NED axes? z is the height above the seabed"
            )
        raise AdapterError(f"track.poses: {bad[first]} ({len(bad)} of {n} poses cannot be used){hint}")
    kept = np.array([i for i in range(n) if i not in bad], dtype=np.int64)
    notes = tuple(f"{bad[i]}: left out" for i in sorted(bad)[:MAX_NOTES])
    if len(bad) > MAX_NOTES:
        notes += (f"{len(bad) - MAX_NOTES} more track poses cannot be used: left out",)
    return TrackPiece(stamps[kept], positions[kept], header_ns, notes, frame=frame)


def _brief(xyz: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{v:.6g}" for v in xyz) + "]"


def _far_in_time(stamps: NDArray[np.int64], good: list[int]) -> dict[int, str]:
    """Return, by pose, why those that are more than a day off most of the others cannot be used."""
    if len(good) < 2:
        return {}
    parts = np.split(np.array(good), np.flatnonzero(np.diff(stamps[good]) > MAX_PAUSE_NS) + 1)
    most = max(parts, key=len)
    first, last = int(stamps[most[0]]), int(stamps[most[-1]])
    return {
        i: f"track pose {i} ({stamps[i]} ns) is more than a day off the others ({first} to {last} ns)"
        for part in parts
        if part is not most
        for i in part.tolist()
    }


def _poses(msg: Any) -> tuple[NDArray[np.int64], NDArray[np.float64], str]:
    check_type(msg, PATH, "track")
    frame = frame_of(msg, "track")
    read = _packed if getattr(msg, "table", None) is not None else _one_by_one
    stamps, positions = read(msg, frame)
    if len(stamps) > 1 and not stamps.any():
        raise AdapterError("track.poses: no pose is stamped (all are 0); expected when the sonar was there")
    return stamps, positions, frame


def _one_by_one(msg: Any, frame: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    n = len(msg.poses)
    if n > MAX_POSES:
        raise AdapterError(f"track has {n} poses; expected at most {MAX_POSES}")
    stamps = np.empty(n, np.int64)
    positions = np.empty((n, 3))
    for i, pose in enumerate(msg.poses):
        _check_pose_frame(i, pose.header.frame_id, frame)
        stamps[i] = stamp_to_ns(pose.header.stamp, f"track.poses[{i}].header.stamp")
        p = pose.pose.position
        positions[i] = p.x, p.y, p.z
    return stamps, positions


def _check_pose_frame(i: int, frame: str, expected: str) -> None:
    if frame not in ("", expected):
        raise AdapterError(f"track.poses[{i}].header.frame_id is {quoted(frame)}; expected {expected!r}")


def _packed(msg: PackedPath, expected: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    assert msg.table is not None
    times, positions, frame = msg.table
    _check_pose_frame(0, frame, expected)
    wrong = (times[:, 0] < 0) | (times[:, 1] >= NANOSECONDS)
    if wrong.any():
        i = int(wrong.argmax())
        sec, nanosec = times[i].tolist()
        raise AdapterError(
            f"track.poses[{i}].header.stamp is {sec} s {nanosec} ns; expected sec >= 0 and nanosec in"
            " [0, 1e9)"
        )
    return times[:, 0] * NANOSECONDS + times[:, 1], positions
