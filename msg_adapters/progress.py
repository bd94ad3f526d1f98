"""diagnostic_msgs/DiagnosticArray to and from the fate of a view, and heartbeats."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from csas_shadow_ros.core.errors import MAX_QUOTED, AdapterError, quoted

from .messages import MessageFactory, check_type, make_header, stamp_to_ns
from .topics import DIAGNOSTICS

HEARTBEAT = "heartbeat"
INTEGRATED = "integrated"
PUBLISHED = "published"
REJECTED = "rejected"
ROLES = ("source", "stage", "sink")
#: Environment variable that names the graph a node belongs to, and what begins the instances of such nodes.
GRAPH_ID = "CSAS_GRAPH_ID"
_OF_GRAPH = "graph:"
_NEWS = (HEARTBEAT.encode(), REJECTED.encode())


class Level(IntEnum):
    """Levels of a DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class ViewProgress:
    """What a node did with one view.

    Parameters
    ----------
    stamp_ns : int
        The view's stamp.
    node : str
        The node's name.
    instance : str
        Identifies the running process, so that a restart is told from a repetition.
    outcome : str
        `integrated`, `published` or `rejected`.
    reason : str
        Why it was rejected; empty otherwise.
    level : Level
        OK; WARN or ERROR for a rejected view.
    values : mapping of str to str
        Anything else worth telling.
    """

    stamp_ns: int
    node: str
    instance: str
    outcome: str
    reason: str = ""
    level: Level = Level.OK
    values: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.outcome not in (INTEGRATED, PUBLISHED, REJECTED):
            expected = f"{INTEGRATED}, {PUBLISHED} or {REJECTED}"
            raise AdapterError(f"outcome is {quoted(self.outcome)}; expected {expected}")
        if (self.outcome == REJECTED) != bool(self.reason):
            raise AdapterError(
                f"reason of a view {self.outcome} is {quoted(self.reason)}; expected one just if rejected"
            )

    @classmethod
    def rejected(
        cls, stamp_ns: int, node: str, instance: str, reason: str, level: Level = Level.WARN
    ) -> ViewProgress:
        """State that a view was refused, and why."""
        return cls(stamp_ns, node, instance, REJECTED, reason, level)


@dataclass(frozen=True)
class Heartbeat:
    """A node's sign of life.

    Parameters
    ----------
    stamp_ns : int
        When it was sent.
    node : str
        The node's name.
    instance : str
        Identifies the running process.
    role : str
        `source` (makes views), `stage` (passes them on) or `sink` (consumes them).
    counts : mapping of str to int
        Views in, out, rejected, ...
    values : mapping of str to str
        Anything else worth telling, such as what the node takes.
    """

    stamp_ns: int
    node: str
    instance: str
    role: str
    counts: Mapping[str, int] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.role not in ROLES:
            raise AdapterError(f"role is {quoted(self.role)}; expected one of: {', '.join(ROLES)}")


def instance_of(graph_id: str, process: str) -> str:
    """Return the identity (``hardware_id``) of a process; without a graph it is the process' own.

    Examples
    --------
    >>> instance_of("5eaf100d", "a1"), instance_of("", "a1")
    ('graph:5eaf100d:a1', 'a1')
    """
    return f"{_OF_GRAPH}{graph_id}:{process}" if graph_id else process


def graph_of(instance: str) -> str:
    """Return the graph in a process' identity; empty if none, as for an outside node.

    Examples
    --------
    >>> graph_of("graph:5eaf100d:a1-source"), graph_of("classifier-1")
    ('5eaf100d', '')
    """
    return instance.split(":", 2)[1] if instance.startswith(_OF_GRAPH) else ""


def progress_to_msg(factory: MessageFactory, item: ViewProgress | Heartbeat) -> Any:
    """Make the DiagnosticArray (one status) of a view's progress or a heartbeat."""
    if isinstance(item, Heartbeat):
        level, message = Level.OK, HEARTBEAT
        counts = {f"count.{k}": str(int(v)) for k, v in item.counts.items()}
        values = {"role": item.role} | counts | dict(item.values)
    else:
        level = item.level
        message = f"{REJECTED}: {item.reason}" if item.outcome == REJECTED else item.outcome
        values = dict(item.values)
    return diagnostics_to_msg(factory, item.stamp_ns, item.node, item.instance, level, message, values)


def diagnostics_to_msg(
    factory: MessageFactory,
    stamp_ns: int,
    node: str,
    instance: str,
    level: Level,
    message: str,
    values: Mapping[str, str],
) -> Any:
    """Make a DiagnosticArray with one status, also for `/diagnostics`."""
    pairs = [factory.make("diagnostic_msgs/msg/KeyValue", key=k, value=str(v)) for k, v in values.items()]
    status = factory.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=factory.octet(int(level)),
        name=node,
        message=message,
        hardware_id=instance,
        values=pairs,
    )
    return factory.make(DIAGNOSTICS, header=make_header(factory, stamp_ns), status=[status])


def is_routine_report(cdr: bytes) -> bool:
    """Say whether a serialised message of topic `progress` can only report success.

    Whoever follows heartbeats and refusals alone need not read it; a False says nothing.
    """
    return not any(word in cdr for word in _NEWS)


def progress_from_msg(msg: Any) -> ViewProgress | Heartbeat:
    """Read a view's progress or a heartbeat.

    Raises
    ------
    AdapterError
        If the array holds not exactly one status, or one that is neither.
    """
    where = "progress"
    check_type(msg, DIAGNOSTICS, where)
    if len(msg.status) != 1:
        raise AdapterError(f"{where}.status has {len(msg.status)} entries; expected 1")
    status = msg.status[0]
    stamp = stamp_to_ns(msg.header.stamp, f"{where}.header.stamp")
    code = status.level[0] if isinstance(status.level, bytes) else int(status.level)
    if code not in Level._value2member_map_:
        raise AdapterError(f"{where}.status[0].level is {code}; expected 0 to 3")
    values = {v.key: v.value for v in status.values}
    if status.message == HEARTBEAT:
        counts = {}
        for key, value in values.items():
            if not key.startswith("count."):
                continue
            try:
                counts[key.removeprefix("count.")] = int(value)
            except ValueError:
                raise AdapterError(
                    f"{where}.status[0].values: {key[:MAX_QUOTED]} is {quoted(value)}; expected a count"
                ) from None
        others = {k: v for k, v in values.items() if k != "role" and not k.startswith("count.")}
        return Heartbeat(stamp, status.name, status.hardware_id, values.get("role", ""), counts, others)
    outcome, _, reason = status.message.partition(": ")
    return ViewProgress(stamp, status.name, status.hardware_id, outcome, reason, Level(code), values)
