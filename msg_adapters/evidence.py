"""diagnostic_msgs/DiagnosticArray to and from the contribution of each view."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from csas_shadow_ros.core.errors import MAX_STAMP_NS, AdapterError, quoted
from csas_shadow_ros.core.shape.result import ViewEvidence

from .messages import MessageFactory
from .statuses import Status, Value, statuses_from_msg, statuses_to_msg

_WHERE = "evidence"


def evidence_to_msg(factory: MessageFactory, evidence: Mapping[int, ViewEvidence], stamp_ns: int) -> Any:
    """Make the DiagnosticArray of each view's contribution: one status per view, named by its stamp (ns).

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    evidence : mapping of int to ViewEvidence
        By stamp.
    stamp_ns : int
        Stamp of the newest view, ns.
    """
    return statuses_to_msg(factory, stamp_ns, [_status(one) for one in evidence.values()])


def _status(one: ViewEvidence) -> Status:
    values: dict[str, Value] = {
        "aspect_deg": math.degrees(one.aspect_rad),
        "aspect_rad": one.aspect_rad,
        "sonar_x_m": one.sonar_m[0],
        "sonar_y_m": one.sonar_m[1],
        "sonar_z_m": one.sonar_m[2],
        "sigma_r": one.seabed_level,
        "contrast": one.contrast,
        "estimated": bool(one.levels_estimated),
        "height_m": one.height_m,
        "unexplained": one.unexplained,
        "lit": one.lit,
        "shift_m": one.shift_m,
    }
    return Status.of(str(int(one.stamp_ns)), values)


def evidence_from_msg(msg: Any) -> dict[int, ViewEvidence]:
    """Read each view's contribution, by stamp, to the last digit.

    Raises
    ------
    AdapterError
        If a status is not named by a stamp, or naming the value that is missing or not what it must be.
    """
    _, statuses = statuses_from_msg(msg, _WHERE)
    found = {}
    for name, status in statuses.items():
        if not (name.isascii() and name.isdecimal() and len(name) < 20 and int(name) <= MAX_STAMP_NS):
            raise AdapterError(f"{_WHERE} has a status named {quoted(name)}; expected a view's stamp in ns")
        x, y, z = status.reals("sonar_x_m", "sonar_y_m", "sonar_z_m", finite=True)
        found[int(name)] = ViewEvidence(
            stamp_ns=int(name),
            aspect_rad=status.real("aspect_rad", finite=True),
            sonar_m=(x, y, z),
            seabed_level=status.real("sigma_r"),
            contrast=status.real("contrast"),
            levels_estimated=status.truth("estimated"),
            height_m=status.real("height_m"),
            unexplained=status.real("unexplained") if "unexplained" in status else math.nan,
            lit=status.real("lit") if "lit" in status else math.nan,
            shift_m=status.real("shift_m", finite=True) if "shift_m" in status else 0.0,
        )
    return found
