"""Node `viewer`: the operator's view of the live graph, in a browser (figures 2, 3, 5, 6 and 8).

It only looks: it sends no heartbeat and no reports, so no source waits for it, and what it is too slow for it
drops. When a source says that it has finished, the node joins as a sink for as long as it lacks views (those
dropped, or sent before it was started), gets them by flow control, and says goodbye.
"""

from __future__ import annotations

import contextlib
import math
import os
import queue
import sys
import threading
import time
from collections import deque
from dataclasses import asdict, replace
from functools import partial
from typing import Any

from csas_shadow_ros.bags.bag import BagMessage
from csas_shadow_ros.core.errors import CsasError
from csas_shadow_ros.core.parameters import CarvingParameters, SubApertureParameters
from csas_shadow_ros.results.layout import json_ready
from csas_shadow_ros.viewer.codes import amplitude_codes
from csas_shadow_ros.viewer.contacts import about, contacts_of
from csas_shadow_ros.viewer.derived import Reduced, Shape
from csas_shadow_ros.viewer.server import ViewerServer
from csas_shadow_ros.viewer.source import box_json, grid_of, spooled
from csas_shadow_ros.viewer.store import Spool, ViewStore
from msg_adapters import (
    TOPICS,
    VIEW_STREAMS,
    Heartbeat,
    Pairer,
    coherent_image_from_msgs,
    ground_picture_from_msgs,
    measurements_from_msg,
    target_from_msg,
    view_from_msgs,
    voxel_grid_from_msgs,
)
from msg_adapters.topics import stream as stream_of

from . import qos
from .runtime.base import INTEGRATED, CsasNode, Inlet, run_node, say_goodbye
from .runtime.flow import place_of
from .runtime.runs import RunFollower

#: Messages that wait to be shown; newer ones are dropped, and caught up with at the end of the run.
_BACKLOG = 32
_GROWING = ("multilook", "color_by_aspect", "voxel_grid", "voxel_views")
_BATCH = 8
#: Discovery takes a moment after the start and after leaving; so often a run's missing views are asked for.
_SETTLE_S, _TRIES = 3.0, 3
#: A graph whose source has been silent for so long is gone: six heartbeats, as of consumers (`nodes.rivals`).
_SILENT_S = 3.0
#: The rate of views is that of so long.
_RATE_S = 5.0


class CatchingUp(Inlet):
    """The reports on a stream's stored views: a sink while some are missing."""

    def __init__(self, node: ViewerNode, stream: str) -> None:
        # No subscriptions of its own: the viewer's are there anyway.
        self.node = node
        self.stream = stream
        self.role = "sink"
        self.optional = False
        self.held = deque()
        self.instance = f"{node.instance}-{stream}"

    def give_up_lonely(self) -> None:
        """Do nothing: no unpaired messages are kept here."""

    # Nobody need wait for its successor, which asks by itself.

    def report(self, stamp_ns: int, outcome: str, reason: str = "", **more: str) -> None:
        """Report the fate of a view."""
        super().report(stamp_ns, outcome, reason, passing="true", **more)

    def beat(self, *, leaving: bool) -> Heartbeat:
        """Make the heartbeat."""
        made = super().beat(leaving=leaving)
        return replace(made, values={**made.values, "passing": "true"})


class ViewerNode(CsasNode):
    """Takes everything that can be shown; serves the page."""

    name = "viewer"
    server: ViewerServer | None = None

    def setup(self) -> None:
        """Listen for pages, then subscribe."""
        p = self.parameters
        self.store = ViewStore(title="live", live=True)
        self.server = ViewerServer(self.store, p.host, p.port, None if p.token == "auto" else p.token)
        try:
            self.server.start()
        except CsasError:
            self.server = None
            raise
        self.get_logger().info(f"the view is at {self.server.url}")
        self._spool = Spool()
        self._shape = Shape(self.store, CarvingParameters(method=p.method))
        self._queue: queue.Queue[tuple[str, Any, Any]] = queue.Queue(_BACKLOG)
        self._volumes: dict[str, Any] = {}
        self._track: Any = None
        #: The run that is shown.
        self._run_ns: int | None = None
        self._runs = RunFollower(self, self._on_track)
        self._image: dict[str, bytes] = {}
        self._finished = False
        self._said_s = 0.0
        #: When a source was heard last, and when the newest view came.
        self._heard_s = self._newest_s = -math.inf
        self._total = 0
        #: When each of the last views came.
        self._came: deque[float] = deque(maxlen=50)
        self._joined = ""
        self._tries: dict[tuple[str, int], int] = {}
        self._since_s = time.monotonic()
        self._shaped = threading.Event()
        self._measured = False
        self._stopping = threading.Event()
        self._worker = threading.Thread(target=self._work, name="viewer-worker", daemon=True)
        self._worker.start()
        for name in VIEW_STREAMS:
            self._pair(name, latched=False)
        for name in _GROWING:
            self._pair(name, latched=True)
        self.subscribe_latched("target", self._take_target)
        self.subscribe_latched("measurements", self._take_measurements)
        for topic in ("image", "camera_info"):
            self.subscribe_latched(topic, partial(self._take_image, topic), raw=True)
        self.follow_sources()

    def forget(self) -> None:
        """Close the page's server."""
        if self.server is not None:
            self._stopping.set()
            self.server.stop()
            self._worker.join(5.0)
            self.server = None

    def stop(self) -> None:
        """End the work, and the server."""
        super().stop()
        self.forget()

    def state_counts(self) -> dict[str, int]:
        """Return the number of stored views per stream."""
        if self.server is None:
            return {}
        return {name: len(self.store.sets[name]) for name in VIEW_STREAMS}

    # Taking messages: at once, and without ever making the graph wait

    def _pair(self, name: str, *, latched: bool) -> None:
        kind = stream_of(name)
        pairer = Pairer(kind.image_topic, capacity=qos.MAX_WINDOW)

        def take(msg: Any, *, is_info: bool) -> None:
            pair = pairer.add(msg, is_info=is_info)
            pairer.orphans.clear()  # a view of which half was lost is one more that is lacking
            if pair is not None:
                self.counts["in"] += 1
                try:
                    self._queue.put_nowait((name, *pair))
                except queue.Full:
                    self.counts["dropped"] += 1

        for topic, is_info in ((kind.image_topic, False), (kind.info_topic, True)):

            def callback(msg: Any, is_info: bool = is_info) -> None:
                take(msg, is_info=is_info)

            if latched:
                self.subscribe_latched(topic, callback)
            else:
                self.subscribe(topic, qos.VIEWS, callback)

    def _on_track(self, name: int, renamed: dict[int, int]) -> None:
        if self._run_ns is not None:
            self._run_ns = renamed.get(self._run_ns, self._run_ns)
        if self._run_ns is None or name == self._run_ns:
            self._show_track(name)

    def _show_track(self, name: int) -> None:
        self._track = self._runs.book.track(name)
        self.store.put_track(self._track)
        self._offer_reduced()

    def _enter_run(self, stamp: int) -> None:
        """Show another run from its first view on: until then the one before stays."""
        run_ns = self._runs.run_of(stamp)
        if run_ns is None or run_ns == self._run_ns:
            return
        if self._run_ns is not None:
            self.store.reset(keep=("target", "reduced"))
            self._tries.clear()
            self._measured = False
        self._run_ns = run_ns
        self._show_track(run_ns)

    def _take_target(self, msg: Any) -> None:
        self.store.put_part("target", box_json(target_from_msg(msg)))

    def _take_measurements(self, msg: Any) -> None:
        told = measurements_from_msg(msg)
        self._measured = True
        self.store.put_dimensions(told.objects[0].dimensions if told.objects else None)
        report = {
            "verdict": told.verdict,
            "quality": {"verdict": told.quality.verdict, "reasons": list(told.quality.reasons)},
            "views": {"used": told.views_used},
            "objects": [
                {
                    "number": one.number,
                    "position_m": one.dimensions.position_m,
                    "dimensions": asdict(one.dimensions),
                    "views_used": one.views_used,
                    "files": ["grid.npz" if one.number == 1 else ""],
                }
                for one in told.objects
            ],
            "objects_left_out": [asdict(one) for one in told.left_out],
        }
        report = json_ready(report)
        self.store.put_part("report", about(report))
        self.store.put_part("contacts", contacts_of(report))

    def _take_image(self, topic: str, cdr: bytes) -> None:
        self._image[topic] = cdr
        self._offer_reduced()

    def _offer_reduced(self) -> None:
        there = self._track is not None and {"image", "camera_info"} <= set(self._image)
        self.store.put_part("reduced", there)
        self.store.make_reduced = self._make_reduced if there else None

    def _make_reduced(self) -> None:
        image, info = (
            BagMessage(topic, TOPICS[topic].type_name, 0, 0, memoryview(self._image[topic])).decode()
            for topic in ("image", "camera_info")
        )
        coherent = coherent_image_from_msgs(image, info)
        Reduced(coherent, self._track, SubApertureParameters()).fill(self.store)

    # Showing them: in a thread that gives way to all others

    def _work(self) -> None:
        with contextlib.suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        while not self._stopping.is_set():
            try:
                name, image, info = self._queue.get(timeout=0.3)
            except queue.Empty:
                self.guard("shape", self._shape_some)
                continue
            self.guard(name, self._show, name, image, info)

    def _show(self, name: str, image: Any, info: Any) -> None:
        if name in VIEW_STREAMS:
            entry = spooled(self._spool, name, view_from_msgs(image, info, name))
            self._enter_run(entry.info.stamp_ns)
            self.store.put_view(name, entry)
            if name == "shadow" or not self.store.sets["shadow"]:
                self._newest_s = time.monotonic()
                self._came.append(self._newest_s)
            self._shaped.clear()
            inlet = next((i for i in self.inlets if i.stream == name), None)
            if inlet is not None:
                inlet.report(entry.info.stamp_ns, INTEGRATED)
        elif name.startswith("voxel_"):
            stamp, volume, values = voxel_grid_from_msgs(image, info, name)
            self._volumes[name] = stamp, volume, values
            likelihood, views = (self._volumes.get(n) for n in ("voxel_grid", "voxel_views"))
            if likelihood and views and likelihood[0] == views[0] and volume == likelihood[1] == views[1]:
                p = self._shape.parameters
                grid = grid_of(volume, likelihood[2], views[2], p)
                self.store.put_grid("main", grid, p.min_views_fraction)
                self._shaped.clear()
        else:
            ground, pixels = ground_picture_from_msgs(image, info, name)
            self.store.put_picture(name, ground, amplitude_codes(pixels) if name == "multilook" else pixels)

    def _shape_some(self) -> None:
        """Carve by the other method, and measure at the end, while nothing else is to be done."""
        if self._shaped.is_set() or "main" not in self.store.grids:
            return
        left = self._shape.pending()
        for name, entry in left[:_BATCH]:
            self._shape.add(name, entry)
        if len(left) <= _BATCH:
            self._shaped.set()
            # Who carves says how large it is; of another's grid nobody does.
            self._shape.publish(measure=self._finished and not self._measured)

    # Catching up, once nobody else needs the source

    def on_source(self, beat: Heartbeat) -> None:
        """Join when a source has finished and views are missing; leave when they have arrived."""
        own = beat.values.get("stream", "")
        if own == "sector" or self.server is None:
            self._heard_s = time.monotonic()
            return
        if self.inlets and beat.instance != self._joined:
            self._leave()  # another run has begun: whatever the last one lacked is not to be had any more
        if self.inlets:
            done = beat.values.get("finished_for", "").split()
            if all(inlet.instance in done for inlet in self.inlets):
                self._leave()
            return
        finished, total = bool(beat.counts.get("finished")), beat.counts.get("total", 0)
        self._heard_s, self._total = time.monotonic(), total
        if finished != self._finished:
            self._finished = finished
            self._shaped.clear()
        fed = [s for s in VIEW_STREAMS if place_of(s) >= place_of(own)]
        # A stream that nobody publishes cannot be caught up with.
        fed = [s for s in fed if self.count_publishers(stream_of(s).image_topic)]
        lacking = any(len(self.store.sets[s]) < total for s in fed)
        # Not before everybody is heard of, nor for ever: a view that a stage refuses is never to be had.
        settled = time.monotonic() - self._since_s > _SETTLE_S and self._queue.empty()
        tries = self._tries.get((beat.instance, total), 0)
        if finished and lacking and settled and tries < _TRIES:
            self._tries[beat.instance, total] = tries + 1
            self._join(fed, beat.instance)

    def _join(self, streams: list[str], source: str) -> None:
        self._joined = source
        joined = [CatchingUp(self, s) for s in streams]
        for inlet in joined:
            for stamp in list(self.store.sets[inlet.stream]):
                inlet.report(stamp, INTEGRATED)
        self.inlets.extend(joined)
        self.get_logger().info("the run is finished: asking for the views that were missed")

    def _leave(self) -> None:
        """Say goodbye and take the kept reports back: a later source would wait for their sender."""
        with self._beat_lock:
            say_goodbye(self._heartbeats, self.messages, self.inlets)
            self.inlets.clear()
            old = (self._reports, self._heartbeats)
            self._owned = [(destroy, made) for destroy, made in self._owned if made not in old]
            for made in old:
                self.destroy_publisher(made)
            self._reports = self.publisher("progress", qos.REPORTS)
            self._heartbeats = self.publisher("progress", qos.HEARTBEAT)
        self._since_s = time.monotonic()
        self._shaped.clear()
        self._finished = True

    def tick(self) -> None:
        """Show the run's progress on the page."""
        now = time.monotonic()
        if now - self._said_s > 1.0 and self.server is not None:
            self._said_s = now
            held = len(self.store.sets["shadow"]) or len(self.store.sets["sub_aperture"])
            self.store.put_part("status", f"{held} views, " + ("finished" if self._finished else "running"))
            self.store.put_part("progress", self._progress(now, held))

    def _progress(self, now: float, held: int) -> dict[str, Any]:
        """Say how the run goes, as the page's badge tells it."""
        silent = now - self._heard_s
        state = "finished" if self._finished else "running"
        if silent > _SILENT_S:
            state = "silent" if math.isfinite(silent) else "waiting"
        recent = [t for t in list(self._came) if now - t < _RATE_S]
        span = now - recent[0] if recent else 0.0
        return {
            "state": state,
            "views": held,
            "of": self._total or None,
            "rate": round(len(recent) / span, 1) if span > 0.5 else None,
            "newest_s": round(now - self._newest_s) if held and math.isfinite(self._newest_s) else None,
            "silent_s": round(silent) if state == "silent" else None,
        }


def main() -> int:
    """Run the node."""
    return run_node(ViewerNode)


if __name__ == "__main__":
    sys.exit(main())
