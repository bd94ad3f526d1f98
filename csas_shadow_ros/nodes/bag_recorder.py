"""Node `bag_recorder`: records the contract's topics into a bag, as they come, and loses no view."""

from __future__ import annotations

import fcntl
import sys
import time
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

from csas_shadow_ros.bags import BagReader, BagWriter
from csas_shadow_ros.core.errors import BagError, ParameterError
from msg_adapters import STREAMS, TOPICS, Heartbeat
from msg_adapters.topics import absolute_name

from . import qos
from .base import INTEGRATED, CsasNode, Inlet, run_node
from .playing import header_stamp, recorded_streams, topics_to_record

#: Latched when they were published, and so when they are played.
_LATCHED = frozenset(
    {"image", "camera_info", "track", "target", "voxels", "mesh"}
    | {
        topic
        for stream in ("multilook", "color_by_aspect", "voxel_grid", "voxel_views")
        for topic in (STREAMS[stream].image_topic, STREAMS[stream].info_topic)
    }
)
#: Topics of messages that differ though they carry the same stamp.
_NEVER_ALIKE = frozenset({"progress", "/diagnostics"})
_FLUSH_S = 1.0


class RecordingInlet(Inlet):
    """The reports of a recorded stream of views: a sink, but only while somebody publishes the stream."""

    def __init__(self, node: BagRecorderNode, stream: str) -> None:
        # No subscriptions of its own: the recorder's raw ones serve all topics alike.
        self.node = node
        self.stream = stream
        self.role = "sink"
        self.instance = f"{node.instance}-{stream}"
        self.stamps: dict[bool, set[int]] = {False: set(), True: set()}

    def wrote(self, stamp: int, *, is_info: bool) -> None:
        """Note that one of a pair is in the bag; report the view once both are."""
        self.stamps[is_info].add(stamp)
        if stamp in self.stamps[not is_info]:
            self.report(stamp, INTEGRATED)

    def report_taken_over(self) -> None:
        """Report what is in the bag already."""
        for stamp in sorted(self.stamps[False] & self.stamps[True]):
            self.report(stamp, INTEGRATED, **self._idle())

    def _idle(self) -> dict[str, str]:
        # Right after the start this also means: not discovered yet.
        published = self.node.count_publishers(STREAMS[self.stream].image_topic)
        return {} if published else {"idle": "true"}

    def give_up_lonely(self) -> None:
        """Nothing is kept that could be lonely."""

    def beat(self, *, leaving: bool) -> Heartbeat:
        """Make the heartbeat; a stream that nobody publishes is waited for by nobody."""
        beat = super().beat(leaving=leaving)
        return replace(beat, values={**beat.values, **self._idle()})


class BagRecorderNode(CsasNode):
    """Records raw messages. A view counts as recorded once both its messages are written."""

    name = "bag_recorder"
    writer: BagWriter | None = None
    _lock: TextIO | None = None

    def setup(self) -> None:
        """Open the bag, take over what a killed recorder left, and subscribe."""
        p = self.parameters
        if not p.out:
            raise ParameterError("out is ''; expected the path of the bag to make")
        self._flows = {
            topic: (inlet, is_info)
            for stream in recorded_streams(p.topics)
            for inlet in [RecordingInlet(self, stream)]
            for topic, is_info in ((STREAMS[stream].image_topic, False), (STREAMS[stream].info_topic, True))
        }
        self._seen: set[tuple[str, int, int]] = set()
        self._flushed_s = 0.0
        self._open(Path(p.out))
        self.inlets.extend(dict.fromkeys(inlet for inlet, _ in self._flows.values()))
        for topic in topics_to_record(p.topics):
            self._record(topic)

    def _open(self, out: Path) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        lock = out.with_name(f".{out.name}.lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            raise BagError(f"{out} is being recorded by another process") from None
        self._lock = lock
        cut = out.with_name(f"{out.name}.cut")
        finished = (out / "metadata.yaml").exists()
        if out.exists() and (self.parameters.resume or not finished):
            # A recorder was killed here: its bag has no end. Or it was ended, and is to go on. What the bag
            # holds goes into the new one.
            if cut.exists():
                raise BagError(f"{cut} and {out} are both unfinished; expected one of them at most")
            out.rename(cut)
        self.writer = BagWriter(out, compress=self.parameters.compress)
        if cut.exists():
            self._take_over(cut)

    def _take_over(self, cut: Path) -> None:
        try:
            reader = BagReader(cut)
        except BagError as error:
            self.get_logger().warning(f"{error}; nothing of the unfinished recording can be used")
            return
        namespace = absolute_name("", self.get_namespace()).rstrip("/")
        prefix = f"{namespace}/"
        for message in reader.messages():
            relative = message.topic.removeprefix(prefix)
            if relative in TOPICS:
                self._write(relative, bytes(message.cdr), message.log_time_ns, report=False)
        self.get_logger().info(f"took over {len(self._seen)} messages of an unfinished recording")
        for file in cut.iterdir():
            file.unlink()
        cut.rmdir()

    def _record(self, topic: str) -> None:
        profile = qos.UNLATCHED if topic in ("progress", "/diagnostics") else qos.VIEWS

        def take(cdr: Any) -> None:
            self._write(topic, cdr, time.time_ns())

        if topic in _LATCHED:
            self.subscribe_latched(topic, take, raw=True)
        else:
            self.subscribe(topic, profile, take, raw=True)

    def _write(self, topic: str, cdr: bytes, when: int, *, report: bool = True) -> None:
        if self.writer is None:
            return
        stamp = header_stamp(cdr, topic)
        flow = self._flows.get(topic)
        # Results of the same stamp may differ, and a latched message comes by two subscriptions.
        key = (topic, stamp, 0 if flow is not None else zlib.crc32(cdr))
        if key in self._seen and topic not in _NEVER_ALIKE:
            self.counts["duplicates"] += 1
        else:
            name = absolute_name(topic, self.get_namespace())
            latched = topic in _LATCHED
            self.writer.add_topic(name, TOPICS[topic].type_name, depth=1 if latched else 100, latched=latched)
            self.writer.write(name, cdr, when)
            self.counts["written"] += 1
            if topic not in _NEVER_ALIKE:
                self._seen.add(key)
        if flow is not None:
            inlet, is_info = flow
            if report:
                self.counts["in"] += not is_info
                if stamp in inlet.stamps[not is_info]:
                    # On disk before it is said to be: nobody sends again what a killed recorder reported.
                    self.writer.flush()
                inlet.wrote(stamp, is_info=is_info)
            else:
                inlet.stamps[is_info].add(stamp)

    def on_activated(self) -> None:
        """Report what a killed recorder had recorded already."""
        if self.writer is None:
            self.error = f"{self.parameters.out} is finished; clean up and configure again for another bag"
        for inlet in self.inlets:
            if isinstance(inlet, RecordingInlet):
                inlet.report_taken_over()

    def tick(self) -> None:
        """See to it that a crash costs little."""
        if self.writer is not None and time.monotonic() - self._flushed_s > _FLUSH_S:
            self._flushed_s = time.monotonic()
            self.writer.flush()

    def finish(self) -> None:
        """Finish the bag: its metadata come last, and at once."""
        if self.writer is not None:
            writer, self.writer = self.writer, None
            writer.close()
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def main() -> int:
    """Run the node."""
    return run_node(BagRecorderNode)


if __name__ == "__main__":
    sys.exit(main())
