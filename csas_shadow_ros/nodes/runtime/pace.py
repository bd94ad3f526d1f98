"""Decide when to publish a growing result."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from csas_shadow_ros.node_table import SOURCES

#: Without a source that tells the end, a result that has not changed for so long is shown as it is.
IDLE_S = 2.0
#: A source that is silent for so long is away; what has come is shown.
SOURCE_SILENT_S = 3.0
#: A source that has spoken and falls silent was killed, as a rule, and its successor goes on: after 5 s on a
#: busy machine. One that has not come back by then (as long as a source waits for a sink) will not.
SOURCE_GONE_S = 60.0
#: After a burst of views that has been over for so long, publishing holds up nobody.
_QUIET_S = 0.06


def source_is_there(node: Any) -> bool:
    """Say whether a node of the package that tells the end of a run reports in a node's namespace."""
    found = node.get_publishers_info_by_topic(node.resolve_topic_name("progress"))
    return any(publisher.node_name in SOURCES for publisher in found)


class Growing:
    """Publishes a growing result at intervals while somebody subscribes, and once when complete.

    Parameters
    ----------
    publish : callable
        Publishes the result as it is.
    wanted : callable
        Says whether anybody looks.
    hz : float
        Most often; while views are coming in less, where publishing takes more than a tenth of the time.
    source_there : callable
        Says whether a source that tells the end is there, also if nothing has been heard of it yet. Where
        none is, the end is that nothing comes any more.
    """

    def __init__(
        self,
        publish: Callable[[], None],
        wanted: Callable[[], bool],
        hz: float,
        source_there: Callable[[], bool],
    ) -> None:
        self._publish = publish
        self._wanted = wanted
        self._source_there = source_there
        self.set_rate(hz)
        #: Whether all views are in and the result is published.
        self.complete = False
        #: Whether what is published is the end result, as far as anybody knows.
        self.final = False
        #: Whether something has changed since anything was published, and since an end result was.
        self._dirty = self._open = False
        self._ended = False
        self._published_s = self._changed_s = -math.inf
        self._source_s = -math.inf
        self._cost_s = 0.0

    def set_rate(self, hz: float) -> None:
        """Limit the rate of unfinished results; 0: never publish them."""
        self.period_s = 1.0 / hz if hz > 0.0 else math.inf

    def changed(self) -> None:
        """Say that the result has changed."""
        self._dirty = self._open = True
        self.complete = self.final = False
        self._changed_s = time.monotonic()

    def source_says(self, ended: bool) -> None:
        """Note a source's statement whether every view has arrived."""
        self._source_s, self._ended = time.monotonic(), ended

    @property
    def silent_s(self) -> float:
        """Seconds since the source that had spoken fell silent; 0 if it has not, or if there is none."""
        silent_s = time.monotonic() - self._source_s
        return silent_s if SOURCE_SILENT_S < silent_s < math.inf else 0.0

    def begin_again(self) -> None:
        """Wait for another result; what was published stays as it is."""
        self.complete = self.final = self._dirty = self._open = self._ended = False

    def finish(self) -> None:
        """Publish the final result now, unconditionally."""
        self.final = True
        self._do(time.monotonic())
        self.complete = True

    def tick(self, now: float) -> None:
        """Publish if due."""
        self.final = self._ended
        if self._ended and not self.complete:
            # Also where nothing came at all: that is a result too.
            self._do(now)
            self.complete = True
        elif self._open:
            silent_s, same_s = now - self._source_s, now - self._changed_s
            rests = silent_s > SOURCE_SILENT_S and same_s > IDLE_S
            self.final = rests and self._is_gone(silent_s, same_s)
            quiet = same_s > _QUIET_S
            due = now - self._published_s > max(self.period_s, 0.0 if quiet else 10.0 * self._cost_s)
            if self.final or (self._dirty and (rests or (due and self._wanted()))):
                self._do(now)

    def _is_gone(self, silent_s: float, same_s: float) -> bool:
        """Say whether nothing more will come, as far as anybody can know."""
        if math.isfinite(silent_s):
            return silent_s > SOURCE_GONE_S
        # Never heard of: who has only begun on a busy machine may get views before a source's first word.
        return same_s > SOURCE_GONE_S or not self._source_there()

    def _do(self, now: float) -> None:
        self._dirty = False
        self._open = self._open and not self.final
        self._publish()
        self._published_s = time.monotonic()
        self._cost_s = self._published_s - now
