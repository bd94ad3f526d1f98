"""Node `bag_recorder`: records the contract's topics into a bag and loses no view."""

from __future__ import annotations

import fcntl
import itertools
import shutil
import sys
import time
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from csas_shadow_ros.bags import BagReader, BagWriter
from csas_shadow_ros.core.errors import BagError, ParameterError
from csas_shadow_ros.core.geometry.runs import TrackBook
from csas_shadow_ros.durable import sync_tree
from msg_adapters import STREAMS, TOPICS, message_from_cdr, track_piece_from_msg
from msg_adapters.topics import absolute_name, is_latched, is_result, is_topic, split_prefix
from msg_adapters.topics import topic as topic_of

from . import qos
from .playing import message_stamp, recorded_streams, topics_to_record
from .runtime.base import INTEGRATED, CsasNode, Inlet, Latched, run_node
from .runtime.runs import HOLD_S

#: Topics of messages that differ though they carry the same stamp.
_NEVER_ALIKE = frozenset({"progress", "/diagnostics"})
#: What is said once for all runs to come, whenever: each bag has it, as far as it is known.
_STANDING = frozenset({"origin", "scene_transform"})
#: So many of them are kept: a mission says it anew for each contact.
_MOST_STANDING = 16
#: A run's result stays published until the next one has these to say; then its bag is finished.
_ENDS_THE_RUN_BEFORE = frozenset({"measurements", "voxel_grid/image"})
#: Bags of one recorder, at most.
_MOST_RUNS = 10_000
#: So many messages wait for the track of their run at most: the views in flight of every stream, and what is
#: latched. Of more, views give way: they are sent again.
_MOST_UNPLACED = 128
_FLUSH_S = 1.0
#: So much of the disk is left free: an index of 10 000 views, some MB, is needed to finish a bag, and others
#: that share the disk (logs, results) can still say what is wrong.
_RESERVE = 16 << 20


def _unused(cut: Path, kind: str) -> Path:
    """Return a name beside an unfinished recording's that nothing has yet."""
    names = (cut.with_name(f"{cut.stem}.{kind}{number or ''}") for number in itertools.count())
    return next(name for name in names if not name.exists())


def _bag_of_run(out: Path, number: int) -> Path:
    """Return the bag of the second, third, … run."""
    return out.with_name(f"{out.name}_{number}")


class RecordingInlet(Inlet):
    """The reports on a recorded stream of views: a sink, but only while somebody publishes the stream."""

    def __init__(self, node: BagRecorderNode, stream: str) -> None:
        # No subscriptions of its own: the recorder's raw ones serve all topics alike.
        self.node = node
        self.stream = stream
        self.role = "sink"
        self.optional = True
        self.held = deque()
        self.instance = f"{node.instance}-{stream}"
        self.stamps: dict[bool, set[int]] = {False: set(), True: set()}

    def wrote(self, stamp: int, *, is_info: bool) -> None:
        """Note that one message of a pair is in the bag; report the view once both are."""
        self.stamps[is_info].add(stamp)
        if stamp in self.stamps[not is_info]:
            self.report(stamp, INTEGRATED)

    def report_taken_over(self) -> None:
        """Report the views that are already in the bag."""
        for stamp in sorted(self.stamps[False] & self.stamps[True]):
            self.report(stamp, INTEGRATED, **self._idle())

    def give_up_lonely(self) -> None:
        """Do nothing: no unpaired messages are kept here."""


@dataclass(eq=False)
class RunBag:
    """The bag of one run while it is written."""

    path: Path
    writer: BagWriter
    #: Name of the run; None until a track or a message that a track covers tells it.
    run_ns: int | None = None
    #: What is in it: (topic, stamp, checksum where messages of a stamp may differ).
    seen: set[tuple[str, int, int]] = field(default_factory=set)
    #: Latched topics that it has messages of.
    latched: set[str] = field(default_factory=set)
    #: It has messages of views.
    has_views: bool = False


class BagRecorderNode(CsasNode):
    """Records raw messages, one bag per run. A view is recorded once both its messages are written."""

    name = "bag_recorder"
    _lock: TextIO | None = None
    _bags: list[RunBag]

    def __init__(self, **options: Any) -> None:
        self._bags = []
        super().__init__(**options)

    def setup(self) -> None:
        """Open the bag, take over a killed recorder's messages, and subscribe."""
        p = self.parameters
        if not p.out:
            raise ParameterError("out is ''; expected the path of the bag to make")
        self._flows = {
            topic: (inlet, is_info)
            for stream in recorded_streams(p.topics)
            for inlet in [RecordingInlet(self, stream)]
            for topic, is_info in ((STREAMS[stream].image_topic, False), (STREAMS[stream].info_topic, True))
        }
        self._book = TrackBook()
        #: Tracks of runs of which nothing else has come yet: (when, message), a run.
        self._tracks: dict[int, list[tuple[int, bytes]]] = {}
        self._over: set[int] = set()
        #: Messages whose stamp no track covers yet: (since, topic, message).
        self._unplaced: list[tuple[float, str, bytes]] = []
        self._standing: deque[tuple[str, int, bytes]] = deque(maxlen=_MOST_STANDING)
        self._flushed_s = 0.0
        #: Topics of which something was not taken for want of space, and the latched topics' subscriptions.
        self._dropped: set[str] = set()
        self._by_topic: dict[str, Latched] = {}
        self._largest = 0
        self._broken = False
        self._open(Path(p.out))
        self.inlets.extend(dict.fromkeys(inlet for inlet, _ in self._flows.values()))
        self._recorded: set[str] = set()
        self._all = p.topics == "all"
        for topic in topics_to_record(p.topics):
            self._record(topic)
        self.follow_sources()  # and hear of other graphs

    # Bags

    def _open(self, out: Path) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        lock = out.with_name(f".{out.name}.lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            raise BagError(f"{out} is being recorded by another process") from None
        self._lock = lock
        # A killed recorder leaves the bag of its last run without an end: its successor goes on with that. So
        # does one with `resume`, whose predecessor ended in mid-run, as a node does that begins anew.
        last = out
        for number in range(2, _MOST_RUNS):
            if not _bag_of_run(out, number).exists():
                break
            last = _bag_of_run(out, number)
        goes_on = self.parameters.resume or not (last / "metadata.yaml").exists()
        self._open_bag(last if goes_on else out)

    def _open_bag(self, path: Path) -> RunBag:
        cut = path.with_name(f"{path.name}.cut")
        finished = (path / "metadata.yaml").exists()
        for left in path.parent.iterdir() if path.parent.exists() else ():
            if left.name.startswith(f"{path.name}.taken"):
                shutil.rmtree(left)  # its recorder was killed before it had done so
        if cut.exists():
            # A recorder was killed while it took over what another one had left: all of that is still there,
            # and its own bag holds nothing else.
            if finished:
                raise BagError(f"{cut} and {path} are both there; expected one of them: remove or rename one")
            shutil.rmtree(path, ignore_errors=True)
        elif path.exists() and (self.parameters.resume or not finished):
            # A recorder was killed here: its bag has no end. Or it was ended, and is to go on. What the bag
            # holds goes into the new one.
            path.rename(cut)
        fast = self.parameters.compress and self.parameters.compression == "lz4"
        bag = RunBag(path, BagWriter(path, compress="lz4" if fast else self.parameters.compress))
        self._bags.append(bag)
        if cut.exists():
            self._take_over(bag, cut)
        return bag

    def _take_over(self, bag: RunBag, cut: Path) -> None:
        try:
            reader = BagReader(cut)
        except BagError as error:
            kept = _unused(cut, "unusable")
            cut.rename(kept)
            self.get_logger().warning(f"{error}; the unfinished recording is unusable, and kept as {kept}")
            return
        namespace = absolute_name("", self.get_namespace()).rstrip("/")
        prefix = f"{namespace}/"
        for message in reader.messages():
            relative = message.topic.removeprefix(prefix)
            if is_topic(relative):
                if relative == "track":
                    self._learn(bytes(message.cdr))
                self._write(bag, relative, bytes(message.cdr), message.log_time_ns, report=False)
        bag.run_ns = next(iter(self._book.names), None)
        self.get_logger().info(f"took over {len(bag.seen)} messages of an unfinished recording")
        # In one step: what is left of it is a whole recording, or none.
        taken = _unused(cut, "taken")
        cut.rename(taken)
        shutil.rmtree(taken)

    def _close_bag(self, bag: RunBag) -> None:
        self._bags.remove(bag)
        for topic, stamp, _ in bag.seen:
            if topic in self._flows:
                inlet, is_info = self._flows[topic]
                inlet.stamps[is_info].discard(stamp)  # a mission of days has millions
        if bag.run_ns is not None:
            self._over.add(bag.run_ns)
        try:
            bag.writer.close()
            if self.parameters.sync:
                sync_tree(bag.path)
        except (BagError, OSError) as error:
            self.unable = self.unable or str(error)
            self.get_logger().error(f"{error}; data up to there are readable")

    # Which bag

    def _learn(self, cdr: bytes) -> int:
        piece = track_piece_from_msg(message_from_cdr(cdr, TOPICS["track"].type_name, "track"))
        name = self._book.add(piece)
        for before, after in self._book.renamed.items():
            for bag in self._bags:
                bag.run_ns = after if bag.run_ns == before else bag.run_ns
            if before in self._tracks:
                self._tracks.setdefault(after, []).extend(self._tracks.pop(before))
        return name

    def _place_again(self, *, at_once: bool = False) -> None:
        """Write what waits for its track, as far as it has come, or it has waited long enough."""
        held, self._unplaced = self._unplaced, []
        for since_s, topic, cdr in held:
            late = at_once or time.monotonic() - since_s > HOLD_S
            if late or self._book.run_of(message_stamp(cdr, topic) or 0) is not None:
                # One that is refused is not to cost those behind it.
                self.guard(topic, partial(self._take, late=late), topic, cdr)
            else:
                self._unplaced.append((since_s, topic, cdr))

    def _take(self, topic: str, cdr: bytes, *, late: bool = False) -> None:
        """Write a message into the bag of the run that its stamp is of."""
        when = time.time_ns()
        if not self._bags:
            return
        self._largest = max(self._largest, len(cdr))
        if self.unable or not self._has_room(len(cdr)):
            self.counts["dropped"] += 1
            self._dropped.add(topic)
            return
        if topic in _STANDING:
            self._standing.append((topic, when, cdr))
            for bag in self._bags:
                self._write(bag, topic, cdr, when)
        elif topic == "track":
            self._take_track(cdr, when)
        else:
            self._take_of_run(topic, cdr, when, late=late)

    def _take_track(self, cdr: bytes, when: int) -> None:
        """Write a track into its run's bag, or keep it until that begins."""
        name = self._learn(cdr)
        if self._bags[-1].run_ns is None:
            self._bags[-1].run_ns = name
        for bag in self._bags:
            if bag.run_ns == name:
                self._write(bag, "track", cdr, when)
                return
        self._tracks.setdefault(name, []).append((when, cdr))
        self._place_again()

    def _take_of_run(self, topic: str, cdr: bytes, when: int, *, late: bool) -> None:
        """Write what has a stamp into the bag of its run, which it may begin."""
        stamp = None if topic in _NEVER_ALIKE else message_stamp(cdr, topic)
        run_ns = None if stamp is None else self._book.run_of(stamp)
        if run_ns is None and stamp is not None:
            if not late and self._may_have_overtaken_its_track(topic):
                self._wait_for_track(topic, cdr)
                return
            self._require_of_known_run(topic, stamp)
        if run_ns in self._over:
            raise BagError(f"{topic} of the run of {run_ns} ns came after its bag was finished; not recorded")
        for bag in self._bags:
            if run_ns == bag.run_ns:
                self._write(bag, topic, cdr, when)
                break
        else:
            bag = self._bags[-1]
            if run_ns is not None and bag.run_ns is not None:
                bag = self._begin_run(run_ns)
            self._write(bag, topic, cdr, when)
        if topic in _ENDS_THE_RUN_BEFORE:
            for older in self._bags[: self._bags.index(bag)]:
                self._close_bag(older)

    def _may_have_overtaken_its_track(self, topic: str) -> bool:
        """Say whether a message that no track covers may be of a run whose track is still to come.

        Views do so that reach a recorder which has just begun again, and the result of an earlier run that
        is still published when a recorder begins. Where views came without a track, none is to come.
        """
        if self._book.names:
            return True
        return is_result(topic) and "track" in self._recorded and not self._bags[-1].has_views

    def _require_of_known_run(self, topic: str, stamp: int) -> None:
        """Raise for the result of a run that was over before this recorder began: no bag here is its."""
        first = min(self._book.names, default=0)
        if is_result(topic) and stamp < first:
            raise BagError(
                f"{topic} stamped {stamp} ns is of a run before the first whose track came ({first} ns);"
                " not recorded"
            )

    def _wait_for_track(self, topic: str, cdr: bytes) -> None:
        """Keep a message until its track comes; if there are too many, the oldest view goes."""
        self._unplaced.append((time.monotonic(), topic, cdr))
        if len(self._unplaced) > _MOST_UNPLACED:
            gone = next((n for n, (_, name, _) in enumerate(self._unplaced) if name in self._flows), 0)
            del self._unplaced[gone]

    # Room

    def _has_room(self, size: int) -> bool:
        """Say whether the disk has room; a bag that is always left some can be finished, and gone on with."""
        path = self._bags[-1].path
        try:
            free = shutil.disk_usage(path).free
        except OSError as error:
            self.cannot(f"cannot write to {path}: {error.strerror}")
            return False
        needed = size + _RESERVE
        if free < needed:
            self.cannot(f"the disk of {path} has {free / 1e6:.1f} MB left; expected {needed / 1e6:.1f} MB")
        return free >= needed

    def _look_for_room(self) -> None:
        """Go on once there is room again, by a margin."""
        if self._broken or not self._bags:
            return
        if shutil.disk_usage(self._bags[-1].path).free > 2 * _RESERVE + self._largest:
            self.cannot("")
            for topic in self._dropped & set(self._by_topic):
                # Views are sent again; of these whoever subscribes anew gets the last.
                self._by_topic[topic].ask_again()
            self._dropped.clear()

    def _failed(self, error: BagError) -> None:
        """Write no more after the disk has refused: what a bag holds behind that cannot be read."""
        if not isinstance(error.__cause__, OSError):
            raise error
        self._broken = True
        self.cannot(str(error))

    def _begin_run(self, run_ns: int) -> RunBag:
        """Open the bag of another run; that of the run before stays open until the new one has results."""
        out = Path(self.parameters.out)
        number = next(n for n in range(2, _MOST_RUNS) if not _bag_of_run(out, n).exists())
        bag = self._open_bag(_bag_of_run(out, number))
        bag.run_ns = run_ns
        self.get_logger().info(f"the run of {run_ns} ns is recorded into {bag.path}")
        while len(self._bags) > 2:
            self._close_bag(self._bags[0])
        for when, cdr in self._tracks.pop(run_ns, ()):
            self._write(bag, "track", cdr, when)
        for topic, when, cdr in self._standing:
            self._write(bag, topic, cdr, when)
        return bag

    def _record(self, topic: str) -> None:
        if topic in self._recorded:
            return
        self._recorded.add(topic)
        take = self._taker(topic)
        if is_latched(topic):
            profile = qos.TRACK if topic == "track" else qos.LATCHED
            self._by_topic[topic] = self.subscribe_latched(topic, take, raw=True, profile=profile)
        else:
            self.subscribe(topic, qos.UNLATCHED if topic in _NEVER_ALIKE else qos.VIEWS, take, raw=True)

    def _taker(self, topic: str) -> Callable[[bytes], None]:
        return lambda cdr: self._take(topic, cdr)

    def _write(self, bag: RunBag, topic: str, cdr: bytes, when: int, *, report: bool = True) -> None:
        stamp = message_stamp(cdr, topic)
        flow = self._flows.get(topic)
        # Results of the same stamp may differ, and a latched message comes by two subscriptions.
        key = (topic, stamp or 0, 0 if flow is not None else zlib.crc32(cdr))
        if key in bag.seen and topic not in _NEVER_ALIKE:
            self.counts["duplicates"] += 1
        else:
            name = absolute_name(topic, self.get_namespace())
            latched = is_latched(topic)
            bag.writer.add_topic(
                name, topic_of(topic).type_name, depth=1 if latched else 100, latched=latched
            )
            try:
                bag.writer.write(name, cdr, when)
            except BagError as error:
                self._failed(error)
                return
            self.counts["written"] += 1
            if latched:
                bag.latched.add(topic)
            if topic not in _NEVER_ALIKE:
                bag.seen.add(key)
        if flow is not None and stamp is not None:
            inlet, is_info = flow
            bag.has_views = True
            if report:
                self.counts["in"] += not is_info
                if stamp in inlet.stamps[not is_info]:
                    # On disk before it is said to be: nobody sends again what a killed recorder reported.
                    try:
                        bag.writer.flush()
                    except BagError as error:
                        self._failed(error)
                        return
                inlet.wrote(stamp, is_info=is_info)
            else:
                inlet.stamps[is_info].add(stamp)

    def on_activated(self) -> None:
        """Report the views of a killed recorder."""
        if not self._bags:
            self.error = f"{self.parameters.out} is finished; clean up and configure again for another bag"
        for inlet in self.inlets:
            if isinstance(inlet, RecordingInlet):
                inlet.report_taken_over()

    def state_values(self) -> dict[str, str]:
        """Return the recorded run, its bag, and the latched topics that this has messages of."""
        if not self._bags:
            return {}
        bag = self._bags[-1]
        # Heartbeats ask from a thread of their own, while the set grows: it is copied in one step.
        values = {"bag": str(bag.path), "holds": " ".join(sorted(tuple(bag.latched)))}
        return values | ({} if bag.run_ns is None else {"run": str(bag.run_ns)})

    def state_counts(self) -> dict[str, int]:
        """Count the messages that wait for the track of their run."""
        return {"waiting_for_track": len(self._unplaced)}

    def tick(self) -> None:
        """Flush the bag against a crash; record further objects' topics as they appear."""
        if self._bags and time.monotonic() - self._flushed_s > _FLUSH_S:
            self._flushed_s = time.monotonic()
            if self.unable:
                self._look_for_room()
            try:
                for bag in self._bags if not self.unable else ():
                    bag.writer.flush()
            except BagError as error:
                self._failed(error)
        self._place_again()
        if self._bags and self._all:
            prefix = f"{absolute_name('', self.get_namespace()).rstrip('/')}/"
            for name, _ in self.get_topic_names_and_types():
                relative = name.removeprefix(prefix)
                if relative != name and split_prefix(relative)[0] and is_topic(relative):
                    self._record(relative)

    def finish(self) -> None:
        """Finish the bags, with their metadata last."""
        if self._bags:
            self._place_again(at_once=True)
        for bag in list(self._bags):
            self._close_bag(bag)
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def main() -> int:
    """Run the node."""
    return run_node(BagRecorderNode)


if __name__ == "__main__":
    sys.exit(main())
