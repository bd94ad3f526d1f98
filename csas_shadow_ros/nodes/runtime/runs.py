"""Assign messages to runs: a message belongs to the run with a track over its stamp."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from csas_shadow_ros.core.geometry.runs import TrackBook
from msg_adapters import TOPICS, frame_of, message_from_cdr, track_piece_from_msg

from .. import qos

if TYPE_CHECKING:
    from .base import CsasNode

#: So long a message waits for a track that covers its stamp (s): a vehicle publishes its track at 1 Hz or
#: faster, and ten of these may be lost. At half of it a slow track costs views; at double nothing but memory.
HOLD_S = 10.0


class RunFollower:
    """Follows topic `track` and separates runs by it.

    Parameters
    ----------
    node : CsasNode
        The node.
    on_track : callable, optional
        Called with the run that a Path belongs to, and the names that have changed since.
    """

    def __init__(self, node: CsasNode, on_track: Callable[[int, dict[int, int]], None] | None = None) -> None:
        self.book = TrackBook()
        self._on_track = on_track
        self._frame = node.parameters.scene_frame
        # Raw: rclpy makes an object of each pose, which takes seconds where there are 200 000.
        node.subscribe_latched("track", self._take, profile=qos.TRACK, raw=True)

    def _take(self, cdr: bytes) -> None:
        path = message_from_cdr(cdr, TOPICS["track"].type_name, "track")
        frame_of(path, "track", self._frame)
        name = self.book.add(track_piece_from_msg(path))
        if self._on_track is not None:
            self._on_track(name, dict(self.book.renamed))

    def last_of(self, run_ns: int | None) -> int | None:
        """Return the stamp of a run's last pose; None without a track."""
        return self.book.span(run_ns)[1] if run_ns in self.book.names and run_ns is not None else None

    def run_of(self, stamp_ns: int) -> int | None:
        """Return the name of the run with a track over this stamp; None if there is none."""
        return self.book.run_of(stamp_ns)

    def hold(self, stamp_ns: int) -> tuple[str, float]:
        """Say why a message must wait, and for how long at most (s); empty if it need not.

        Where there is no track at all, all that comes is of one run.
        """
        if not self.book.names or self.run_of(stamp_ns) is not None:
            return "", 0.0
        spans = ", ".join("{} to {} ns".format(*self.book.span(name)) for name in self.book.names)
        return f"no track covers its stamp (tracks go from {spans})", HOLD_S

    def image_hold(self, stamp_ns: int) -> tuple[str, float]:
        """Say the same for an image, which waits for a track as long as there is none at all."""
        if not self.book.names:
            return "there is no track", math.inf
        return self.hold(stamp_ns)
