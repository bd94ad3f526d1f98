"""diagnostic_msgs/DiagnosticArray to and from what is to be carved: topic `search`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from csas_shadow_ros.core.errors import AdapterError
from csas_shadow_ros.core.search.decision import Decision
from csas_shadow_ros.core.shape.result import LeftOut
from csas_shadow_ros.core.target import SignEvidence
from csas_shadow_ros.core.volume import Target

from .messages import MessageFactory
from .values import Status, numbered, statuses_from_msg, statuses_to_msg, value_texts


@dataclass(frozen=True)
class SearchMessage:
    """What topic `search` says.

    Parameters
    ----------
    decision : Decision
        What is to be carved.
    run_ns : int or None
        The run's name: the stamp of its track's first pose.
    target_stamp_ns : int
        Stamp of the `target` marker that goes with it.
    may_move : bool
        The run is still going on: another decision may follow, and replaces this one.
    """

    decision: Decision
    run_ns: int | None
    target_stamp_ns: int
    may_move: bool


def target_values(target: Target, prefix: str = "") -> dict[str, Any]:
    """Return the values that tell a body's volume."""
    names = ("x_m", "y_m", "size_x_m", "size_y_m", "size_z_m")
    numbers = (*target.position_m, *target.size_m)
    own: dict[str, Any] = {name: float(value) for name, value in zip(names, numbers, strict=True)}
    own |= {"evidence": float(target.evidence), "stands": bool(target.stands)}
    return {f"{prefix}{name}": value for name, value in own.items()}


def target_of_values(status: Status, prefix: str = "") -> Target:
    """Read what `target_values` wrote.

    Raises
    ------
    AdapterError
        If a value is missing or a size is not positive.
    """
    x, y, *size = (
        status.number(f"{prefix}{name}") for name in ("x_m", "y_m", "size_x_m", "size_y_m", "size_z_m")
    )
    if not min(size) > 0:
        raise AdapterError(
            f"{status.where} status {status.name!r}: size is {tuple(size)}; expected x, y, z > 0 m"
        )
    stands = status.values.get(f"{prefix}stands", "true") == "true"
    evidence = status.number(f"{prefix}evidence", float("nan"))
    return Target((x, y), (size[0], size[1], size[2]), evidence, stands)


def sign_values(sign: SignEvidence | None) -> dict[str, Any]:
    """Return the values that tell how the spectrum's sign fits."""
    if sign is None:
        return {}
    return {
        "spectrum_sign": sign.stated,
        "spectrum_sign.verdict": sign.verdict,
        "spectrum_sign.stated_evidence": float(sign.stated_evidence),
        "spectrum_sign.other_evidence": float(sign.other_evidence),
    }


def sign_of_values(status: Status) -> SignEvidence | None:
    """Read what `sign_values` wrote."""
    if "spectrum_sign" not in status.values:
        return None
    return SignEvidence(
        status.whole("spectrum_sign"),
        status.number("spectrum_sign.stated_evidence"),
        status.number("spectrum_sign.other_evidence"),
    )


def left_out_statuses(left_out: Any) -> list[Status]:
    """Return a status for each body that is no object, or is not carved."""
    return [
        Status(
            f"left out {number}",
            one.reason,
            value_texts({"x_m": float(one.position_m[0]), "y_m": float(one.position_m[1])}),
        )
        for number, one in enumerate(left_out, start=1)
    ]


def left_out_of(statuses: dict[str, Status]) -> list[LeftOut]:
    """Read what `left_out_statuses` wrote."""
    return [
        LeftOut((one.number("x_m"), one.number("y_m")), one.message) for one in numbered(statuses, "left out")
    ]


def decision_to_msg(
    factory: MessageFactory,
    decision: Decision,
    stamp_ns: int,
    run_ns: int | None,
    target_stamp_ns: int,
    *,
    may_move: bool = False,
) -> Any:
    """Make the message of topic `search`.

    Parameters
    ----------
    factory : MessageFactory
        Makes the message.
    decision : Decision
        What is to be carved.
    stamp_ns : int
        Stamp.
    run_ns, target_stamp_ns, may_move
        See `SearchMessage`.
    """
    bodies = [] if decision.target is None else [decision.target, *decision.others]
    found = f"{len(bodies)} to carve, {len(decision.left_out)} left out" if bodies else "no object"
    run = {"run": run_ns, "target": target_stamp_ns, "may_move": may_move, **sign_values(decision.sign)}
    statuses = [Status("run", found, value_texts(run))]
    statuses += [
        Status(f"body {number}", "to be carved", value_texts(target_values(body)))
        for number, body in enumerate(bodies, start=1)
    ]
    return statuses_to_msg(factory, stamp_ns, [*statuses, *left_out_statuses(decision.left_out)])


def decision_from_msg(msg: Any) -> SearchMessage:
    """Read the message of topic `search`.

    Raises
    ------
    AdapterError
        If a status or a value is missing or wrong.
    """
    statuses = statuses_from_msg(msg, "search")
    run = statuses.get("run")
    if run is None:
        raise AdapterError(f"search has statuses {sorted(statuses)}; expected one named 'run'")
    bodies = [target_of_values(one) for one in numbered(statuses, "body")]
    decision = Decision(
        bodies[0] if bodies else None, tuple(bodies[1:]), tuple(left_out_of(statuses)), sign_of_values(run)
    )
    name = run.whole("run", 0) if "run" in run.values else None
    return SearchMessage(decision, name, run.whole("target"), run.values.get("may_move") == "true")
