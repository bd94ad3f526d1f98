"""Replay a bag through the node graph: every node a process of its own, as `ros2 launch` does it.

`replay` starts the processes, watches them, restarts one that dies, collects the result from the
latched topics, and ends its own processes by their ids, whatever happens.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ..core import errors
from ..core.errors import CsasError, NoTargetError, ParameterError
from ..core.parameters import MAX_OBJECTS, PipelineParameters, Stage
from ..node_table import NODES as _NODES
from ..node_table import REPLACEABLE, chain, joins, makers
from ..nodes.runtime.params import NODES, check
from ..nodes.runtime.rivals import at_work
from .processes import (
    MAX_DOMAIN_ID,
    DomainReservation,
    Graph,
    ReplayError,
    environment_of,
    new_graph_id,
    signals_deferred,
    start_fork_server,
)
from .refusals import Refusals, RejectedView

# What takes long to import is imported where it is used: the nodes' processes are on their way by then.
if TYPE_CHECKING:
    import trimesh
    from numpy.typing import NDArray

    from msg_adapters import Heartbeat

    from ..core.geometry import GroundGrid
    from ..core.search.decision import Decision
    from ..core.shape.mesh import Dimensions
    from ..core.shape.result import Result
    from ..core.shape.volume import Target, VoxelGrid

#: Who may have refused a view before it is in a stream.
_STAGES_BEFORE = {stage: makers(stage) for stage in get_args(Stage)}
#: How often every node is heard (`nodes.base.BEAT_S`).
BEAT_S = 0.5
#: What is published already comes within a second, on a busy machine in some.
_COLLECT_S = 60.0
#: A node of the user's own that is started beside a replay is there within this on a busy machine.
_UNHEARD_S = 5.0


@dataclass(frozen=True)
class NodeReport:
    """What one node says of its part.

    Parameters
    ----------
    busy_s : float
        Seconds that it computed, converted and published.
    restarts : int
        How often its process was started again.
    counts : dict
        Its counts: views in, out, rejected, ...
    """

    busy_s: float
    restarts: int
    counts: dict[str, int]


@dataclass(eq=False)
class ReplayResult:
    """What a replay leaves.

    Attributes
    ----------
    stage : str
        What the bag was played from.
    result : Result
        What the graph published: grid, mesh, dimensions, objects, verdict, … as of `pipeline.run`.
    composites : dict
        ``multilook`` (float32) and ``color_by_aspect`` (uint8, RGB), where they were made.
    composites_grid : GroundGrid or None
        Their lattice.
    composed : int
        Views in them.
    views_total : int
        Views that the source had.
    rejected : list of RejectedView
        Views that were not used.
    lost : int
        Views that vanished on their way; expected 0.
    nodes : dict of NodeReport
        Each node's part, by name.
    recording : Path or None
        The bag that was recorded.
    not_recorded : list of str
        What was published and is not in it, and why; expected to be empty.
    seconds : float
        Wall time, from the first process to the result.
    seconds_after : float
        Of that, since the last view was through.
    """

    stage: str
    result: Result
    composites: dict[str, NDArray[Any]] = field(default_factory=dict)
    composites_grid: GroundGrid | None = None
    composed: int = 0
    views_total: int = 0
    rejected: list[RejectedView] = field(default_factory=list)
    lost: int = 0
    nodes: dict[str, NodeReport] = field(default_factory=dict)
    recording: Path | None = None
    not_recorded: list[str] = field(default_factory=list)
    seconds: float = 0.0
    seconds_after: float = 0.0

    @property
    def target(self) -> Target | None:
        """The volume that was carved; None: there is no object."""
        return self.result.target

    @property
    def grid(self) -> VoxelGrid | None:
        """The carved grid."""
        return self.result.grid

    @property
    def mesh(self) -> trimesh.Trimesh | None:
        """Surface of the object."""
        return self.result.mesh

    @property
    def dimensions(self) -> Dimensions | None:
        """Measures of the object."""
        return self.result.dimensions

    @property
    def views_used(self) -> int:
        """Views in the grid."""
        return self.result.views_used


class _OwnStage:
    """A node of the user's own that takes the place of one that a replay leaves out.

    Parameters
    ----------
    name : str
        The node that is left out.
    most_s : float
        The replay ends if nobody publishes what it gives for so long.
    """

    def __init__(self, name: str, most_s: float) -> None:
        self._name, self._most_s = name, most_s
        self._streams = _NODES[name].gives
        self._since_s, self._told, self._asked_s = time.monotonic(), False, 0.0

    def look(self, node: Any, domain_id: int, tell: Callable[[str], None]) -> None:
        """Look for it at every beat; say once that it is not there, and end the replay if it stays away."""
        now = time.monotonic()
        if now - self._asked_s < BEAT_S:
            return
        self._asked_s = now
        if any(node.count_publishers(f"{stream}/image") for stream in self._streams):
            self._since_s, self._told = now, False
            return
        what = f"{' or '.join(self._streams)} in ROS domain {domain_id}"
        if now - self._since_s > self._most_s:
            raise ReplayError(
                f"nobody published {what} for {self._most_s:g} s; expected your node in place of {self._name}"
            )
        if now - self._since_s > _UNHEARD_S and not self._told:
            self._told = True
            tell(f"nobody publishes {what}: waiting for your node in place of {self._name}")


class _Watcher:
    """Listens to a graph: progress first, and results once they are complete.

    It looks at what has come a few times a second and has no executor, which would gather all of the node's
    entities for each message anew: the nodes report every view, four times over, and need the processor.
    """

    def __init__(self, graph: Graph, domain_id: int) -> None:
        # Late, so that reading this module needs no ROS.
        import rclpy
        from rclpy.context import Context

        from msg_adapters import RclpyMessages

        from ..nodes import qos
        from ..nodes.runtime.hearing import make_hearing
        from ..nodes.runtime.secured import security_told

        self._qos = qos
        self._rclpy = rclpy
        self._messages = RclpyMessages()
        own = {k: v for k, v in graph.environment.items() if k.startswith(("ROS_", "FAST"))}

        def make() -> Any:
            context = Context()
            try:
                rclpy.init(context=context, domain_id=domain_id)
                with security_told():
                    # Nobody would answer who asks for its parameters.
                    return rclpy.create_node(
                        "replay", context=context, namespace="csas", start_parameter_services=False
                    )
            except BaseException:
                rclpy.try_shutdown(context=context)
                raise

        def take_back(node: Any) -> None:
            node.destroy_node()
            rclpy.try_shutdown(context=node.context)

        with environment_of(own):
            self._node = make_hearing(make, take_back)
        self._context = self._node.context
        self.beats: dict[tuple[str, str], Any] = {}
        self._dead: set[str] = set()
        self.refusals = Refusals()
        self.errors: dict[str, str] = {}
        self.latest: dict[str, Any] = {}
        self._collected: set[str] = set()
        self._subscriptions: list[Any] = []
        #: Who else's graph is at work here; empty if nobody's is.
        self.rival = ""
        self._graph = graph
        self._domain_id = domain_id
        self._stages: list[_OwnStage] = []
        self._subscribe("progress", qos.REPORTS, self._on_progress, raw=True)

    def awaits(self, left_out: Sequence[str], stall_timeout_s: float) -> None:
        """Look out from now on for nodes of the user's own in place of those left out."""
        self._stages = [_OwnStage(name, stall_timeout_s) for name in left_out]

    def look_for_stages(self, tell: Callable[[str], None]) -> None:
        """Say which of them is not there.

        Raises
        ------
        ReplayError
            If one has been missing for too long.
        """
        for stage in self._stages:
            stage.look(self._node, self._domain_id, tell)

    def _subscribe(
        self, topic: str, profile: Any, callback: Callable[[Any], None], *, raw: bool = False
    ) -> None:
        from msg_adapters import topic as topic_of

        kind = self._messages.cls(topic_of(topic).type_name)
        self._subscriptions.append(self._node.create_subscription(kind, topic, callback, profile, raw=raw))

    def _on_progress(self, cdr: bytes) -> None:
        from rclpy.serialization import deserialize_message

        from msg_adapters import TOPICS, Heartbeat, is_routine_report, progress_from_msg
        from msg_adapters.progress import graph_of

        if not self.refusals and is_routine_report(cdr):
            return  # it changes nothing here, and a run has thousands
        try:
            item = progress_from_msg(
                deserialize_message(cdr, self._messages.cls(TOPICS["progress"].type_name))
            )
        except CsasError:
            return  # an outside node's; the graph's own are well-formed
        theirs = graph_of(item.instance)
        if theirs != self._graph.graph_id and (theirs or item.node in self._graph.processes):
            if isinstance(item, Heartbeat) and item.values.get("leaving") != "true":
                whose = f"of another graph ({theirs})" if theirs else "that this replay did not start"
                self.rival = f"{item.node} {whose}"
            return
        if isinstance(item, Heartbeat):
            stream = item.values.get("stream", item.values.get("input", ""))
            if item.values.get("leaving") == "true":
                self.beats.pop((item.node, stream), None)
            elif item.instance not in self._dead:
                self.beats[item.node, stream] = item
            if text := item.values.get("error"):
                self.errors[item.node] = text
        else:
            self.refusals.hear(item)

    def died(self, node: str) -> None:
        """Forget what a process said of itself that is no more."""
        for key in [key for key in self.beats if key[0] == node]:
            self._dead.add(self.beats.pop(key).instance)

    def unable(self, node: str) -> str:
        """Say why a node cannot do its work; empty if it can."""
        told = [b.values.get("unable", "") for (name, _), b in self.beats.items() if name == node]
        return max(told, default="")

    def published(self, streams: Iterable[str]) -> list[str]:
        """Return those of the streams that somebody publishes."""
        from msg_adapters.topics import stream as stream_of

        return [s for s in streams if self._node.count_publishers(stream_of(s).image_topic)]

    def recorded(self, streams: Iterable[str]) -> bool:
        """Say whether the running recorder has every view of those of the streams that somebody publishes."""
        from msg_adapters.topics import stream as stream_of

        finished: set[str] = set()
        for beat in self.beats.values():
            finished.update(beat.values.get("finished_for", "").split())
        if self.unable("bag_recorder"):
            return True
        for stream in streams:
            if self._node.count_publishers(stream_of(stream).image_topic):
                beat = self.beats.get(("bag_recorder", stream))
                if beat is None or beat.instance not in finished:
                    return False
        return True

    def alone(self) -> bool:
        """Say whether nobody but the graph's own processes, as they are, can have said anything."""
        # Each has two publishers, for reports and for heartbeats.
        return bool(self._node.count_publishers("progress") <= 2 * len(self._graph.processes))

    def spin(self, seconds: float) -> None:
        """Take what has come, then let so much time pass.

        Raises
        ------
        ReplayError
            If another graph is at work in the same domain and namespace.
        """
        # What a signal raises in the middle of a callback would leave the middleware half undone.
        with signals_deferred():
            for subscription in self._subscriptions:
                handle = subscription.handle
                with handle:
                    while (taken := handle.take_message(subscription.msg_type, subscription.raw)) is not None:
                        subscription.callback(taken[0])
        if self.rival:
            there = at_work(self.rival, self._node.get_namespace(), self._context.get_domain_id())
            raise ReplayError(f"{there}, and no view says whose it is; expected a domain of its own")
        time.sleep(seconds)

    def collect(self, topics: Iterable[str]) -> None:
        """Take latched topics from now on: whoever subscribes gets the last message of each."""
        for topic in topics:
            if topic not in self._collected:
                self._collected.add(topic)
                self._subscribe(topic, self._qos.LATCHED, partial(self.latest.__setitem__, topic))

    def close(self) -> None:
        self._node.destroy_node()
        self._rclpy.shutdown(context=self._context)


def node_parameters(
    parameters: PipelineParameters, target: Target | None = None, max_objects: int = MAX_OBJECTS
) -> dict[str, dict[str, Any]]:
    """Spread the pipeline's parameters over the nodes.

    Parameters
    ----------
    parameters : PipelineParameters
        Parameters of all stages.
    target : Target, optional
        Given to every node behind `sub_aperture`, for bags that hold no image to find it in.
    max_objects : int
        Bodies that are carved at most.
    """

    def of(*sets: Any) -> dict[str, Any]:
        return {f.name: getattr(s, f.name) for s in sets for f in fields(s)}

    p = parameters
    place: dict[str, Any] = {}
    if target is not None:
        place = {"target": "given", "position_m": tuple(target.position_m)}
    box = {**place, "size_m": tuple(target.size_m)} if target is not None else {}
    return {
        "sub_aperture": of(p.sub_aperture, p.target) | {"max_objects": max_objects},
        "shadow_enhancement": of(p.shadow) | place,
        "shadow_likelihood": of(p.likelihood) | box,
        "voxel_carver": of(p.shadow, p.likelihood, p.carving, p.place) | box,
    }


def replay(
    bag: str | Path,
    out_dir: str | Path | None = None,
    parameters: PipelineParameters | None = None,
    *,
    stage: str = "auto",
    namespace: str | None = None,
    rate: float = 0.0,
    record: str | Path | bool = False,
    composites: bool = True,
    window: int = 4,
    domain_id: int | None = None,
    max_objects: int = MAX_OBJECTS,
    overrides: Mapping[str, Mapping[str, Any]] | None = None,
    progress: Callable[[int, int], None] | bool = True,
    notice: Callable[[str], None] | None = None,
    max_restarts: int = 3,
    stall_timeout_s: float = 180.0,
    beside: Mapping[str, Mapping[str, Any]] | None = None,
    without: Iterable[str] = (),
) -> ReplayResult:
    """Replay a bag through the node graph and return what it leaves.

    Parameters
    ----------
    bag : path-like
        A rosbag2 directory or a lone storage file.
    out_dir : path-like, optional
        Where the nodes' logs go (``log/``), and the recording if `record` is True. A temporary folder
        otherwise.
    parameters : PipelineParameters
        Parameters of all stages, as of the in-process pipeline.
    stage : str
        What to play: see the parameter of `bag_player`.
    namespace : str, optional
        Namespace of the bag's topics; found by itself if not given.
    rate : float
        Views: times the recorded speed; 0: as fast as the graph takes them.
    record : path-like or bool
        Record all topics into this bag; True: ``out_dir/recording``.
    composites : bool
        Make the composites too, where there are sub-aperture views.
    window : int
        Views that may be on their way at once.
    domain_id : int, optional
        ROS domain, to look on with other tools; a free one otherwise. No two replays share one.
    max_objects : int
        Bodies that are carved at most, the target among them; of shadow views and later stages one.
    overrides : mapping of node name to mapping, optional
        Further node parameters.
    progress : callable or bool
        Called with (views done, views in all); True: a bar on the terminal.
    notice : callable, optional
        Called with each line that a user should see, such as that a node died.
    max_restarts : int
        How often each node may die.
    stall_timeout_s : float
        Give up when nothing at all has changed for so long.
    beside : mapping of node name to mapping, optional
        Further nodes, with their parameters, that only look on: `viewer`.
    without : iterable of str
        Nodes of `REPLACEABLE` that are not started, as an outside node in this domain takes their place.

    Raises
    ------
    CsasError
        If the bag, a parameter or the image is not usable (as `pipeline.run` raises it), or the graph
        does not get to its end (`ReplayError`).
    """
    p = parameters or PipelineParameters()
    if domain_id is not None and (type(domain_id) is not int or not 0 <= domain_id <= MAX_DOMAIN_ID):
        raise ParameterError(f"domain_id is {domain_id!r}; expected a whole number from 0 to {MAX_DOMAIN_ID}")
    tell = notice or (lambda _: None)
    began = time.monotonic()
    with contextlib.ExitStack() as stack:
        out = stack.enter_context(_folder(out_dir))
        recording = None if record is False else out / "recording" if record is True else Path(record)
        chosen, decision = _plan(bag, stage, p, namespace)
        of_stage = node_parameters(p, None if decision is None else decision.target, max_objects)
        without = leave_out(without, chosen)
        composites = composites and "composites" not in without
        plan = _node_plan(bag, chosen, of_stage, rate, recording, composites, window, overrides or {})
        plan = {name: own for name, own in plan.items() if name not in without}
        plan["bag_player"]["bag_namespace"] = namespace or ""
        plan |= {name: dict(own) for name, own in (beside or {}).items()}
        check(plan)
        graph, watcher = stack.enter_context(_running(plan, domain_id, out / "log", max_restarts))
        done = stack.enter_context(_shown(progress))
        watcher.awaits([name for name in chain(chosen) if name in without], stall_timeout_s)
        _until_complete(graph, watcher, chosen, done, tell, stall_timeout_s)
        through = time.monotonic()
        messages = _collect(graph, watcher, chosen, done, tell, stall_timeout_s)
        if not watcher.alone():
            # Some outside node, or a process that has died; or a graph that has not been heard yet.
            watcher.spin(2.0 * BEAT_S)
            watcher.spin(0.0)
        result = _result_of(messages, watcher, graph, chosen)
        result.seconds_after = time.monotonic() - through
        result.recording = recording
        result.seconds = time.monotonic() - began
        if recording is not None:
            result.not_recorded = _finish_recording(recording, graph, watcher, result, set(messages))
    return result


def leave_out(names: Iterable[str], stage: str) -> frozenset[str]:
    """Return the nodes that a replay does not start.

    Parameters
    ----------
    names : iterable of str
        The nodes.
    stage : str
        What is played.

    Raises
    ------
    ParameterError
        If one is unknown, cannot be left out, or would not be started anyway.
    """
    left = frozenset(names)
    for name in sorted(left):
        if name not in _NODES:
            raise ParameterError(f"without is {name!r}; expected one of: {', '.join(REPLACEABLE)}")
        if why := _NODES[name].needed:
            raise ParameterError(
                f"a replay cannot do without {name}: {why}; expected one of: {', '.join(REPLACEABLE)}"
            )
        if not joins(name, stage):
            raise ParameterError(f"without is {name!r}, but {stage} views do not pass it; expected none such")
    return left


@contextlib.contextmanager
def _folder(out_dir: str | Path | None) -> Iterator[Path]:
    """Give the folder for logs and recording, made if need be; without one, a temporary one."""
    if out_dir is None:
        with tempfile.TemporaryDirectory(prefix="csas_replay_") as made:
            yield Path(made)
        return
    out = Path(out_dir)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(
            f"out_dir is {str(out)!r} ({error.strerror}); expected a folder that can be written to"
        ) from None
    yield out


@contextlib.contextmanager
def _running(
    plan: Mapping[str, Mapping[str, Any]], domain_id: int | None, logs: Path, max_restarts: int
) -> Iterator[tuple[Graph, _Watcher]]:
    """Start the nodes of a plan in a domain of their own, and what listens to them; end them afterwards."""
    graph_id = new_graph_id()
    with contextlib.ExitStack() as stack:
        domain = stack.enter_context(DomainReservation(domain_id))
        server = stack.enter_context(start_fork_server(domain, logs, graph_id))
        graph = stack.enter_context(Graph(plan, domain, logs, max_restarts, server, graph_id))
        with signals_deferred():
            watcher = _Watcher(graph, domain)
            stack.callback(watcher.close)
        yield graph, watcher


def _plan(
    bag: str | Path, stage: str, p: PipelineParameters, namespace: str | None = None
) -> tuple[str, Decision | None]:
    """Say what is played, and what is carved if no node can decide it."""
    from ..bags import BagReader, read_run
    from ..nodes.playing import stage_of_bag

    chosen = stage_of_bag(BagReader(bag, namespace), stage)
    if chosen in ("image", "sector"):
        return chosen, None
    from ..core.later_stages import check_method
    from ..from_bag import decision_of_views

    check_method(chosen, p)
    decision = decision_of_views(read_run(bag, namespace), chosen, p, 1)
    if decision.target is None:
        raise NoTargetError(f"there is no object in the {chosen} views of {bag}")
    return chosen, decision


def _node_plan(
    bag: str | Path,
    stage: str,
    of_stage: Mapping[str, dict[str, Any]],
    rate: float,
    recording: Path | None,
    composites: bool,
    window: int,
    overrides: Mapping[str, Mapping[str, Any]],
) -> dict[str, dict[str, Any]]:
    plan: dict[str, dict[str, Any]] = {name: of_stage.get(name, {}) for name in chain(stage)}
    if composites and joins("composites", stage):
        plan["composites"] = {}
    # Figure 8 compares the methods.
    plan["voxel_carver"] |= {"compare": stage not in ("likelihood", "shadow_mask")}
    if recording is not None:
        plan["bag_recorder"] = {"out": str(recording.resolve())}
    if rate == 0.0:
        # Flat out nobody looks at results that grow.
        for name in ("voxel_carver", "composites"):
            if name in plan:
                plan[name]["publish_hz"] = 0.0
    # The source waits for its sinks, or the first views are made twice.
    sinks = 1 + ("composites" in plan)
    flow: dict[str, Any] = {"window": window, "min_sinks": sinks}
    if stage in ("image", "sector"):
        plan["sub_aperture"] |= flow
        flow = {"window": window, "min_sinks": 1}
    plan["bag_player"] = {"bag": str(Path(bag).resolve()), "stage": stage, "rate": float(rate), **flow}
    if stage == "sector" and (rate == 0.0 or recording is not None):
        # Flat out a provisional target is of no use to anybody; and a recording holds one view of a stamp.
        plan["sub_aperture"]["first_search_deg"] = 360.0
    for name, own in overrides.items():
        if name not in NODES:
            raise ParameterError(f"unknown node {name!r}; expected one of: {', '.join(NODES)}")
        if name in plan:
            plan[name] = {**plan[name], **own}
    return plan


@contextlib.contextmanager
def _shown(progress: Callable[[int, int], None] | bool) -> Iterator[Callable[[int, int], None]]:
    if callable(progress):
        yield progress
        return
    if not progress:
        yield lambda *_: None
        return
    from tqdm import tqdm

    with tqdm(total=None, unit="view", desc="replay", dynamic_ncols=True) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def _until_complete(
    graph: Graph,
    watcher: _Watcher,
    stage: str,
    progress: Callable[[int, int], None],
    tell: Callable[[str], None],
    stall_timeout_s: float,
    told: int = 0,
) -> None:
    # What the result takes is loaded while the nodes are, one after the other: later they need every core.
    import trimesh  # noqa: F401

    from ..core.shape import mesh, threshold  # noqa: F401

    source = "sub_aperture" if stage in ("image", "sector") else stage
    sender = "sub_aperture" if stage in ("image", "sector") else "bag_player"
    finished = False
    state: object = None
    since = time.monotonic()
    while True:
        # Once all views are through, the result is all that is waited for.
        watcher.spin(0.02 if finished else 0.1)
        graph.watch()
        for line in graph.deaths[told:]:
            watcher.died(line.partition(" ")[0])
            tell(f"{line}; it is started again")
        told = len(graph.deaths)
        if watcher.errors:
            # What stops a node may be another graph, which it can have heard before this process has.
            watcher.spin(2 * BEAT_S)
            watcher.spin(0.0)
            raise _error_of(*next(iter(watcher.errors.items())))
        if not finished:  # then it has nothing left to do, and may have ended
            watcher.look_for_stages(tell)
        beat = watcher.beats.get((sender, source))
        if beat is not None and beat.counts.get("total"):
            progress(beat.counts["done"], beat.counts["total"])
        finished = beat is not None and bool(beat.counts.get("finished"))
        if beat is not None and finished and _sinks_complete(graph, watcher):
            progress(beat.counts["done"], beat.counts["total"])
            return
        changes = {key: _got_through(beat) for key, beat in watcher.beats.items()}
        # At a rate the next view's time may be far off: the player says so.
        paced = any(b.values.get("due_in_s") for b in watcher.beats.values())
        if changes != state or paced:
            state, since = changes, time.monotonic()
        elif time.monotonic() - since > stall_timeout_s:
            lines = [f"{name}: {process.last_line()}" for name, process in graph.processes.items()]
            raise ReplayError(
                f"nothing has happened for {stall_timeout_s:g} s; the nodes' last lines: {'; '.join(lines)}"
            )


def _got_through(beat: Heartbeat) -> tuple[str, int, int, int]:
    """Say what a node has done; views that are sent again, to somebody who hears none, are nothing."""
    counts = beat.counts
    first_time = counts.get("in", 0) - counts.get("duplicates", 0)
    return beat.instance, first_time, counts.get("done", 0), counts.get("views", 0)


def _sinks_complete(graph: Graph, watcher: _Watcher) -> bool:
    from ..nodes.playing import recorded_streams

    for name in ("voxel_carver", "composites"):
        if name not in graph.processes:
            continue
        beats = [b for (node, _), b in watcher.beats.items() if node == name]
        if not beats or not all(b.counts.get("complete") for b in beats):
            return False
    if "bag_recorder" not in graph.processes:
        return True
    return watcher.recorded(recorded_streams(_topics_recorded(graph)))


def _not_held(graph: Graph, watcher: _Watcher, stage: str, messages: set[str]) -> set[str]:
    """Return what the running recorder has yet to get of what is said once."""
    from ..nodes.playing import recorded_streams

    if "bag_recorder" not in graph.processes or watcher.unable("bag_recorder"):
        return set()
    if not recorded_streams(_topics_recorded(graph)):
        return set()  # without a stream it has no heartbeat
    beats = [beat for (node, _), beat in watcher.beats.items() if node == "bag_recorder"]
    held = {topic for beat in beats for topic in beat.values.get("holds", "").split()}
    return _said_once(stage, messages, _topics_recorded(graph)) - held


def _error_of(node: str, text: str) -> CsasError:
    """Make the error that a node named, of the kind that it had there."""
    kind, _, message = text.partition(": ")
    found = getattr(errors, kind, None)
    if isinstance(found, type) and issubclass(found, CsasError):
        return found(message)
    return ReplayError(f"{node}: {text}")


def _collect(
    graph: Graph,
    watcher: _Watcher,
    stage: str,
    progress: Callable[[int, int], None],
    tell: Callable[[str], None],
    stall_timeout_s: float,
) -> dict[str, Any]:
    """Take what the graph has published; a node that dies before is started again and publishes it again."""
    from msg_adapters.result import topics_of_result

    wanted = {"measurements", "objects"}
    if stage in ("image", "sector"):
        wanted |= {"search", "target"}
    if "composites" in graph.processes and _views_in(watcher, "composites"):
        wanted |= {f"{s}/{t}" for s in ("multilook", "color_by_aspect") for t in ("image", "camera_info")}
    dead = len(graph.deaths)
    since = time.monotonic()
    while True:
        watcher.collect(wanted)
        got = watcher.latest
        if wanted <= set(got):
            further = set(topics_of_result(got["measurements"]))
            if not further <= set(got):
                wanted |= further
                continue
            # A message may be on its way to the recorder for seconds, where the middleware lost a part of it.
            late = sorted(_not_held(graph, watcher, stage, wanted))
            if not late:
                return got
            if time.monotonic() - since > _COLLECT_S:
                tell(f"the recording holds nothing of {', '.join(late)}")
                return got
        watcher.spin(0.01)
        graph.watch()
        if len(graph.deaths) > dead:
            # What died takes what it had published with it: its successor works until it can say it again.
            _until_complete(graph, watcher, stage, progress, tell, stall_timeout_s, told=dead)
            dead, since = len(graph.deaths), time.monotonic()
        elif time.monotonic() - since > _COLLECT_S:
            missing = ", ".join(sorted(wanted - set(got)))
            raise ReplayError(f"the result did not come on {missing} in {_COLLECT_S:g} s")


def _views_in(watcher: _Watcher, node: str) -> int:
    told = [b.counts.get("views", 0) for (name, _), b in watcher.beats.items() if name == node]
    return max(told, default=0)


def _finish_recording(
    recording: Path, graph: Graph, watcher: _Watcher, result: ReplayResult, messages: set[str]
) -> list[str]:
    """End the graph, so that its bag is finished, and say what of the run the bag lacks."""
    published = watcher.published(_STAGES_BEFORE)
    unable = watcher.unable("bag_recorder")
    graph.stop()
    topics = _topics_recorded(graph)
    lacking = _not_recorded(recording, topics, result, published, messages)
    return [unable, *lacking] if unable else lacking


def _topics_recorded(graph: Graph) -> str:
    """Return the recorder's parameter."""
    return str(graph.parameters["bag_recorder"].get("topics", "all"))


def _said_once(stage: str, messages: set[str], topics: str) -> set[str]:
    """Return the latched topics that a recorder of these topics has to hold of a run."""
    from ..nodes.playing import topics_to_record

    inputs = {"image": {"image", "camera_info", "track"}, "sector": {"track"}}.get(stage, set())
    once = inputs | messages
    return once if topics == "all" else once & set(topics_to_record(topics))


def _not_recorded(
    recording: Path, topics: str, result: ReplayResult, published: Iterable[str], messages: set[str]
) -> list[str]:
    """Hold a recording against what was published; one line for each topic or stream that is not whole."""
    from ..bags import BagReader
    from ..nodes.playing import recorded_streams

    try:
        reader = BagReader(recording)
    except CsasError as error:
        return [str(error)]

    def count(topic: str) -> int:
        found = reader.topic(topic)
        return found.count if found is not None else 0

    once = _said_once(result.stage, messages, topics)
    lacking = [topic for topic in sorted(once) if not count(topic)]
    lines = [f"nothing of {', '.join(lacking)}"] if lacking else []
    kept = recorded_streams(topics)
    for name in published:
        if name not in kept:
            continue
        stages = _STAGES_BEFORE[name]
        # In the place of a node that was left out somebody else's may have refused it.
        replaced = not result.nodes.keys() >= set(stages)
        refused = {
            view.stamp_ns
            for view in result.rejected
            if view.node in stages or (replaced and view.node not in _NODES)
        }
        wanted = result.views_total - len(refused)
        held = min(count(f"{name}/image"), count(f"{name}/camera_info"))
        if held < wanted:
            lines.append(f"{held} of {wanted} {name} views")
    return lines


def _result_of(got: Mapping[str, Any], watcher: _Watcher, graph: Graph, stage: str) -> ReplayResult:
    """Put together what the graph has published."""
    from msg_adapters import ground_picture_from_msgs, result_from_msgs

    result = ReplayResult(stage, result_from_msgs(got))
    result.composed = _views_in(watcher, "composites")
    for (node, stream), beat in sorted(watcher.beats.items()):
        if node in graph.processes:
            restarts = graph.processes[node].restarts
            result.nodes[node] = NodeReport(beat.counts.get("busy_ms", 0) / 1e3, restarts, dict(beat.counts))
        if "total" in beat.counts and stream != "sector":
            result.views_total, result.lost = beat.counts["total"], beat.counts["lost"]
    result.rejected = watcher.refusals.listed(result.result.evidence)
    for name in ("multilook", "color_by_aspect"):
        if f"{name}/image" in got:
            ground, pixels = ground_picture_from_msgs(got[f"{name}/image"], got[f"{name}/camera_info"], name)
            result.composites[name], result.composites_grid = pixels, ground.grid
    return result
