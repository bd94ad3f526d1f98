"""Quality of service of every topic, each with its reason."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

#: Views that may be in flight at once, at most: the queues of every stage hold so many.
MAX_WINDOW = 8


def _profile(depth: int, *, latched: bool, lossy: bool = False) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if lossy else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


#: Views: reliable, since a lost one spoils the result. Volatile: a late joiner gets them by flow control,
#: not from a history that would hold megabytes a view. The depth is that of the largest window.
VIEWS = _profile(MAX_WINDOW, latched=False)

#: Image, camera_info, track, target and results: the one current value, for whoever joins or restarts.
LATCHED = _profile(1, latched=True)

#: The track, which may come in pieces: a reader keeps several until it has time for them.
TRACK = _profile(64, latched=True)

#: The same topics from an outside publisher that does not latch: subscribed to besides `LATCHED`, since
#: a transient_local subscription does not match a volatile publisher.
UNLATCHED = _profile(8, latched=False)

#: The same where that publisher is best effort, as drivers are: a reliable subscription does not match it.
LOSSY = _profile(8, latched=False, lossy=True)

#: Reports of views: kept for a source that restarts, so that it need not send what is done already. Longer
#: runs only forget the oldest, which are then sent again and found to be in already.
REPORTS = _profile(4096, latched=True)

#: Heartbeats: only the last one means anything. transient_local, or it would not match `REPORTS` readers.
HEARTBEAT = _profile(1, latched=True)

#: /clock, as rosbag2 and simulators publish it: reliable, so that every reader takes it.
CLOCK = _profile(1, latched=False)

#: /diagnostics, as every ROS tool expects it.
DIAGNOSTICS = _profile(10, latched=False)
