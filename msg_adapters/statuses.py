"""diagnostic_msgs/DiagnosticArray as a list of named statuses, with numbers to the last digit.

A number travels as its shortest text that reads back as the same float (`repr`), ``nan`` included. Readers
pass over values and statuses that they do not know.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from csas_shadow_ros.core.errors import AdapterError, quoted
from csas_shadow_ros.core.shape.result import Detectable, LeftOut
from csas_shadow_ros.core.shape.volume import Target

from .messages import MessageFactory, check_type, frame_of, make_header, stamp_to_ns
from .progress import Level
from .topics import DIAGNOSTICS

if TYPE_CHECKING:
    from csas_shadow_ros.core.search.bodies import SignEvidence

Value = float | int | bool | str

RUN = "run"
LEFT_OUT = "left out"
_DETECTABLE = "detectable_"


def text_of(value: Value) -> str:
    """Write a value: truths as true and false, floats so that they read back the same."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    # Not repr() of what came: numpy's numbers write their type.
    return str(int(value)) if isinstance(value, int) else repr(float(value))


@dataclass(frozen=True)
class Status:
    """One status of an array.

    Parameters
    ----------
    name : str
        What it is about.
    values : mapping of str to str
        By their keys.
    message : str
        One line for a person.
    level : Level
        OK, WARN or ERROR.
    where : str
        The topic, for errors.
    """

    name: str
    values: Mapping[str, str]
    message: str = ""
    level: Level = Level.OK
    where: str = ""

    @classmethod
    def of(cls, name: str, values: Mapping[str, Value], message: str = "", level: Level = Level.OK) -> Status:
        """Make a status of numbers, truths and text."""
        return cls(name, {key: text_of(value) for key, value in values.items()}, message, level)

    def refuse(self, key: str, expected: str) -> AdapterError:
        """Return the error for an invalid value."""
        return AdapterError(f"{self._at(key)} is {quoted(self.values[key])}; expected {expected}")

    def _at(self, key: str) -> str:
        return f"{self.where}, status {quoted(self.name)}: {key}"

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def text(self, key: str, allowed: tuple[str, ...] = ()) -> str:
        """Read a text, optionally one of an allowed set.

        Raises
        ------
        AdapterError
            If it is missing or none of them.
        """
        if key not in self.values:
            raise AdapterError(f"{self._at(key)} is missing; expected it among the values")
        if allowed and self.values[key] not in allowed:
            raise self.refuse(key, f"one of: {', '.join(allowed)}")
        return self.values[key]

    def real(self, key: str, *, finite: bool = False) -> float:
        """Read a number; NaN means unknown.

        Raises
        ------
        AdapterError
            If it is missing, no number, or not finite where it must be.
        """
        text = self.text(key)
        try:
            value = float(text)
        except ValueError:
            raise self.refuse(key, "a number") from None
        if finite and not abs(value) < float("inf"):
            raise self.refuse(key, "a finite number")
        return value

    def reals(self, *keys: str, finite: bool = False) -> tuple[float, ...]:
        """Read several numbers."""
        return tuple(self.real(key, finite=finite) for key in keys)

    def whole(self, key: str, least: int = 0) -> int:
        """Read a whole number.

        Raises
        ------
        AdapterError
            If it is missing, no whole number, or under the least one.
        """
        text, expected = self.text(key), f"a whole number of at least {least}"
        try:
            value = int(text)
        except ValueError:
            raise self.refuse(key, expected) from None
        if value < least:
            raise self.refuse(key, expected)
        return value

    def truth(self, key: str) -> bool:
        """Read true or false.

        Raises
        ------
        AdapterError
            If it is missing or neither.
        """
        return self.text(key, ("true", "false")) == "true"


def statuses_to_msg(factory: MessageFactory, stamp_ns: int, statuses: Iterable[Status]) -> Any:
    """Make the DiagnosticArray of statuses.

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    stamp_ns : int
        Stamp, ns.
    statuses : iterable of Status
        In the order that they are to have.
    """
    pair, status = (factory.cls(f"diagnostic_msgs/msg/{kind}") for kind in ("KeyValue", "DiagnosticStatus"))
    return factory.make(
        DIAGNOSTICS,
        header=make_header(factory, stamp_ns),
        status=[
            status(
                level=factory.octet(int(one.level)),
                name=one.name,
                message=one.message,
                hardware_id="",
                values=[pair(key=key, value=value) for key, value in one.values.items()],
            )
            for one in statuses
        ],
    )


def statuses_from_msg(msg: Any, where: str) -> tuple[int, dict[str, Status]]:
    """Read a DiagnosticArray as statuses by name, in their order.

    Returns
    -------
    stamp_ns : int
    statuses : dict of Status

    Raises
    ------
    AdapterError
        If it is another type of message or in another frame, two statuses have one name, or a level is none.
    """
    check_type(msg, DIAGNOSTICS, where)
    frame_of(msg, where)
    found: dict[str, Status] = {}
    for i, one in enumerate(msg.status):
        code = one.level[0] if isinstance(one.level, bytes) else int(one.level)
        if code not in Level._value2member_map_:
            raise AdapterError(f"{where}.status[{i}].level is {code}; expected 0 to 3")
        if one.name in found:
            name = quoted(one.name)
            raise AdapterError(f"{where}.status[{i}].name is {name} again; expected one status a name")
        values = {v.key: v.value for v in one.values}
        found[one.name] = Status(one.name, values, one.message, Level(code), where)
    return stamp_to_ns(msg.header.stamp, f"{where}.header.stamp"), found


def run_of(statuses: Mapping[str, Status], where: str) -> Status:
    """Return the status of the run.

    Raises
    ------
    AdapterError
        If there is none.
    """
    if RUN not in statuses:
        names = ", ".join(map(repr, statuses)) or "none"
        raise AdapterError(f"{where}.status has {names}; expected one that is named {RUN!r}")
    return statuses[RUN]


def numbered(statuses: Mapping[str, Status], word: str) -> dict[int, Status]:
    """Return the statuses named ``<word> <number>`` by their numbers, from 1, in rising order."""
    pattern = re.compile(rf"{re.escape(word)} ([1-9]\d*)")
    found = {int(match[1]): one for name, one in statuses.items() if (match := pattern.fullmatch(name))}
    return dict(sorted(found.items()))


def target_values(target: Target, prefix: str = "") -> dict[str, Value]:
    """Return the values of a body of the search."""
    (x, y), (dx, dy, dz) = target.position_m, target.size_m
    values: dict[str, Value] = {"x_m": x, "y_m": y, "size_x_m": dx, "size_y_m": dy, "size_z_m": dz}
    values |= {"evidence": target.evidence, "stands": bool(target.stands)}
    return {prefix + key: value for key, value in values.items()}


def target_of(status: Status, prefix: str = "") -> Target:
    """Read a body of the search.

    Raises
    ------
    AdapterError
        If a value is missing or not what it must be.
    """
    x, y = status.reals(f"{prefix}x_m", f"{prefix}y_m", finite=True)
    sizes = [f"{prefix}size_{axis}_m" for axis in "xyz"]
    for key in sizes:
        if not status.real(key, finite=True) > 0:
            raise status.refuse(key, "more than 0 m")
    dx, dy, dz = status.reals(*sizes)
    return Target((x, y), (dx, dy, dz), status.real(f"{prefix}evidence"), status.truth(f"{prefix}stands"))


def sign_values(sign: SignEvidence | None) -> dict[str, Value]:
    """Return the values of the evidence for the spectrum sign; empty if it was not checked."""
    if sign is None:
        return {}
    return {
        "sign": int(sign.stated),
        "sign_evidence": sign.stated_evidence,
        "sign_other_evidence": sign.other_evidence,
        "sign_verdict": sign.verdict,
    }


def sign_of(status: Status) -> SignEvidence | None:
    """Read the evidence for the spectrum sign; None if it was not checked.

    Raises
    ------
    AdapterError
        If a value is missing or no number, or the sign is none.
    """
    if "sign" not in status:
        return None
    from csas_shadow_ros.core.search.bodies import (
        SignEvidence,  # late: half a second for all that it searches with
    )

    stated = int(status.text("sign", ("1", "-1")))
    return SignEvidence(stated, *status.reals("sign_evidence", "sign_other_evidence"))


def detectable_values(one: Detectable | None) -> dict[str, Value]:
    """Return the values of what a search that found nothing would have found; empty if it was not asked."""
    return {} if one is None else {f"{_DETECTABLE}{name}": value for name, value in asdict(one).items()}


def detectable_of(status: Status) -> Detectable | None:
    """Read what a search that found nothing would have found; None if it was not asked.

    Raises
    ------
    AdapterError
        If a value is missing or no number.
    """
    if f"{_DETECTABLE}size_m" not in status:
        return None
    size_m, height_m, contrast_db = (
        status.real(f"{_DETECTABLE}{name}", finite=True) for name in ("size_m", "height_m", "contrast_db")
    )
    found, places = (status.whole(f"{_DETECTABLE}{name}") for name in ("found", "places"))
    return Detectable(size_m, height_m, contrast_db, found, places)


def left_out_statuses(left_out: Iterable[LeftOut]) -> list[Status]:
    """Return a status for each body left out: its place, with the reason as message."""
    found = []
    for number, one in enumerate(left_out, start=1):
        values: dict[str, Value] = {"x_m": one.position_m[0], "y_m": one.position_m[1]}
        if one.strong:
            values["strong"] = True
        found.append(Status.of(f"{LEFT_OUT} {number}", values, message=one.reason))
    return found


def left_out_of(statuses: Mapping[str, Status]) -> tuple[LeftOut, ...]:
    """Read the bodies left out, in their order.

    Raises
    ------
    AdapterError
        If a place is missing or no number.
    """
    found = []
    for status in numbered(statuses, LEFT_OUT).values():
        x, y = status.reals("x_m", "y_m")
        strong = "strong" in status and status.truth("strong")
        found.append(LeftOut((x, y), status.message, strong))
    return tuple(found)
