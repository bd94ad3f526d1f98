"""Detect other graphs in a namespace: views carry no owner, so a node that hears another graph stops.

Needs no ROS, so that it can be tested with a clock that the test turns.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

from msg_adapters.progress import GRAPH_ID, Heartbeat, graph_of

#: A node of another graph that has been silent for so long is gone: six heartbeats, as of consumers.
_GONE_S = 3.0
#: Two heartbeats so far apart are no last words of a process that has just been killed: half a period.
_LIVES_S = 0.25
#: Who has not looked for so long was busy: what it was told meanwhile is still in its queue.
_DEAF_S = 1.0


def at_work(who: str, namespace: str, domain_id: int) -> str:
    """Name another graph and where it is, in the words of every node and of `replay`."""
    return f"{who} is at work in ROS domain {domain_id}, namespace {namespace}"


class Rivals:
    """Detects other graphs in a node's namespace.

    Parameters
    ----------
    node : str
        The node's name.
    alone : bool
        There can be one such node in a namespace: a second is as bad as another graph.
    graph_id : str, optional
        The graph that the node belongs to, empty for none; by default what the environment says.
    clock : callable
        Seconds; monotonic.
    """

    def __init__(
        self,
        node: str,
        *,
        alone: bool,
        graph_id: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.graph_id = os.environ.get(GRAPH_ID, "") if graph_id is None else graph_id
        self._node = node
        self._alone = alone
        self._clock = clock
        self._met: dict[str, float] = {}
        #: Who, and when it was heard last.
        self._there: dict[str, tuple[float, str]] = {}
        self._looked_s = clock()

    def is_other(self, instance: str) -> bool:
        """Say whether a process belongs to another graph; without an identity it belongs to any."""
        theirs = graph_of(instance)
        return bool(theirs and self.graph_id and theirs != self.graph_id)

    def hear(self, beat: Heartbeat, own_instance: str) -> None:
        """Handle a heartbeat."""
        if own_instance and beat.instance.startswith(own_instance):
            return
        now, other = self._clock(), self.is_other(beat.instance)
        if beat.values.get("leaving") == "true":
            self._there.pop(beat.instance, None)
            self._met.pop(beat.instance, None)
        elif other:
            self._there[beat.instance] = (now, f"{beat.node} of another graph ({graph_of(beat.instance)})")
        elif (
            self._alone
            and beat.node == self._node
            and now - self._met.setdefault(beat.instance, now) > _LIVES_S
        ):
            self._there[beat.instance] = (now, f"another {beat.node}")

    def look(self) -> str:
        """Name the other graph; empty if none. Call it a few times a second."""
        now = self._clock()
        deaf_s, self._looked_s = now - self._looked_s, now
        for instance, (heard_s, who) in list(self._there.items()):
            if deaf_s > _DEAF_S:
                self._there[instance] = (heard_s + deaf_s, who)
            elif now - heard_s > _GONE_S:
                del self._there[instance]
        return min((who for _, who in self._there.values()), default="")
