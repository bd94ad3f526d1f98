"""Values of a DiagnosticStatus: numbers to the last digit, and errors that name what is wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from csas_shadow_ros.core.errors import AdapterError

from .messages import MessageFactory, check_type, make_header
from .progress import Level
from .topics import DIAGNOSTICS


@dataclass(frozen=True)
class Status:
    """One status of an array: a name, a line to read, and values by name.

    Parameters
    ----------
    name, message : str
        What it is of, and a line for people.
    values : mapping of str to str
        Numbers as Python writes them, so that they come back to the last digit.
    level : Level
        OK, WARN or ERROR.
    where : str
        Topic, for errors.
    """

    name: str
    message: str
    values: Mapping[str, str]
    level: Level = Level.OK
    where: str = ""

    def number(self, key: str, default: float | None = None) -> float:
        """Read a number.

        Raises
        ------
        AdapterError
            If it is not there (and there is no default) or is none.
        """
        text = self.values.get(key)
        if text is None and default is not None:
            return default
        try:
            return float(text)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            raise AdapterError(
                f"{self.where} status {self.name!r}: {key} is {text!r}; expected a number"
            ) from None

    def whole(self, key: str, default: int | None = None) -> int:
        """Read a whole number, however large; errors are those of `number`."""
        text = self.values.get(key)
        if text is None and default is not None:
            return default
        try:
            return int(text)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            raise AdapterError(
                f"{self.where} status {self.name!r}: {key} is {text!r}; expected a whole number"
            ) from None

    def text(self, key: str, allowed: Sequence[str]) -> str:
        """Read one of several words.

        Raises
        ------
        AdapterError
            If it is none of them.
        """
        text = self.values.get(key, "")
        if text not in allowed:
            raise AdapterError(
                f"{self.where} status {self.name!r}: {key} is {text!r}; expected one of: {', '.join(allowed)}"
            )
        return text


def value_texts(values: Mapping[str, Any]) -> dict[str, str]:
    """Write values: floats to their last digit, ``true`` and ``false``; what is None is left out."""
    return {
        name: ("true" if value else "false") if isinstance(value, bool) else _written(value)
        for name, value in values.items()
        if value is not None
    }


def _written(value: Any) -> str:
    return repr(float(value)) if isinstance(value, float) else str(value)


def statuses_to_msg(factory: MessageFactory, stamp_ns: int, statuses: Sequence[Status]) -> Any:
    """Make a DiagnosticArray."""
    made = [
        factory.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=factory.octet(int(one.level)),
            name=one.name,
            message=one.message,
            hardware_id="",
            values=[
                factory.make("diagnostic_msgs/msg/KeyValue", key=k, value=v) for k, v in one.values.items()
            ],
        )
        for one in statuses
    ]
    return factory.make(DIAGNOSTICS, header=make_header(factory, stamp_ns), status=made)


def statuses_from_msg(msg: Any, where: str) -> dict[str, Status]:
    """Read a DiagnosticArray: its statuses by name.

    Raises
    ------
    AdapterError
        If it is none, or two statuses have one name.
    """
    check_type(msg, DIAGNOSTICS, where)
    found: dict[str, Status] = {}
    for number, status in enumerate(msg.status):
        if status.name in found:
            raise AdapterError(f"{where}.status[{number}].name is {status.name!r} again; expected each once")
        code = status.level[0] if isinstance(status.level, bytes) else int(status.level)
        level = Level(code) if code in Level._value2member_map_ else Level.STALE
        found[status.name] = Status(
            status.name, status.message, {v.key: v.value for v in status.values}, level, where
        )
    return found


def numbered(statuses: Mapping[str, Status], kind: str) -> list[Status]:
    """Return the statuses ``kind 1``, ``kind 2``, … in their order.

    Raises
    ------
    AdapterError
        If a number is missing.
    """
    own = {name: one for name, one in statuses.items() if name.rpartition(" ")[0] == kind}
    ordered = []
    for number in range(1, len(own) + 1):
        if f"{kind} {number}" not in own:
            where = next(iter(own.values())).where
            raise AdapterError(f"{where} holds {', '.join(sorted(own))}; expected {kind} 1 to {len(own)}")
        ordered.append(own[f"{kind} {number}"])
    return ordered


def finite(value: float) -> float | None:
    """Return a number that is one, None otherwise."""
    return value if math.isfinite(value) else None
