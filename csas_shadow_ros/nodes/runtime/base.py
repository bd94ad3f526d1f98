"""What all nodes share: parameters, lifecycle, reports, diagnostics, joined inputs and flow control."""

from __future__ import annotations

import gc
import math
import os
import re
import signal
import sys
import tempfile
import threading
import time
import traceback
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSCompatibility, ReliabilityPolicy, qos_check_compatible
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from csas_shadow_ros.core.errors import CsasError, ParameterError
from csas_shadow_ros.core.geometry import View
from csas_shadow_ros.core.search.decision import Decision
from csas_shadow_ros.core.shape.volume import Target
from msg_adapters import (
    TOPICS,
    Heartbeat,
    Level,
    Pairer,
    RclpyMessages,
    SearchNews,
    TargetBox,
    ViewProgress,
    decision_from_msg,
    diagnostics_to_msg,
    frame_of,
    is_routine_report,
    message_from_cdr,
    progress_from_msg,
    progress_to_msg,
    stamp_to_ns,
    target_from_msg,
    target_may_move,
    view_info_from_msg,
    view_to_msgs,
)
from msg_adapters.progress import INTEGRATED, PUBLISHED, REJECTED, instance_of
from msg_adapters.topics import stream as stream_of
from msg_adapters.topics import topic as topic_of

from .. import qos
from .flow import Flow
from .hearing import Deaf, Reach, make_hearing
from .host import Host
from .params import DYNAMIC, NODES, declare, from_overrides
from .rivals import Rivals, at_work
from .secured import security_told
from .shared_memory import tidy_up_after_a_killed_graph
from .watchdog import ends_if_it_stands_still

NAMESPACE = "csas"
BEAT_S = 0.5
_LOG_EVERY_S = 10.0
_MAX_KINDS = 32
#: Who leaves waits so long (s) for others to hear of it. One that is killed never does.
_GOODBYE_S = 2.0
#: So many views are known again if they come twice: as many as the kept reports (`qos.REPORTS`).
_REMEMBERED = 4096
_LONELY_S = 5.0
#: How soon a node that nothing happens to notices that it is told to stop.
_STOP_S = 0.05
#: How often it is looked who publishes latched topics: sooner than a large image is through.
_DURABILITY_S, _WHO_S = 0.05, 1.0
#: How often it is asked anew who publishes a topic, where their number is the same.
_STRANGERS_S = 5.0


def kind_of(reason: str) -> str:
    """Return the kind of a reason: the reason without its numbers."""
    return re.sub(r"-?\d[\d.,e+-]*", "#", reason)[:160]


class CsasNode(LifecycleNode):
    """A lifecycle node of the package.

    Subclasses set `name` and override `setup`, which makes publishers, inlets and sources.

    Parameters
    ----------
    context : Context, optional
        rclpy context; the default one otherwise.
    namespace : str
        Namespace unless the command line remaps it.
    overrides : mapping, optional
        Parameter values, besides those of the command line.
    arguments : sequence of str, optional
        ROS arguments of this node alone (``--ros-args …``).

    Raises
    ------
    ParameterError
        If a parameter is unknown or out of range.
    """

    name: ClassVar[str] = ""
    #: There can be one such node in a namespace.
    alone: ClassVar[bool] = False

    def __init__(
        self,
        *,
        context: Context | None = None,
        namespace: str = NAMESPACE,
        overrides: Mapping[str, Any] | None = None,
        arguments: Sequence[str] | None = None,
    ) -> None:
        super().__init__(
            self.name,
            context=context,
            namespace=namespace,
            cli_args=list(arguments) if arguments else None,
            parameter_overrides=[Parameter(k, value=v) for k, v in (overrides or {}).items()],
        )
        given = {name: p.value for name, p in self._parameter_overrides.items()}
        self.parameters: Any = from_overrides(NODES[self.name], given)
        declare(self, self.parameters)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.instance = ""
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.messages = RclpyMessages()
        self.active = self._configured = False
        #: Topics of the contract that it has subscribed to, and that it publishes.
        self._takes: dict[str, None] = {}
        self._gives: dict[str, None] = {}
        self.counts: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        #: The first reason of each kind, word for word.
        self.examples: dict[str, str] = {}
        self.busy_s = 0.0
        #: What stops the node from working, if anything does; shown in diagnostics and heartbeats.
        self.error = ""
        #: Why the node cannot take anything for now, if it cannot: the others go on without it after a while.
        self.unable = ""
        #: Who else's graph is at work here; as long as it is, nothing is taken and nothing sent.
        self.rival = ""
        self.rivals = Rivals(self.name, alone=self.alone)
        #: Stamp of the target that the node works for, "0" before there is one; empty: it needs none.
        self.target_stamp = ""
        self.inlets: list[Inlet] = []
        self.sources: list[Source] = []
        self._owned: list[tuple[Callable[[Any], Any], Any]] = []
        self._latched: list[Latched] = []
        #: Topics of which something came that was not taken: the node was inactive, or a rival was there.
        self._missed: set[str] = set()
        #: Publishers of our topics of which nothing can be heard.
        self.strangers = Strangers(self)
        self._deaf = Deaf(self.context.get_domain_id())
        self._logged: dict[str, tuple[float, int]] = {}
        self._rates: dict[str, tuple[int, float]] = {}
        self._beat_lock = threading.Lock()
        self._beat_stop = threading.Event()
        self._beat_thread: threading.Thread | None = None

    # To override

    def setup(self) -> None:
        """Make publishers, inlets and sources."""

    def forget(self) -> None:
        """Drop a run's state; called on cleanup."""

    def finish(self) -> None:
        """Finish what must survive; called on deactivation and shutdown."""

    @classmethod
    def preload(cls) -> None:
        """Load in advance what the first view needs; works without a node, and takes time only once."""

    def on_activated(self) -> None:
        """Do the work due once at activation."""

    def tick(self) -> None:
        """Do the work due a few times a second."""

    def state_counts(self) -> dict[str, int]:
        """Return counts for the heartbeat, besides the common ones."""
        return {}

    def state_values(self) -> dict[str, str]:
        """Return further values for the heartbeat and diagnostics."""
        return {}

    def waiting(self) -> str:
        """Say what the node waits for; empty if nothing."""
        return ""

    def keeps_its_state(self) -> bool:
        """Say whether the node's state comes only from its own graph, after another one has gone.

        If not, it begins anew, as a node that was killed does: sources send it everything again.
        """
        return True

    def on_source(self, beat: Heartbeat) -> None:
        """Handle a source's heartbeat; only nodes that `follow_sources` receive them."""

    # Making entities that live from configure to cleanup

    def publisher(self, topic: str, profile: Any) -> Publisher:
        """Make a publisher of a topic of the contract."""
        self._gives[topic] = None
        return self.own_publisher(self.messages.cls(topic_of(topic).type_name), topic, profile)

    def own_publisher(self, kind: Any, topic: str, profile: Any) -> Publisher:
        """Make a publisher for a topic outside the contract."""
        made = self.create_publisher(kind, topic, profile)
        self._owned.append((self.destroy_publisher, made))
        return made

    def subscribe(
        self, topic: str, profile: Any, callback: Callable[[Any], None], *, raw: bool = False
    ) -> Subscription:
        """Subscribe to a topic of the contract; errors of the callback do not end the node."""

        def guarded(msg: Any) -> None:
            if self.active and (not self.rival or topic == "progress"):
                self.guard(topic, callback, msg)
            else:
                self._missed.add(topic)

        kind = self.messages.cls(topic_of(topic).type_name)
        # Not rclpy's own warnings: of two subscriptions to a topic one may hear what the other cannot.
        # Of publishers that none of them hears `Strangers` tells.
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        made = self.create_subscription(kind, topic, guarded, profile, raw=raw, event_callbacks=quiet)
        self._takes[topic] = None
        self._owned.append((self.destroy_subscription, made))
        self.strangers.subscribed(made)
        return made

    def unsubscribe(self, subscription: Subscription) -> None:
        """Remove a subscription."""
        self._owned.remove((self.destroy_subscription, subscription))
        self.strangers.unsubscribed(subscription)
        self.destroy_subscription(subscription)

    def subscribe_latched(
        self,
        topic: str,
        callback: Callable[[Any], None],
        *,
        raw: bool = False,
        profile: Any = qos.LATCHED,
    ) -> Latched:
        """Subscribe to a latched topic, whether or not its publisher really latches it."""
        if not self._latched:
            # One timer for all topics: a recorder follows dozens.
            self.every(_DURABILITY_S, self._look_for_unlatched)
        made = Latched(
            self, topic, profile, lambda profile: self.subscribe(topic, profile, callback, raw=raw)
        )
        self._latched.append(made)
        return made

    def _look_for_unlatched(self) -> None:
        for one in self._latched:
            one.look()

    def _ask_for_missed(self) -> None:
        """Get again what was latched while the node took nothing: nobody publishes it a second time."""
        missed, self._missed = self._missed, set()
        for one in self._latched:
            if one.topic in missed:
                one.ask_again()

    def every(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call back periodically while the node is configured.

        On steady time: a node that goes by `/clock` works on while that stands still, jumps or is not there.
        """
        made = self.create_timer(period_s, lambda: self.guard("timer", callback), clock=self._steady)
        self._owned.append((self.destroy_timer, made))

    def background(self, callback: Callable[[], None]) -> Background:
        """Make background work, done piece by piece between callbacks while the node is configured."""
        made = Background(self, callback)
        self._owned.append((Background.cancel, made))
        return made

    def start_waiting_work(self) -> None:
        """Start work triggered before the node had an executor."""
        for _, entity in list(self._owned):
            if isinstance(entity, Background):
                entity.start()

    def follow_sources(self) -> None:
        """Listen to the sources' heartbeats."""
        self.subscribe("progress", qos.REPORTS, self._on_progress, raw=True)

    def _on_progress(self, cdr: bytes) -> None:
        if is_routine_report(cdr):
            return  # most are, and to read one takes as long as to carve from a view
        item = progress_from_msg(deserialize_message(cdr, self.messages.cls(TOPICS["progress"].type_name)))
        if self.is_ours(item) and isinstance(item, Heartbeat) and item.role == "source" and not self.rival:
            self.on_source(item)

    # Other graphs

    def is_ours(self, item: ViewProgress | Heartbeat) -> bool:
        """Say whether a message on `progress` belongs to this graph; note its sender."""
        if isinstance(item, Heartbeat):
            self.rivals.hear(item, self.instance)
            if not self.rival:
                self._look_for_rivals()
        return not self.rivals.is_other(item.instance)

    def _look_for_rivals(self) -> None:
        who = self.rivals.look()
        if who and not self.rival:
            self.rival = at_work(who, self.get_namespace(), self.context.get_domain_id())
            self.get_logger().error(f"{self.rival}: receiving and sending nothing until it ends")
        elif not who and self.rival:
            self.get_logger().warning(f"{self.rival.partition(' is at work')[0]} has gone: resuming")
            self.rival = ""
            if not self.keeps_its_state():
                self._begin_anew()
            elif self.active:
                self._ask_for_missed()

    def _begin_anew(self) -> None:
        def again() -> None:
            self.trigger_deactivate()
            self.trigger_cleanup()
            if not self.start():
                self.get_logger().error(self.error or "could not begin anew")

        if self.executor is not None:
            self.executor.create_task(again)  # not within a timer that it takes away

    @property
    def scene_frame(self) -> str:
        """The only accepted frame of messages; empty: any single frame per run."""
        return str(self.parameters.scene_frame)

    @property
    def trouble(self) -> str:
        """What stops the node from working; empty if nothing."""
        return self.rival or self.error

    def cannot(self, why: str) -> None:
        """Announce, at once and in every heartbeat, why the node cannot work; empty: it can again."""
        before, self.unable = self.unable, why
        if why and not before:
            self.get_logger().error(f"{why}: receiving nothing")
        elif before and not why:
            self.get_logger().warning("resuming")
        if bool(why) != bool(before):
            self.tell_now()

    # Errors

    def guard(self, where: str, work: Callable[..., None], *args: Any) -> None:
        """Run a piece of work; count and name any error, and continue."""
        start = time.perf_counter()
        try:
            work(*args)
        except CsasError as error:
            self.reject(str(error))
        except InvalidHandle:
            return  # the node is being torn down
        except Exception as error:
            self.fault(where, error)
        finally:
            self.busy_s += time.perf_counter() - start

    def fault(self, where: str, error: BaseException) -> None:
        """Count an unexpected error, with its traceback in the log."""
        self.reject(f"{where}: {type(error).__name__}: {error}", level="error")
        self.get_logger().debug("".join(traceback.format_exception(error)))

    def reject(self, reason: str, *, level: str = "warn") -> None:
        """Count an unusable item, and name it in the log: each kind at most every 10 s."""
        self.counts["rejected"] += 1
        kind = kind_of(reason)
        if kind not in self.reasons and len(self.reasons) >= _MAX_KINDS:
            kind = "other reasons"
        self.reasons[kind] += 1
        self.examples.setdefault(kind, reason if kind != "other reasons" else kind)
        self.log_throttled(kind, reason, level)

    def log_throttled(self, kind: str, text: str, level: str) -> None:
        """Log a line unless one of its kind was logged just before; then count it."""
        now = time.monotonic()
        since, held = self._logged.get(kind, (-_LOG_EVERY_S, 0))
        if now - since < _LOG_EVERY_S:
            self._logged[kind] = (since, held + 1)
            return
        self._logged[kind] = (now, 0)
        more = f" (and {held} more of this kind)" if held else ""
        # rclpy remembers a severity per calling line, so each level has its own.
        if level == "error":
            self.get_logger().error(f"{text}{more}")
        else:
            self.get_logger().warning(f"{text}{more}")

    # Reports and diagnostics

    def now_ns(self) -> int:
        """Return the node's time."""
        return int(self.get_clock().now().nanoseconds)

    def send_report(self, item: ViewProgress) -> None:
        """Publish the fate of a view."""
        self._reports.publish(progress_to_msg(self.messages, item))

    def tell_now(self) -> None:
        """Send the heartbeats at once, because others wait for a change."""
        with self._beat_lock:
            if self.active:
                self._send_beats()

    def leave(self, inlet: Inlet) -> None:
        """Say goodbye for one inlet."""
        with self._beat_lock:
            self.inlets.remove(inlet)
            say_goodbye(self._heartbeats, self.messages, [inlet])

    def _send_beats(self) -> None:
        for voice in self._voices():
            self._heartbeats.publish(progress_to_msg(self.messages, voice.beat(leaving=False)))

    def _voices(self) -> list[Inlet | Source]:
        return [*self.inlets, *self.sources]

    def common_counts(self) -> dict[str, int]:
        """Return the counts that every heartbeat carries."""
        names = ("in", "out", "rejected", "duplicates")
        counts = {name: self.counts[name] for name in names} | {"busy_ms": int(self.busy_s * 1e3)}
        return counts | self.state_counts()

    def _beat_on(self) -> None:
        # A thread of its own: a stage that computes for seconds is busy, not gone.
        while not self._beat_stop.wait(BEAT_S):
            with self._beat_lock:
                if self.active and not self._beat_stop.is_set():
                    try:
                        self._send_beats()
                    except (InvalidHandle, RuntimeError) as error:
                        # The context was shut down under us, or counts changed while they were read.
                        if not self.context.ok():
                            return
                        self.get_logger().debug(f"skipped a heartbeat: {error}")

    def _publish_diagnostics(self) -> None:
        now = time.monotonic()
        values: dict[str, str] = {}
        for name, count in sorted(self.counts.items()):
            before, since = self._rates.get(name, (0, now))
            self._rates[name] = (count, now)
            values[name] = str(count)
            if now > since:
                values[f"{name} per second"] = f"{(count - before) / (now - since):.1f}"
        values |= {f"rejected: {self.examples[kind]}": str(n) for kind, n in self.reasons.most_common()}
        values["busy seconds"] = f"{self.busy_s:.3f}"
        values |= {k: str(v) for k, v in self.state_counts().items()} | self.state_values()
        for source in self.sources:
            values |= {f"{source.stream} {k}": str(v) for k, v in source.counts().items()}
        waiting, unheard = self.waiting(), list(self.strangers.unheard.values())
        if waiting and (deaf := self._deaf.look()):
            self.log_throttled("deaf", deaf, "warn")
            waiting = f"{waiting}; {deaf}"
        values |= {f"not heard {n}": text for n, text in enumerate(unheard, 1)}
        if self.trouble or self.unable:
            level, text = Level.ERROR, self.trouble or self.unable
        elif unheard:
            level, text = Level.WARN, "; ".join([unheard[0], *([waiting] if waiting else [])])
        elif waiting:
            level, text = Level.WARN, waiting
        elif self.counts["rejected"]:
            level, text = Level.WARN, f"{self.counts['rejected']} rejected"
        else:
            level, text = Level.OK, "running" if self.active else "inactive"
        name = self.get_fully_qualified_name()
        self._diagnostics.publish(
            diagnostics_to_msg(self.messages, self.now_ns(), name, self.instance, level, text, values)
        )

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Set everything up; refuse with one line if that fails."""
        self._configured = True
        # Whatever an earlier configuration reported is forgotten with its state.
        self.instance = instance_of(self.rivals.graph_id, uuid.uuid4().hex[:12])
        try:
            self._reports = self.publisher("progress", qos.REPORTS)
            self._heartbeats = self.publisher("progress", qos.HEARTBEAT)
            self._diagnostics = self.publisher("/diagnostics", qos.DIAGNOSTICS)
            self.error = self.unable = ""
            self.parameters.check()
            self.setup()
            self.every(1.0, self._publish_diagnostics)
            self.every(_WHO_S, self.strangers.look)
            self.every(0.2, self._tick)
        except (CsasError, OSError) as error:
            self.error = str(error)
            self.get_logger().error(self.error)
            self._destroy_owned()
            self._configured = False
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def _tick(self) -> None:
        self.start_waiting_work()
        self._look_for_rivals()
        if self.active and not self.rival:
            for inlet in self.inlets:
                inlet.give_up_lonely()
            self.tick()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start working."""
        self.active = True
        self._ask_for_missed()
        self._beat_stop.clear()
        self._beat_thread = threading.Thread(target=self._beat_on, name="heartbeat", daemon=True)
        self._send_beats()
        self._beat_thread.start()
        # Heartbeats go on meanwhile: others know already that this node is there.
        self.preload()
        self.on_activated()
        self.get_logger().info(f"active: takes {_brief(self._takes)}; gives {_brief(self._gives)}")
        for source in self.sources:
            source.wake()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working; sources stop waiting for this node."""
        self._stop_working()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop everything, ready for another configuration."""
        self.finish()
        self._destroy_owned()
        self.forget()
        self._configured = False
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Shut down from any state."""
        self.stop()
        return super().on_shutdown(state)

    def _stop_working(self) -> None:
        if not self.active:
            return
        self.finish()
        self._beat_stop.set()
        with self._beat_lock:
            self.active = False
            try:
                say_goodbye(self._heartbeats, self.messages, self._voices())
            except (InvalidHandle, RuntimeError) as error:
                self.get_logger().debug(f"could not say goodbye: {error}")
        if self._beat_thread is not None:
            self._beat_thread.join()
            self._beat_thread = None

    def _destroy_owned(self) -> None:
        self.inlets.clear()
        self.sources.clear()
        self._latched.clear()
        self._missed.clear()
        self._takes.clear()
        self._gives.clear()
        self.strangers.clear()
        while self._owned:
            destroy, entity = self._owned.pop()
            destroy(entity)

    def start(self) -> bool:
        """Configure and activate; log and return False if the node refuses."""
        ok = TransitionCallbackReturn.SUCCESS
        return bool(self.trigger_configure() == ok and self.trigger_activate() == ok)

    def stop(self) -> None:
        """End the work in an orderly way."""
        self._stop_working()
        self.finish()
        self._destroy_owned()

    def _on_set_parameters(self, changes: list[Parameter]) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        known = self.parameters.__dataclass_fields__
        own = {c.name: c.value for c in changes if c.name in known}
        if self._configured and (fixed := [name for name in own if name not in DYNAMIC]):
            reason = f"{fixed[0]} can be set while the node is unconfigured; expected: cleanup first"
            return SetParametersResult(successful=False, reason=reason)
        try:
            # What belongs together may come one by one: it is checked when the node is configured.
            changed = replace(self.parameters, **own)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.parameters = changed
        for source in self.sources:
            source.apply(changed)
        return SetParametersResult(successful=True)


class Background:
    """Work done piece by piece between a node's other callbacks.

    A task of the executor, not a guard condition: an executor that works by events cannot see those.

    Parameters
    ----------
    node : CsasNode
        The node.
    callback : callable
        Does a piece of the work.
    """

    def __init__(self, node: CsasNode, callback: Callable[[], None]) -> None:
        self._node: CsasNode | None = node
        self._callback: Callable[[], None] | None = callback
        self._triggered = self._queued = False

    def trigger(self) -> None:
        """Do a piece of it soon; several triggers before that count as one."""
        self._triggered = True
        self.start()

    def start(self) -> None:
        """Hand it to the executor, if triggered and there is one."""
        executor = self._node.executor if self._node is not None else None
        if self._triggered and not self._queued and executor is not None:
            self._queued = True
            executor.create_task(self._run)

    def cancel(self) -> None:
        """Do no more of it; an executor that still has it must not keep the node."""
        self._node = self._callback = None

    def _run(self) -> None:
        self._triggered = self._queued = False
        if self._node is not None and self._callback is not None:
            self._node.guard("work", self._callback)


def _latches(publisher: TopicEndpointInfo) -> bool:
    """Say whether a publisher keeps its messages for us; none does that is best effort."""
    profile = publisher.qos_profile
    return bool(
        profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        and profile.reliability != ReliabilityPolicy.BEST_EFFORT
    )


class Latched:
    """The subscriptions to a latched topic: one of its own, and one for publishers that do not latch it.

    Such publishers do not match the first one, and those that latch match both: what they publish would come
    twice, an image of hundreds of megabytes too. The second is there as long as nobody publishes, or somebody
    who does not latch. Where one of those is best effort it is so too: each message of these topics is whole
    by itself, and what is lost on the way leaves what was there before.

    Parameters
    ----------
    node : CsasNode
        The node.
    topic : str
        Name of the topic.
    profile : QoSProfile
        That of the first subscription.
    subscribe : callable
        Makes a subscription, of a quality of service.
    """

    def __init__(
        self, node: CsasNode, topic: str, profile: Any, subscribe: Callable[[Any], Subscription]
    ) -> None:
        self._node = node
        self.topic = topic
        self._latched = profile
        self._subscribe = subscribe
        self._publishers = 0
        self._asked_s = time.monotonic()
        self._profile = qos.UNLATCHED
        self._first = subscribe(profile)
        self.subscription: Subscription | None = subscribe(self._profile)

    def ask_again(self) -> None:
        """Subscribe anew: whoever does gets what is latched."""
        self._node.unsubscribe(self._first)
        self._first = self._subscribe(self._latched)

    def look(self) -> None:
        """Subscribe or unsubscribe as publishers come and go."""
        count, now = self._node.count_publishers(self.topic), time.monotonic()
        # Who they are takes longer to ask than how many; one may have taken another's place.
        if count == self._publishers and now - self._asked_s < _WHO_S:
            return
        self._publishers, self._asked_s = count, now
        name = self._node.resolve_topic_name(self.topic)
        publishers = self._node.get_publishers_info_by_topic(name)
        plain = [p for p in publishers if not _latches(p)]
        lossy = [p for p in plain if p.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT]
        profile = qos.LOSSY if lossy else qos.UNLATCHED
        wanted = bool(plain) or not publishers
        if self.subscription is not None and (not wanted or profile is not self._profile):
            self._node.unsubscribe(self.subscription)
            self.subscription = None
        if wanted and self.subscription is None:
            self._profile = profile
            self.subscription = self._subscribe(profile)
            for p in lossy:
                who = _publisher_name(p)
                self._node.get_logger().warning(
                    f"{name}: {who} publishes best effort: lost messages are not resent"
                )


def _publisher_name(publisher: TopicEndpointInfo) -> str:
    """Name a publisher; the middleware finds the endpoint before it knows whose it is."""
    if publisher.node_name.startswith("_NODE_NAME_UNKNOWN"):
        return "a publisher whose node is not known yet"
    return f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"


class Strangers:
    """Publishers that a node cannot hear, because their type or QoS does not match.

    ROS says nothing of the one, and of the other only a line of the middleware's own.

    Parameters
    ----------
    node : CsasNode
        The node.
    """

    def __init__(self, node: CsasNode) -> None:
        self._node = node
        self._subscriptions: list[Subscription] = []
        #: Number of publishers of each topic, and when it was asked who they are.
        self._asked: dict[str, tuple[int, float]] = {}
        #: What is wrong with each, by topic and endpoint.
        self.unheard: dict[tuple[str, bytes], str] = {}

    def subscribed(self, subscription: Subscription) -> None:
        """Look after a subscription."""
        self._subscriptions.append(subscription)

    def unsubscribed(self, subscription: Subscription) -> None:
        """Look after it no longer."""
        self._subscriptions.remove(subscription)

    def clear(self) -> None:
        """Forget everything."""
        self._subscriptions.clear()
        self._asked.clear()
        self.unheard.clear()

    def look(self) -> None:
        """Check the publishers, and log once each one that cannot be heard."""
        ours: dict[str, list[Subscription]] = {}
        for subscription in self._subscriptions:
            ours.setdefault(subscription.topic_name, []).append(subscription)
        now = time.monotonic()
        for topic, subscriptions in ours.items():
            # Who they are takes longer to ask than how many; one may have taken another's place.
            count, (before, since_s) = self._node.count_publishers(topic), self._asked.get(topic, (0, now))
            if count == before and (not count or now - since_s < _STRANGERS_S):
                continue
            self._asked[topic] = count, now
            found = {
                (topic, bytes(publisher.endpoint_gid)): text
                for publisher in self._node.get_publishers_info_by_topic(topic)
                if (text := self._fault(topic, publisher, subscriptions))
            }
            for key, text in found.items():
                if key not in self.unheard:
                    self._node.get_logger().warning(text)
            self.unheard = {k: v for k, v in self.unheard.items() if k[0] != topic} | found

    @staticmethod
    def _fault(topic: str, publisher: TopicEndpointInfo, subscriptions: list[Subscription]) -> str:
        """Say why a publisher cannot be heard; empty if it can."""
        who = f"{topic}: {_publisher_name(publisher)}"
        expected = _type_name(subscriptions[0].msg_type)
        if publisher.topic_type != expected:
            return f"{who} publishes {publisher.topic_type}; expected {expected}"
        offered = publisher.qos_profile
        checks = [qos_check_compatible(offered, one.qos_profile) for one in subscriptions]
        if any(level != QoSCompatibility.ERROR for level, _ in checks):
            return ""
        if offered.reliability == ReliabilityPolicy.BEST_EFFORT:
            return f"{who} publishes {expected} best effort; expected reliable"
        if offered.durability == DurabilityPolicy.VOLATILE:
            return f"{who} publishes {expected} volatile; expected transient local"
        return f"{who} publishes {expected} with an incompatible QoS: {checks[0][1].rstrip('; ')}"


def _brief(topics: Iterable[str]) -> str:
    """Name topics in one line: the two of a stream as one, and not what every node has."""
    told = dict.fromkeys(
        re.sub("/(image|camera_info)$", "/*", name)
        for name in topics
        if name not in ("progress", "/diagnostics")
    )
    return ", ".join(told) or "nothing"


def _type_name(kind: Any) -> str:
    return f"{'/'.join(kind.__module__.split('.')[:2])}/{kind.__name__}"


class Inlet:
    """A stream of image and camera_info pairs that a node receives.

    Parameters
    ----------
    node : Host
        The node.
    stream : str
        Name of the stream.
    role : str
        `stage` or `sink`.
    work : callable
        Takes (image, camera_info) and returns the outcome to report, or None to report nothing.
        A `CsasError` that it raises refuses the view.
    hold : callable, optional
        Says of a stamp why its view cannot be worked on yet, and for how long (s) it may wait; such views
        wait for `release`, a window of them at most.
    optional : bool
        Nobody waits for this consumer as long as nobody publishes the stream.
    """

    def __init__(
        self,
        node: Host,
        stream: str,
        role: str,
        work: Callable[[Any, Any], str | None],
        hold: Callable[[int], tuple[str, float]] | None = None,
        *,
        optional: bool = False,
    ) -> None:
        self.node = node
        self.stream = stream
        self.role = role
        self.optional = optional
        self.instance = f"{node.instance}-{stream}"
        self.held: deque[tuple[float, Any, Any]] = deque(maxlen=qos.MAX_WINDOW)
        self._work = work
        self._hold = hold or (lambda _: ("", 0.0))
        kind = stream_of(stream)
        self._pairer = Pairer(kind.image_topic, capacity=qos.MAX_WINDOW)
        self._last_s = time.monotonic()
        self._seen: dict[int, None] = {}
        # Raw: of a message that rclpy decodes the pixels are copied twice more.
        self._subscriptions = [
            node.subscribe(kind.image_topic, qos.VIEWS, self._take_image, raw=True),
            node.subscribe(kind.info_topic, qos.VIEWS, lambda msg: self._take(msg, is_info=True)),
        ]
        node.inlets.append(self)

    def close(self) -> None:
        """Stop receiving the stream, and say goodbye so that nobody waits."""
        self.node.leave(self)
        for subscription in self._subscriptions:
            self.node.unsubscribe(subscription)
        self._subscriptions.clear()

    def _take_image(self, cdr: bytes) -> None:
        topic = stream_of(self.stream).image_topic
        self._take(message_from_cdr(cdr, TOPICS[topic].type_name, topic), is_info=False)

    def _take(self, msg: Any, *, is_info: bool) -> None:
        self._last_s = time.monotonic()
        kind = stream_of(self.stream)
        frame_of(msg, kind.info_topic if is_info else kind.image_topic, self.node.scene_frame)
        pair = self._pairer.add(msg, is_info=is_info)
        self._report_orphans()
        if pair is None:
            return
        self.node.counts["in"] += 1
        self._work_or_hold(time.monotonic(), *pair)

    def _work_or_hold(self, since_s: float, image: Any, info: Any) -> None:
        stamp = stamp_to_ns(image.header.stamp)
        reason, patience_s = self._hold(stamp)
        if not reason:
            self._work_on(image, info)
        elif time.monotonic() - since_s <= patience_s:
            self.held.append((since_s, image, info))
        else:
            self.refuse(stamp, info, f"{self.stream} stamped {stamp} ns: {reason}; ignored")

    def _work_on(self, image: Any, info: Any) -> None:
        stamp = stamp_to_ns(image.header.stamp)
        if stamp in self._seen:
            self.node.counts["duplicates"] += 1
        try:
            outcome = self._work(image, info)
        except CsasError as error:
            self.refuse(stamp, info, str(error))
            return
        self._seen[stamp] = None
        if len(self._seen) > _REMEMBERED:
            self._seen.pop(next(iter(self._seen)))
        if outcome is not None:
            self.report(stamp, outcome)

    def refuse(self, stamp: int, info: Any, reason: str) -> None:
        """Count an unusable view, name it, and report it to the sources."""
        self.node.reject(reason)
        self.report(stamp, REJECTED, reason, **self._aspect_of(info))

    def _aspect_of(self, info: Any) -> dict[str, str]:
        """Say which aspect a refused view is of, as far as that is legible."""
        try:
            aspect = view_info_from_msg(info, self.stream).aspect_rad
        except CsasError:
            return {}
        return {"aspect_deg": f"{math.degrees(aspect):.6f}"}

    def release(self) -> None:
        """Process the held views that need not wait any longer."""
        for _ in range(len(self.held)):
            self._work_or_hold(*self.held.popleft())

    def report(self, stamp_ns: int, outcome: str, reason: str = "", **more: str) -> None:
        """Report the fate of a view to the sources."""
        self.node.counts["out" if outcome == PUBLISHED else outcome] += outcome != REJECTED
        level = Level.WARN if outcome == REJECTED else Level.OK
        values = {"role": self.role, "input": self.stream, **self._for_target(), **more}
        self.node.send_report(
            ViewProgress(stamp_ns, self.node.name, self.instance, outcome, reason, level, values)
        )

    def _report_orphans(self) -> None:
        for line in self._pairer.orphans:
            self.node.reject(line)
        self._pairer.orphans.clear()

    def give_up_lonely(self) -> None:
        """Drop messages without a partner after a silence; refuse those that waited too long."""
        if self.held:
            self.release()
        if time.monotonic() - self._last_s > _LONELY_S:
            self._last_s = time.monotonic()
            self._pairer.flush()
            self._report_orphans()

    def _idle(self) -> dict[str, str]:
        """Say that nobody need wait for this consumer, as nobody publishes what it takes."""
        # Right after the start this also means: not discovered yet.
        published = not self.optional or self.node.count_publishers(stream_of(self.stream).image_topic)
        return {} if published else {"idle": "true"}

    def _for_target(self) -> dict[str, str]:
        return {"target": self.node.target_stamp} if self.node.target_stamp else {}

    def beat(self, *, leaving: bool) -> Heartbeat:
        """Make the heartbeat."""
        values = {"input": self.stream, **self._for_target(), **self.node.state_values(), **self._idle()}
        if leaving:
            values["leaving"] = "true"
        if self.node.trouble:
            values["error"] = self.node.trouble
        if self.node.unable:
            values["unable"] = self.node.unable
        counts = self.node.common_counts()
        return Heartbeat(self.node.now_ns(), self.node.name, self.instance, self.role, counts, values)


class Source:
    """A stream of views that a node sends under flow control.

    Parameters
    ----------
    node : CsasNode
        The node; its parameters are the flow's too.
    stream : str
        Name of the stream.
    make : callable
        Makes and publishes the view of a stamp. A `CsasError` that it raises takes the view back.
    may_send : callable, optional
        Says whether it is time to send that view for the first time.
    """

    def __init__(
        self,
        node: CsasNode,
        stream: str,
        make: Callable[[int], None],
        may_send: Callable[[int], bool] | None = None,
    ) -> None:
        p = node.parameters
        self.node = node
        self.stream = stream
        self.instance = f"{node.instance}-source"
        self.flow = Flow(
            stream, window=p.window, resend_s=p.resend_s, sink_wait_s=p.sink_wait_s, min_sinks=p.min_sinks
        )
        kind = stream_of(stream)
        self.image = node.publisher(kind.image_topic, qos.VIEWS)
        self.info = node.publisher(kind.info_topic, qos.VIEWS)
        self._make = make
        self._may_send = may_send or (lambda _: True)
        self._looked_s = 0.0
        self._told: list[str] = []
        self._work = node.background(self._pump)
        node.subscribe("progress", qos.REPORTS, self._on_progress)
        node.every(0.05, self._pump)
        node.sources.append(self)

    def apply(self, parameters: Any) -> None:
        """Apply changed parameters."""
        self.flow.window = parameters.window
        self.flow.resend_s = parameters.resend_s
        self.flow.sink_wait_s = parameters.sink_wait_s

    def wake(self) -> None:
        """Look for work at the next opportunity."""
        self._work.trigger()

    def _on_progress(self, msg: Any) -> None:
        before = self.flow.in_flight
        item = progress_from_msg(msg)
        if not self.node.is_ours(item):
            return
        self.flow.heard(item)
        if self.flow.in_flight < before:
            self.wake()

    def _pump(self) -> None:
        if not self.node.active or self.node.rival:
            return
        flow, now = self.flow, time.monotonic()
        if now - self._looked_s > 0.1:
            self._looked_s = now
            flow.look(self.image.get_subscription_count())
        self._log_notes()
        fresh = flow.peek()
        may_send = fresh is None or self._may_send(fresh)
        stamp = flow.next(fresh=may_send)
        if stamp is None:
            if flow.acknowledged_by_transport and flow.in_flight and self._all_acked():
                flow.transported()
                self.wake()
            self._tell_the_end()
            return
        try:
            self._make(stamp)
            self.node.counts["sent"] += 1
        except CsasError as error:
            flow.refuse(stamp, str(error))
            self.refused(stamp, str(error))
        self.wake()

    def _tell_the_end(self) -> None:
        """Tell at once for whom the run is at its end: they wait for nothing else."""
        ended = [] if self.flow.in_flight else list(self.flow.finished_for())
        if ended != self._told:
            self._told = ended
            self.node.tell_now()

    def _all_acked(self) -> bool:
        instant = Duration(nanoseconds=1_000_000)
        return bool(self.image.wait_for_all_acked(instant) and self.info.wait_for_all_acked(instant))

    def _log_notes(self) -> None:
        for level, text in self.flow.notes:
            if level == "error":
                self.node.get_logger().error(text)
            else:
                self.node.get_logger().warning(text)
        self.flow.notes.clear()

    def refused(self, stamp_ns: int, reason: str, **values: str) -> None:
        """Report a view that the source cannot make."""
        self.node.reject(reason)
        values |= {"role": "source", "input": self.stream}
        self.node.send_report(
            ViewProgress(stamp_ns, self.node.name, self.instance, REJECTED, reason, Level.WARN, values)
        )

    def counts(self) -> dict[str, int]:
        """Return the progress counts."""
        flow = self.flow
        return {
            "total": flow.total,
            "done": flow.done,
            "in_flight": flow.in_flight,
            "resends": flow.resends,
            "lost": len(flow.lost),
            "refused": len(flow.refused),
            "finished": int(flow.finished),
            "more_to_come": int(flow.more_to_come),
        }

    def beat(self, *, leaving: bool) -> Heartbeat:
        """Make the heartbeat, which tells finished sinks that the run is over."""
        # Also while the node computes, when nobody else would notice that somebody has come.
        self.flow.meet(self.image.get_subscription_count())
        values = {"stream": self.stream}
        if leaving:
            values["leaving"] = "true"
        else:
            values["finished_for"] = " ".join(self.flow.finished_for())
            values["waiting_for"] = self.flow.waiting_for()
            values |= self.node.state_values()
            if self.flow.target:
                values["target"] = self.flow.target
        if self.node.trouble:
            values["error"] = self.node.trouble
        counts = self.node.common_counts() | self.counts()
        return Heartbeat(self.node.now_ns(), self.node.name, self.instance, "source", counts, values)


def say_goodbye(heartbeats: Publisher, messages: RclpyMessages, voices: Sequence[Inlet | Source]) -> None:
    """Publish last heartbeats one by one, and wait for each until all others have it, two seconds in all.

    What others have not acknowledged goes with its publisher, which is destroyed next. Who has no processor
    just then would wait for the sender as for one that was killed.
    """
    end_s = time.monotonic() + _GOODBYE_S
    for voice in voices:
        heartbeats.publish(progress_to_msg(messages, voice.beat(leaving=True)))
        left_s = end_s - time.monotonic()
        if left_s > 0.0:
            heartbeats.wait_for_all_acked(Duration(seconds=left_s))


class ViewOutlet:
    """A stream of views that a stage publishes.

    Parameters
    ----------
    node : Host
        The node.
    stream : str
        Name of the stream.
    """

    def __init__(self, node: Host, stream: str) -> None:
        self._node = node
        self._stream = stream
        kind = stream_of(stream)
        self._info = node.publisher(kind.info_topic, qos.VIEWS)
        self._image = node.publisher(kind.image_topic, qos.VIEWS)

    @property
    def wanted(self) -> bool:
        """Whether anybody subscribes to the stream; otherwise it need not be computed."""
        return bool(self._image.get_subscription_count() or self._info.get_subscription_count())

    def send(self, view: View, *, trusted: bool = True) -> None:
        """Publish a view with its stamp unchanged; `trusted` as for `view_to_msgs`."""
        image, info = view_to_msgs(self._node.messages, view, self._stream, trusted=trusted)
        self._info.publish(info)
        self._image.publish(image)


class TargetInlet:
    """What to carve: from parameters, or from topics `target` and `search`; never guessed.

    Parameters
    ----------
    node : CsasNode
        The node; its parameters say whether the target is given.
    on_known : callable
        Called once it is known that there is a target, or that there is none; again when it is another one.
    on_another : callable, optional
        Called with `another_run` before that when another one takes the place of what is known: the target of
        a run that is still going on has moved, or another run has begun.
    """

    def __init__(
        self, node: CsasNode, on_known: Callable[[], None], on_another: Callable[..., None] | None = None
    ) -> None:
        p = node.parameters
        self._node = node
        self._on_known = on_known
        self._on_another = on_another or (lambda **_: None)
        #: Whether another target of the same run may follow and replace this one.
        self.may_move = False
        self.known = p.target == "given"
        self.decision = Decision(None)
        #: Name of the run that it is of; None where nobody says.
        self.run_ns: int | None = None
        self._searched: SearchNews | None = None
        self._early: Any = None
        if self.known:
            size = getattr(p, "size_m", (0.0, 0.0, 0.0))
            target = Target((p.position_m[0], p.position_m[1]), (size[0], size[1], size[2]))
            self.decision = Decision(target)
        else:
            node.target_stamp = "0"
            node.subscribe_latched("search", self._take_search)
            node.subscribe_latched("target", self._take)

    @property
    def target(self) -> Target | None:
        """The run's target; None if absent or unknown."""
        return self.decision.target

    @property
    def stamp(self) -> str:
        """Stamp of the target, as reports name it; empty for a given target."""
        return self._node.target_stamp

    def _take_search(self, msg: Any) -> None:
        self._searched = decision_from_msg(msg)
        early, self._early = self._early, None
        if early is not None:
            self._take(early)

    def _take(self, msg: Any) -> None:
        box = target_from_msg(msg)
        stamp = stamp_to_ns(msg.header.stamp, "target.header.stamp")
        searched = self._searched
        if searched is None or searched.target_stamp_ns != stamp:
            searched = None
            if self._node.count_publishers("search"):
                self._early = msg  # what else there is to carve comes at the same time
                return
        frame = None if box is None else frame_of(msg, "target", self._node.scene_frame)
        decision = Decision(self._target_of(box), frame=frame) if searched is None else searched.decision
        run_ns = None if searched is None else searched.run_ns
        if str(stamp) == self._node.target_stamp:
            if not decision.same_target(self.decision):
                self._node.reject(f"target stamped {stamp} ns differs from another of the same stamp")
            return
        another_run = run_ns is not None and run_ns != self.run_ns
        may_move = target_may_move(msg)
        if self.known and not another_run and not (self.may_move and may_move):
            if not decision.same_target(self.decision):
                self._node.reject(
                    f"target stamped {stamp} ns lies elsewhere than that of {self._node.target_stamp} ns, and"
                    " no message begins another run: keeping the first"
                )
            return
        if self.known:
            self._on_another(another_run=another_run)
        self.known, self.decision, self.run_ns = True, decision, run_ns
        self.may_move, self._node.target_stamp = may_move, str(stamp)
        self._on_known()

    @staticmethod
    def _target_of(box: TargetBox | None) -> Target | None:
        return None if box is None else Target((box.centre_m[0], box.centre_m[1]), box.size_m)

    def missing(self) -> str:
        """Say why the target is unknown; empty once it is known."""
        return "" if self.known else "no target position: none received on topic target, none given"

    def hold(self, _: int) -> tuple[str, float]:
        """Let views wait until the target is known."""
        return self.missing(), math.inf


def run_node(kind: type[CsasNode], arguments: Sequence[str] | None = None) -> int:
    """Run a node until SIGINT or SIGTERM; all console scripts use this.

    Returns
    -------
    int
        0; 2 if a parameter or an argument is refused or the node cannot be configured.
    """
    if "HOME" not in os.environ:
        # rclpy.init raises where it can find no directory for its log.
        os.environ.setdefault("ROS_LOG_DIR", str(Path(tempfile.gettempdir(), "ros_log")))
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        # Not rclpy's handlers: they shut the context down before the node can say goodbye.
        signal.signal(number, lambda *_: stop.set())
    argv = [sys.argv[0], *(sys.argv[1:] if arguments is None else arguments)]

    def make() -> CsasNode:
        context = Context()
        try:
            rclpy.init(args=argv, context=context, signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:
            # rclpy's own errors: arguments or a parameter file that cannot be read.
            raise ParameterError(str(error)) from None
        try:
            with security_told():
                return kind(context=context)
        except BaseException:
            rclpy.try_shutdown(context=context)
            raise

    def take_back(node: CsasNode) -> None:
        node.destroy_node()
        rclpy.try_shutdown(context=node.context)

    with ends_if_it_stands_still():
        while True:
            reach, code = _run_once(kind, make, take_back, stop)
            if not reach.is_given_up or stop.is_set():
                return code
            reach.take_others()


def _run_once(
    kind: type[CsasNode],
    make: Callable[[], CsasNode],
    take_back: Callable[[CsasNode], None],
    stop: threading.Event,
) -> tuple[Reach, int]:
    """Run a node until it is told to stop, or others do not reach it; return that, and the exit status."""
    try:
        node = make_hearing(make, take_back)
    except ParameterError as error:
        sys.stderr.write(f"{kind.name}: {error}\n")
        return Reach(), 2
    reach = Reach()
    context = node.context
    code = 0
    try:
        try:
            if node.parameters.autostart and not node.start():
                sys.stderr.write(f"{kind.name}: {node.error or 'could not be started'}\n")
                code = 2
            else:
                spin(node, stop, reach)
        finally:
            node.stop()
            node.destroy_node()
            # The lifecycle's own entities hold the participant, and its shared memory, until they are
            # collected; a process that was forked comes to no interpreter's end that would do it.
            del node
            gc.collect()
    finally:
        domain_id = context.get_domain_id() if context.ok() else None
        rclpy.try_shutdown(context=context)
        if _is_orphan() and domain_id is not None:
            tidy_up_after_a_killed_graph(domain_id, float(os.environ["CSAS_SINCE_S"]))
    return reach, code


def _is_orphan() -> bool:
    """Say whether the process that started this one, as a graph's node, is gone without having ended it."""
    parent = os.environ.get("CSAS_PARENT_PID")
    return bool(parent) and os.getppid() != int(parent or 0)


def make_executor(context: Context) -> Executor:
    """Make the executor with the least overhead.

    The one that waits by sets gathers all of a node's entities, services and timers among them, for each
    message anew: 0.5 ms and more of Python, which a graph pays thousands of times a run.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor

        return EventsExecutor(context=context)
    except (ImportError, OSError, ValueError, RuntimeError, AttributeError):
        # It came to ROS 2 with Jazzy, and wants a standard error with a descriptor, which notebooks lack.
        return SingleThreadedExecutor(context=context)


def spin(node: CsasNode, stop: threading.Event, reach: Reach | None = None) -> None:
    """Spin until told to stop, or until it is known that others do not reach this process.

    A message that cannot even be taken is counted, not fatal.
    """
    executor = make_executor(node.context)
    executor.add_node(node)
    node.start_waiting_work()
    try:
        while not stop.is_set() and node.context.ok():
            try:
                executor.spin_once(timeout_sec=_STOP_S)
            except ExternalShutdownException:
                return
            except Exception as error:
                node.fault("message could not be taken", error)
            if _is_orphan():
                return  # whoever started us is gone without ending us
            if reach is not None and reach.is_lost():
                node.get_logger().warning(
                    "others send to a port in shared memory of a killed predecessor: this node begins anew at"
                    " other ports"
                )
                return
    finally:
        executor.remove_node(node)
        executor.shutdown(timeout_sec=1.0)


__all__ = [
    "INTEGRATED",
    "PUBLISHED",
    "REJECTED",
    "CsasNode",
    "Inlet",
    "Source",
    "TargetInlet",
    "ViewOutlet",
    "run_node",
    "spin",
]
