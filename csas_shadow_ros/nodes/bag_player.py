"""Node `bag_player`: plays a run from a bag; raw messages go out as they were recorded."""

from __future__ import annotations

import sys
import time
from typing import Any

from csas_shadow_ros.bags import BagReader, MessagePair, iterate_pairs
from csas_shadow_ros.bags.pairs import Problem
from csas_shadow_ros.bags.tracks import BagRuns
from csas_shadow_ros.core.errors import BagError, CsasError, ParameterError
from msg_adapters import coherent_image_from_msgs, stamp_from_ns, track_to_msg

from . import qos
from .playing import BagViews, schedule, stage_of_bag
from .runtime.base import CsasNode, Source, run_node


class BagPlayerNode(CsasNode):
    """Publishes image and track (latched), or the views of one stage (under flow control)."""

    name = "bag_player"

    def setup(self) -> None:
        """Open the bag and serve its latched topics."""
        if not self.parameters.bag:
            raise ParameterError("bag is ''; expected the path of a bag")
        self.reader = BagReader(self.parameters.bag, self.parameters.bag_namespace or None)
        self.views: BagViews | None = None
        self._began: tuple[float, float] | None = None
        #: The view that was sent last, and when the latched image was recorded.
        self._sent: int | None = None
        self._latched_ns = 0
        #: When the next view is to be sent at the chosen rate, on the monotonic clock.
        self._due_s = 0.0
        stage = stage_of_bag(self.reader, self.parameters.stage)
        self.runs = BagRuns(self.reader, self._problem, self.parameters.run or None)
        self.get_logger().info(f"plays {stage} of {self.parameters.bag}")
        if stage == "image":
            self.latch_image()
        else:
            self.views = BagViews(self.reader, stage, self.runs.covers)
            self._schedule, notes = schedule(self.views.times)
            for note in notes if self.parameters.rate > 0 else ():
                self.get_logger().warning(note)
            self.source = Source(self, stage, self.send_view, self.may_send)
            self.source.flow.offer(self.views.times)
            self.latch("target")
        self.latch_track()
        self.latch_origin()
        if self.parameters.clock_hz > 0:
            self.start_clock()
        for line in (*self.reader.problems, *(self.views.problems if self.views else ())):
            self.reject(line)

    # Latched topics

    def latch(self, relative: str, cdr: Any = None) -> None:
        """Latch one message of a topic, by default the bag's last one."""
        if cdr is None:
            for message in self.reader.messages([relative]):
                cdr = message.cdr
        if cdr is not None:
            self.publisher(relative, qos.LATCHED).publish(bytes(cdr))

    def latch_image(self) -> None:
        """Latch the first usable image; if there is none, an unusable one, so that it is named."""
        found = self.reader.topic("image")
        alone = found is not None and found.count == 1 and len(self.runs.names) < 2
        chosen: MessagePair | None = None
        for pair in iterate_pairs(self.reader, "image", self._problem):
            if not alone and not self.runs.covers(pair.stamp_ns):
                continue
            chosen = pair
            if alone:
                break  # whoever takes it looks at its pixels
            try:
                coherent_image_from_msgs(pair.image, pair.info)
                break
            except CsasError as error:
                self._problem(Problem(pair.topic, pair.number, pair.stamp_ns, str(error)))
        if chosen is None:
            raise BagError(f"{self.parameters.bag} holds no image with a camera_info of the same stamp")
        self._latched_ns = chosen.stamp_ns
        self.latch("camera_info", chosen.info_cdr)
        self.latch("image", chosen.image_cdr)

    def latch_track(self) -> None:
        """Latch all of the run's poses in the bag's Paths, as one message."""
        name = self.runs.name
        if name is not None:
            path = track_to_msg(self.messages, self.runs.book.track(name))
            self.publisher("track", qos.LATCHED).publish(path)

    def latch_origin(self) -> None:
        """Latch the run's place on earth as the bag recorded it."""
        said = self.runs.origin(self._problem)
        if said is not None:
            self.latch("origin", said[1])

    def _problem(self, problem: Problem) -> None:
        self.reject(str(problem))

    # Time

    def start_clock(self) -> None:
        """Start publishing the recording's time."""
        from rosgraph_msgs.msg import Clock

        publisher = self.own_publisher(Clock, "/clock", qos.CLOCK)

        def tell() -> None:
            if self.active:
                publisher.publish(Clock(clock=stamp_from_ns(self.messages, self.recorded_ns())))

        self.every(1.0 / self.parameters.clock_hz, tell)

    def recorded_ns(self) -> int:
        """Return the present time of the recording; for a latched image the end of its run."""
        if self.views is None:
            return self._latched_ns
        times = self.views.times
        if self._sent is None or self._began is None:
            return next(iter(times.values()), 0)
        first_ns, at_s = next(iter(times.values())), self._schedule[self._sent]
        if (rate := self.parameters.rate) > 0:
            since, first = self._began
            later = [at for at in self._schedule.values() if at > at_s]
            # Time goes on between two views, and waits for the next one where that is late.
            now_s = first + (time.monotonic() - since) * rate
            at_s = max(at_s, min(now_s, later[0] if later else at_s))
        return first_ns + round(at_s * 1e9)

    # Views

    def may_send(self, stamp: int) -> bool:
        """Say whether the view's time has come, at the chosen rate."""
        rate = self.parameters.rate
        if rate <= 0 or self.views is None:
            return True
        if self._began is None:
            return True
        since, first = self._began
        self._due_s = since + (self._schedule[stamp] - first) / rate
        return time.monotonic() >= self._due_s

    def state_values(self) -> dict[str, str]:
        """Return the remaining time until the next view is due."""
        wait_s = self._due_s - time.monotonic()
        return {"due_in_s": f"{wait_s:.1f}"} if wait_s > 0 and not self.source.flow.in_flight else {}

    def send_view(self, stamp: int) -> None:
        """Publish a view as it was recorded."""
        if self.views is None:
            raise BagError(f"view {stamp} ns requested, but the player plays the bag's image")
        image, info = self.views.get(stamp)
        if self._began is None:
            self._began = (time.monotonic(), self._schedule[stamp])
        if self._sent is None or self._schedule[stamp] > self._schedule[self._sent]:
            self._sent = stamp  # one that is sent again turns no clock back
        self.source.info.publish(info)
        self.source.image.publish(image)


def main() -> int:
    """Run the node."""
    return run_node(BagPlayerNode)


if __name__ == "__main__":
    sys.exit(main())
