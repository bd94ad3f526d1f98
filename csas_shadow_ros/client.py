"""Take part in the graph with a node of your own, such as a classifier, and lose no view.

See ``docs/classifier.md``; ``examples/classifier.py`` is ten lines.
"""

from __future__ import annotations

import signal
import threading
import time
import traceback
import uuid
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.serialization import deserialize_message
from rclpy.signals import uninstall_signal_handlers

from csas_shadow_ros.core.errors import CsasError, ParameterError
from csas_shadow_ros.core.geometry import View, ViewInfo, looks_at
from csas_shadow_ros.core.imaging.mask_codes import MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN
from msg_adapters import (
    VIEW_STREAMS,
    Heartbeat,
    RclpyMessages,
    TargetBox,
    ViewProgress,
    is_routine_report,
    progress_from_msg,
    progress_to_msg,
    stamp_to_ns,
    target_from_msg,
    view_from_msgs,
)
from msg_adapters.progress import INTEGRATED, PUBLISHED, REJECTED
from msg_adapters.topics import stream as stream_of
from msg_adapters.topics import topic as topic_of

from .nodes import qos
from .nodes.runtime.base import BEAT_S, Inlet, ViewOutlet, say_goodbye
from .nodes.runtime.flow import place_of
from .nodes.runtime.hearing import Reach, avoid_dead_ports
from .nodes.runtime.pace import Growing, source_is_there

#: What a callback gives back: nothing, the pixels of its result, or in words why it cannot use the view.
Answer = NDArray[Any] | str | None
Callback = Callable[[NDArray[Any], ViewInfo], Answer]
#: Streams whose sources know when every view is through; of an image or sectors they are before the views.
_VIEWS = frozenset(VIEW_STREAMS)
_LONELY_S = 5.0
_STOP_S = 0.05
#: Outcomes that are remembered, for views that come twice: days of views, a few MB.
_REMEMBERED = 1 << 16


#: Why a view subscriber hears nobody, and what helps.
DEAF = (
    "others write to ports in shared memory that this process has not, so it hears nobody; start it again,"
    " and make its node by csas_shadow_ros.client.create_node"
)


def create_node(name: str, **options: Any) -> Any:
    """Make a node as `rclpy.create_node` does, also where one of its name was killed just before.

    The middleware gives a new process the ports in shared memory of one that was killed. The others write to
    the old ones for some seconds, or for good. This takes ports that nobody writes to.

    Parameters
    ----------
    name : str
        The node's name.
    **options
        What `rclpy.create_node` takes: ``namespace``, ``context``, …

    Returns
    -------
    rclpy.node.Node
        The node.

    Examples
    --------
    >>> import rclpy
    >>> from csas_shadow_ros.client import create_node
    >>> rclpy.init()
    >>> node = create_node("classifier", namespace="csas")
    >>> node.get_fully_qualified_name()
    '/csas/classifier'
    >>> node.destroy_node()
    >>> rclpy.shutdown()
    """
    with avoid_dead_ports():
        return rclpy.create_node(name, **options)


class ViewSubscriber:
    """Calls back with every view of a stream: none is lost, however slow the callback is.

    It pairs images and camera infos, reports each view, and sends heartbeats while the callback computes.
    One that comes late, or again after it was killed, is sent every view that the source can make.

    Parameters
    ----------
    node : rclpy.node.Node
        Your node, in the graph's namespace; somebody has to spin it (`spin`, or ``rclpy.spin``).
    stream : str
        `sub_aperture`, `shadow`, `likelihood` or `shadow_mask`.
    callback : callable
        Takes (pixels, info): an ndarray of shape (rows, cols), NaN where the view knows nothing, and a
        `ViewInfo` (aspect, camera, stamp). A text that it returns, or an exception that it raises, refuses
        the view for that reason. It runs in a thread of its own, one view at a time.
    results : str, optional
        Stream that the callback's results go out on: `likelihood` or `shadow_mask`; of sub-apertures `shadow`
        too. It must return the result's pixels then (of a bool mask True is shadow, and unknown is where the
        view is NaN), and its node takes the place of the stage that makes this stream. By default a view
        ends here.
    on_finished : callable, optional
        Called, in the callback's thread and after its last view, once a run is over: the source says that
        every view has been through, or has been silent for so long that a result counts as final. It takes
        the run's name, the stamp (ns) of its track's first pose; None where the source knows no track. If a
        view of the run comes after all, it is called again once that is through.

    Raises
    ------
    ParameterError
        If `stream` is no stream of views, or `results` none that comes after it.

    Notes
    -----
    Without `results` the callback is called once with each view in the life of the process: a successor has
    to be told everything again. With `results` it is called again with a view whose result was lost
    behind it.

    Examples
    --------
    >>> import rclpy
    >>> from csas_shadow_ros.client import ViewSubscriber, spin
    >>> rclpy.init()
    >>> node = rclpy.create_node("classifier", namespace="csas")
    >>> views = ViewSubscriber(node, "shadow", lambda pixels, info: print(info.aspect_rad, pixels.shape))
    >>> spin(node, timeout_s=0.1)  # without a timeout until Ctrl-C
    >>> views.close()
    >>> node.destroy_node()
    >>> rclpy.shutdown()
    """

    def __init__(
        self,
        node: Any,
        stream: str,
        callback: Callback,
        *,
        results: str | None = None,
        on_finished: Callable[[int | None], None] | None = None,
    ) -> None:
        if stream not in VIEW_STREAMS:
            raise ParameterError(f"stream is {stream!r}; expected one of: {', '.join(VIEW_STREAMS)}")
        later = [name for name in VIEW_STREAMS if place_of(name) > place_of(stream)]
        if results is not None and results not in later:
            raise ParameterError(
                f"results is {results!r}; expected one of the streams behind {stream}:"
                f" {', '.join(later) or 'there is none'}"
            )
        self._callback = callback
        self._stream = stream
        self._host = _Host(node, self._look)
        self._reach = Reach()
        self._target: TargetBox | None = None
        self._wake = threading.Condition()
        self._waiting: OrderedDict[int, tuple[Any, Any]] = OrderedDict()
        self._known: OrderedDict[tuple[Any, ...], tuple[str, str]] = OrderedDict()
        #: Lines at which the callback has failed.
        self._raised: set[tuple[str, int | None]] = set()
        self._working_on: tuple[Any, ...] = ()
        self._closed = False
        self._on_finished = on_finished
        self._run: int | None = None
        self._over: deque[int | None] = deque()
        # As every sink of the package: it says when what there is is final.
        self._growing = Growing(self._run_is_over, lambda: False, 0.0, partial(source_is_there, node))
        # The outlet before the inlet: what comes in can go out.
        self._results = results
        self._outlet = None if results is None else ViewOutlet(self._host, results)
        self._host.subscribe("target", qos.LATCHED, self._take_target)
        role = "sink" if results is None else "stage"
        self._inlet = Inlet(self._host, stream, role, self._enqueue)
        if on_finished is not None:
            self._host.subscribe("progress", qos.REPORTS, self._take_progress, raw=True)
        self._worker = threading.Thread(target=self._work, name=f"{stream} callback", daemon=True)
        self._worker.start()
        self._host.start()

    @property
    def counts(self) -> dict[str, int]:
        """Views: `in`, `integrated` or `out`, `rejected`, `duplicates`."""
        return dict(self._host.counts)

    def close(self) -> None:
        """Finish the view that is worked on, and say goodbye, so that nobody waits."""
        with self._wake:
            self._closed = True
            self._wake.notify()
        if self._worker is not threading.current_thread():
            self._worker.join()
        self._host.stop()

    def __enter__(self) -> ViewSubscriber:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # In the node's executor

    def _take_target(self, msg: Any) -> None:
        self._target = target_from_msg(msg)
        self._host.target_stamp = str(stamp_to_ns(msg.header.stamp, "target.header.stamp"))

    def _take_progress(self, cdr: bytes) -> None:
        """Note what a source of views says of the run's end."""
        if is_routine_report(cdr):
            return
        kind = self._host.messages.cls(topic_of("progress").type_name)
        beat = progress_from_msg(deserialize_message(cdr, kind))
        if not isinstance(beat, Heartbeat) or beat.role != "source":
            return
        if beat.values.get("stream") not in _VIEWS:
            return
        # Nobody waits for a stage itself: it has passed everything on once all behind it are done.
        ended = self._inlet.instance in beat.values.get("finished_for", "").split()
        ended |= self._outlet is not None and bool(beat.counts.get("finished"))
        name = beat.values.get("run", "")
        with self._wake:
            run = int(name) if name.isdecimal() else None
            if run != self._run:
                self._growing.begin_again()
                self._run = run
            self._growing.source_says(ended)
            self._growing.tick(time.monotonic())

    def _run_is_over(self) -> None:
        """Have the callback's thread tell that the run is over, after the views that wait."""
        if self._growing.final:
            self._over.append(self._run)
            self._wake.notify()

    def _has_changed(self) -> None:
        with self._wake:
            self._growing.changed()
            self._growing.source_says(False)  # what it said before did not count this view

    def _enqueue(self, image: Any, info: Any) -> None:
        """Keep a view for the callback: a window of them at most, the newer one of two copies."""
        with self._wake:
            stamp = stamp_to_ns(image.header.stamp)
            if self._waiting.pop(stamp, None) is None and len(self._waiting) >= qos.MAX_WINDOW:
                return  # more than any source has on its way; not reported, so it is sent again
            self._waiting[stamp] = (image, info)
            self._wake.notify()

    # In the callback's thread

    def _work(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._waiting or self._over or self._closed)
                if self._closed:
                    return
                over = not self._waiting
                if over:
                    run = self._over.popleft()
                else:
                    stamp, (image, info) = self._waiting.popitem(last=False)
            if over:
                self._tell_the_end(run)
                continue
            try:
                self._work_on(stamp, image, info)
            except (InvalidHandle, RuntimeError) as error:
                if not self._host.node.context.ok():
                    return  # shut down under us: nobody hears it any more
                self._host.reject(f"{type(error).__name__}: {error}")

    def _tell_the_end(self, run: int | None) -> None:
        try:
            if self._on_finished is not None:
                self._on_finished(run)
        except Exception as error:
            # The run is over all the same, and the next one's views are to be taken.
            self._host.node.get_logger().error("".join(traceback.format_exception(error)))

    def _work_on(self, stamp: int, image: Any, info: Any) -> None:
        # The same stamp with another camera or focus is another view: of a target that has moved.
        key = (stamp, *info.p, *info.d)
        known = self._known.get(key)
        if known is None or self._outlet is not None:
            known = self._ask(stamp, image, info)
        else:
            self._host.counts["duplicates"] += 1
        if known is None:
            return
        if key not in self._known:
            self._has_changed()
        self._known[key] = known
        if len(self._known) > _REMEMBERED:
            self._known.popitem(last=False)
        outcome, reason = known
        if outcome == REJECTED:
            self._inlet.refuse(stamp, info, reason)
        else:
            self._inlet.report(stamp, outcome)

    def _ask(self, stamp: int, image: Any, info: Any) -> tuple[str, str] | None:
        """Call back; return (outcome, reason), None for a view of a target that has moved since."""
        try:
            view = view_from_msgs(image, info, self._stream)
            if self._outdated(view.info):
                return None
            answer = self._callback(view.pixels, view.info)
            if isinstance(answer, str):
                return REJECTED, answer or "refused without a reason"
            if self._outdated(view.info):
                return None
            if self._outlet is None:
                if answer is not None:
                    raise TypeError(f"callback returned {type(answer).__name__}; expected None or a reason")
                return INTEGRATED, ""
            self._outlet.send(self._result(answer, view), trusted=False)
            return PUBLISHED, ""
        except CsasError as error:
            return REJECTED, str(error)
        except (InvalidHandle, ExternalShutdownException):
            raise
        except Exception as error:
            self._tell_of_raise(error, stamp)
            return REJECTED, f"{type(error).__name__}: {error}"

    def _tell_of_raise(self, error: Exception, stamp: int) -> None:
        """Log where the callback failed, once for each line of it; other views may fail there too."""
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = last.filename, last.lineno
        if place not in self._raised:
            self._raised.add(place)
            told = "".join(traceback.format_exception(error)).rstrip()
            self._host.node.get_logger().error(
                f"the callback failed at the view stamped {stamp} ns:\n{told}"
            )

    def _outdated(self, info: ViewInfo) -> bool:
        return self._target is not None and not looks_at(info, self._target.centre_m[:2])

    def _result(self, answer: Answer, view: View) -> View:
        if not isinstance(answer, np.ndarray):
            what = type(answer).__name__
            raise TypeError(f"callback returned {what}; expected the result's pixels or a reason")
        if answer.dtype == np.bool_ and self._results == "shadow_mask":
            answer = np.where(answer, np.uint8(MASK_SHADOW), np.uint8(MASK_OUTSIDE))
            if answer.shape == view.pixels.shape:  # others are refused below
                answer[np.isnan(view.pixels)] = MASK_UNKNOWN
        wanted = np.uint8 if self._results == "shadow_mask" else np.float32
        return View(view.info, np.ascontiguousarray(answer.astype(wanted, casting="same_kind", copy=False)))

    # In the heartbeats' thread

    def _look(self, age_s: float) -> None:
        with self._wake:
            self._growing.tick(time.monotonic())
        if self._reach.is_lost():
            self._host.unable = DEAF  # nobody waits for it for long
            self._host.node.get_logger().error(DEAF)
        topic = stream_of(self._stream).image_topic
        if age_s > _LONELY_S and not self._host.count_publishers(topic):
            name = self._host.node.resolve_topic_name(topic)
            domain = self._host.node.context.get_domain_id()
            self._host.warn_once(
                f"nobody in ROS domain {domain} publishes {name}: waiting; expected a graph in the same"
                " domain (ROS_DOMAIN_ID) and namespace"
            )


class _Host:
    """What an `Inlet` and a `ViewOutlet` need of a node, within a node of somebody else's."""

    def __init__(self, node: Any, look: Callable[[float], None]) -> None:
        self.node = node
        self.name: str = node.get_name()
        self.instance = uuid.uuid4().hex[:12]
        self.messages = RclpyMessages()
        self.scene_frame = ""
        self.counts: Counter[str] = Counter()
        self.inlets: list[Inlet] = []
        self.trouble = self.unable = self.target_stamp = ""
        self._look = look
        self._warned: set[str] = set()
        self._owned: list[tuple[Callable[[Any], Any], Any]] = []
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._reports = self.publisher("progress", qos.REPORTS)
        self._heartbeats = self.publisher("progress", qos.HEARTBEAT)
        self._thread = threading.Thread(target=self._beat_on, name="heartbeat", daemon=True)

    def start(self) -> None:
        """Let others know at once that there is somebody, and go on doing so."""
        self._beat()
        self._thread.start()

    def stop(self) -> None:
        """Say goodbye, and take back what was made."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._thread.join()
        try:
            for inlet in list(self.inlets):
                inlet.close()
            for destroy, entity in self._owned:
                destroy(entity)
        except (InvalidHandle, RuntimeError) as error:
            # The context was shut down before: those who wait find out after a while.
            self.node.get_logger().debug(f"could not say goodbye: {error}")
        self._owned.clear()

    def _beat(self) -> None:
        for inlet in self.inlets:
            self._heartbeats.publish(progress_to_msg(self.messages, inlet.beat(leaving=False)))

    def _beat_on(self) -> None:
        began = time.monotonic()
        while not self._stop.wait(BEAT_S):
            try:
                with self._lock:
                    for inlet in self.inlets:
                        inlet.give_up_lonely()
                self._beat()
                self._look(time.monotonic() - began)
            except InvalidHandle:
                return  # the node was destroyed
            except RuntimeError as error:
                if not self.node.context.ok():
                    return
                self.node.get_logger().debug(f"skipped a heartbeat: {error}")

    def publisher(self, topic: str, profile: Any) -> Any:
        made = self.node.create_publisher(self.messages.cls(topic_of(topic).type_name), topic, profile)
        self._owned.append((self.node.destroy_publisher, made))
        return made

    def subscribe(
        self, topic: str, profile: Any, callback: Callable[[Any], None], *, raw: bool = False
    ) -> Any:
        def guarded(msg: Any) -> None:
            try:
                with self._lock:
                    callback(msg)
            except CsasError as error:
                self.reject(str(error))

        kind = self.messages.cls(topic_of(topic).type_name)
        made = self.node.create_subscription(kind, topic, guarded, profile, raw=raw)
        self._owned.append((self.node.destroy_subscription, made))
        return made

    def unsubscribe(self, subscription: Any) -> None:
        self._owned.remove((self.node.destroy_subscription, subscription))
        self.node.destroy_subscription(subscription)

    def count_publishers(self, topic: str) -> int:
        return int(self.node.count_publishers(topic))

    def leave(self, inlet: Inlet) -> None:
        self.inlets.remove(inlet)
        say_goodbye(self._heartbeats, self.messages, [inlet])

    def reject(self, reason: str) -> None:
        self.counts["rejected"] += 1
        self.node.get_logger().warning(reason, throttle_duration_sec=1.0)

    def warn_once(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            self.node.get_logger().warning(text)

    def send_report(self, item: ViewProgress) -> None:
        self._reports.publish(progress_to_msg(self.messages, item))

    def now_ns(self) -> int:
        return int(self.node.get_clock().now().nanoseconds)

    def common_counts(self) -> dict[str, int]:
        return {name: self.counts[name] for name in ("in", "out", "rejected", "duplicates")}

    def state_values(self) -> dict[str, str]:
        return {}


def spin(
    node: Any, timeout_s: float | None = None, *, until: Callable[[], bool] = lambda: False
) -> None:
    """Spin a node until SIGINT or SIGTERM, and leave it able to say goodbye.

    ``rclpy.spin`` does as well, but on Ctrl-C rclpy cuts the node off first: the graph then waits for it as
    for one that was killed. Call it from the main thread.

    Parameters
    ----------
    node : rclpy.node.Node
        The node.
    timeout_s : float, optional
        Come back after so long.
    until : callable, optional
        Come back once it returns True; asked twenty times a second.
    """
    uninstall_signal_handlers()
    stop = threading.Event()
    before = {n: signal.signal(n, lambda *_: stop.set()) for n in (signal.SIGINT, signal.SIGTERM)}
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end = None if timeout_s is None else time.monotonic() + timeout_s
    try:
        while not stop.is_set() and node.context.ok() and (end is None or time.monotonic() < end):
            if until():
                return
            executor.spin_once(timeout_sec=_STOP_S)
    except ExternalShutdownException:
        pass
    finally:
        executor.remove_node(node)
        executor.shutdown(timeout_sec=1.0)
        for number, handler in before.items():
            signal.signal(number, handler)


__all__ = ["Reach", "ViewSubscriber", "create_node", "spin"]
