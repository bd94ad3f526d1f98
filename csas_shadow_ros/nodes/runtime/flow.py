"""Flow control: no view is lost, however slow a consumer is; memory is bounded; nothing deadlocks.

The rules are told in ``docs/flow_control.md``. This module holds them without any ROS, so that they
can be tested with a clock that the test turns.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from csas_shadow_ros.core.errors import check_range
from msg_adapters.progress import REJECTED, Heartbeat, ViewProgress

#: Place of each stream in the chain; a consumer is fed by every source at or before its place.
PLACES = {"sub_aperture": 0, "shadow": 1, "likelihood": 2, "shadow_mask": 2}
#: A consumer that does not say what it takes is taken to stand behind everything.
_LAST = 99
#: Key of the reports that the transport makes where no consumer reports anything.
TRANSPORT = "transport"
_LONGEST_BACKOFF_S = 20.0
_FIRST_RESEND_S = 1.0
#: A source that was busy reads for so long what it was told meanwhile before it sends anything.
_CATCH_UP_S = 0.05
#: Once all are there that a source waits for, it listens for so long to what the last of them has to say.
_LAST_WORD_S = 0.2


def place_of(stream: str) -> int:
    """Return a stream's place in the chain."""
    return PLACES.get(stream, _LAST)


@dataclass
class Peer:
    """A consumer that reports: its state as told by its messages.

    Parameters
    ----------
    instance, node : str
        The running process' identity, and its node's name.
    role : str
        `stage` or `sink`.
    stream : str
        What it takes; empty if it does not say.
    heard_s : float
        When it was last heard.
    """

    instance: str
    node: str
    role: str
    stream: str
    heard_s: float
    alive: bool = True
    #: The target that it works for; empty if it needs none.
    target: str = ""
    #: It says that it cannot do its work, and why; it is waited for as one that has gone.
    unable: str = ""
    #: It has said goodbye: a report that was overtaken by that does not bring it back, a heartbeat does.
    left: bool = False
    #: It only fetches what it has missed: if it vanishes, its successor asks anew.
    passing: bool = False

    @property
    def key(self) -> str:
        """Key of the reports that count as this peer's.

        A sink's state dies with its process, so only that process' own reports count. A stage has
        no state: whatever any process of its name has passed on is passed on.
        """
        return self.instance if self.role == "sink" else f"stage {self.node}"


@dataclass
class _Sent:
    at_s: float
    attempts: int = 1
    #: Attempts that a last consumer did not get while it got later ones: only those tell that it vanished.
    #: Where a stage is away nothing gets to those behind it, for however long, whatever others get.
    vanished: int = 0
    #: How many later views each last consumer (key) has reported for the first time.
    overtaken: Counter[str] = field(default_factory=Counter)
    serial: int = 0
    #: A consumer came back: what was on its way has probably died with its predecessor.
    due: bool = False


@dataclass
class Flow:
    """Decides which view a source sends next, and when all are done.

    A view is done when every live last consumer has reported it, or a stage before that consumer
    has refused it. Last consumers are all sinks, and the stages behind which nobody reports.

    Parameters
    ----------
    stream : str
        What the source sends: a stream of `PLACES`, or ``sector``.
    window : int
        Views that may be on their way at once.
    resend_s : float
        A view of which nothing is heard is sent again after so long without any progress.
    peer_timeout_s : float
        A consumer that is silent for so long is gone.
    sink_wait_s : float
        How long a sink that vanished, or any first consumer, is waited for.
    max_attempts : int
        A view that vanishes so many times, while later ones get to a last consumer that lacks it, is lost.
    min_sinks : int
        Nothing is sent before so many sinks are there (or `sink_wait_s` is over).
    settle_s : float
        How long after the first subscriber or consumer the source listens before it sends: heartbeats and
        kept reports tell it who reports, and what is done already. Less if `min_sinks` are there, and a
        stage for every step before them: then there is nobody to be heard.
    clock : callable
        Seconds; monotonic.
    """

    stream: str
    window: int = 4
    resend_s: float = 5.0
    peer_timeout_s: float = 3.0
    sink_wait_s: float = 60.0
    max_attempts: int = 5
    min_sinks: int = 0
    settle_s: float = 1.0
    clock: Callable[[], float] = time.monotonic
    #: Lines to log, (level, text); the node takes them.
    notes: list[tuple[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        check_range("window", self.window, 1, 64)
        #: More views will be offered: the run is not over when all are done.
        self.more_to_come = False
        #: No view is sent for the first time.
        self.held = False
        #: The target that views are made for; reports of views of another one do not count. Empty: any.
        self.target = ""
        self.peers: dict[str, Peer] = {}
        self.lost: dict[int, str] = {}
        self.resends = 0
        self._stamps: dict[int, None] = {}
        self._refused: dict[int, str] = {}
        self._reports: dict[str, set[int]] = {}
        self._rejected_at: dict[int, set[int]] = {}
        self._in_flight: dict[int, _Sent] = {}
        self._missing: dict[int, None] = {}
        self._gone: dict[tuple[str, str], float] = {}
        self._names: set[tuple[str, str]] = set()
        self._leaves: list[Peer] = []
        self._known_leaves: frozenset[str] = frozenset()
        self._any_done = False
        self._serial = 0
        self._progress_s = self._born_s = self._served_s = self._looked_s = self.clock()
        self._subscribers = 0
        self._met_s: float | None = None
        self._back_s = self._arrived_s = -math.inf

    # What the source has

    def offer(self, stamps: Iterable[int]) -> None:
        """Add views that the source can make at any time, in the order in which to send them."""
        for stamp in stamps:
            self._stamps.setdefault(stamp)
        self._recount()

    def refuse(self, stamp: int, reason: str) -> None:
        """Withdraw a view that the source cannot make after all."""
        self._refused[stamp] = reason
        self._in_flight.pop(stamp, None)
        self._missing.pop(stamp, None)

    def begin_again(self, target: str) -> None:
        """Forget all views and their reports, to offer them again for another target."""
        self.target = target
        self.lost.clear()
        for kept in (self._stamps, self._refused, self._reports, self._rejected_at, self._in_flight):
            kept.clear()
        self._missing.clear()
        self._progress_s = self.clock()

    # What consumers say

    def heard(self, item: ViewProgress | Heartbeat) -> None:
        """Handle a report or a heartbeat of a consumer."""
        role = item.role if isinstance(item, Heartbeat) else item.values.get("role", "stage")
        if role == "source":
            return
        now = self.clock()
        stream = item.values.get("input", "")
        if not self._feeds(stream):
            return
        leaving = item.values.get("leaving") == "true"
        # A recorder of a stream that nobody publishes, as far as it knows: nothing for it to report.
        idle = item.values.get("idle") == "true"
        peer = self.peers.setdefault(item.instance, Peer(item.instance, item.node, role, stream, now, False))
        if isinstance(item, Heartbeat):
            self._is_unable(peer, item.values.get("unable", ""))
        peer.passing = item.values.get("passing") == "true"
        there = not leaving and not idle and not peer.unable
        peer.left = leaving or (peer.left and isinstance(item, ViewProgress))
        if isinstance(item, ViewProgress) and (idle or peer.left):
            there = peer.alive and not peer.left  # a report tells what was done, not how it stands now
        peer.heard_s = now
        peer.target = item.values.get("target", "")
        changed, peer.alive = peer.alive != there, there
        if changed and there:
            self._arrived(peer)
        if leaving:
            # Gone on purpose: nobody waits for it. An idle one may be a killed one's successor, which has
            # not found the publishers yet: its predecessor is waited for as before.
            self._gone.pop((peer.node, peer.stream), None)
        if changed:
            # At once: the next look may come after somebody was told that the run is over.
            self._choose_leaves()
        if isinstance(item, ViewProgress) and self._counts(peer):
            self._reported(peer, item)

    def _is_unable(self, peer: Peer, why: str) -> None:
        """Wait, for a while, for a sink that was counted on and says that it cannot work."""
        if why and not peer.unable and peer.role == "sink" and peer.alive:
            self._gone[peer.node, peer.stream] = self.clock()
            wait = f"waiting for it, {self.sink_wait_s:g} s at most"
            self.notes.append(("warn", f"{peer.node} cannot take {peer.stream}: {why}; {wait}"))
        peer.unable = why

    def _counts(self, peer: Peer) -> bool:
        return not (self.target and peer.target) or peer.target == self.target

    def _feeds(self, stream: str) -> bool:
        if self.stream == "sector" or stream == "sector":
            return stream == self.stream
        return not stream or place_of(stream) >= place_of(self.stream)

    def _arrived(self, peer: Peer) -> None:
        name = (peer.node, peer.stream)
        self._gone.pop(name, None)
        self._arrived_s = self.clock()
        if peer.role == "sink":
            # A process of this name before it died: its reports will never be asked for again.
            for other in list(self.peers.values()):
                twin = (other.node, other.stream) == (peer.node, peer.stream)
                if twin and other is not peer and not other.alive:
                    del self.peers[other.instance]
                    self._reports.pop(other.key, None)
        if self.lost:
            self.lost.clear()
            self._recount()  # what was given up is missing again
        if name in self._names:
            for sent in self._in_flight.values():
                sent.due, sent.attempts, sent.vanished = True, 1, 0
            self._progress_s = self.clock()
        self._names.add(name)

    def _reported(self, peer: Peer, item: ViewProgress) -> None:
        stamp = item.stamp_ns
        reports = self._reports.setdefault(peer.key, set())
        fresh = stamp not in reports
        reports.add(stamp)
        if item.outcome == REJECTED and peer.role == "stage":
            self._rejected_at.setdefault(place_of(peer.stream), set()).add(stamp)
        if fresh:
            self._progress_s = self.clock()
            self._overtakes(stamp, peer.key)
        if stamp in self._in_flight and self._is_done(stamp):
            self._retire(stamp)
        elif stamp in self._missing and self._is_done(stamp):
            del self._missing[stamp]

    def _overtakes(self, stamp: int, key: str) -> None:
        """Note of earlier views that a last consumer has got this later one."""
        if (sent := self._in_flight.get(stamp)) is not None:
            for other in self._in_flight.values():
                other.overtaken[key] += other.serial < sent.serial

    def transported(self) -> None:
        """State that the transport has delivered everything in flight (used if nobody reports)."""
        for stamp in list(self._in_flight):
            self._reports.setdefault(TRANSPORT, set()).add(stamp)
            if self._is_done(stamp):
                self._retire(stamp)

    def _retire(self, stamp: int) -> None:
        del self._in_flight[stamp]
        self._missing.pop(stamp, None)
        self._any_done = True
        self._progress_s = self.clock()

    # Who must have what

    def live(self) -> list[Peer]:
        """Return the present consumers."""
        return [p for p in self.peers.values() if p.alive]

    def sinks(self) -> list[Peer]:
        """Return the present sinks."""
        return [p for p in self.live() if p.role == "sink"]

    def _is_done(self, stamp: int) -> bool:
        if not self._leaves:
            return stamp in self._reports.get(TRANSPORT, ())
        return next(self._lacking(stamp), None) is None

    def _lacking(self, stamp: int) -> Iterator[str]:
        """Iterate the last consumers (keys) that have not reported a view, nor anybody's refusal of it."""
        for leaf in self._leaves:
            if stamp in self._reports.get(leaf.key, ()):
                continue
            place = place_of(leaf.stream)
            if not any(at < place and stamp in stamps for at, stamps in self._rejected_at.items()):
                yield leaf.key

    def _overtaken(self, stamp: int) -> int:
        """Say how many later views have got through to a last consumer that lacks this one."""
        overtaken = self._in_flight[stamp].overtaken
        return max((overtaken[key] for key in self._lacking(stamp)), default=0)

    def _recount(self) -> None:
        out = self._refused
        self._missing = {s: None for s in self._stamps if s not in out and not self._is_done(s)}
        for stamp in [s for s in self._in_flight if s not in self._missing]:
            self._retire(stamp)

    def look(self, subscribers: int = 1) -> None:
        """Notice who has come and gone; call it a few times a second.

        Parameters
        ----------
        subscribers : int
            How many subscriptions the source's image topic has, reporting or not.
        """
        now = self.clock()
        deaf_s, self._looked_s = now - self._looked_s, now
        if deaf_s > 1.0:
            # The source itself was busy: what the others said meanwhile is still in its queue.
            self._back_s = now
            for peer in self.peers.values():
                peer.heard_s += deaf_s
        for peer in self.peers.values():
            if peer.alive and now - peer.heard_s > self.peer_timeout_s:
                peer.alive = False
                if peer.role == "sink" and not peer.passing and not self._twin_alive(peer):
                    self._gone[peer.node, peer.stream] = now
                    self.notes.append(
                        ("warn", f"{peer.node} has been silent for {self.peer_timeout_s:g} s: waiting for it")
                    )
        for key, since in list(self._gone.items()):
            if now - since > self.sink_wait_s:
                del self._gone[key]
                self.notes.append(("warn", f"{key[0]} did not come back in {self.sink_wait_s:g} s; going on"))
        self._subscribers = subscribers
        self.meet(subscribers)
        if self.live() or subscribers:
            self._served_s = now
        self._choose_leaves()

    def meet(self, subscribers: int) -> None:
        """Note the first appearance of a consumer; callable from any thread."""
        if self._met_s is None and (subscribers or self.peers):
            self._met_s = self.clock()

    def _choose_leaves(self) -> None:
        """Say who are the last consumers, and what they lack."""
        live = self.live()
        takers = {place_of(p.stream) for p in live}
        # A stage is last if nobody behind it reports: it stands for the unknown that follows it.
        leaves = [p for p in live if p.role == "sink" or place_of(p.stream) + 1 not in takers]
        self._leaves = [p for p in leaves if p.role == "sink" or p.stream]
        keys = frozenset(p.key for p in self._leaves)
        if keys != self._known_leaves:
            self._known_leaves = keys
            self._recount()

    def _twin_alive(self, peer: Peer) -> bool:
        name = (peer.node, peer.stream)
        return any(p is not peer and p.alive and (p.node, p.stream) == name for p in self.peers.values())

    # What to send

    @property
    def acknowledged_by_transport(self) -> bool:
        """True if nobody reports; the node then calls `transported` on delivery."""
        return not self._leaves and self._subscribers > 0

    def waiting_for(self) -> str:
        """Say what the source waits for before it sends; empty if nothing."""
        now = self.clock()
        new = self._met_s is not None and now - self._met_s < self.settle_s
        if new and self._all_there():
            new = now - self._arrived_s < _LAST_WORD_S
        if new or now - self._back_s < min(_CATCH_UP_S, self.settle_s):
            return "other nodes to appear"
        if others := sorted({p.node for p in self.live() if not self._counts(p)}):
            return f"{', '.join(others)} to take the target"
        if self._gone and not self.sinks():
            return f"{', '.join(sorted(n for n, _ in self._gone))} to come back"
        # So many are waited for once: whoever says goodbye after the first view is waited for no more, and
        # who vanishes is in `_gone`.
        begun = self._serial > 0
        if not begun and now - self._born_s < self.sink_wait_s and len(self.sinks()) < self.min_sinks:
            return f"{self.min_sinks} sinks ({len(self.sinks())} present)"
        if not self._leaves and not self._subscribers and now - self._served_s < self.sink_wait_s:
            return "a consumer"
        return ""

    def _all_there(self) -> bool:
        """Say whether as many sinks are there as are waited for, and all stages that lead to them."""
        sinks = {p.node: place_of(p.stream) for p in self.sinks()}
        if not 0 < self.min_sinks <= len(sinks):
            return False
        last = max(sinks.values())
        stages = {place_of(p.stream) for p in self.live() if p.role == "stage"}
        return last != _LAST and stages >= set(range(place_of(self.stream), last))

    def next(self, *, fresh: bool = True) -> int | None:
        """Return the stamp of the view to send now, which then counts as sent; None if there is none.

        Parameters
        ----------
        fresh : bool
            Whether a view may be sent for the first time; False: only again.
        """
        if self.waiting_for() or (not self._leaves and not self._subscribers):
            return None
        now = self.clock()
        for stamp, sent in self._in_flight.items():
            if not self._is_due(stamp, now):
                continue
            # A copy sent because somebody came back tells nothing of the one before, which may be under way.
            sent.vanished += not sent.due and self._overtaken(stamp) > 0
            if sent.vanished >= self.max_attempts:
                reason = f"sent {sent.attempts} times, never reported though others were"
                self.lost[stamp] = reason
                self.notes.append(("error", f"view {stamp} ns is lost: {reason}"))
                del self._in_flight[stamp]
                self._missing.pop(stamp, None)
                return self.next(fresh=fresh)
            self._serial += 1
            self.resends += 1
            sent.attempts += 1
            sent.at_s, sent.serial, sent.due = now, self._serial, False
            sent.overtaken.clear()
            return stamp
        if not fresh or self.held or len(self._in_flight) >= self.window:
            return None
        for stamp in self._missing:
            if stamp not in self._in_flight and stamp not in self.lost:
                self._serial += 1
                self._in_flight[stamp] = _Sent(now, serial=self._serial)
                return stamp
        return None

    def peek(self) -> int | None:
        """Return the view that `next` would send for the first time, without sending it."""
        return next((s for s in self._missing if s not in self._in_flight and s not in self.lost), None)

    def _is_due(self, stamp: int, now: float) -> bool:
        sent = self._in_flight[stamp]
        if sent.due or self._overtaken(stamp) >= 2 * self.window:
            return True
        if self.acknowledged_by_transport:
            return False
        # Later attempts wait longer: a slow consumer must not drown in copies. While others get through
        # the view may merely be queued, so the time runs from the last progress of any view.
        # Before anything got through, links of the graph may just not have found each other yet.
        first = self.resend_s if self._any_done else min(self.resend_s, _FIRST_RESEND_S)
        patience = min(first * 2.0 ** (sent.attempts - 1), max(_LONGEST_BACKOFF_S, self.resend_s))
        return now - max(sent.at_s, self._progress_s) > patience

    # How far it is

    @property
    def total(self) -> int:
        """Number of views of the source."""
        return len(self._stamps)

    @property
    def in_flight(self) -> int:
        """Views in flight."""
        return len(self._in_flight)

    @property
    def pending(self) -> bool:
        """Whether an offered view is still unsent or in flight."""
        return any(s not in self.lost for s in self._missing)

    @property
    def refused(self) -> dict[int, str]:
        """Views that the source could not make, and why."""
        return self._refused

    @property
    def done(self) -> int:
        """Views that no present consumer needs (again)."""
        return self.total - len(self._missing)

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do for any present or awaited consumer."""
        if not self._stamps or self.more_to_come or self._gone or self._in_flight:
            return False
        if self.waiting_for():
            return False
        nobody = not self._leaves and not self._subscribers
        return nobody or not self.pending

    def finished_for(self) -> Iterator[str]:
        """Iterate the consumers (instances) that have, or will never have, every view."""
        if self.finished:
            yield from (p.instance for p in self._leaves)
