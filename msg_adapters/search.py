"""diagnostic_msgs/DiagnosticArray to and from the decision what to carve."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from .messages import MessageFactory, frame_of
from .statuses import (
    RUN,
    Status,
    Value,
    detectable_of,
    detectable_values,
    left_out_of,
    left_out_statuses,
    numbered,
    run_of,
    sign_of,
    sign_values,
    statuses_from_msg,
    statuses_to_msg,
    target_of,
    target_values,
)

if TYPE_CHECKING:
    from csas_shadow_ros.core.search.decision import Decision

_WHERE = "search"
_BODY = "body"


@dataclass(frozen=True)
class SearchNews:
    """A decision, and its run and target.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the message, ns.
    decision : Decision
        What is to be carved.
    run_ns : int or None
        The run's name: the stamp of its track's first pose; None where there is no track.
    target_stamp_ns : int
        Stamp of the marker on `target` that says the same.
    may_move : bool
        The run is still going on: another decision may follow, and replaces this one.
    """

    stamp_ns: int
    decision: Decision
    run_ns: int | None
    target_stamp_ns: int
    may_move: bool = False


def decision_to_msg(
    factory: MessageFactory,
    decision: Decision,
    stamp_ns: int,
    run_ns: int | None,
    target_stamp_ns: int,
    may_move: bool = False,
) -> Any:
    """Make the DiagnosticArray of a decision: one status for the run, each body and each one left out.

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    decision : Decision
        What is to be carved.
    stamp_ns : int
        Stamp, ns.
    run_ns, target_stamp_ns, may_move
        See `SearchNews`.

    Raises
    ------
    AdapterError
        If the stamp is no ROS time.
    """
    values: dict[str, Value] = {} if run_ns is None else {"run": int(run_ns)}
    values |= {"target": int(target_stamp_ns), "may_move": bool(may_move)} | sign_values(decision.sign)
    values |= detectable_values(decision.detectable) | {"others_step_rad": decision.others_step_rad}
    # The target is body 1; where there is none, that number stays free.
    bodies = dict(enumerate(decision.others, start=2))
    if decision.target is not None:
        bodies = {1: decision.target} | bodies
    said = f"{len(bodies)} to carve, {len(decision.left_out)} left out"
    statuses = [Status.of(RUN, values, said)]
    statuses += [Status.of(f"{_BODY} {number}", target_values(body)) for number, body in bodies.items()]
    if decision.frame is not None:
        factory = factory.in_frame(decision.frame)
    return statuses_to_msg(factory, stamp_ns, [*statuses, *left_out_statuses(decision.left_out)])


def decision_from_msg(msg: Any) -> SearchNews:
    """Read a decision, to the last digit.

    Raises
    ------
    AdapterError
        Naming the status and the value that are missing or not what they must be.
    """
    from csas_shadow_ros.core.search.decision import Decision  # late, as in sign_of

    stamp_ns, statuses = statuses_from_msg(msg, _WHERE)
    run = run_of(statuses, _WHERE)
    bodies = {number: target_of(status) for number, status in numbered(statuses, _BODY).items()}
    target = bodies.pop(1, None)
    frame = frame_of(msg, _WHERE)
    told = left_out_of(statuses), sign_of(run), frame, detectable_of(run)
    step = run.real("others_step_rad", finite=True) if "others_step_rad" in run else 0.0
    decision = Decision(target, tuple(bodies.values()), *told, others_step_rad=step)
    run_ns = run.whole("run") if "run" in run else None
    return SearchNews(stamp_ns, decision, run_ns, run.whole("target"), run.truth("may_move"))
