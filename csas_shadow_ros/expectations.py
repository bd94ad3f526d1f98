"""What a run is expected to find: a file of values and tolerances, held against its report.

For continuous integration: `csas-shadow replay BAG --expect expect.yaml --junit report.xml`
(``docs/replay_in_ci.md``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from .core.errors import ParameterError

Report = Mapping[str, Any]


def _views(name: str) -> Callable[[Report], Any]:
    return lambda report: report["views"][name]


def _scores(name: str) -> Callable[[Report], Any]:
    return lambda report: ((report["truth"] or {}).get("scores") or {}).get(name)


#: Values of a run, by the names that a file gives them.
OF_RUN: dict[str, Callable[[Report], Any]] = {
    "verdict": lambda report: report["verdict"],
    "quality": lambda report: report["quality"]["verdict"],
    "objects": lambda report: len(report["objects"]),
    "views_in": _views("in"),
    "views_used": _views("used"),
    "views_rejected": _views("rejected"),
    "views_lost": _views("lost"),
    "arc_deg": lambda report: report["arc_deg"],
    "iou_truth": _scores("iou_truth"),
    "iou_hull": _scores("iou_hull"),
    "seconds": lambda report: sum(v for v in report["timings_s"].values() if v is not None),
}


def _dimension(name: str) -> Callable[[Report], Any]:
    return lambda entry: entry["dimensions"][name]


def _place(name: str) -> Callable[[Report], Any]:
    return lambda entry: (entry.get("place") or {}).get(name)


#: Values of one object: of the target by their bare names, of others under ``object_2`` and so on.
OF_OBJECT: dict[str, Callable[[Report], Any]] = {
    **{name: _dimension(name) for name in ("length_m", "width_m", "height_m", "volume_m3", "heading_deg")},
    "x_m": lambda entry: entry["dimensions"]["position_m"][0],
    "y_m": lambda entry: entry["dimensions"]["position_m"][1],
    **{name: _place(name) for name in ("latitude_deg", "longitude_deg", "bearing_deg")},
}
#: Directions of a length, which has no front: a half turn changes nothing.
_HALF_TURN = ("heading_deg", "bearing_deg")
_PREFIX = "object_"


@dataclass(frozen=True)
class Expectation:
    """One value that is expected.

    Parameters
    ----------
    name : str
        Of the value: one of `OF_RUN` or `OF_OBJECT`.
    number : int
        Of the object; 0: a value of the run.
    allowed : tuple
        Values that it may have; empty: any within the bounds.
    low, high : float
        Bounds.
    """

    name: str
    number: int = 0
    allowed: tuple[Any, ...] = ()
    low: float = -math.inf
    high: float = math.inf

    def __str__(self) -> str:
        return self.name if self.number < 2 else f"{_PREFIX}{self.number}.{self.name}"

    @property
    def expected(self) -> str:
        """What is expected, in words."""
        if self.allowed:
            return " or ".join(map(repr, self.allowed))
        if math.isinf(self.low):
            return f"at most {self.high:g}"
        return f"at least {self.low:g}" if math.isinf(self.high) else f"{self.low:g} to {self.high:g}"

    def fault(self, report: Report) -> str:
        """Say what is wrong with the value in a report; empty if it is as expected."""
        value = self._value(report)
        if value is None:
            return f"{self} is not known; expected {self.expected}"
        if self.allowed:
            met = value in self.allowed
        elif self.name in _HALF_TURN:
            # Nearest to the middle of the bounds, whichever way round it was measured.
            middle = (self.low + self.high) / 2.0
            turned = middle + math.remainder(float(value) - middle, 180.0) if math.isfinite(middle) else value
            met = self.low <= turned <= self.high
        else:
            met = self.low <= float(value) <= self.high
        shown = value if isinstance(value, str) else f"{value:.10g}"
        return "" if met else f"{self} is {shown}; expected {self.expected}"

    def _value(self, report: Report) -> Any:
        if not self.number:
            return OF_RUN[self.name](report)
        for entry in report["objects"]:
            if entry["number"] == self.number:
                return OF_OBJECT[self.name](entry)
        return None


def read_expectations(path: str | Path) -> tuple[Expectation, ...]:
    r"""Read what is expected from a YAML file.

    Parameters
    ----------
    path : path-like
        A mapping of names (`OF_RUN`, `OF_OBJECT`) to a value, a list of allowed values, or a mapping with
        ``is`` and ``within``, or ``min`` and ``max``. ``object_2`` and so on hold such mappings of further
        objects.

    Returns
    -------
    tuple of Expectation

    Raises
    ------
    ParameterError
        If it cannot be read, is empty, or a name or a value is none that there is.

    Examples
    --------
    >>> import pathlib
    >>> _ = pathlib.Path("expect.yaml").write_text("verdict: object\\nlength_m: {is: 0.8, within: 0.05}\\n")
    >>> [f"{one}: {one.expected}" for one in read_expectations("expect.yaml")]
    ["verdict: 'object'", 'length_m: 0.75 to 0.85']
    """
    try:
        document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ParameterError(f"file of expectations {str(path)!r} cannot be read: {reason}") from error
    if not isinstance(document, dict) or not document:
        raise ParameterError(f"{path} is not a mapping of names to expected values")
    found = []
    for name, value in document.items():
        prefix, _, digits = str(name).rpartition("_")
        if f"{prefix}_" == _PREFIX and digits.isdecimal():
            if not isinstance(value, dict) or not 1 <= int(digits) <= 64:
                raise ParameterError(f"{path}: {name} is {value!r}; expected names and values of that object")
            found += [_expectation(path, str(key), one, int(digits)) for key, one in value.items()]
        else:
            found.append(_expectation(path, str(name), value, 0 if name in OF_RUN else 1))
    return tuple(found)


def _expectation(path: str | Path, name: str, value: Any, number: int) -> Expectation:
    if name not in (OF_OBJECT if number else OF_RUN):
        known = ", ".join(OF_OBJECT if number > 1 else (*OF_RUN, *OF_OBJECT, "object_2"))
        raise ParameterError(f"{path}: there is no value {name!r}; expected one of: {known}")
    if not isinstance(value, dict):
        allowed = tuple(value) if isinstance(value, list) else (value,)
        if not allowed or not all(isinstance(one, str | int | float) for one in allowed):
            raise ParameterError(f"{path}: {name} is {value!r}; expected a value, a list of them, or bounds")
        words = _words(name)
        for one in allowed:
            if one not in words if words else isinstance(one, str):
                expected = f"one of: {', '.join(words)}" if words else "a number"
                raise ParameterError(f"{path}: {name} is {one!r}; expected {expected}")
        return Expectation(name, number, allowed)
    keys = set(value)
    numbers = all(isinstance(v, int | float) and math.isfinite(v) for v in value.values())
    if not numbers or not (keys == {"is", "within"} or (keys and keys <= {"min", "max"})):
        raise ParameterError(
            f"{path}: {name} is {value!r}; expected numbers named is and within, or min and max"
        )
    if keys == {"is", "within"}:
        low, high = value["is"] - value["within"], value["is"] + value["within"]
    else:
        low, high = value.get("min", -math.inf), value.get("max", math.inf)
    if low > high:
        raise ParameterError(f"{path}: {name} is {value!r}, which no value can be")
    return Expectation(name, number, low=low, high=high)


def _words(name: str) -> tuple[str, ...]:
    """Return the words that a value can be; empty if it is a number."""
    from .core.shape.result import QUALITIES, VERDICTS

    return {"verdict": VERDICTS, "quality": QUALITIES}.get(name, ())


@dataclass(frozen=True)
class Checked:
    """What became of one run's expectations.

    Parameters
    ----------
    name : str
        What was run.
    faults : mapping of str to str
        By each expectation, what is wrong; empty if it is met.
    seconds : float
        How long the run took.
    error : str
        Why there is no result; empty if there is one.
    """

    name: str
    faults: Mapping[str, str]
    seconds: float = 0.0
    error: str = ""

    @property
    def unmet(self) -> list[str]:
        """What is wrong, one line each."""
        return [fault for fault in self.faults.values() if fault]


def check_report(name: str, report: Report, expectations: Sequence[Expectation]) -> Checked:
    """Hold a report against what is expected."""
    seconds = OF_RUN["seconds"](report)
    return Checked(name, {str(one): one.fault(report) for one in expectations}, seconds)


def write_junit(path: str | Path, runs: Sequence[Checked]) -> None:
    """Write JUnit XML: a suite a run, a case an expectation.

    Parameters
    ----------
    path : path-like
        The file; its folder is made if need be.
    runs : sequence of Checked
        What was run.
    """
    root = ElementTree.Element("testsuites")
    for run in runs:
        failures = len(run.unmet)
        suite = ElementTree.SubElement(
            root,
            "testsuite",
            name=run.name,
            tests=str(len(run.faults) + 1),
            failures=str(failures),
            errors=str(int(bool(run.error))),
            skipped="0",
            time=f"{run.seconds:.3f}",
        )
        case = ElementTree.SubElement(
            suite, "testcase", classname=run.name, name="run", time=f"{run.seconds:.3f}"
        )
        if run.error:
            ElementTree.SubElement(case, "error", message=_legal(run.error))
        for name, fault in run.faults.items():
            case = ElementTree.SubElement(suite, "testcase", classname=run.name, name=name, time="0")
            if fault:
                ElementTree.SubElement(case, "failure", message=_legal(fault))
    ElementTree.indent(root)
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def _legal(text: str) -> str:
    """Leave out what XML cannot hold: control characters, of a path for instance."""
    return "".join(c if c.isprintable() or c == " " else "?" for c in text)
